"""The paper's blur strength: the defocused picture over the sharp one, along spokes around the dot."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from torchdof.validation import show

from ..problems import FitError
from ..result import Array, Indices
from ..validation import a_number, a_picture
from .dot import find_dot

__all__ = ["blur_strength", "polar_samples"]

_SMALLEST = 5  # px: noise is taken from second differences of second differences


def polar_samples(
    picture: ArrayLike, centre: tuple[float, float], radius: float, *, step_deg: float = 10.0, spacing: float = 1.0
) -> tuple[Array, Array, Array]:
    """Levels of a picture along spokes around a point.

    Args:
        picture: `[H, W]`.
        centre: (x, y) in px; the centre of pixel (0, 0) is (0, 0).
        radius: length of the spokes in px.
        step_deg: angle between spokes; the paper's is 10 degrees.
        spacing: distance between samples along a spoke in px.

    Returns:
        Radii `[n]` in px, angles `[m]` in radians, and the levels `[m, n]`, bilinear between pixels.

    Reference:
        Sato, Dobashi, Yamamoto, section 2.

    Example:
        >>> import numpy as np
        >>> r, theta, levels = polar_samples(np.ones((21, 21)), (10, 10), radius=5)
        >>> len(r), len(theta), float(levels.mean())
        (6, 36, 1.0)
    """
    from scipy.ndimage import map_coordinates

    levels = a_picture("picture", picture, 1)
    try:
        x, y = (a_number("centre", c, -1e9, 1e9, unit="pixels") for c in centre)
    except (TypeError, ValueError):
        raise FitError(f"centre must be (x, y) in pixels, got {show(centre)}") from None
    for name, value, most in (("radius", radius, 1e5), ("spacing", spacing, 1e5), ("step_deg", step_deg, 120.1)):
        try:
            a_number(name, value, 0.0, most)
        except FitError:
            got = f"got {show(radius)}, {show(spacing)}, {show(step_deg)}"
            raise FitError(f"radius, spacing and step_deg must be positive, {got}") from None
    if radius / spacing * 360 / step_deg > 1e7:
        raise FitError(f"spacing and step_deg must give at most 10 million samples, got {spacing:g} and {step_deg:g}")
    r = np.arange(0.0, radius + 1e-9, spacing)
    theta = np.deg2rad(np.arange(0.0, 360.0 - 1e-9, step_deg))
    columns = x + r[None, :] * np.cos(theta)[:, None]
    rows = y + r[None, :] * np.sin(theta)[:, None]
    levels = map_coordinates(levels, [rows, columns], order=1, mode="nearest")
    return r, theta, np.asarray(levels, dtype=np.float64)


def blur_strength(
    sharp: ArrayLike, blurred: ArrayLike, *, step_deg: float = 10.0, spacing: float = 1.0
) -> tuple[Array, Array, Indices]:
    """`I_b(r, theta) / I(r, theta)` from the dot's centre to its circumference.

    The centre is the dot's in the sharp picture, as in the paper: a displaced defocused dot is not followed. What is
    measured is the dot convolved with the kernel, not the kernel, and it ends at the dot's circumference: use it to
    compare with the paper, and the forward model to render.

    Args:
        sharp: `[H, W]`, linear light, the dot in focus.
        blurred: `[H, W]`, linear light, the same dot out of focus.
        step_deg: angle between spokes.
        spacing: distance between samples along a spoke in px.

    Returns:
        Radii, strengths and the number of the spoke of each sample, all `[n]`.

    Raises:
        FitError: no usable dot (see `find_dot`).

    Reference:
        Sato, Dobashi, Yamamoto, section 2.
    """
    still, moved = a_picture("sharp", sharp, _SMALLEST), a_picture("blurred", blurred, _SMALLEST)
    dot, soft = find_dot(still), find_dot(moved)
    # the last pixel of the dot is half paper
    r, theta, below = polar_samples(
        still, (dot.x, dot.y), max(dot.radius - 1.0, 1.0), step_deg=step_deg, spacing=spacing
    )
    above = polar_samples(moved, (dot.x, dot.y), float(r[-1]), step_deg=step_deg, spacing=spacing)[2]
    below, above = below - dot.background, above - soft.background
    used = below > 0.2 * dot.peak
    spokes = np.broadcast_to(np.arange(theta.size)[:, None], used.shape)
    radii = np.broadcast_to(r[None, :], used.shape)
    return radii[used], above[used] / below[used], spokes[used]
