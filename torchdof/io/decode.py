"""The stored numbers of image files and arrays, whose size is compared with limits and memory before it is decoded."""

import contextlib
import dataclasses
import itertools
import mmap
import os
import re
import struct
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .memory import free_bytes
from .metadata import Metadata, kept_metadata, upright

MAX_PIXELS = 2**28  # of an image or array; a larger limit allows damaged headers to claim more memory
MAX_ATTRIBUTES = 4096  # in all parts of an EXR file together; renderers write a few hundred
_MAX_STRANGE = 0.1  # largest share of numbers smaller than 1e-18 or larger than 1e18; more: damaged files are read
_SPACE = rb"(?:\s|#[^\n]*\n)+"  # white space and comments
_PFM_HEADER = re.compile(
    rb"P([Ff])" + _SPACE + rb"(-?\d{1,9})" + _SPACE + rb"(-?\d{1,9})" + _SPACE + rb"([-+.\deE]+)(?=\s)"
)
DEPTH_ARRAYS = ("depth", "depths", "predicted_depth")  # names of depth among the arrays of an estimator's file
MAX_CHANNELS = 1024  # in a part of an EXR file; OpenImageIO has the same limit


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of a file, as stored."""

    label: str  # name of the part, often empty
    names: tuple[str, ...]  # names of the channels
    values: np.ndarray  # [H, W, C]
    kinds: tuple[str, ...]  # stored type of each channel in OpenImageIO's names: "uint8", "half", ...
    is_exr: bool = False  # names may have a layer before a dot, and integers are not scaled to white
    straight_alpha: bool = False  # colour is not premultiplied by alpha
    metadata: Metadata = dataclasses.field(default_factory=dict)
    window: tuple[int, int, int, int, int, int] | None = None  # x, y, full x, full y, full width, full height
    orientation: int = 1  # EXIF orientation as stored; the values are upright already
    stated: dict[str, Any] = dataclasses.field(default_factory=dict)  # what the file states of its encoding


@contextlib.contextmanager
def utf8_name(path: Path) -> Iterator[str]:
    """A UTF-8 name of a file, which OpenImageIO needs; other names get a temporary symbolic link."""
    if str(path).isprintable():  # bytes that are not UTF-8 are surrogates, which are not printable
        yield str(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder, f"picture{path.suffix}")
        link.symlink_to(path.absolute())
        yield str(link)


@contextlib.contextmanager
def errors_named(path: Path) -> Iterator[None]:
    """Puts the name of a file before the message of an error."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:  # torch's allocator raises the latter
        raise OSError(f"{path}: does not fit into memory ({first_line(str(error))})") from None
    except UnicodeDecodeError:
        raise OSError(f"{path}: is damaged (a name in its header is not text)") from None
    except (OSError, ValueError) as error:
        raise (OSError if isinstance(error, OSError) else ValueError)(f"{path}: {error}") from None


def read_parts(path: Path) -> list[Part]:
    """All parts of an image file; ``OSError`` if damaged, ``ValueError`` if too large or of an unsupported kind."""
    if path.suffix.lower() == ".pfm":
        return [_read_pfm(path)]
    _check_header(path)
    with utf8_name(path) as name:
        parts = list(_parts(name))
    return [_unscaled(path, parts[0])] if path.suffix.lower() == ".pgm" else parts


