"""Reads a folder of photographs of a dot, described by its `capture.toml`, and cuts windows around the dot."""

import os
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from torchdof.validation import choice, fields, number, show

from ..problems import FitError, warn
from .captures import CAMERA, PATTERNS, RANGES, Captures, Dots, check_distances, cut_pairs, read_picture

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MANIFEST = "capture.toml"
_FAR_M = 100.0  # m; a dot on paper is not seen from farther, so larger distances are likely in millimetres
Colours = Literal["mean", "each"]


def _text(name: str, value: Any) -> None:
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError(f"{name} must be a text, got {show(value)}")


def _crop(name: str, value: Any) -> None:
    numbers = value if isinstance(value, list) and len(value) == 4 else [-1]
    if not all(type(v) is int and 0 <= v < 2**31 for v in numbers) or not all(numbers[2:]):
        raise ValueError(f"{name} must be [left, top, width, height] in pixels, got {show(value)}")


_FIELDS: Mapping[str, Callable[..., Any]] = {
    **{name: partial(number, low=low, high=high) for name, (low, high) in RANGES.items()},
    **dict.fromkeys(("sharp", "dark", "name", "file"), _text),
    "crop": _crop,
    "transfer": partial(choice, choices=("linear", "srgb")),
    "dots": partial(choice, choices=get_args(Dots)),
    "colours": partial(choice, choices=get_args(Colours)),
    "bayer": partial(choice, choices=PATTERNS),
}
_OF_MANIFEST = [name for name in _FIELDS if name not in ("file", "distance_m", "width_px")]
_OF_SHOT = ["file", "distance_m", "exposure_s"]
_REQUIRED = ("focus_m", "sharp", "file", "distance_m")


