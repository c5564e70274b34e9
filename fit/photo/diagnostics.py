"""What may be wrong with a forward fit: its residual, its roundness, its window, its bounds."""

from __future__ import annotations

import numpy as np

from ..problems import (
    AsymmetryWarning,
    BoundaryWarning,
    FitError,
    FlatProfileError,
    FlatProfileWarning,
    MagnificationWarning,
    NotLinearWarning,
    ResidualWarning,
    WindowError,
    WindowWarning,
    warn,
)
from ..result import Array, BlurFit, Mask
from .dot import Dot, noise_inside, noise_of
from .dot_model import Edge, soft_edge
from .forward import Forward, Solution
from .ratio import polar_samples

__all__ = ["EXPLAINED", "asymmetry_of", "check_fit", "check_linearity", "signal_pixels"]

EXPLAINED = 1.15
"""Misfit of an ideal dot, over the noise, up to which it explains a sharp picture."""

_ENCODED = 0.7
_FAR_ABOVE = 1.6  # residual over noise
_MATTERS = 0.005
_UNEVEN = 0.3
_SPOT, _SPOT_MATTERS = 8.0, 0.003
_MAGNIFIED = 0.08
_OUTSIDE_REFUSED, _OUTSIDE_WARNED = 0.05, 0.005


def signal_pixels(pair: Forward) -> Mask:
    """Pixels with light in them `[H, W]`: used, and within the blurred dot's reach."""
    rows, columns = np.indices(pair.data.shape)
    near = np.hypot(columns - pair.data_dot.x, rows - pair.data_dot.y) <= pair.data_dot.reach + 1
    return np.asarray(near & pair.used)


def asymmetry_of(pair: Forward, solution: Solution) -> float:
    """Norm of what depends on the angle in the residual (its first four harmonics) over the norm of the light."""
    residual = np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0)
    centre = (pair.data_dot.x + solution.moves["dx"], pair.data_dot.y + solution.moves["dy"])
    r, _, uneven = polar_samples(residual, centre, max(pair.data_dot.reach, 2.0), step_deg=10.0)
    light = polar_samples(pair.data - solution.background, centre, float(r[-1]), step_deg=10.0)[2]
    waves = np.fft.rfft(uneven, axis=0)[1:5] / uneven.shape[0]
    # r weighs a sample by the area it stands for
    varying = float(np.sum(r * 2 * np.sum(np.abs(waves) ** 2, axis=0)))
    whole = float(np.sum(r * np.mean(light**2, axis=0)))
    return float(np.sqrt(varying / whole)) if whole > 0 else np.inf


def check_fit(
    pair: Forward,
    solution: Solution,
    fit: BlurFit,
    files: tuple[str | None, str | None],
    freest: BlurFit,
    stacklevel: int = 4,
) -> None:
    """Raise or warn about everything that makes a fit less than it looks.

    Args:
        pair: the pictures.
        solution: what was found.
        fit: the same, as it will be returned.
        files: names of the two pictures.
        freest: the fit whose residual is held against the noise.
        stacklevel: where warnings point.

    Raises:
        FitError: the fit has no gain (the pictures have nothing in common).
        FlatProfileError: the kernel's size is not determined at all.
        WindowError: more than 5 % of the blur's light falls outside the window.
    """
    file = files[1]
    if not fit.gain > 0:
        raise FitError("the blurred picture has nothing in common with the sharp one", file=file, number=fit.gain)
    outside = _outside(pair, solution)
    if outside > _OUTSIDE_REFUSED:
        raise WindowError(
            f"the window cuts the blur: {100 * outside:.0f} % of its light falls outside {_size(pair)}; "
            "cut a larger one",
            file=file,
            number=outside,
        )
    if outside > _OUTSIDE_WARNED:
        text = f"{100 * outside:.1f} % of the blur's light falls outside the window of {_size(pair)}; cut a larger one"
        warn(WindowWarning(text, file=file, number=outside), stacklevel)
    ratio = freest.residual_over_noise
    if freest.residual > _MATTERS and ratio > _FAR_ABOVE:
        text = (
            f"the residual is {100 * freest.residual:.1f} %, {ratio:.1f} times the noise; is the image linear, not "
            "sRGB encoded, a single white dot, and not a strong JPEG?"
        )
        text += f" Family {freest.family!r} may be too simple" if freest.family != "radial" else ""
        warn(ResidualWarning(text, file=file, number=ratio), stacklevel)
    change = fit.magnification / pair.magnification
    if abs(np.log(change)) > _MAGNIFIED:
        text = (
            f"the blurred dot is {change:.3f} times the size it should have; are the distances right, and is the image "
            "linear, not sRGB encoded?"
        )
        warn(MagnificationWarning(text, file=file, number=change), stacklevel)
    _check_spots(pair, solution, file, stacklevel + 1)
    if fit.asymmetry > _UNEVEN:
        text = (
            f"the blur is not round: {100 * fit.asymmetry:.0f} % of it depends on the angle, which no family here "
            "has; is the lens decentred, or the dot off the axis?"
        )
        warn(AsymmetryWarning(text, file=file, number=fit.asymmetry), stacklevel)
    if solution.family != "radial":
        _check_parameters(pair, solution, file, stacklevel + 1)