def _parts(name: str) -> Iterator[Part]:
    """The parts of a file that OpenImageIO reads; only EXR files have several."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(name, config)
    if source is None:
        raise OSError(f"cannot be read ({first_line(oiio.geterror())})")
    is_exr = source.format_name() == "openexr"
    try:
        for number in itertools.count() if is_exr else (0,):
            if not source.seek_subimage(number, 0):
                return
            spec = source.spec()
            check_size(spec.width, spec.height, spec.nchannels * (spec.format.size() + 4))
            if spec.deep:
                raise ValueError("holds deep samples; flatten it to one sample a pixel first")
            _check_colours(spec)
            values = source.read_image(spec.format)
            problem = source.geterror()
            if values is None or problem:
                raise OSError(f"is damaged or cut short ({first_line(problem)})")
            names, orientation = tuple(spec.channelnames), 1
            values, metadata = values.reshape(spec.height, spec.width, len(names)), kept_metadata(spec.extra_attribs)
            window = (spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height)
            if not is_exr:
                names = tuple(("Y", "YA", "RGB", "RGBA")[len(names) - 1]) if len(names) <= 4 else names
                orientation = spec.get_int_attribute("Orientation", 1)
                values, metadata = upright(values, metadata)
            if (
                source.format_name() == "png"
                and (primaries := _png_primaries(Path(name)))
                and "ICCProfile" not in metadata
            ):
                metadata |= {"chromaticities": ("float[8]", primaries)} if "CICP" not in metadata else {}
            yield Part(
                label=spec.get_string_attribute("name"),
                names=names,
                values=values,
                kinds=tuple(map(str, spec.channelformats)) or (str(spec.format),) * len(names),
                is_exr=is_exr,
                straight_alpha=bool(spec.get_int_attribute("oiio:UnassociatedAlpha")),
                metadata=metadata,
                window=window if values.shape[:2] == (spec.height, spec.width) else None,
                orientation=orientation,
                stated=_stated(spec, source.format_name() == "png"),
            )
    finally:
        source.close()


def _stated(spec: Any, is_png: bool) -> dict[str, Any]:
    """The attributes that state the encoding: of a PNG all, of other files of integers the profile."""
    names = {"ICCProfile"} if str(spec.format) in ("uint8", "uint16") else set[str]()
    return {a.name: a.value for a in spec.extra_attribs if is_png or a.name in names}


def _png_primaries(path: Path) -> tuple[float, ...] | None:
    """Chromaticities in the cHRM chunk of a PNG, in the order of EXR files; None without one or beside sRGB."""
    found = None
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"sRGB"):
            size = int.from_bytes(head[:4], "big")
            if head[4:] == b"cHRM" and size == 32:
                numbers = [number / 100_000 for number in struct.unpack(">8I", file.read(32))]
                found = (*numbers[2:], *numbers[:2])
                size = 0
            file.seek(size + 4, os.SEEK_CUR)
    return None if head[4:] == b"sRGB" else found


def is_complete(path: Path) -> bool:
    """Whether an image file ends where its header says. A PNG must have its last chunk, other files their last row."""
    import OpenImageIO as oiio

    with utf8_name(path) as name:
        source = oiio.ImageInput.open(name)
        if source is None:
            oiio.geterror()
            return False
        spec = source.spec()
        if source.format_name() == "png":
            with path.open("rb") as file:
                file.seek(-8, os.SEEK_END)
                is_whole = file.read(4) == b"IEND"
        else:
            is_whole = source.read_scanline(spec.y + spec.height - 1, 0, "float") is not None
        problem = source.geterror()
        source.close()
    return is_whole and not problem


def _check_header(path: Path) -> None:
    """Refuse an EXR with more than ``MAX_ATTRIBUTES`` or ``MAX_CHANNELS``; OpenEXR takes minutes for 1e5."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[:4] != b"v/1\x01" or len(content) < 9:
            return
        has_parts, offset = bool(content[5] & 0x10), 8
        attribute = re.compile(rb"[^\0]+\0([^\0]+)\0(.{4})", re.DOTALL)  # name, type, size of the value that follows
        for _ in range(MAX_ATTRIBUTES):
            if content[offset : offset + 1] == b"\0" and has_parts:  # the end of a part's header
                offset += 1
            found = attribute.match(content, offset)
            if found is None:  # the end of all headers, or damage that the reader will refuse
                return
            start, offset = found.end(), found.end() + int.from_bytes(found[2], "little")
            is_list = found[1] == b"chlist"  # of channels, each a name, a zero and 16 bytes
            count = len(re.findall(rb"[^\0]+\0.{16}", content[start:offset], re.DOTALL)) if is_list else 0
            if count > MAX_CHANNELS:
                raise ValueError(f"its header has {count} channels in a part; at most {MAX_CHANNELS} are read")
    raise ValueError(f"its headers hold more than {MAX_ATTRIBUTES} attributes, which is the limit")


