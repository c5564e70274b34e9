"""The paper's blur strength: the defocused picture over the sharp one, along spokes around the dot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..problems import FitError
from ..result import Array, BlurFit, Indices
from ..validation import a_picture
from .dot import find_dot
from .profile_fit import fit_profile

__all__ = ["blur_strength", "fit_ratio"]

_SMALLEST = 5  # px: noise is taken from second differences of second differences
_STEP_DEG = 10


def blur_strength(sharp: ArrayLike, blurred: ArrayLike) -> tuple[Array, Array, Indices]:
    """`I_b(r, theta) / I(r, theta)` from the dot's centre to its circumference, every pixel of r and 10 degrees.

    The centre is the dot's in the sharp picture, as in the paper: a displaced defocused dot is not followed. What is
    measured is the dot convolved with the kernel, not the kernel, and it ends at the dot's circumference: use it to
    compare with the paper, and the forward model to render.

    Args:
        sharp: `[H, W]`, linear light, the dot in focus.
        blurred: `[H, W]`, linear light, the same dot out of focus.

    Returns:
        Radii in px, strengths (levels are bilinear between pixels) and the number of the spoke of each sample, all
        `[n]`.

    Raises:
        FitError: no usable dot.

    Reference:
        Sato, Dobashi, Yamamoto, section 2.

    Example:
        >>> from torchdof.optics import psf
        >>> dot = psf.disc(6.0, size=31).numpy()
        >>> r, strength, spoke = blur_strength(dot, 0.5 * dot)
        >>> round(float(r.max())), round(float(strength.mean()), 3), len(set(spoke.tolist()))
        (5, 0.5, 36)
    """
    from scipy.ndimage import map_coordinates

    still, moved = a_picture("sharp", sharp, _SMALLEST), a_picture("blurred", blurred, _SMALLEST)
    dot, soft = find_dot(still), find_dot(moved)
    # the last pixel of the dot is half paper
    r = np.arange(0.0, max(dot.radius - 1.0, 1.0) + 1e-9)
    theta = np.deg2rad(np.arange(0, 360, _STEP_DEG))[:, None]
    where = [dot.y + r * np.sin(theta), dot.x + r * np.cos(theta)]
    below, above = (map_coordinates(p, where, order=1, mode="nearest") for p in (still, moved))
    below, above = below - dot.background, above - soft.background
    used = below > 0.2 * dot.peak
    spokes, rays = np.nonzero(used)
    return r[rays], above[used] / below[used], spokes


def fit_ratio(sharp: Array | None, blurred: Array, family: str) -> BlurFit:
    """The paper's procedure: a profile fitted to the blur strength, errors that a spoke has in common allowed for."""
    if sharp is None:
        raise FitError("model='ratio' divides by the sharp picture, got sharp=None; use model='forward'")
    r, strength, spokes = blur_strength(sharp, blurred)
    return replace(fit_profile(r, strength, family, groups=spokes), model="ratio")
