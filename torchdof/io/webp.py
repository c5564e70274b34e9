"""Chunks of WebP files (RIFF containers): EXIF data of a picture, and pictures joined to an animation."""

import os
import struct
import tempfile
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from .atomic import atomic_file

__all__ = ["add_exif", "write_animation"]

_DURATION_MS = 40  # of one picture
_FLAGS = {b"ICCP": 0x20, b"ALPH": 0x10, b"EXIF": 0x08, b"ANIM": 0x02}  # flags of a WebP with these chunks


def add_exif(path: Path, spec: Any) -> None:
    """Adds the tags of an OpenImageIO specification to a WebP file; OpenImageIO encodes them in a PNG of one pixel."""
    import OpenImageIO as oiio

    tags = oiio.ImageSpec(1, 1, 3, "uint8")
    tags.extra_attribs = spec.extra_attribs
    tags.erase_attribute("ICCProfile")
    with tempfile.TemporaryDirectory() as folder:
        pixel = Path(folder, "pixel.png")
        if not oiio.ImageBuf(tags).write(str(pixel)):
            raise OSError(f"{pixel}: could not be written; is the disk full?")
        length, _, exif = pixel.read_bytes().partition(b"eXIf")
    chunks = _chunks(path) | {b"EXIF": _chunk(b"EXIF", exif[: int.from_bytes(length[-4:], "big")])}
    path.write_bytes(_webp(chunks, spec.width, spec.height, chunks.values()))


def write_animation(path: str | os.PathLike[str], pictures: Sequence[Path]) -> None:
    """Joins WebP files of one size, as they are, to an animation that repeats, with their profile and EXIF data."""
    import OpenImageIO as oiio

    spec = oiio.ImageBuf(str(pictures[0])).spec()
    place = bytes(6) + _size(spec.width, spec.height) + _DURATION_MS.to_bytes(3, "little")
    names, frames = {b"ANIM"}, list[bytes]()
    for picture in pictures:
        chunks = _chunks(picture)
        names |= chunks.keys()
        image = b"".join(chunk for name, chunk in chunks.items() if name in (b"ALPH", b"VP8 "))
        frames.append(_chunk(b"ANMF", place + b"\2" + image))  # 2: not blended with the picture before
    parts = [chunks.get(b"ICCP", b""), _chunk(b"ANIM", bytes(6)), *frames, chunks.get(b"EXIF", b"")]
    with atomic_file(path) as temporary:
        temporary.write_bytes(_webp(names, spec.width, spec.height, parts))


def _chunks(path: Path) -> dict[bytes, bytes]:
    """The chunks of a still WebP file by name, without the header that lists them."""
    content, start, chunks = path.read_bytes(), 12, dict[bytes, bytes]()
    while start < len(content):
        name, length = struct.unpack_from("<4sI", content, start)
        chunks[name] = content[start : start + 8 + length + length % 2]
        start += len(chunks[name])
    chunks.pop(b"VP8X", None)
    return chunks


def _webp(names: Collection[bytes], width: int, height: int, chunks: Iterable[bytes]) -> bytes:
    """A file with a header that lists the names of its chunks, those in an animation too."""
    flags = sum(flag for name, flag in _FLAGS.items() if name in names)
    header = _chunk(b"VP8X", bytes([flags, 0, 0, 0]) + _size(width, height))
    return _chunk(b"RIFF", b"".join([b"WEBP", header, *chunks]))


def _size(width: int, height: int) -> bytes:
    return (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")


def _chunk(name: bytes, body: bytes) -> bytes:
    return name + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)