def _check_colours(spec: Any) -> None:
    """Refuse a TIFF whose colours OpenImageIO does not convert: CIELAB, a raw mosaic, negatives."""
    code = spec.get_int_attribute("tiff:PhotometricInterpretation", 2)  # 0, 1: grey; 2: RGB; 3: palette; 6: YCbCr
    is_cmyk = code == 5 and spec.get_string_attribute("tiff:ColorSpace") == "CMYK"
    if code not in (1, 2, 3, 6) and not (code == 0 and str(spec.format) == "uint8") and not is_cmyk:
        kind = f"photometric interpretation {code}: CIELAB, a raw mosaic, a negative or the like"
        raise ValueError(f"its colours are not stored as RGB or grey ({kind}); convert it to RGB")


def _read_pfm(path: Path) -> Part:
    """Reads a PFM file. OpenImageIO would multiply disparities by the scale in the header."""
    with path.open("rb") as file:
        header = _PFM_HEADER.match(file.read(4096))
        if header is None:
            raise OSError("is not a PFM file (its header should read 'PF' or 'Pf', size and scale)")
        names = "RGB" if header[1] == b"F" else "Y"
        width, height, scale = int(header[2]), int(header[3]), header[4]
        check_size(width, height, 2 * 4 * len(names))
        try:
            has_order = float(scale) != 0.0
        except ValueError:
            raise OSError(f"is not a PFM file (its scale should be a number, got {scale.decode()!r})") from None
        if not has_order:
            raise ValueError("has scale 0, which states no byte order; write -1 for little-endian or 1 for big-endian")
        byte_count = 4 * width * height * len(names)
        file.seek(header.end())
        data = file.read(2 * byte_count + 2)
    if len(data) == byte_count + 2 and data[:2] == b"\r\n":
        data = data[1:]
    elif len(data) > byte_count + 1 and len(data) - data.count(b"\r\n") == byte_count + 1:
        data = data.replace(b"\r\n", b"\n")  # all of it was written in the text mode of Windows
    data = data[1:]  # without the white space that ends the header
    if len(data) == byte_count // 2:
        raise OSError("holds 2 bytes a number, as of half floats; a PFM file holds 4: write float32, or an EXR file")
    if len(data) != byte_count:
        problem = "is cut short" if len(data) < byte_count else "is longer than its header says"
        raise OSError(f"{problem} ({len(data)} of {byte_count} bytes of pixels)")
    values = np.frombuffer(data, dtype="<f4" if scale.startswith(b"-") else ">f4").astype(np.float32)
    refuse_noise(values)
    values = values.reshape(height, width, len(names))[::-1]  # the bottom row is stored first
    return Part("", tuple(names), values, ("float",) * len(names))


