"""What makes a forward fit less than it looks: its residual, its roundness, its window, its bounds."""

from __future__ import annotations

import numpy as np

from ..problems import FitError, warn
from ..result import BlurFit
from .diagnostics import CHANCE, UNEVEN, asymmetry_of, size_of_blur
from .forward import Forward, Solution
from .noise import independent_share, noise_of

__all__ = ["FAR_ABOVE", "check_fit"]

FAR_ABOVE = 1.6
"""Residual over noise from which on it is said."""

_MATTERS, _SEEN = 0.005, 1e-3
_SPOT, _SPOT_MATTERS = 8.0, 0.003
_MAGNIFIED = 0.08
_OUTSIDE_REFUSED, _OUTSIDE_WARNED = 0.05, 0.005


def check_fit(pair: Forward, solution: Solution, fit: BlurFit, file: str | None, freest: BlurFit) -> None:
    """Raise or warn about everything that makes a fit of the picture `file` less than it looks.

    The solution is judged as the `fit` that will be returned; its residual beside that of the `freest` fit.
    """
    if not fit.gain > 0:
        raise FitError("the blurred picture has nothing in common with the sharp one", file=file, number=fit.gain)
    outside = _outside(pair, solution)
    size = f"{pair.data.shape[1]}x{pair.data.shape[0]} px"
    if outside > _OUTSIDE_REFUSED:
        text = f"the window cuts the blur: {100 * outside:.0f} % of its light falls outside {size}; cut a larger one"
        raise FitError(text, "window", file=file, number=outside)
    if outside > _OUTSIDE_WARNED:
        text = f"{100 * outside:.1f} % of the blur's light falls outside the window of {size}; cut a larger one"
        warn(text, "window", file=file, number=outside)
    _check_residual(fit, freest, file)
    change = fit.magnification / pair.magnification
    if abs(np.log(change)) > _MAGNIFIED:
        text = (
            f"the blurred dot is {change:.3f} times the size it should have; are the distances right, and is the image "
            "linear, not sRGB encoded?"
        )
        warn(text, "magnification", file=file, number=change)
    _check_spots(pair, solution, file)
    if fit.asymmetry > UNEVEN and asymmetry_of(pair, solution)[1] < CHANCE:
        text = (
            f"the blur is not round: {100 * fit.asymmetry:.0f} % of it depends on the angle in a way that family "
            f"{fit.family!r} has not; is the lens decentred, the dot off the axis, or the stop a polygon? Families "
            "'auto' and 'image' take any shape"
        )
        warn(text, "asymmetry", file=file, number=fit.asymmetry)
    if solution.family != "radial":
        _check_parameters(pair, solution, file)


def _outside(pair: Forward, solution: Solution) -> float:
    """Share of the blur's light that falls outside the window, of what its kernel, as wide as the window, holds."""
    source = pair.moved_source(solution.moves)
    inside = float(pair.convolve(source, pair.kernel(solution)[None], whole=True)[0].sum())
    total = float(source[0, 0].real)
    return 1 - inside / total if total > 0 else 1.0


def _check_residual(fit: BlurFit, freest: BlurFit, file: str | None) -> None:
    """Warn about a residual far above the noise: that of the freest fit, and what a cheaper family adds to it."""
    ratio = freest.residual_over_noise
    far_above = (freest.residual > _MATTERS and ratio > FAR_ABOVE) or (freest.residual > _SEEN and ratio > 2.0)
    # of a residual that is said already, only what the family adds
    most = max(2.0, 1.3 * ratio) if far_above else 2.0
    if fit is not freest and fit.residual > _SEEN and fit.residual_over_noise > most:
        text = (
            f"family {fit.family!r} leaves {fit.residual_over_noise:.1f} times the noise ({100 * fit.residual:.1f} % "
            f"of the light), the free profile {ratio:.1f} times; it was chosen because what is "
            "missing would not be seen at accuracy_db: ask for more, or for a richer family"
        )
        warn(text, "residual", file=file, number=fit.residual_over_noise)
    if far_above:
        text = (
            f"the residual is {100 * freest.residual:.1f} %, {ratio:.1f} times the noise; is the image linear, not "
            "sRGB encoded, a single white dot, and not a strong JPEG?"
        )
        text += f" Family {freest.family!r} may be too simple" if freest.family != "radial" else ""
        warn(text, "residual", file=file, number=ratio)


def _check_spots(pair: Forward, solution: Solution, file: str | None) -> None:
    """Warn about light beyond the dot's blur, which no family has: too little of it shows in the residual."""
    from scipy.ndimage import gaussian_filter

    beyond = (pair.distance > pair.dot.reach + 4) & pair.used
    if not beyond.any():
        return
    residual = np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0)
    remaining = np.where(beyond, gaussian_filter(residual, 2.0, mode="constant"), -np.inf)
    y, x = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
    height, peak = float(remaining[y, x]), pair.dot.peak
    # smoothing by sigma = 2 px leaves 0.14 of white noise, and more of noise that goes together in neighbours
    smooth = pair.fine_share * independent_share(pair.noise_correlation)
    around = remaining[beyond]
    usual = 1.4826 * float(np.median(np.abs(around - np.median(around))))  # of a JPEG's blocks, too
    if height > max(_SPOT * max(0.14 * noise_of(pair.data) / np.sqrt(smooth), usual), _SPOT_MATTERS * peak):
        text = (
            f"a spot of {100 * height / peak:.1f} % of the dot's level is left at ({x}, {y}), "
            f"{pair.distance[y, x]:.0f} px from the dot and beyond its blur: is there another dot, dust or a "
            "reflection? The error bars do not count it"
        )
        warn(text, "residual", file=file, number=height / peak)


def _check_parameters(pair: Forward, solution: Solution, file: str | None) -> None:
    """Warn about parameters that ended on a bound, and about a blur whose size the pictures do not determine."""
    low, high = pair.bounds(solution.names)
    for name, least, most in zip(solution.names, low, high, strict=True):
        value = float({**solution.moves, **solution.params}[name])
        at_least, at_most = value <= least + 1e-6 * abs(least), value >= most * (1 - 1e-6)
        length = name in ("sigma", "radius", "r_c")
        if at_most and length:
            text = f"the blur is wider than the window: {name} ran to {value:.3g} px"
            raise FitError(text, "flat profile", file=file, number=value)
        # a blur below a pixel has no shape, and the exponent of a tilt that is not there, the curvature of blades that
        # are straight, or leave a circle, end anywhere
        if (at_least and not length and name != "b" or at_most) and name not in ("m", "curvature"):
            warn(f"{name} ended on its bound {value:.4g}; it is only a limit", "boundary", file=file, number=value)
    size, error = size_of_blur(pair, solution)
    if not error < 0.5 * size:
        text = f"the blur's rms radius of {size:.3g} +- {error:.2g} px is not determined: too little blur, or too noisy"
        warn(text, "flat profile", file=file, number=error / size if size else np.inf)