def check_linearity(still: Array, dot: Dot, edge: Edge, file: str | None, stacklevel: int = 5) -> None:
    """Warn where a sharp picture shows that it is not in linear light: by its noise, or by its dot's edge."""
    inside = noise_inside(still, dot)
    # light only makes noise grow with the level; 4 standard errors of the noise's own estimate are allowed
    if inside and dot.noise > (1 + 4 / np.sqrt(inside[1])) * inside[0] and dot.noise > 1e-4 * dot.peak:
        ratio = dot.noise / max(inside[0], 1e-9 * dot.peak)
        text = (
            f"the dark paper has {ratio:.1f} times the noise of the white dot, as in a picture that is left sRGB "
            "encoded; is the image linear? Decode it first"
        )
        warn(NotLinearWarning(text, file=file, number=ratio), stacklevel)
        return
    if edge.misfit < EXPLAINED:
        return
    bent = soft_edge(still, dot, fit_exponent=True)
    if bent.exponent < _ENCODED and bent.rms < 0.75 * edge.rms:
        text = (
            f"the dot's edge is that of light to the power {bent.exponent:.2f}, as in a picture that is left sRGB "
            "encoded (about 0.45); is the image linear? Decode it first"
        )
        warn(NotLinearWarning(text, file=file, number=bent.exponent), stacklevel)


def _outside(pair: Forward, solution: Solution) -> float:
    """Share of the blur's light that falls outside the window."""
    kernel = pair.kernels(solution.family, {k: np.asarray(v)[None] for k, v in solution.params.items()})
    source = pair.moved_source(solution.moves)
    inside = float(pair.convolve(source, kernel, whole=True)[0].sum())
    total = float(source[0, 0].real)
    # what the window-wide kernel itself left out
    return 1 - inside / total if total > 0 else 1.0


def _check_spots(pair: Forward, solution: Solution, file: str | None, stacklevel: int) -> None:
    """Warn about light beyond the dot's blur, which no family has: too little of it shows in the residual."""
    from scipy.ndimage import gaussian_filter

    rows, columns = np.indices(pair.data.shape)
    distance = np.hypot(columns - pair.data_dot.x, rows - pair.data_dot.y)
    beyond = (distance > pair.data_dot.reach + 4) & pair.used
    if not beyond.any():
        return
    remaining = gaussian_filter(np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0), 2.0)
    remaining = np.where(beyond, remaining, -np.inf)
    y, x = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
    height, peak = float(remaining[y, x]), pair.data_dot.peak
    # smoothing by sigma = 2 px leaves 0.14 of white noise
    if height > max(_SPOT * 0.14 * noise_of(pair.data), _SPOT_MATTERS * peak):
        text = (
            f"a spot of {100 * height / peak:.1f} % of the dot's level is left at ({x}, {y}), "
            f"{distance[y, x]:.0f} px from the dot and beyond its blur: is there another dot, dust or a reflection? "
            "The error bars do not count it"
        )
        warn(ResidualWarning(text, file=file, number=height / peak), stacklevel)


def _check_parameters(pair: Forward, solution: Solution, file: str | None, stacklevel: int) -> None:
    """Warn about parameters that ended on a bound, and about a blur whose size the pictures do not determine."""
    low, high = pair.bounds(solution.names)
    for name, least, most in zip(solution.names, low, high, strict=True):
        value = solution.params.get(name, solution.moves.get(name, 0.0))
        # r_c = 0 and sigma or b at its least are honest answers; a blur below a pixel has no shape
        natural = name in ("r_c", "sigma", "radius", "b", "m") and float(value) <= least + 1e-6
        if not natural and (float(value) >= most * (1 - 1e-6) or float(value) <= least + 1e-6 * abs(least)):
            if name in ("sigma", "radius", "r_c"):
                raise FlatProfileError(
                    f"the blur is wider than the window: {name} ran to {float(value):.3g} px",
                    file=file,
                    number=float(value),
                )
            if name == "m":
                continue  # the exponent of a tilt that is not there
            text = f"{name} ended on its bound {float(value):.4g}; it is only a limit"
            warn(BoundaryWarning(text, file=file, number=float(value)), stacklevel)
    size, error = _size_of_blur(pair, solution)
    if not error < 0.5 * size:
        text = f"the blur's rms radius of {size:.3g} +- {error:.2g} px is not determined: too little blur, or too noisy"
        warn(FlatProfileWarning(text, file=file, number=error / size if size else np.inf), stacklevel)


def _size_of_blur(pair: Forward, solution: Solution) -> tuple[float, float]:
    """The kernel's rms radius and its standard error, px; single parameters may trade with each other."""
    shape = list(solution.params)
    steps = {n: 1e-3 * max(abs(float(solution.params[n])), 0.1) for n in shape}
    varied = {n: np.full(len(shape) + 1, float(solution.params[n])) for n in shape}
    for i, n in enumerate(shape):
        varied[n][i + 1] += steps[n]
    kernels = pair.kernels(solution.family, varied)
    away = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2
    rms = np.sqrt((kernels * (away[:, None] ** 2 + away[None, :] ** 2)).sum((1, 2)))
    slope = np.array([(rms[i + 1] - rms[0]) / steps[n] for i, n in enumerate(shape)])
    index = [solution.names.index(n) for n in shape]
    covariance = solution.covariance[np.ix_(index, index)]
    known = np.isfinite(np.diag(covariance))
    if known.all():
        return float(rms[0]), float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
    # parameters trade with each other without limit; their size may be known all the same
    numbers = np.array([solution.params.get(n, solution.moves.get(n, 0.0)) for n in solution.names])
    jacobian = pair._jacobian(solution.family, solution.names, numbers)[:, index]
    _, values, right = np.linalg.svd(jacobian, full_matrices=False)
    seen = values > 1e-6 * values.max()
    along = right @ slope
    if not seen.any() or np.abs(along[~seen]).sum() > 0.1 * np.abs(along).sum():
        return float(rms[0]), np.inf
    noise = np.sqrt(solution.squares / pair.values.size)
    return float(rms[0]), float(noise * np.linalg.norm(along[seen] / values[seen]))


def _size(pair: Forward) -> str:
    return f"{pair.data.shape[1]}x{pair.data.shape[0]} px"
