"""How much an EXR's header holds, counted before its library reads it: that one takes minutes for 1e5 attributes.

Reference:
    Technical Introduction to OpenEXR; OpenEXR File Layout, openexr.com.
"""

import mmap
from pathlib import Path

__all__ = ["MOST_ATTRIBUTES", "check"]

MOST_ATTRIBUTES = 4096
"""Of all parts of a file together; what renderers write is a few hundred."""

_MAGIC = b"v/1\x01"
_SEVERAL_PARTS = 0x10  # in the third byte of the version


def check(path: Path) -> None:
    """Refuse an EXR whose headers hold more attributes than anybody wrote; one that is damaged is left to its reader.

    Raises:
        ValueError: Saying how many are read.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[:4] != _MAGIC or len(content) < 9:
            return
        several, place = bool(content[5] & _SEVERAL_PARTS), 8
        for _ in range(MOST_ATTRIBUTES):
            if content[place : place + 1] == b"\0":  # the end of a part's header
                place += 1
                if not several or content[place : place + 1] == b"\0":
                    return
            name_end = content.find(b"\0", place)
            type_end = content.find(b"\0", name_end + 1)
            if name_end < 0 or type_end < 0 or type_end + 5 > len(content):
                return
            place = type_end + 5 + int.from_bytes(content[type_end + 1 : type_end + 5], "little")
            if place >= len(content):
                return
    raise ValueError(f"{path}: its headers hold more than {MOST_ATTRIBUTES} attributes, and no more are read")
