"""What a data set is made of: images, their depths, and the cameras that are given for them."""

import dataclasses
import os
from pathlib import Path

from ..validation import number

__all__ = ["Pair", "pairs_in"]

_IMAGES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".hdr", ".pfm")
_DEPTHS = (".npy", ".npz", ".exr", ".png", ".tif", ".tiff", ".pfm")


@dataclasses.dataclass(frozen=True)
class Pair:
    """An image and its depth.

    Args:
        image: Image file.
        depth: Depth file; None takes the depth channel of the image.
        focus_m: Distance in focus in metres; None draws one.
        f_number: F-number; None draws one.

    Raises:
        ValueError: If a number is not positive.

    Example:
        >>> Pair("a.png", "a.npy", focus_m=2.0).f_number is None
        True
    """

    image: str
    depth: str | None = None
    focus_m: float | None = None
    f_number: float | None = None

    def __post_init__(self) -> None:
        for name in ("focus_m", "f_number"):
            if getattr(self, name) is not None:
                number(name, getattr(self, name), low=0.0, infinite=name == "focus_m")


def pairs_in(images: str | os.PathLike[str], depths: str | os.PathLike[str] | None = None) -> list[Pair]:
    """The images of a folder, each with the depth file of another that has its name but for the suffix; full paths.

    Args:
        images: Folder of images.
        depths: Folder of depth maps; None takes the depth channels of the images.

    Raises:
        FileNotFoundError: If a folder is not there or holds no image.
        ValueError: If an image has no depth, or several.
    """
    found = _by_stem(images, _IMAGES)
    if not found:
        raise FileNotFoundError(f"{images}: no images here ({' '.join(_IMAGES)})")
    twice = next((paths for paths in found.values() if len(paths) > 1), None)
    if twice:
        raise ValueError(f"{twice[0]}: there is {twice[1].name} of the same name; keep one of them")
    if depths is None:
        return [Pair(str(path)) for (path,) in found.values()]
    maps = _by_stem(depths, _DEPTHS)
    pairs = []
    for stem, (image,) in found.items():
        fitting = maps.get(stem, [])
        if len(fitting) != 1:
            listed = " and ".join(path.name for path in fitting) or "none"
            raise ValueError(f"{image}: needs one depth map {stem}.* in {depths}, found {listed}")
        pairs.append(Pair(str(image), str(fitting[0])))
    return pairs


def _by_stem(folder: str | os.PathLike[str], suffixes: tuple[str, ...]) -> dict[str, list[Path]]:
    if not Path(folder).is_dir():
        raise FileNotFoundError(f"{folder}: there is no such folder")
    found: dict[str, list[Path]] = {}
    for path in sorted(Path(folder).absolute().iterdir()):
        if path.suffix.lower() in suffixes and not path.name.startswith("."):
            found.setdefault(path.stem, []).append(path)
    return found
