"""Photographs of a dot at several distances: read, linearise, subtract the dark, find the dot, cut the windows."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from torchdof.io.images import read_image
from torchdof.io.metadata import camera_facts, original_width
from torchdof.io.transfer import Transfer
from torchdof.validation import show

from ..problems import CameraWarning, DistanceError, FitError, ManifestError, NonFiniteError, NotLinearWarning, warn
from ..result import Array
from .crop import Capture, Dots, cut_pairs, size_of
from .mosaic import PATTERNS, demosaiced

__all__ = ["Capture", "Captures", "Colours", "inside", "read_captures", "read_pair"]

MANIFEST = "capture.toml"
Colours = Literal["mean", "each"]
_RANGES = {  # beyond any camera's
    "focus_m": (1e-5, 1e6),
    "distance_m": (1e-5, 1e6),
    "focal_length_mm": (1e-3, 1e6),
    "f_number": (1e-2, 1e4),
    "sensor_width_mm": (1e-3, 1e5),
    "exposure_s": (1e-9, 1e7),
    "width_px": (1, 2**31),
    "full_width_px": (1, 2**31),
    "original_width_px": (1, 2**31),
}


@dataclass(frozen=True)
class Captures:
    """Pairs of one dot at increasing distances, and the camera that took them.

    Attributes:
        pairs: by increasing distance.
        focus_m: distance of the sharp picture: what the lens stays focused on.
        width_px: width of the whole frame, which `sensor_width_mm` belongs to: the pictures may be crops of it.
        focal_length_mm: of the lens, or None.
        f_number: of the lens, or None.
        sensor_width_mm: of the camera, or None.
        name: of the table to be.
        notes: more about the capture, for the table's provenance.
        original_width_px: width at which EXIF says the pictures were taken, where it is another than theirs and nobody
            said whether they are crops. None otherwise.
    """

    pairs: tuple[Capture, ...]
    focus_m: float
    width_px: int
    focal_length_mm: float | None = None
    f_number: float | None = None
    sensor_width_mm: float | None = None
    name: str = ""
    notes: Mapping[str, Any] = field(default_factory=dict)
    original_width_px: int | None = None

    def __post_init__(self) -> None:
        """Check what all later steps rely on.

        Raises:
            DistanceError: distances are not increasing, not positive, or one is that of the focus.
            FitError: no pair, or a camera number that is not positive.
        """
        if not isinstance(self.pairs, Sequence) or not all(isinstance(p, Capture) for p in self.pairs):
            raise FitError(f"pairs must be a tuple of Capture(sharp, blurred, distance_m), got {show(self.pairs)}")
        if not self.pairs:
            raise FitError("captures hold no pair of pictures; photograph the dot at one more distance at least")
        _check_distances([p.distance_m for p in self.pairs], self.focus_m, None)
        for what in ("width_px", "focal_length_mm", "f_number", "sensor_width_mm", "original_width_px"):
            value = getattr(self, what)
            plain, (low, high) = isinstance(value, int | float) and not isinstance(value, bool), _RANGES[what]
            if not (plain and low <= value <= high) and (value is not None or what == "width_px"):
                raise FitError(f"{what} must be positive, got {show(value)}; a camera's is {low:g} to {high:g}")

    def __iter__(self) -> Iterator[Capture]:
        """Iterate over the pairs."""
        return iter(self.pairs)

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.pairs)


def read_captures(
    folder: str | os.PathLike[str],
    *,
    dots: Dots | None = None,
    colours: Colours | None = None,
    root: str | os.PathLike[str] | None = None,
) -> list[Captures]:
    """Read a folder of photographs described by its `capture.toml`.

    ```toml
    focus_m = 0.20              # the lens stays focused here
    sharp = "0200mm.png"        # the dot at that distance
    focal_length_mm = 50.0      # camera: what is left out is read from EXIF; all three make the table know its unit
    f_number = 2.8
    sensor_width_mm = 36.0
    full_width_px = 6000        # optional: width of the whole frame, if the pictures were cropped before
    crop = [1200, 800, 900, 900]  # optional: left, top, width, height in px; what lies outside is not looked at
    transfer = "srgb"           # "srgb" or "linear"; left out, floats are linear, and integers sRGB with a warning
    dark = "dark.png"           # optional: lens cap on, same exposure
    exposure_s = 0.02           # optional: of the sharp picture
    dots = "one"                # or "centre", "each" for a grid of dots
    colours = "mean"            # or "each": red, green and blue by themselves, a kernel a colour in the table
    bayer = "RGGB"              # optional: the pictures are a sensor's mosaic, one colour a pixel, linear
    name = "my lens at f/2.8"   # optional

    [[shot]]                    # by increasing distance
    file = "0500mm.png"
    distance_m = 0.50
    exposure_s = 0.02           # optional
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
        ManifestError: the manifest is missing, is not TOML, or a field is wrong.
        DistanceError: distances are not increasing, not positive, or that of the focus.
        FitError: a picture's kind of trouble, with its file.
        OSError: a picture is missing or damaged.

    Warns:
        NotLinearWarning: pictures of integers whose transfer nobody stated: they are taken for sRGB.
        CameraWarning: the manifest contradicts EXIF.
    """
    if not isinstance(folder, str | os.PathLike):
        raise ManifestError(f"folder must be the path of a folder or of its {MANIFEST}, got {show(folder)}")
    path = Path(folder)
    path = path / MANIFEST if path.is_dir() or path.suffix != ".toml" else path
    if root is not None:
        inside(path, root, str(path))
    fields = _manifest(path)
    where, base = str(path), path.parent
    focus = _number(fields, "focus_m", where)
    shots = fields.get("shot")
    if not isinstance(shots, list) or not shots or not all(isinstance(s, dict) for s in shots):
        raise ManifestError("give at least one [[shot]] with file and distance_m", file=where)
    _known(fields, _FIELDS, where)
    for shot in shots:
        _known(shot, ("file", "distance_m", "exposure_s"), where)
    distances = [_number(s, "distance_m", where) for s in shots]
    _check_distances(distances, focus, where)
    transfer = fields.get("transfer")
    if transfer not in (None, "linear", "srgb"):
        raise ManifestError(f"transfer must be 'linear' or 'srgb', got {transfer!r}", file=where)
    chosen = dots or fields.get("dots", "one")
    if chosen not in get_args(Dots):
        raise ManifestError(f"dots must be 'one', 'centre', 'each' or 'field', got {chosen!r}", file=where)
    wanted = colours or fields.get("colours", "mean")
    if wanted not in ("mean", "each"):
        raise ManifestError(f"colours must be 'mean' or 'each', got {wanted!r}", file=where)
    pattern = fields.get("bayer")
    if pattern not in (None, *PATTERNS):
        raise ManifestError(f"bayer must be one of {', '.join(PATTERNS)}, got {show(pattern)}", file=where)
    dark = _text(fields, "dark", where)
    sharp = base / _text(fields, "sharp", where, needed=True)  # type: ignore[operator]
    files = [base / _text(shot, "file", where, needed=True) for shot in shots]  # type: ignore[operator]
    if root is not None:
        for file in [sharp, *files, *([] if dark is None else [base / dark])]:
            inside(file, root, where)
    crop = _crop(fields, where)
    darkness = None if dark is None else _read(base / dark, transfer, None, crop, pattern)
    first = _read(sharp, transfer, darkness, crop, pattern)
    if wanted == "each" and first.colours.shape[0] != 3:
        got = f"got {first.colours.shape[0]}"
        raise ManifestError(f"colours = 'each' needs pictures of three colours, or bayer = 'RGGB', {got}", file=where)
    still, exposed = first.light, _optional(fields, "exposure_s", where)
    columns: list[list[Capture]] = []
    encoded = [sharp.name] if first.encoded else []
    for shot, distance, file in zip(shots, distances, files, strict=True):
        moved = _read(file, transfer, darkness, crop, pattern)
        if moved.light.shape != still.shape:
            raise ManifestError(f"{file.name} is {size_of(moved.light)}, {sharp.name} is {size_of(still)}", file=where)
        _check_same_camera(first.facts, moved.facts, sharp.name, str(file))
        encoded += [file.name] if moved.encoded else []
        second = _optional(shot, "exposure_s", where)
        columns.append(
            cut_pairs(
                still,
                moved.light,
                distance,
                focus / distance,
                chosen,
                (str(sharp), str(file)),
                first.white,
                None if exposed is None or second is None else second / exposed,
                first.middle,
                (first.colours, moved.colours) if wanted == "each" else None,
            )
        )
    _check_stated(transfer, encoded, where)
    camera = {name: _optional(fields, name, where) for name in ("focal_length_mm", "f_number", "sensor_width_mm")}
    from_exif = [name for name, value in camera.items() if value is None and name in first.facts]
    _check_exif(camera, first.facts, where)
    full_width = _optional(fields, "full_width_px", where)
    if full_width is not None and full_width < first.width_px:
        got = f"got {full_width:g} for pictures of {first.width_px}"
        raise ManifestError(f"full_width_px must be at least the pictures' own width, {got}", file=where)
    notes = {"manifest": path.name, "transfer": transfer or "by file type", "pictures": [s["file"] for s in shots]}
    if from_exif:
        notes["from_exif"] = from_exif
    return [
        Captures(
            pairs=tuple(column[i] for column in columns),
            focus_m=focus,
            width_px=first.width_px if full_width is None else round(full_width),
            **{name: first.facts.get(name) if value is None else value for name, value in camera.items()},
            name=_text(fields, "name", where) or base.resolve().name,
            notes=notes | {"dots": chosen, "position_px": list(columns[0][i].position_px)},
            original_width_px=first.original_width_px if full_width is None else None,
        )
        for i in range(min(len(c) for c in columns))
    ]


def read_pair(
    sharp: str | os.PathLike[str],
    blurred: str | os.PathLike[str],
    *,
    distance_m: float = 1.0,
    magnification: float = 1.0,
    transfer: Transfer | None = None,
) -> Capture:
    """Read two photographs of one dot and cut the windows that hold it.

    Args:
        sharp: file of the dot in focus.
        blurred: file of the dot out of focus, the same size.
        distance_m: of the dot in `blurred`.
        magnification: expected size of the dot in `blurred` over that in `sharp`.
        transfer: "linear" or "srgb"; None takes integers as sRGB and floats as linear.

    Raises:
        FitError: a picture's kind of trouble, with its file.
        OSError: a picture is missing or damaged.

    Warns:
        NotLinearWarning: a picture of integers, and `transfer` is None.
    """
    for name, file in (("sharp", sharp), ("blurred", blurred)):
        if not isinstance(file, str | os.PathLike):
            raise FitError(f"{name} must be the path of a picture, got {show(file)}")
    first, second = _read(Path(sharp), transfer), _read(Path(blurred), transfer)
    still, moved, files = first.light, second.light, (str(sharp), str(blurred))
    if still.shape != moved.shape:
        raise FitError(f"the pictures must have one size, got {size_of(still)} and {size_of(moved)}", file=str(blurred))
    encoded = [Path(f).name for f, p in zip(files, (first, second), strict=True) if p.encoded]
    _check_stated(transfer, encoded, None)
    return cut_pairs(still, moved, distance_m, magnification, "one", files, first.white, None, first.middle)[0]


_FIELDS = (
    "focus_m", "sharp", "shot", "focal_length_mm", "f_number", "sensor_width_mm", "transfer", "dark", "exposure_s",
    "dots", "name", "full_width_px", "crop", "colours", "bayer",
)  # fmt: skip


def _manifest(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ManifestError("there is no such manifest; write a capture.toml beside the pictures", file=str(path))
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ManifestError(f"is not TOML: {error}", file=str(path)) from error


def inside(file: Path, root: str | os.PathLike[str], where: str) -> None:
    """Refuse a file that does not lie in a folder, wherever its name and links lead."""
    folder, real = os.path.realpath(root), os.path.realpath(file)
    if not os.path.isdir(folder):
        raise ManifestError(f"root must be a folder, got {show(str(root))}", file=where)
    if os.path.commonpath([folder, real]) != folder:
        raise ManifestError(f"{str(file)!r} lies outside of {root}, and nothing else may be read (--root)", file=where)


def _known(fields: Mapping[str, Any], names: Sequence[str], where: str) -> None:
    for name in fields:
        if name not in names:
            raise ManifestError(f"{name!r} is not a field; known are {', '.join(names)}", file=where)


def _number(fields: Mapping[str, Any], name: str, where: str) -> float:
    value, (low, high) = fields.get(name), _RANGES[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ManifestError(
            f"{name} must be a positive number, got {show(value)}; a camera's is {low:g} to {high:g}", file=where
        )
    return float(value)


def _optional(fields: Mapping[str, Any], name: str, where: str) -> float | None:
    return _number(fields, name, where) if name in fields else None


def _text(fields: Mapping[str, Any], name: str, where: str, needed: bool = False) -> str | None:
    value = fields.get(name)
    if (value is None and needed) or not (value is None or (isinstance(value, str) and value and "\0" not in value)):
        raise ManifestError(f"{name} must be a text, got {value!r}", file=where)
    return value


def _check_distances(distances: Sequence[float], focus: float, where: str | None) -> None:
    """Refuse distances that are not positive and increasing, or that equal the focus."""
    for what, value in [("focus_m", focus), *(("distance_m", d) for d in distances)]:
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e100:
            raise DistanceError(f"{what} must be a positive number of metres, got {show(value)}", file=where)
    for before, distance in zip([0.0, *distances], distances, strict=False):
        if not before < distance < math.inf:
            raise DistanceError(
                f"distances must be positive and increasing, got {', '.join(f'{d:g}' for d in distances)} m",
                file=where,
                number=float(distance),
            )
        if distance == focus:
            raise DistanceError(f"a shot lies at the focus ({focus:g} m) and has no blur", file=where, number=focus)
    if not 0 < focus < math.inf:
        raise DistanceError(f"focus_m must be positive, got {focus}", file=where, number=float(focus))


@dataclass(frozen=True)
class _Photograph:
    """A picture `[H, W]` in linear light, mean of its colours, and what its file says.

    Attributes:
        light: `[H, W]`.
        colours: `[C, H, W]`, whose mean it is.
        white: the level at which it is clipped, or None.
        encoded: whether it was stored in integers, and decoded as sRGB.
        width_px: of the whole picture.
        middle: (x, y) of the whole picture's centre in px of `light`.
        facts: what EXIF says about the camera.
        original_width_px: width at which EXIF says it was taken, where that is another one.
    """

    light: Array
    colours: Array
    white: float | None
    encoded: bool
    width_px: int
    middle: tuple[float, float]
    facts: Mapping[str, float]
    original_width_px: int | None


def _read(
    path: Path,
    transfer: Any,
    dark: _Photograph | None = None,
    crop: tuple[int, int, int, int] | None = None,
    pattern: str | None = None,
) -> _Photograph:
    picture = read_image(path, transfer=transfer)
    pixels = picture.pixels[0].numpy().astype(np.float64)
    pixels = pixels[[i for i, name in enumerate(picture.channels) if name != "A"]]
    if pattern is not None:
        if len(pixels) != 1:
            got = f"got {len(pixels)} colours"
            raise ManifestError(f"bayer = {pattern!r} is for pictures with one colour a pixel, {got}", file=str(path))
        pixels = demosaiced(pixels[0], pattern)
    height, width = pixels.shape[1:]
    middle = ((width - 1) / 2, (height - 1) / 2)
    if crop is not None:
        left, top, columns, rows = crop
        if left + columns > width or top + rows > height:
            raise ManifestError(f"crop {list(crop)} leaves the picture of {width}x{height}", file=str(path))
        pixels = pixels[:, top : top + rows, left : left + columns]
        middle = (middle[0] - left, middle[1] - top)
    bad = int(np.sum(~np.isfinite(pixels)))
    if bad:
        raise NonFiniteError(f"{bad} values are NaN or infinite", file=str(path), number=float(bad))
    white = 1.0 if picture.sample in ("8", "16") else None
    high = pixels >= 1.0 - 1e-6
    if dark is not None:
        if dark.colours.shape != pixels.shape:
            raise FitError(f"the dark frame is {size_of(dark.light)}, the picture {size_of(pixels[0])}", file=str(path))
        pixels = pixels - dark.colours
    light = pixels.mean(axis=0)
    if white is not None:
        pixels[high] = white
        light[high.any(axis=0)] = white  # one clipped colour clips the mean
    facts = camera_facts(picture.metadata, width)
    if height > width and "sensor_width_mm" in facts:  # turned upright: EXIF speaks of the longer side
        facts["sensor_width_mm"] *= width / height
    original = original_width(picture.metadata)
    taken = original if original is not None and original > width else None
    encoded = white is not None and picture.transfer == "srgb"
    return _Photograph(light, pixels, white, encoded, width, middle, facts, taken)


def _crop(fields: Mapping[str, Any], where: str) -> tuple[int, int, int, int] | None:
    value = fields.get("crop")
    if value is None:
        return None
    whole = isinstance(value, list) and len(value) == 4 and all(type(v) is int and 0 <= v < 2**31 for v in value)
    if not whole or value[2] < 1 or value[3] < 1:
        raise ManifestError(f"crop must be [left, top, width, height] in pixels, got {show(value)}", file=where)
    return value[0], value[1], value[2], value[3]


def _check_stated(transfer: str | None, encoded: Sequence[str], where: str | None) -> None:
    """Warn of pictures that are decoded as sRGB because nobody said how they are encoded."""
    if transfer is None and encoded:
        more = f" and {len(encoded) - 1} more" if len(encoded) > 1 else ""
        text = (
            f"nobody said how {encoded[0]}{more} are encoded, and they are taken for sRGB. A camera's own tone curve "
            "or sharpening makes the kernel up to 15 % too small and need not show: develop to linear light without "
            "them. Then say transfer = 'linear', or 'srgb' if that is all that was done"
        )
        warn(NotLinearWarning(text, file=where, number=float(len(encoded))), stacklevel=4)


def _check_same_camera(first: Mapping[str, float], second: Mapping[str, float], name: str, file: str) -> None:
    """Refuse pictures of one capture between which the lens was changed."""
    for what, word in (("f_number", "f-number"), ("focal_length_mm", "focal length")):
        if what in first and what in second and abs(math.log(first[what] / second[what])) > 0.02:
            raise ManifestError(
                f"EXIF says this was taken at {word} {second[what]:g}, and {name} at {first[what]:g}; aperture and "
                "zoom must stay as they are",
                file=file,
                number=second[what],
            )


def _check_exif(camera: Mapping[str, float | None], facts: Mapping[str, float], where: str) -> None:
    """Warn where the manifest contradicts what EXIF says; the manifest's is taken."""
    for name, most in (("focal_length_mm", 0.1), ("f_number", 0.1), ("sensor_width_mm", 0.15)):
        stated = camera[name]
        if stated is not None and name in facts and abs(math.log(stated / facts[name])) > most:
            text = f"{name} is stated as {stated:g}, and EXIF says {facts[name]:.4g}; the stated one is taken"
            warn(CameraWarning(text, file=where, number=stated / facts[name]), stacklevel=4)