def refuse_noise(values: np.ndarray) -> None:
    """Refuses floating-point numbers whose magnitudes are those of bytes in a wrong order or from a wrong place.

    A quarter of random single-precision numbers is smaller than 1e-18, and a quarter is larger than 1e18. One or two
    such numbers may mark pixels without depth.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        magnitudes = np.abs(values.reshape(-1)[:: 1 + values.size // 2**20].astype(np.float64))
    magnitudes = magnitudes[np.isfinite(magnitudes) & (magnitudes > 0)]
    is_strange = (magnitudes < 1e-18) | (magnitudes > 1e18)
    share = is_strange.mean() if magnitudes.size else 0.0
    if share == 1.0 or (share > _MAX_STRANGE and np.unique(magnitudes[is_strange]).size > 2):
        ends = f"{magnitudes.min():.1g} to {magnitudes.max():.1g}"
        advice = "its bytes are in another order, type or place than its header says; write the file anew"
        raise ValueError(f"its numbers have magnitudes from {ends}, as random bytes have: {advice}")


def _unscaled(path: Path, part: Part) -> Part:
    """The numbers as a PGM file stores them; OpenImageIO would multiply them to fill 8 or 16 bits."""
    with path.open("rb") as file:
        header = re.sub(rb"#[^\n]*", b"", file.read(400)).split()
    largest = int(header[3])
    levels = np.rint(part.values * (largest / np.iinfo(part.values.dtype).max)).astype(part.values.dtype)
    return dataclasses.replace(part, values=levels)


def read_array(path: Path, key: str | None, place: tuple[int, int] | None = None, kinds: str = "fiu") -> np.ndarray:
    """The array ``[H, W]`` of an ``.npy`` file, or of an ``.npz`` file: its only array, depth, or ``key``.

    ``place`` is the index of an image in a sequence, and the number of images, for an array ``[N, H, W]``. ``kinds``
    are letters of NumPy for the types that are accepted. Refuses pickles.
    """
    try:
        if path.suffix.lower() == ".npz":
            with zipfile.ZipFile(path) as archive:
                largest = max((entry.file_size for entry in archive.infolist()), default=0)
            if largest > 8 * MAX_PIXELS + 4096 or 2 * largest > free_bytes():
                raise ValueError(f"holds {largest} bytes, more than {MAX_PIXELS} pixels or than there is memory for")
            with np.load(path, allow_pickle=False) as arrays:
                names = ", ".join(arrays.files)
                named = [name for name in arrays.files if name.lower() in DEPTH_ARRAYS]
                key = named[0] if key is None and len(named) == 1 else key
                if key is None and len(arrays.files) != 1:
                    raise ValueError(f"which of the arrays {names} is depth? name it (--depth-channel)")
                if key is not None and key not in arrays.files:
                    raise ValueError(f"no array {key!r}; it has {names}")
                array, mask = arrays[key or arrays.files[0]], arrays["mask"] if "mask" in arrays.files else None
                if mask is not None and mask.dtype == bool and mask.shape == array.shape and array.dtype.kind == "f":
                    array = np.where(mask, array, np.inf)  # as MoGe writes skies in its other files
        else:
            array = np.load(path, allow_pickle=False, mmap_mode="r")
        if not isinstance(array, np.ndarray):
            raise ValueError("it is not an array")
    except Exception as error:  # numpy and zipfile raise a dozen kinds of errors for damaged files
        raise ValueError(f"cannot be read as an array ({first_line(str(error))})") from None
    shape = array.shape
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim == 3 and array.shape[-1] > 4:  # not [H, W, C]
        if place is None or place[1] != len(array):
            images = "" if place is None else f"; the sequence has {place[1]} images"
            remedy = "give a sequence of as many images, such as shot.####.png"
            raise ValueError(f"holds {len(array)} maps (an array {list(shape)}){images}; {remedy}")
        array = array[place[0]]
    if array.ndim != 2 or array.dtype.kind not in kinds or array.size == 0:
        raise ValueError(f"expected an array [H, W] of numbers, got {list(shape)} of {array.dtype}")
    check_size(array.shape[1], array.shape[0], array.dtype.itemsize + 4)
    return np.asarray(array)


def check_size(width: int, height: int, pixel_bytes: int) -> None:
    """Refuses a picture with too many pixels, or for which there is too little memory."""
    claim = f"its header claims {width} x {height} pixels"
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise ValueError(f"{claim}; between 1 and {MAX_PIXELS} are read")
    needed, free = width * height * pixel_bytes, free_bytes()
    if needed > free:
        gib = f"{needed / 2**30:.3g} GiB; {max(0.0, free) / 2**30:.3g} GiB of memory are free"
        raise ValueError(f"{claim}, which take {gib}")


def first_line(text: str) -> str:
    """The first line of a library's message."""
    return text.strip().splitlines()[0] if text.strip() else "no reason given"
