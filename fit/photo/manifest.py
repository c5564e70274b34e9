"""A folder of photographs of a dot, described by its `capture.toml`: read, and cut into windows around the dot."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from torchdof.validation import show

from ..problems import FitError, warn
from ..validation import a_choice, a_number
from .captures import CAMERA, RANGES, Captures, check_distances
from .frame import PATTERNS, Dots, Frame, cut_pairs, read_frame, size_of

__all__ = ["MANIFEST", "Captures", "Colours", "inside", "read_captures"]

MANIFEST = "capture.toml"
Colours = Literal["mean", "each"]

_NUMBERS = ("focus_m", "exposure_s", "full_width_px", *CAMERA)
_TEXTS = ("sharp", "dark", "name")
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "transfer": ("linear", "srgb"),
    "dots": get_args(Dots),
    "colours": get_args(Colours),
    "bayer": PATTERNS,
}
_FIELDS = ("shot", "crop", *_NUMBERS, *_TEXTS, *_CHOICES)
_OF_A_SHOT = ("file", "distance_m", "exposure_s")


def read_captures(
    folder: str | os.PathLike[str],
    *,
    dots: Dots | None = None,
    colours: Colours | None = None,
    root: str | os.PathLike[str] | None = None,
) -> list[Captures]:
    """Read a folder of photographs described by its `capture.toml`.

    ```toml
    focus_m = 0.20                # the lens stays focused here
    sharp = "0200mm.png"          # the dot at that distance
    focal_length_mm = 50.0        # what is left out of camera is read from EXIF; all three make the table know its unit
    f_number = 2.8
    sensor_width_mm = 36.0
    transfer = "srgb"             # or "linear"; left out, floats are linear, and integers sRGB with a warning

    [[shot]]                      # by increasing distance
    file = "0500mm.png"
    distance_m = 0.50

    # at will, before the shots: full_width_px = 6000 of the whole frame, if the pictures were cropped before;
    # crop = [left, top, width, height] in px; dark = "dark.png", lens cap on; exposure_s, here and of each shot;
    # dots = "centre", "each" or "field" of a grid; colours = "each"; bayer = "RGGB" for a sensor's mosaic; name
    ```

    Args:
        folder: with the manifest and the pictures, or the manifest's path.
        dots: instead of the manifest's "dots".
        colours: instead of the manifest's "colours".
        root: folder that the manifest and every picture must lie in, links followed, for a service that reads
            manifests of strangers. None reads whatever they name, `../` and absolute paths among it.

    Returns:
        One `Captures`; with `dots="each"` or "field" one for every dot of the grid, the most central first.

    Raises:
        FitError: of kind "manifest" where that is missing, is not TOML, or a field is wrong; of kind "distance" where
            distances are not increasing or that of the focus; or a picture's kind of trouble, with its file.
        OSError: a picture is missing or damaged.

    Warns:
        FitWarning: of kind "not linear" for integers whose transfer nobody stated: they are taken for sRGB.
    """
    if not isinstance(folder, str | os.PathLike):
        raise FitError(f"folder must be the path of a folder or of its {MANIFEST}, got {show(folder)}", "manifest")
    path = Path(folder)
    path = path / MANIFEST if path.is_dir() or path.suffix != ".toml" else path
    where, base = str(path), path.parent
    if root is not None:
        inside(path, root, where)
    fields = _manifest(path)
    fields |= {name: value for name, value in (("dots", dots), ("colours", colours)) if value}
    shots = fields.get("shot")
    if not isinstance(shots, list) or not shots or not all(isinstance(s, dict) for s in shots):
        raise FitError("give at least one [[shot]] with file and distance_m", "manifest", file=where)
    known = {name: _field(fields, name, where, needed=name in ("focus_m", "sharp")) for name in _FIELDS[2:]}
    focus, crop = known["focus_m"], _crop(fields, where)
    for some, names in ((fields, _FIELDS), *((shot, _OF_A_SHOT) for shot in shots)):
        for name in some:
            if name not in names:
                raise FitError(f"{name!r} is not a field; known are {', '.join(names)}", "manifest", file=where)
    distances = [_field(shot, "distance_m", where, needed=True) for shot in shots]
    check_distances(distances, focus, where)
    sharp, *files = (base / f for f in (known["sharp"], *(_field(shot, "file", where, needed=True) for shot in shots)))
    dark_file = None if known["dark"] is None else base / known["dark"]
    for file in (sharp, *files, dark_file):
        if root is not None and file is not None:
            inside(file, root, where)
    dark = None if dark_file is None else read_frame(dark_file, known["transfer"], None, crop, known["bayer"])
    first = read_frame(sharp, known["transfer"], dark, crop, known["bayer"])
    each = known["colours"] == "each"
    if each and first.colours.shape[0] != 3:
        text = f"colours = 'each' needs pictures of three colours, or bayer = 'RGGB', got {first.colours.shape[0]}"
        raise FitError(text, "manifest", file=where)
    columns, encoded = [], [sharp.name] if first.encoded else []
    for shot, distance, file in zip(shots, distances, files, strict=True):
        moved = read_frame(file, known["transfer"], dark, crop, known["bayer"])
        _check_alike(first, moved, where)
        encoded += [file.name] if moved.encoded else []
        exposed = _field(shot, "exposure_s", where)
        exposure = exposed / known["exposure_s"] if exposed and known["exposure_s"] else None
        columns.append(cut_pairs(first, moved, distance, focus / distance, known["dots"] or "one", exposure, each))
    if known["transfer"] is None and encoded:
        more = f" and {len(encoded) - 1} more" if len(encoded) > 1 else ""
        text = (
            f"nobody said how {encoded[0]}{more} are encoded, and they are taken for sRGB. A camera's own tone curve "
            "or sharpening makes the kernel up to 15 % too small and need not show: develop to linear light without "
            "them. Then say transfer = 'linear', or 'srgb' if that is all that was done"
        )
        warn(text, "not linear", file=where, number=float(len(encoded)))
    full_width = known["full_width_px"]
    if full_width is not None and full_width < first.width_px:
        got = f"got {full_width:g} for pictures of {first.width_px}"
        raise FitError(f"full_width_px must be at least the pictures' own width, {got}", "manifest", file=where)
    camera = {name: first.facts.get(name) if known[name] is None else known[name] for name in CAMERA}
    notes = {
        "manifest": path.name,
        "transfer": known["transfer"] or "by file type",
        "pictures": [s["file"] for s in shots],
        "dots": known["dots"] or "one",
    }
    if from_exif := [name for name in CAMERA if known[name] is None and camera[name] is not None]:
        notes["from_exif"] = from_exif
    return [
        Captures(
            pairs=pairs,
            focus_m=focus,
            width_px=first.width_px if full_width is None else round(full_width),
            **camera,
            name=known["name"] or base.resolve().name,
            notes=notes | {"position_px": list(pairs[0].position_px)},
        )
        for pairs in zip(*columns, strict=False)
    ]


def inside(file: Path, root: str | os.PathLike[str], where: str) -> None:
    """Refuse a file that does not lie in a folder, wherever its name and links lead."""
    folder, real = os.path.realpath(root), os.path.realpath(file)
    if not os.path.isdir(folder):
        raise FitError(f"root must be a folder, got {show(str(root))}", "manifest", file=where)
    if os.path.commonpath([folder, real]) != folder:
        text = f"{str(file)!r} lies outside of {root}, and nothing else may be read (--root)"
        raise FitError(text, "manifest", file=where)


def _manifest(path: Path) -> dict[str, Any]:
    if not path.is_file():
        text = "there is no such manifest; write a capture.toml beside the pictures"
        raise FitError(text, "manifest", file=str(path))
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FitError(f"is not TOML: {error}", "manifest", file=str(path)) from error


def _field(fields: Mapping[str, Any], name: str, where: str, needed: bool = False) -> Any:
    """A field of the manifest, None where it was left out; a refusal where it is not as it must be."""
    value = fields.get(name)
    if value is None and not needed:
        return None
    try:
        if name in RANGES:
            return a_number(name, value, *RANGES[name])
        if name in _CHOICES:
            a_choice(name, value, _CHOICES[name])
        elif not isinstance(value, str) or not value or "\0" in value:
            raise FitError(f"{name} must be a text, got {show(value)}")
    except FitError as error:
        raise FitError(str(error), "manifest", file=where) from None
    return value


def _crop(fields: Mapping[str, Any], where: str) -> tuple[int, int, int, int] | None:
    value = fields.get("crop")
    if value is None:
        return None
    whole = isinstance(value, list) and len(value) == 4 and all(type(v) is int and 0 <= v < 2**31 for v in value)
    if not whole or value[2] < 1 or value[3] < 1:
        text = f"crop must be [left, top, width, height] in pixels, got {show(value)}"
        raise FitError(text, "manifest", file=where)
    return value[0], value[1], value[2], value[3]


def _check_alike(first: Frame, second: Frame, where: str) -> None:
    """Refuse pictures of unlike size, and those between which the lens was changed."""
    if first.light.shape != second.light.shape:
        text = f"{second.file.name} is {size_of(second.light)}, {first.file.name} is {size_of(first.light)}"
        raise FitError(text, "manifest", file=where)
    for what, word in (("f_number", "f-number"), ("focal_length_mm", "focal length")):
        if what in first.facts and what in second.facts:
            before, after = first.facts[what], second.facts[what]
            if abs(math.log(before / after)) > 0.02:
                text = (
                    f"EXIF says this was taken at {word} {after:g}, and {first.file.name} at {before:g}; aperture and "
                    "zoom must stay as they are"
                )
                raise FitError(text, "manifest", file=str(second.file), number=after)
