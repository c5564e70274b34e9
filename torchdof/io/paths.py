"""Types of files that are read and written, and checks of paths.

Nothing here imports PyTorch, so that an error about a path appears at once.
"""

import os
from pathlib import Path
from typing import Literal

from . import foreign

__all__ = ["IMAGES", "PixelType", "existing", "existing_image", "existing_map", "samples_of"]

PixelType = Literal["8", "16", "half", "float"]

_SAMPLES: dict[str, tuple[PixelType, ...]] = {  # suffix -> sample types, the default first
    ".exr": ("half", "float"),
    ".png": ("8", "16"),
    **dict.fromkeys((".tif", ".tiff"), ("8", "16", "float")),
    **dict.fromkeys((".jpg", ".jpeg", ".webp"), ("8",)),
    **dict.fromkeys((".hdr", ".pfm"), ("float",)),
}
IMAGES = tuple(_SAMPLES)
"""Suffixes of images that are read and written everywhere."""


def samples_of(path: Path) -> tuple[PixelType, ...]:
    """Sample types that an image file can hold, by its suffix; the default is first.

    Raises:
        ValueError: If files with this suffix cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in _SAMPLES:
        raise ValueError(f"{path}: cannot write files of type {suffix or 'none'!r}; use one of {' '.join(IMAGES)}")
    return _SAMPLES[suffix]


def existing_image(path: str | os.PathLike[str]) -> Path:
    """Checks the path of an image, as :func:`existing`."""
    unread = foreign.refusal(path)
    if unread is not None:
        raise ValueError(f"{path}: {unread}")
    is_known = isinstance(path, str | os.PathLike) and Path(path).suffix.lower() in IMAGES
    return existing(path, IMAGES if is_known else (*IMAGES, *foreign.readable()), "an image")


def existing_map(path: str | os.PathLike[str]) -> Path:
    """Checks the path of a depth map, as :func:`existing`."""
    return existing(path, (*IMAGES, ".npy", ".npz"), "a depth map")


def existing(path: str | os.PathLike[str], suffixes: tuple[str, ...], what: str) -> Path:
    """Returns ``path`` if it is a file with one of ``suffixes`` that is not empty; ``what`` describes it in messages.

    Raises:
        OSError: If the file is missing, empty or not a regular file.
        ValueError: If ``path`` is not a path, or has another suffix.
    """
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        from ..validation import show  # imports PyTorch

        raise ValueError(f"expected the path of {what}, got {show(path)}")
    path = Path(path)
    if os.path.islink(os.path.realpath(path)):
        raise OSError(f"{path}: is a link that leads back to itself")
    if path.suffix.lower() not in suffixes:
        raise ValueError(
            f"{path}: {path.suffix or 'no suffix'} is not {what} that can be read; use {' '.join(suffixes)}"
        )
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not path.is_file():
        raise IsADirectoryError(f"{path}: is not a file")
    if path.stat().st_size == 0:
        raise OSError(f"{path}: the file is empty")
    return path
