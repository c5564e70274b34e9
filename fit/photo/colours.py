"""The colours of one capture by themselves: what differs in the size of their blur, and what in its place.

A lens focuses each colour elsewhere (longitudinal colour), which a kernel a colour shows, and draws each at another
size (lateral colour), which displaces the dot of a colour and belongs into no kernel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchdof.optics.aperture import Aperture

from ..problems import unheard
from ..result import Array, BlurFit
from .captures import Captures
from .distances import fit_one
from .dot import find_dot
from .forward import OPENINGS
from .opening import turned
from .source import soft_edge

__all__ = ["NAMES", "Colour", "fit_colours"]

NAMES = ("red", "green", "blue")

_GREEN = 1
_DEFOCUSED_PX = 1.5  # a smaller blur does not tell on which side of focus a colour is
_KNOWN = 0.02  # share of a radius to which the thin lens is believed


@dataclass(frozen=True)
class Colour:
    """One colour of a capture.

    Attributes:
        name: "red", "green" or "blue".
        fits: one for each distance, as those of the mean of the colours.
        focus_shift_dioptres: 1/distance of its focus less that of green's, 1/m: longitudinal colour. NaN where
            fewer than two distances are blurred enough to tell.
        lateral_px: (x, y) by which its dot lies beside green's, px: in focus, then at each distance: lateral colour.
    """

    name: str
    fits: tuple[BlurFit, ...]
    focus_shift_dioptres: float
    lateral_px: tuple[tuple[float, float], ...]


def fit_colours(
    captures: Captures, fits: Sequence[BlurFit], family: str, opening: Aperture | None
) -> tuple[Colour, ...]:
    """Fit red, green and blue of every pair with the family that their mean was fitted with.

    In the sharp picture a colour that is not the one in focus is itself blurred a little. The sharpest colour's edge
    stands for all, so that each kernel holds all of its colour's blur.
    `opening` is as it shows behind the focus, for families that have one.
    """
    found: list[list[BlurFit]] = [[] for _ in NAMES]
    for pair, mean in zip(captures, fits, strict=True):
        if pair.colours is None:
            raise AssertionError("only captures with colours are fitted by colour")
        shown = opening if opening is None or pair.distance_m > captures.focus_m else turned(opening)
        softness = min(soft_edge(still, find_dot(still, file=pair.files[0])).softness for still in pair.colours[0])
        for colour, still, blurred in zip(found, *pair.colours, strict=True):
            with unheard():  # what is wrong with a capture its mean has said
                fit = fit_one(
                    replace(pair, sharp=still, blurred=blurred),
                    captures.focus_m,
                    "image" if family in OPENINGS else family,
                    magnification=mean.magnification,
                    fit_magnification=False,
                    start=None if family in OPENINGS else mean,
                    reach=float(mean.params["radius"]) if family == "radial" else None,
                    aperture=shown,
                    softness=softness,
                )
            colour.append(fit)
    shifts = [_focus_shift(captures.defocus, colour) for colour in found]
    return tuple(
        Colour(name, tuple(colour), shift - shifts[_GREEN], _beside(colour, found[_GREEN]))
        for name, colour, shift in zip(NAMES, found, shifts, strict=True)
    )


def _focus_shift(defocus: Array, fits: Sequence[BlurFit]) -> float:
    """1/distance of a colour's focus less the capture's, 1/m: where the line through its signed radii crosses 0."""
    radius: Array = np.array([f.radius for f in fits]) * np.sign(defocus)
    error = np.hypot([f.radius_stderr for f in fits], _KNOWN * radius)
    telling = np.abs(radius) > _DEFOCUSED_PX
    if telling.sum() < 2:
        return math.nan
    slope, start = np.polyfit(defocus[telling], radius[telling], 1, w=1 / error[telling])
    # the blur is slope * (1/focus - shift' - 1/distance) with the colour's own 1/focus - shift'
    return float(start / slope)


def _beside(fits: Sequence[BlurFit], green: Sequence[BlurFit]) -> tuple[tuple[float, float], ...]:
    """(x, y) by which dots lie beside green's: of the sharp picture, then of each distance."""
    moved = np.array([np.subtract(f.centre, g.centre) for f, g in zip(fits, green, strict=True)])
    shifted = np.array([np.subtract(f.shift, g.shift) for f, g in zip(fits, green, strict=True)])
    return tuple((float(x), float(y)) for x, y in [(moved - shifted).mean(axis=0), *moved])
