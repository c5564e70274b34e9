"""What is wrong with a PNG, found before its library reads it: that one prints a line of its own besides its error.

Reference:
    Portable Network Graphics Specification (Third Edition), W3C 2025.
"""

import mmap
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

__all__ = ["check"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # of a pixel, by the type of colour
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_PASSES = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
_MOST_PARTS = 4096  # texts, most of them; the library takes minutes for 1e5
_PIECE = 2**20  # bytes inflated at once


def check(path: Path) -> None:
    """Refuse a PNG that is cut short or damaged; a file of another type, whatever its name, is left to its reader.

    Raises:
        OSError: Saying what is wrong.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        try:
            _check(content)
        except (_Damaged, zlib.error) as error:
            raise OSError(f"{path}: is damaged or cut short ({error})") from None


class _Damaged(Exception):
    """What is wrong."""


def _check(content: mmap.mmap) -> None:
    if content[:8] != _SIGNATURE:
        return
    chunks = list(_chunks(content))
    names = [name for name, _, _ in chunks]
    if names[0] != b"IHDR" or b"IDAT" not in names or names.count(b"IHDR") + names.count(b"IEND") != 2:
        raise _Damaged("its parts are not those of a PNG file")
    first, count = names.index(b"IDAT"), names.count(b"IDAT")
    if names[first : first + count] != [b"IDAT"] * count:
        raise _Damaged("its pixels are not in one piece")
    for name in names:
        known = name in (b"IHDR", b"PLTE", b"IDAT", b"IEND") or name[:1].islower()
        if not known or not name.isalpha() or not name[2:3].isupper():
            raise _Damaged(f"it has a part {name!r}")
    if len(names) - count > _MOST_PARTS:
        raise _Damaged(f"it has more than {_MOST_PARTS} parts beside its pixels")
    start, end = chunks[0][1:]
    if end - start != 13:
        raise _Damaged("its header has another length")
    width, height, depth, colour, packing, filtering, interlace = struct.unpack(">IIBBBBB", content[start:end])
    valid = depth in _DEPTHS.get(colour, ()) and packing == filtering == 0 and interlace in (0, 1)
    if not valid or not 0 < width < 2**31 or not 0 < height < 2**31:
        raise _Damaged("its header makes no sense")
    palettes = [end - start for name, start, end in chunks[:first] if name == b"PLTE"]
    if len(palettes) > 1 or (colour == 3) > len(palettes) or any(p % 3 or not 0 < p <= 768 for p in palettes):
        raise _Damaged("its palette makes no sense")
    passes = _PASSES if interlace else ((0, 0, 1, 1),)
    lines: list[tuple[int, int]] = []  # how many, and bytes of each
    for top, left, down, right in passes:
        rows, columns = -(-(height - top) // down), -(-(width - left) // right)
        if rows > 0 and columns > 0:
            lines.append((rows, 1 + (columns * _SAMPLES[colour] * depth + 7) // 8))
    _check_pixels((content[start:end] for name, start, end in chunks if name == b"IDAT"), lines)


def _chunks(content: mmap.mmap) -> Iterator[tuple[bytes, int, int]]:
    """Name, start and end of each part, up to the last; its checksum is right."""
    place, name = 8, b""
    while name != b"IEND":
        length, name = struct.unpack(">I4s", content[place : place + 8].ljust(8, b"\0"))
        end = place + 8 + length
        if end + 4 > len(content):
            raise _Damaged("it ends before its pixels do")
        with memoryview(content) as view, view[place + 4 : end] as checked:
            wrong = zlib.crc32(checked) != int.from_bytes(content[end : end + 4], "big")
        if wrong:
            raise _Damaged(f"its part {name!r} has another checksum")
        yield name, place + 8, end
        place = end + 4


def _check_pixels(packed: Iterator[bytes], lines: list[tuple[int, int]]) -> None:
    """Refuse pixels that do not inflate to whole lines, each with a filter that there is."""
    inflate, ahead = zlib.decompressobj(), 0
    starts = ((rows, size) for rows, size in lines)
    rows, size = next(starts)
    for piece in packed:
        while piece and not inflate.eof:
            plain = inflate.decompress(piece, _PIECE)
            piece = inflate.unconsumed_tail
            while rows and ahead < len(plain):
                here = min(rows, -(-(len(plain) - ahead) // size))
                if max(plain[ahead : ahead + here * size : size]) > 4:
                    raise _Damaged("a line of its pixels has no filter that there is")
                ahead, rows = ahead + here * size, rows - here
                if not rows:
                    rows, size = next(starts, (0, 0))
            ahead -= len(plain)
    if rows or ahead > 0 or not inflate.eof:
        raise _Damaged("its pixels are fewer than its header claims")
