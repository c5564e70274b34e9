"""Reads photographs of the printed target from a camera or phone, and determines distances, focus and tone curve."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_gradient_magnitude

from torchdof.io.images import read_image
from torchdof.io.metadata import camera_settings
from torchdof.io.paths import OPTIONAL_SUFFIXES, refusal
from torchdof.validation import number

from ..problems import FitError, warn
from ..result import Array
from .captures import CAMERA, Capture, Captures
from .manifest import MANIFEST, Colours, inside
from .target import DOT_MM, SQUARE_MM, WINDOW, Target, find_target, tone_curve, untoned

_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
_AT_FOCUS = 0.03  # relative difference of distance up to which a photograph is at the focus
_MIN_FOR_TONE = 4  # fewest photographs from which a tone curve can be found


@dataclass(frozen=True)
class Photograph:
    """A photograph of the target."""

    file: str
    light: Array  # [H, W], mean of the colours in linear light, the tone curve undone
    target: Target
    distance_m: float  # from the lens, by the target's size
    sharpness: float  # steepest slope of the dot's edge over its height, 1/px
    clipped: bool  # whether the paper is clipped


@dataclass(frozen=True)
class Photographs:
    """A folder of photographs, ready for fitting."""

    captures: Captures  # for `fit_captures`
    pictures: tuple[Photograph, ...]  # every photograph of the target, by distance
    advice: tuple[str, ...]  # improvements, a sentence each


def read_photographs(
    folder: str | os.PathLike[str],
    *,
    square_mm: float = SQUARE_MM,
    colours: Colours = "mean",
    root: str | os.PathLike[str] | None = None,
) -> Photographs:
    """Reads a folder of photographs of the target, without a description.

    A tone curve is found and undone, each distance is computed from the size of the square, and the sharpest photograph
    is paired with each one out of focus.

    Args:
        folder: folder with the photographs; other files are ignored.
        square_mm: side of the black square as printed, mm.
        colours: "mean", or "each" for a kernel for each colour in the table.
        root: folder that must contain every photograph, after following links; None follows any link.

    Raises:
        FitError: fewer than two photographs show the target, EXIF does not describe the lens, a photograph lies outside
        of the root, or "each" is used for one without three colours. Integers give a `FitWarning` if there are too few
        photographs to find a tone curve.
        ValueError: the square's side is invalid.
        OSError: a picture is damaged.
    """
    number("square_mm", square_mm, low=1e-2, high=1e5, unit="millimetres")
    folder = Path(folder)
    taken = _taken(_files(folder, root), folder, colours)
    pictures, bend, errors, advice = _without_tone_curve(taken, square_mm, str(folder))
    width = pictures[0].light.shape[1]
    pictures, sharpest, focus_m = _at_distances(pictures, taken.settings, width, square_mm)
    out_of_focus = [p for p in pictures if abs(p.distance_m / focus_m - 1) > _AT_FOCUS]
    advice = [*taken.advice, *advice, *_advice(pictures, out_of_focus, sharpest, focus_m)]
    if not out_of_focus:
        text = "all photographs were taken at one distance: step back, without refocusing"
        raise FitError(text, file=str(folder))
    original = {p.file: p.light for p in taken.pictures}

    def colours_of(picture: Photograph, half: int) -> Array:
        pixels = read_image(folder / picture.file).pixels[0, :3].double().numpy()
        return np.stack([untoned(c, bend) if len(errors) else c for c in picture.target.window(pixels, half)])

    def pair(blurred: Photograph) -> Capture:
        both = sharpest, blurred
        half = int(WINDOW * min(p.target.side_px for p in both))
        sharp_levels, blurred_levels = (p.target.window(original[p.file], half) for p in both)
        return Capture(
            sharpest.target.window(sharpest.light, half),
            blurred.target.window(blurred.light, half),
            blurred.distance_m,
            files=(str(folder / sharpest.file), str(folder / blurred.file)),
            white=1.0 if sharpest.clipped else None,
            colours=(colours_of(sharpest, half), colours_of(blurred, half)) if colours == "each" else None,
            uncertain=tuple((untoned(sharp_levels, b), untoned(blurred_levels, b)) for b in bend + errors),
        )

    notes = {"target_square_mm": square_mm, "pictures": [p.file for p in pictures], "sharp": sharpest.file}
    notes |= {"tone_curve": bend.tolist(), "from_exif": list(CAMERA)}
    camera, name = {name: taken.settings[name] for name in CAMERA}, folder.resolve().name
    captures = Captures(tuple(map(pair, out_of_focus)), focus_m, width, **camera, name=name, notes=notes)
    return Photographs(captures, tuple(pictures), tuple(advice))


def _files(folder: Path, root: str | os.PathLike[str] | None) -> list[Path]:
    """The photographs of a folder, at least two."""
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in (*_SUFFIXES, *OPTIONAL_SUFFIXES))
    for path in files:
        if root is not None:
            inside(path, root, str(folder))
        if reason := refusal(path):
            raise FitError(reason, file=str(path))
    if len(files) < 2:
        text = f"there is neither a {MANIFEST} nor two photographs of the page that torchdof fit --target makes"
        raise FitError(text, "manifest", str(folder))
    return files


class _Taken(NamedTuple):
    """Photographs that show the target, as they were taken, without distances."""

    pictures: list[Photograph]
    settings: dict[str, float]  # of the camera, by EXIF
    are_integers: bool
    advice: list[str]


def _taken(files: Sequence[Path], folder: Path, colours: Colours) -> _Taken:
    """Reads photographs, and finds the target in each."""
    pictures, advice, settings, are_integers = list[Photograph](), list[str](), dict[str, float](), True
    for path in files:
        picture = read_image(path)
        if colours == "each" and len(picture.channels) < 3:
            raise FitError("colours = 'each' needs pictures of three colours", file=str(path))
        light = picture.pixels[0, : 3 if len(picture.channels) >= 3 else 1].mean(0).double().numpy()
        try:
            target = find_target(light)
        except FitError as error:
            advice.append(f"{path.name}: left out, {error}")
            continue
        height, width = light.shape
        if pictures and width != pictures[0].light.shape[1]:
            raise FitError(f"is {width} px wide, others {pictures[0].light.shape[1]}: use one camera", file=str(path))
        settings = settings or camera_settings(picture.metadata, width, height)
        is_integer = picture.sample in ("8", "16")
        are_integers = are_integers and is_integer
        slope = gaussian_gradient_magnitude(target.window(light, int(0.06 * target.side_px) + 4), 0.7).max()
        sharpness = float(slope / (target.white - target.black))
        pictures.append(Photograph(path.name, light, target, 0.0, sharpness, is_integer and target.white > 0.98))
    if len(pictures) < 2:
        raise FitError("; ".join(["fewer than two photographs show the target", *advice]), file=str(folder))
    if missing := [name for name in CAMERA if name not in settings]:
        text = f"EXIF has no {', '.join(missing)}: share the originals, or describe them in a {MANIFEST}"
        raise FitError(text, "manifest", str(folder))
    return _Taken(pictures, settings, are_integers, advice)


def _without_tone_curve(
    taken: _Taken, square_mm: float, folder: str
) -> tuple[list[Photograph], Array, Array, list[str]]:
    """The photographs in linear light, the tone curve that was undone, errors of its numbers, and advice."""
    pictures, bend, errors = taken.pictures, np.zeros(3), np.zeros((0, 3))
    if taken.are_integers and len(pictures) >= _MIN_FOR_TONE:
        bend, errors = tone_curve([(p.light, p.target) for p in pictures], square_mm)
    elif taken.are_integers:
        text = f"{len(pictures)} photographs are too few to find a tone curve: take {_MIN_FOR_TONE} or more"
        warn(f"{text}; it makes a kernel up to 15 % too small", "not linear", folder)
    if not bend.any():
        return pictures, bend, errors, []
    pictures = [replace(p, light=untoned(p.light, bend)) for p in pictures]
    pictures = [replace(p, target=find_target(p.light, file=p.file)) for p in pictures]
    curve = ", ".join(f"{value:+.2f}" for value in bend)
    text = f"a tone curve ({curve}) was found by the light of the dot and the edges of the square, and undone; "
    advice = f"{text}blurs of a few px may still be 5 % too small; raw pictures need no such guess"
    return pictures, bend, errors, [advice]


def _at_distances(
    pictures: Sequence[Photograph], settings: Mapping[str, float], width: int, square_mm: float
) -> tuple[list[Photograph], Photograph, float]:
    """The photographs by increasing distance, the sharpest one, and the distance of the focus in metres.

    That distance follows from the square's size there and the thin lens: 1 / focal length = 1 / focus + 1 / image
    distance.
    """
    sharpest = max(pictures, key=lambda p: p.sharpness)
    focal_px = settings["focal_length_mm"] * width / settings["sensor_width_mm"]
    focus_m = (focal_px * square_mm / sharpest.target.side_px + settings["focal_length_mm"]) / 1000
    image_px = focal_px / (1 - settings["focal_length_mm"] / 1000 / focus_m)
    placed = [replace(p, distance_m=image_px * square_mm / 1000 / p.target.side_px) for p in pictures]
    return sorted(placed, key=lambda p: p.distance_m), sharpest, focus_m


def _advice(
    pictures: Sequence[Photograph], out_of_focus: Sequence[Photograph], sharp: Photograph, focus_m: float
) -> list[str]:
    """Improvements, a sentence each."""
    dot_px, count = sharp.target.side_px * DOT_MM / SQUARE_MM / 2, len(out_of_focus)
    is_behind = all(p.distance_m > focus_m for p in out_of_focus)
    advice = [
        (dot_px < 6, f"the sharp dot has a radius of {dot_px:.1f} px, 8 to 20 are best: go nearer"),
        (count < 4, f"{count} distances out of focus: five to nine make a better table"),
        (is_behind, "no picture is nearer than the focus: there the table will be the mirror image of the far side"),
    ]
    for p in pictures:
        white, ratio = p.target.white, p.target.elongation
        advice += [
            (p.clipped, f"{p.file}: the paper is clipped; expose a stop less"),
            (white < 0.15, f"{p.file}: the paper is at {100 * white:.0f} % of white; expose more"),
            (ratio > 1.03, f"{p.file}: the square is {ratio:.2f} times as long as wide; look at it square on"),
        ]
    return [sentence for is_needed, sentence in advice if is_needed]
