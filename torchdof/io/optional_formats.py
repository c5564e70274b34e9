"""Formats that OpenImageIO reads only if it was built with further libraries: HEIC and raw files."""

import os
from pathlib import Path
from typing import Any

__all__ = ["SUFFIXES", "readable", "refusal"]

_CONVERT = "convert it to JPEG or 16-bit TIFF (heif-convert, sips -s format tiff, or let the phone share it as JPEG)"
_DEVELOP = "develop it to linear 16-bit TIFF (dcraw -4 -T, or a converter's linear profile) and copy its EXIF"
_READERS = {
    "heif": (_CONVERT, (".heic", ".heif", ".avif")),
    "raw": (_DEVELOP, (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")),
}

SUFFIXES = tuple(suffix for _, suffixes in _READERS.values() for suffix in suffixes)


def readable() -> tuple[str, ...]:
    """Suffixes among :data:`SUFFIXES` that the installed OpenImageIO reads."""
    import OpenImageIO as oiio

    readers = oiio.get_string_attribute("format_list").split(",")
    return tuple(suffix for reader, (_, suffixes) in _READERS.items() if reader in readers for suffix in suffixes)


def refusal(path: Any) -> str | None:
    """Message with the reason and the conversion for a file that cannot be read here; None for other files."""
    suffix = Path(path).suffix.lower() if isinstance(path, str | os.PathLike) else ""
    if suffix not in SUFFIXES or suffix in readable():
        return None
    remedy = next(remedy for remedy, suffixes in _READERS.values() if suffix in suffixes)
    return f"{suffix} is not read here: {remedy}"
