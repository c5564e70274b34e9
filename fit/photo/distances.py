"""Fits the pairs of a capture, their uncertainty, and each colour."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchdof.optics.aperture import Aperture

from ..problems import without_warnings
from ..result import Array, BlurFit
from .captures import Capture, Captures
from .dot import find_dot
from .opening import turned
from .pair import fit_pair
from .source import soft_edge

_KNOTS = 33  # values of a free profile, equal for all distances
_COLOURS = ("red", "green", "blue")
_GREEN = 1
_DEFOCUSED_PX = 1.5  # px; for smaller blurs it is uncertain on which side of focus a colour is
_RADIUS_ERROR = 0.02  # relative error with which the thin lens gives the radius


def fit_one(pair: Capture, focus_m: float, family: str, opening: Aperture | None = None, **arguments: Any) -> BlurFit:
    """Fits one pair by `fit_pair`, or the size of an opening as seen behind the focus."""
    expected = {"magnification": focus_m / pair.distance_m, "knots": _KNOTS if family == "radial" else None}
    arguments = {"white": pair.white, "files": pair.files, **expected, **arguments}
    if opening is None:
        return fit_pair(pair.sharp, pair.blurred, family, **arguments)
    aperture = turned(opening) if pair.distance_m < focus_m else opening
    return replace(fit_pair(pair.sharp, pair.blurred, "image", aperture=aperture, **arguments), family=family)


def common_opening(captures: Captures, family: str, fits: Sequence[BlurFit]) -> Aperture:
    """The opening of the largest blur whose fit is of `family` ("polygon" or "image"), as seen behind the focus."""
    openings = [(fit, pair) for fit, pair in zip(fits, captures, strict=True) if fit.family == family]
    largest, pair = max(openings, key=lambda opening: opening[0].radius)
    opening = largest.aperture or Aperture()
    return turned(opening) if pair.distance_m < captures.focus_m else opening


def _fit_like(fit: BlurFit, pair: Capture, focus_m: float, sharp: Array, blurred: Array, **options: Any) -> BlurFit:
    """Fits other pictures of a pair like its own: with the same family and opening, or free profile's end."""
    family = fit.family if fit.aperture is None else "image"
    options |= {"aperture": fit.aperture, "reach": fit.params["radius"] if family == "radial" else None}
    return fit_one(replace(pair, sharp=sharp, blurred=blurred), focus_m, family, **options)


def with_uncertainty(pair: Capture, focus_m: float, fit: BlurFit) -> BlurFit:
    """Adds the uncertainty of a pair's pictures (``pair.uncertain``) to the standard errors of its fit."""
    if not pair.uncertain:
        return fit
    with without_warnings():
        others = [_fit_like(fit, pair, focus_m, *pictures) for pictures in pair.uncertain]
    zero = np.zeros(1)
    names = ("values",) if fit.family == "radial" else fit.names
    changes = np.stack(
        [np.hstack([np.subtract(o.params.get(n, zero), fit.params.get(n, zero)) for n in names]) for o in others]
    )  # [others, parameters]
    covariance = fit.covariance + changes.T @ changes
    spread = np.sqrt(np.diag(covariance))
    errors = {"values": spread} if fit.family == "radial" else dict(zip(names, spread.tolist(), strict=True))
    return replace(
        fit,
        stderr=fit.stderr | {n: error for n, error in errors.items() if n in fit.params},
        covariance=covariance,
        radius_stderr=float(np.hypot(fit.radius_stderr, np.linalg.norm([o.radius - fit.radius for o in others]))),
    )


@dataclass(frozen=True)
class Colour:
    """One colour of a capture."""

    name: str  # "red", "green" or "blue"
    fits: tuple[BlurFit, ...]  # one for each distance, like those of the mean of the colours
    # longitudinal colour: 1/distance of its focus minus that of green, 1/m; NaN unless two distances are blurred enough
    focus_shift_dioptres: float
    # lateral colour: (x, y) offsets of its dot from green's, px: in focus, then at each distance
    lateral_px: tuple[tuple[float, float], ...]


def fit_colours(captures: Captures, fits: Sequence[BlurFit]) -> tuple[Colour, ...]:
    """Fits red, green and blue of every pair like their mean.

    The softness of the sharpest colour is used for all, so that each kernel contains all of its colour's blur.
    """
    fits_by_colour: list[list[BlurFit]] = [[] for _ in _COLOURS]
    for pair, mean in zip(captures, fits, strict=True):
        if pair.colours is None:
            raise AssertionError("only captures with colours are fitted by colour")
        softness = min(soft_edge(sharp, find_dot(sharp, file=pair.files[0])).softness for sharp in pair.colours[0])
        fixed: dict[str, Any] = {"magnification": mean.magnification, "fit_magnification": False, "softness": softness}
        with without_warnings():  # the mean's fit has already warned
            for colour, *pictures in zip(fits_by_colour, *pair.colours, strict=True):
                colour.append(_fit_like(mean, pair, captures.focus_m, *pictures, **fixed))
    green = fits_by_colour[_GREEN]
    shifts = [_focus_shift(captures.defocus, colour) for colour in fits_by_colour]
    colours = []
    for name, colour, shift in zip(_COLOURS, fits_by_colour, shifts, strict=True):
        blurred = np.array([np.subtract(f.centre, g.centre) for f, g in zip(colour, green, strict=True)])
        shifts_from_green = np.array([np.subtract(f.shift, g.shift) for f, g in zip(colour, green, strict=True)])
        lateral = tuple((float(x), float(y)) for x, y in [(blurred - shifts_from_green).mean(axis=0), *blurred])
        colours.append(Colour(name, tuple(colour), shift - shifts[_GREEN], lateral))
    return tuple(colours)


def _focus_shift(defocus: Array, fits: Sequence[BlurFit]) -> float:
    """1/distance of a colour's focus minus the capture's, 1/m: where the line through its signed radii crosses 0."""
    radius: Array = np.array([f.radius for f in fits]) * np.sign(defocus)
    error = np.hypot([f.radius_stderr for f in fits], _RADIUS_ERROR * radius)
    is_blurred = np.abs(radius) > _DEFOCUSED_PX
    if is_blurred.sum() < 2:
        return math.nan
    slope, intercept = np.polyfit(defocus[is_blurred], radius[is_blurred], 1, w=1 / error[is_blurred])
    # radius = slope * (1/focus - shift - 1/distance), with the colour's own focus 1/focus - shift
    return float(intercept / slope)
