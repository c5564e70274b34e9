"""HEIC and AVIF photographs, with the depth and matte of an iPhone, by pi-heif, which is an optional package."""

import contextlib
import struct
import tempfile
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .decode import Part, check_size, first_line, read_parts
from .metadata import Metadata, upright
from .portraits import Embedded, by_inverse

_MATTE = "portraiteffectsmatte"  # in the name of the type of an auxiliary image
_CURVES = {16: "PQ", 18: "HLG"}  # transfer characteristics that are not those of a display
_DISPARITY, _INVERSE_Z, _Z = 1, 0, 2  # kinds of depth in the file's own numbers


def read_heif(path: Path) -> Part:
    """The photograph of a HEIC or AVIF file, upright.

    Raises:
        OSError: If the file is damaged.
        ValueError: If it is too large, or its transfer curve is PQ or HLG.
    """
    with path.open("rb") as stream:
        if stream.read(12)[8:] in (b"avif", b"avis"):
            return _read_avif(path)
    with _opened(path) as file:
        info, (width, height) = file.info, file.size
        curve = _CURVES.get((info.get("nclx_profile") or {}).get("transfer_characteristics", 0))
        if curve and "icc_profile" not in info:
            raise ValueError(f"its light is encoded as {curve}, which is not read; export it as JPEG or 16-bit TIFF")
        check_size(width, height, 2 * 4 * 4)
        values, mode = _pixels(file, info["bit_depth"]), file.mode.partition(";")[0]
        names = {"L": ("Y",), "I": ("Y",), "LA": ("Y", "A")}.get(mode, tuple(mode.upper()))
        metadata, _ = _metadata(info)  # the decoder has turned the pixels
    return Part("", names, values, (str(values.dtype),) * len(names), straight_alpha=mode[-1] == "A", metadata=metadata)


def heif_maps(path: Path) -> Embedded:
    """Depth and matte of a HEIC file."""
    with _opened(path) as file:
        depth, meaning, matte = None, dict[str, Any](), None
        for picture in file.info["depth_images"][:1]:
            depth, meaning = _depth(picture)
        for kind, numbers in file.info.get("aux", {}).items():
            if _MATTE in kind:
                auxiliary = file.get_aux_image(numbers[0])
                check_size(auxiliary.size[0], auxiliary.size[1], 2 * 4)
                matte = _pixels(auxiliary, 8)[..., 0].astype(np.float32) / 255
    return Embedded(depth, meaning, matte)


def _depth(picture: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """Stored numbers ``[h, w]`` of a depth image, and their meaning."""
    check_size(picture.size[0], picture.size[1], 2 * 4)
    stated = picture.info["metadata"] or {}
    values = _pixels(picture, 8 if picture.mode == "L" else 10)[..., 0]
    top, kind = float(np.iinfo(values.dtype).max), stated.get("representation_type")
    if kind in (_DISPARITY, _INVERSE_Z) and {"d_min", "d_max"} <= stated.keys():
        return values, by_inverse(stated["d_min"], stated["d_max"], top)
    ends = stated.get("z_near", 0.0), stated.get("z_far", 0.0)
    if kind in (_INVERSE_Z, _Z) and 0 < ends[0] < ends[1]:
        meaning = {"near_m": ends[0], "far_m": ends[1], "kind": "depth" if kind == _Z else "inverse"}
        return values, meaning | {"value_range": (0.0, top)}
    return values, {}


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file, of which nothing is decoded yet; errors of its decoder are those of damaged files."""
    import pi_heif

    try:
        with path.open("rb") as file:
            yield pi_heif.open_heif(file, convert_hdr_to_8bit=False)
    except (EOFError, SyntaxError, RuntimeError) as error:
        raise OSError(f"is damaged or cut short ({first_line(str(error))})") from None


def _pixels(picture: Any, bit_depth: int) -> np.ndarray:
    """Decoded numbers ``[H, W, C]``; more than 8 bits fill 16, so that the largest number is 65535."""
    values = np.atleast_3d(np.array(picture))  # a copy: the memory of the decoder goes with the file
    return values if values.dtype == np.uint8 else values | (values >> bit_depth)


def _read_avif(path: Path) -> Part:
    """The photograph of an AVIF file, which Pillow decodes, to 8 bits."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit here is that of check_size
            picture = Image.open(path, formats=["AVIF"])
        with picture:
            check_size(picture.width, picture.height, 4 * 4)
            values, mode = np.atleast_3d(np.asarray(picture)), picture.mode
            metadata, orientation = _metadata(picture.info)
            values, _ = upright(values, {"Orientation": (None, orientation)})
    except (SyntaxError, RuntimeError) as error:
        raise OSError(f"is damaged or cut short ({first_line(str(error))})") from None
    return Part("", tuple(mode), values, ("uint8",) * len(mode), straight_alpha=mode[-1] == "A", metadata=metadata)


def _metadata(info: Mapping[Any, Any]) -> tuple[Metadata, int]:
    """EXIF data and the colour profile as those of an upright picture in OpenImageIO's names, and the orientation.

    OpenImageIO reads the data from a PNG of one pixel.
    """
    tiff, profile = (info.get("exif") or b"").removeprefix(b"Exif\0\0"), info.get("icc_profile")
    metadata, orientation = Metadata(), 1
    if tiff[:2] in (b"II", b"MM"):
        header, row = struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0), zlib.compress(b"\0\0")
        png = b"\x89PNG\r\n\x1a\n"
        for name, body in {b"IHDR": header, b"eXIf": tiff, b"IDAT": row, b"IEND": b""}.items():
            png += struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        with tempfile.TemporaryDirectory() as folder:
            pixel = Path(folder, "pixel.png")
            pixel.write_bytes(png)
            part = read_parts(pixel)[0]
        metadata, orientation = part.metadata, part.orientation
    if profile:
        metadata |= {"ICCProfile": (f"uint8[{len(profile)}]", np.frombuffer(profile, np.uint8))}
    return metadata, orientation