def read_captures(
    folder: str | os.PathLike[str],
    *,
    dots: Dots | None = None,
    colours: Colours | None = None,
    root: str | os.PathLike[str] | None = None,
) -> list[Captures]:
    """Reads a folder of photographs described by its `capture.toml`.

    ```toml
    focus_m = 0.20                # the lens stays focused here
    sharp = "0200mm.png"          # the dot at that distance
    transfer = "srgb"             # or "linear"; if missing, floats are linear, and integers sRGB with a warning

    [[shot]]                      # by increasing distance
    file = "0500mm.png"
    distance_m = 0.50
    ```

    Fields of the camera (`focal_length_mm`, `f_number`, `sensor_width_mm`) are read from EXIF if they are missing; with
    all three the table's unit is known. The other fields, all optional, are in docs/measuring.md.

    Args:
        folder: folder with the manifest and the pictures, or path of the manifest.
        dots: replaces the manifest's "dots".
        colours: replaces the manifest's "colours".
        root: folder that must contain the manifest and every picture, after following links; None allows any path.

    Returns:
        One `Captures`; with `dots="each"` or "field" one for each dot of the grid, the most central first.

    Raises:
        FitError: of kind "manifest" if it is missing, is not TOML, or has an invalid field; of kind "distance" if
        distances are not increasing or equal the focus; or the error of a picture, with its file. Integers without a
        stated transfer, and distances above 100 m, give a `FitWarning`.
        OSError: a picture is missing or damaged.
    """
    if not isinstance(folder, str | os.PathLike):
        raise FitError(f"folder must be the path of a folder or of its {MANIFEST}, got {show(folder)}", "manifest")
    path = Path(folder)
    path = path / MANIFEST if path.is_dir() or path.suffix != ".toml" else path
    manifest_name, folder_path = str(path), path.parent
    invalid = partial(FitError, kind="manifest", file=manifest_name)
    if root is not None:
        inside(path, root, manifest_name)
    if not path.is_file():
        raise invalid("there is no such manifest; write a capture.toml beside the pictures")
    try:
        stated = {"dots": "one"} | tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise invalid(f"is not TOML: {error}") from error
    shots = stated.pop("shot", None)
    if not isinstance(shots, list) or not shots:
        raise invalid("give at least one [[shot]] with file and distance_m")
    stated |= {name: value for name, value in (("dots", dots), ("colours", colours)) if value}
    manifest = _valid(MANIFEST, stated, _OF_MANIFEST, manifest_name)
    shots = [_valid("[[shot]]", shot, _OF_SHOT, manifest_name) for shot in shots]
    focus, files = manifest["focus_m"], [shot["file"] for shot in shots]
    check_distances([shot["distance_m"] for shot in shots], focus, manifest_name)
    nearest = min(focus, shots[0]["distance_m"])
    if nearest > _FAR_M:
        warn(f"all distances are at least {nearest:g} m; divide millimetres by 1000", "distance", manifest_name)
    if root is not None:
        for name in filter(None, [manifest["sharp"], *files, manifest["dark"]]):
            inside(folder_path / name, root, manifest_name)

    options = {name: manifest[name] for name in ("transfer", "crop", "bayer")}
    options["dark"] = read_picture(folder_path / manifest["dark"], **options).colours if manifest["dark"] else None
    sharp = read_picture(folder_path / manifest["sharp"], **options)
    by_colour = manifest["colours"] == "each"
    if by_colour and (count := len(sharp.colours)) != 3:
        raise invalid(f"colours = 'each' needs pictures of three colours, or bayer = 'RGGB', got {count}")
    columns, encoded = [], [sharp.file.name] * sharp.encoded
    for shot in shots:
        blurred = read_picture(folder_path / shot["file"], **options)
        encoded += [blurred.file.name] * blurred.encoded
        sharp_s, blurred_s, magnification = manifest["exposure_s"], shot["exposure_s"], focus / shot["distance_m"]
        facts = {"distance_m": shot["distance_m"], "exposure": blurred_s / sharp_s if sharp_s and blurred_s else None}
        columns.append([*cut_pairs(sharp, blurred, magnification, manifest["dots"], by_colour, **facts)])
    if manifest["transfer"] is None and encoded:
        further = f" and {len(encoded) - 1} more" if len(encoded) > 1 else ""
        text = f"the encoding of {encoded[0]}{further} is not stated; sRGB is assumed: state transfer, and develop "
        warn(f"{text}without a tone curve, which makes the kernel up to 15 % too small", "not linear", manifest_name)
    width = sharp.width_px if manifest["full_width_px"] is None else round(manifest["full_width_px"])
    if width < sharp.width_px:
        raise invalid(f"full_width_px must be at least {sharp.width_px}, the pictures' own width, got {width}")
    from_exif = {name: sharp.facts[name] for name in CAMERA if manifest[name] is None and name in sharp.facts}
    camera = {name: manifest[name] for name in CAMERA} | from_exif
    transfer, title = manifest["transfer"] or "by file type", manifest["name"] or folder_path.resolve().name
    notes = {"manifest": path.name, "transfer": transfer, "pictures": files, "dots": manifest["dots"]}
    notes |= {"from_exif": list(from_exif)} if from_exif else {}
    return [
        Captures(pairs, focus, width, **camera, name=title, notes=notes | {"position_px": list(pairs[0].position_px)})
        for pairs in zip(*columns, strict=False)
    ]


def inside(file: Path, root: str | os.PathLike[str], where: str) -> None:
    """Raises an error if a file, after following links, lies outside a folder."""
    folder, real = os.path.realpath(root), os.path.realpath(file)
    if not os.path.isdir(folder):
        raise FitError(f"root must be a folder, got {show(str(root))}", "manifest", where)
    if os.path.commonpath([folder, real]) != folder:
        raise FitError(f"{str(file)!r} lies outside of {root} (--root)", "manifest", where)


def _valid(part: str, stated: Any, names: list[str], where: str) -> dict[str, Any]:
    """The fields of a part of the manifest, each checked; None for those that are missing and optional."""
    required = [name for name in names if name in _REQUIRED]
    try:
        given = fields(part, stated, required, [name for name in names if name not in required])
        return dict.fromkeys(names) | {name: _FIELDS[name](name, value) or value for name, value in given.items()}
    except ValueError as error:
        raise FitError(str(error), "manifest", where) from None
