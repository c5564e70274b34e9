"""EXIF data in WebP files, in which OpenImageIO writes none."""

import struct
import tempfile
from pathlib import Path
from typing import Any


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
    chunks, flags = path.read_bytes()[12:], 0  # after "RIFF", the file's size and "WEBP"
    if chunks.startswith(b"VP8X"):  # an extended file already: with alpha or a profile
        chunks, flags = chunks[18:], chunks[8]
    size = (spec.width - 1).to_bytes(3, "little") + (spec.height - 1).to_bytes(3, "little")
    header = _chunk(b"VP8X", bytes([flags | 8, 0, 0, 0]) + size)  # 8: with EXIF
    content = b"WEBP" + header + chunks + _chunk(b"EXIF", exif[: int.from_bytes(length[-4:], "big")])
    path.write_bytes(_chunk(b"RIFF", content))


def _chunk(name: bytes, body: bytes) -> bytes:
    return name + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)
