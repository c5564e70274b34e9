"""Types of files that are read and written, and checks of paths.

Nothing here imports PyTorch, so that an error about a path appears at once.
"""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

PixelType = Literal["8", "16", "half", "float"]

_SAMPLES: dict[str, tuple[PixelType, ...]] = {  # suffix -> sample types, the default first
    ".exr": ("half", "float"),
    ".png": ("8", "16"),
    **dict.fromkeys((".tif", ".tiff"), ("8", "16", "float")),
    **dict.fromkeys((".jpg", ".jpeg", ".webp"), ("8",)),
    **dict.fromkeys((".hdr", ".pfm"), ("float",)),
}
IMAGE_SUFFIXES = tuple(_SAMPLES)
"""Suffixes of images that every installation reads and writes."""

MAP_SUFFIXES = (*IMAGE_SUFFIXES, ".npy", ".npz", ".pgm")
"""Suffixes of depth maps."""

_CONVERT = "install its reader, pip install 'torchdof[heif]', or convert it to JPEG or 16-bit TIFF (heif-convert)"
_DEVELOP = "develop it to linear 16-bit TIFF (dcraw -4 -T, or a converter's linear profile) and copy its EXIF"
OPTIONAL_SUFFIXES = {
    **dict.fromkeys((".heic", ".heif", ".avif"), ("heif", _CONVERT)),
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf"), ("raw", _DEVELOP)),
}
"""Suffixes of images that are read with a further library, as OpenImageIO calls it, and what to do without it."""


def has_pi_heif() -> bool:
    """Whether pi-heif is installed, which reads HEIC and AVIF files."""
    return find_spec("pi_heif") is not None


def readers() -> list[str]:
    """Formats that the installed OpenImageIO reads."""
    import OpenImageIO as oiio

    return oiio.get_string_attribute("format_list").split(",")


def refusal(path: str | os.PathLike[str]) -> str | None:
    """Message with the reason and the conversion for a file that cannot be read here; None for other files."""
    suffix = Path(path).suffix.lower()
    reader, remedy = OPTIONAL_SUFFIXES.get(suffix, ("", ""))
    if not reader or (reader == "heif" and has_pi_heif()) or reader in readers():
        return None
    return f"{suffix} is not read here: {remedy}"


def samples_of(path: Path) -> tuple[PixelType, ...]:
    """Sample types that an image file can hold, by its suffix, the default first; refuses other suffixes."""
    suffix = path.suffix.lower()
    if suffix not in _SAMPLES:
        kind = f"files of type {suffix!r}" if suffix else "a file without a type"
        raise ValueError(f"{path}: cannot write {kind}; use one of {' '.join(IMAGE_SUFFIXES)}")
    return _SAMPLES[suffix]


def existing_image(path: str | os.PathLike[str]) -> Path:
    """Checks the path of an image; errors name it."""
    return _readable_file(path, (*IMAGE_SUFFIXES, *OPTIONAL_SUFFIXES), "an image")


def existing_map(path: str | os.PathLike[str]) -> Path:
    """Checks the path of a depth map; errors name it."""
    return _readable_file(path, (*MAP_SUFFIXES, *OPTIONAL_SUFFIXES), "a depth map")


def named_file(source: str | os.PathLike[str], folder: Path, suffix: str, what: str) -> Path:
    """The file of a path, or of a name without suffix that is shipped in ``folder``; messages call it ``what``."""
    if not isinstance(source, str | os.PathLike):
        from ..validation import show  # imports PyTorch

        raise ValueError(f"source must be the name or the path of a {what}, got {show(source)}")
    path = Path(source)
    if not path.suffix and not path.exists():
        path = folder / f"{path}{suffix}"
    if not path.is_file():
        names = ", ".join(sorted(each.stem for each in folder.glob(f"*{suffix}")))
        raise FileNotFoundError(f"no {what} {str(source)!r}: neither a file nor one of the shipped ({names})")
    return path


def _readable_file(path: str | os.PathLike[str], suffixes: tuple[str, ...], what: str) -> Path:
    """Returns ``path`` if it is a file that can be read, with one of ``suffixes``; messages call it ``what``."""
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        from ..validation import show  # imports PyTorch

        raise ValueError(f"expected the path of {what}, got {show(path)}")
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; name a file in it, or a sequence as {path.name}/frame.####.exr")
    if path.suffix.lower() not in suffixes:
        kind = f"a file of type {path.suffix}" if path.suffix else "a file without a suffix"
        known = " ".join(suffix for suffix in suffixes if refusal(f"a{suffix}") is None)
        raise ValueError(f"{path}: {kind} is not {what} that can be read; use {known}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not path.is_file():
        raise IsADirectoryError(f"{path}: is not a file")
    if path.stat().st_size == 0:
        raise OSError(f"{path}: the file is empty")
    if reason := refusal(path):
        raise ValueError(f"{path}: {reason}")
    return path
