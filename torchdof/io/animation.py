"""Joins pictures to an animated WebP."""

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from .atomic import atomic_file

__all__ = ["write_animation"]

_DURATION_MS = 40  # of one picture
_PROFILE, _ALPHA, _ANIMATION = 0x20, 0x10, 0x02  # flags of what a WebP has


def write_animation(path: str | os.PathLike[str], pictures: Sequence[Path]) -> None:
    """Joins WebP files of one size to an animation that repeats, 25 a second; it is written whole or not at all.

    The animation has the compressed pictures of the files as they are, and one colour profile.

    Reference:
        WebP Container Specification, developers.google.com/speed/webp/docs/riff_container.
    """
    import OpenImageIO as oiio

    spec = oiio.ImageBuf(str(pictures[0])).spec()
    size = (spec.width - 1).to_bytes(3, "little") + (spec.height - 1).to_bytes(3, "little")
    place = bytes(6) + size + _DURATION_MS.to_bytes(3, "little") + b"\2"  # 2: not blended with the picture before
    flags, profile, frames = _ANIMATION, b"", list[bytes]()
    for picture in pictures:
        content, start, image = picture.read_bytes(), 12, b""
        while start < len(content):
            name, length = struct.unpack_from("<4sI", content, start)
            chunk = content[start : start + 8 + length + length % 2]
            flags |= {b"ICCP": _PROFILE, b"ALPH": _ALPHA}.get(name, 0)
            profile = chunk if name == b"ICCP" else profile
            image += chunk if name in (b"ALPH", b"VP8 ") else b""
            start += len(chunk)
        frames.append(_chunk(b"ANMF", place + image))
    header = _chunk(b"VP8X", bytes([flags, 0, 0, 0]) + size) + profile + _chunk(b"ANIM", bytes(6))
    with atomic_file(path) as temporary:
        temporary.write_bytes(_chunk(b"RIFF", b"".join([b"WEBP", header, *frames])))


def _chunk(name: bytes, body: bytes) -> bytes:
    return name + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)
