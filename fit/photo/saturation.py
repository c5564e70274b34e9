"""What is clipped: pixels at a stated level, or on a plateau that noise would not leave flat; blacks cut off at 0."""

from __future__ import annotations

import numpy as np

from ..problems import FitError, warn
from ..result import Array, Mask
from .dot import Dot, distance_from

__all__ = ["check_blacks", "used_pixels"]

_MOST = 0.6  # share of the dot's pixels beyond which what is left does not fix a fit
_CUT = 0.1  # share of the paper on the lowest level, from which on what is cut off lifts it by a twentieth of the noise
_WIDER = 1.5  # noise over its mean to noise below; where a tenth of it is cut off, 1.9


def used_pixels(
    picture: Array, dot: Dot, white: float | None, file: str | None, name: str, *, refuse: bool = True
) -> Mask:
    """Pixels that are not clipped `[H, W]`, those that noise may have clipped left out with them.

    With `refuse` it warns of pixels that are left out, and raises a `FitError`, both of kind "saturated", where too
    little of the dot is left. `white` None looks for a plateau.
    """
    from scipy.ndimage import uniform_filter

    level = white if white is not None else _plateau(picture, dot)
    clipped = picture >= (np.inf if level is None else level * (1 - 1e-6))
    count = int(clipped.sum())
    if level is None or not count:
        return ~clipped
    # where the level is within the noise of white, only the dark half of the noise is left
    clipped |= uniform_filter(picture, 3, mode="nearest") > level - 3 * dot.noise
    bright = picture > dot.background + 0.15 * dot.peak
    share = float(np.sum(clipped & bright)) / max(int(bright.sum()), 1)
    if refuse and share > _MOST:
        text = f"{100 * share:.0f} % of the {name} dot's pixels are clipped at {level:.4g}; expose less"
        raise FitError(text, "saturated", file=file, number=share)
    if refuse:
        text = f"{count} pixels of the {name} picture are clipped at {level:.4g} and were left out; expose less"
        warn(text, "saturated", file=file, number=float(count))
    return ~clipped


def _plateau(picture: Array, dot: Dot) -> float | None:
    """The level at which a picture is clipped, or None.

    A clipped picture has many pixels at exactly its highest level, more than one level lower, although its noise is
    larger than the distance between its levels. Without noise a flat top is only a flat top.
    """
    top = float(picture.max())
    above = picture[picture > dot.background + 0.5 * dot.peak]
    at_top = int(np.sum(above == top))
    if at_top < 5 or at_top < 0.02 * above.size:
        return None
    levels, counts = np.unique(above, return_counts=True)
    if levels.size > 1 and counts[-1] <= counts[-2]:
        return None  # the tail of the noise, in the few levels of a file
    spacing = float(np.median(np.diff(levels))) if levels.size > 1 else 0.0
    return top if dot.noise > 0.6 * spacing and dot.noise > 1e-12 * abs(top) else None


def check_blacks(picture: Array, dot: Dot, file: str | None, name: str) -> None:
    """Warn where the dark paper's noise is cut off below: it is then brighter than it was, and faint light is not.

    Paper without noise, and paper that keeps within a few levels of a file, lies on its lowest level by right: there
    noise is no wider than a level, or as wide below as above.
    """
    paper = picture[distance_from(dot, picture.shape) > dot.reach + 1]
    levels, counts = np.unique(paper, return_counts=True)
    if levels.size < 2 or counts[0] < _CUT * paper.size:
        return
    mean = float(paper.mean())
    within_a_level = not dot.noise > max(0.6 * (levels[1] - levels[0]), 1e-6 * dot.peak)
    if within_a_level or float(np.quantile(paper, 0.995)) - mean < _WIDER * (mean - levels[0]):
        return
    share = float(counts[0] / paper.size)
    text = (
        f"{100 * share:.0f} % of the {name} picture's paper lies on its lowest level, {levels[0]:.3g}: blacks are cut "
        "off there, and the kernel comes out up to 1 % too small; develop so that black lies above its noise"
    )
    warn(text, "saturated", file=file, number=share)
