"""Maps inside a JPEG file: GDepth (XMP), Dynamic Depth (pictures behind the first), and multi-picture files (MPF)."""

import base64
import binascii
import dataclasses
import re
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .decode import Part, read_parts
from .portraits import Embedded, by_inverse, by_range

_XMP, _EXTENSION = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_EXTENSION_HEADER = 40  # bytes after the name: a checksum of 32, the whole length, the offset of this piece
_RANGE = ("Format", "Near", "Far", "Units", "MeasureType")
_SUFFIXES = {b"\xff\xd8": ".jpg", b"\x89P": ".png"}
_GAIN_MAPS = (b"hdrgm:", b"HDRGainMap", b"urn:iso:std:iso:ts:21496")  # in a grey picture that is for HDR displays
_HEADER_BYTES = 65536  # of a picture, in which these names are searched


class _Jpeg(NamedTuple):
    """A file, or a part of it, that starts with a JPEG picture."""

    content: bytes
    xmp: str  # standard and extended
    mpf: int  # offset of the index of pictures, from which it counts, or 0
    end: int  # offset behind the first picture

    def field(self, prefix: str, name: str) -> str | None:
        """A property of the XMP data."""
        return _field(self.xmp, prefix, name)


def jpeg_maps(path: Path) -> Embedded:
    """The maps inside a JPEG file.

    Raises:
        OSError: If a map is damaged.
        ValueError: If a map states a range of distances that makes no sense.
    """
    file = _parsed(path.read_bytes())
    if data := file.field("GDepth", "Data"):
        original = file.field("GImage", "Data")
        values, meaning = by_range(_grey(_base64(data)), {name: file.field("GDepth", name) for name in _RANGE})
        return Embedded(values, meaning, original=_read(_base64(original)) if original else None)
    items = dict(_items(file))
    if "Depth" in items:
        values, meaning = by_range(_grey(items["Depth"]), {name: file.field("DepthMap", name) for name in _RANGE})
        return Embedded(values, meaning, original=_read(items["Original"]) if "Original" in items else None)
    maps = Embedded()
    for picture in _pictures(file):
        maps = _with_picture(maps, picture)
    return maps


def _with_picture(maps: Embedded, picture: bytes) -> Embedded:
    """The maps, and those that a further picture of a multi-picture file adds.

    Apple's pictures state their kind. Another grey picture is taken for depth whose numbers are not stated.
    """
    stated = _parsed(picture)
    kind, header = stated.field("apdi", "AuxiliaryImageType") or "", picture[:_HEADER_BYTES]
    if "portraiteffectsmatte" in kind:
        return dataclasses.replace(maps, matte=_grey(picture).astype(np.float32) / 255)
    if kind in ("disparity", "depth"):
        low, high = (float(stated.field("apdi", f"Float{end}Value") or "nan") for end in ("Min", "Max"))
        ends = {"near_m": low, "far_m": high, "kind": "depth", "value_range": (0.0, 255.0)}
        meaning = by_inverse(low, high, 255.0) if kind == "disparity" else ends
        return dataclasses.replace(maps, depth=_grey(picture), meaning=meaning)
    if kind or maps.depth is not None or any(name in header for name in _GAIN_MAPS):
        return maps
    part = _read(picture)
    return dataclasses.replace(maps, depth=part.values[..., 0]) if part.names == ("Y",) else maps


def _parsed(content: bytes) -> _Jpeg:
    """The segments of a JPEG picture that hold XMP data and the index of a multi-picture file."""
    xmp, extension, mpf, place = [], dict[int, bytes](), 0, 2
    while content[place : place + 1] == b"\xff" and content[place + 1] != 0xDA:  # start of the pixels
        size = int.from_bytes(content[place + 2 : place + 4], "big")
        body = content[place + 4 : place + 2 + size]
        if body.startswith(_XMP):
            xmp.append(body[len(_XMP) :])
        elif body.startswith(_EXTENSION):
            piece = body[len(_EXTENSION) :]
            extension[int.from_bytes(piece[36:40], "big")] = piece[_EXTENSION_HEADER:]
        elif body.startswith(b"MPF\0"):
            mpf = place + 8
        place += 2 + max(size, 2)
    xmp += [extension[offset] for offset in sorted(extension)]
    end = content.find(b"\xff\xd9", place) + 2  # a marker cannot appear among the pixels
    return _Jpeg(content, b"".join(xmp).decode("utf-8", "replace"), mpf, end if end > 1 else len(content))


def _field(xmp: str, prefix: str, name: str) -> str | None:
    """A property written as an attribute, or as an element."""
    found = re.search(rf"\b{prefix}:{name}(?:\s*=\s*[\"']([^\"']*)|>([^<]*))", xmp)
    return (found[1] or found[2] or "").strip() if found else None


def _items(file: _Jpeg) -> Iterator[tuple[str, bytes]]:
    """Meaning, such as Depth, and content of the pictures behind the first, which Dynamic Depth lists in order."""
    listed = file.xmp.partition(":Directory")[2].partition(":Directory")[0]
    items = [item for item in re.split(r"<rdf:li\b", listed)[1:] if _field(item, "Item", "Mime")]
    sizes = [int(_field(item, "Item", "Length") or 0) for item in items]
    depth_uri = file.field("DepthMap", "DepthURI")
    place = file.end + int(_field(items[0], "Item", "Padding") or 0) if items else 0
    if items and file.content[place : place + 2] not in _SUFFIXES:  # unlisted bytes in between
        place = len(file.content) - sum(sizes[1:])
    for item, size in list(zip(items, sizes, strict=True))[1:]:
        is_depth = depth_uri is not None and _field(item, "Item", "DataURI") == depth_uri
        yield "Depth" if is_depth else _field(item, "Item", "Semantic") or "", file.content[place : place + size]
        place += size + int(_field(item, "Item", "Padding") or 0)


def _pictures(file: _Jpeg) -> Iterator[bytes]:
    """The further pictures of a multi-picture file."""
    index = file.content[file.mpf :] if file.mpf else b""
    order = "<" if index[:2] == b"II" else ">"
    try:
        (start,) = struct.unpack_from(order + "I", index, 4)
        (count,) = struct.unpack_from(order + "H", index, start)
        for entry in range(count):
            tag, _, size, offset = struct.unpack_from(order + "HHII", index, start + 2 + 12 * entry)
            for picture in range(16, size if tag == 0xB002 else 0, 16):  # 16 bytes each; the first is the photograph
                length, place = struct.unpack_from(order + "II", index, offset + picture + 4)
                if index[place : place + 2] == b"\xff\xd8":
                    yield index[place : place + length]
    except struct.error:  # a damaged index
        return


def _base64(text: str) -> bytes:
    try:
        return base64.b64decode(re.sub(r"\s", "", text) + "==")
    except binascii.Error as error:
        raise OSError(f"it is damaged ({error})") from None


def _grey(picture: bytes) -> np.ndarray:
    """Numbers ``[h, w]`` of an encoded map; phones also store them as three equal channels."""
    return _read(picture).values[..., 0]


def _read(picture: bytes) -> Part:
    """A picture in memory."""
    suffix = _SUFFIXES.get(picture[:2])
    if suffix is None:
        raise OSError("it is neither a JPEG nor a PNG picture")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"map{suffix}")
        path.write_bytes(picture)
        return read_parts(path)[0]
