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
    ResidualWarning,
    WindowError,
    WindowWarning,
    warn,
)
from ..result import Array, BlurFit, Mask
from .dot import mixed_differences, noise_of
from .forward import Forward, Solution, without_level
from .noise import independent_share

__all__ = [
    "CHANCE",
    "FAR_ABOVE",
    "UNEVEN",
    "asymmetry_of",
    "check_fit",
    "left_open",
    "noise_near",
    "signal_pixels",
    "size_of_blur",
    "unexplained",
]

UNEVEN = 0.02
"""Share of a blur's light that depends on the angle, from which on it is said not to be round."""

CHANCE = 1e-6
"""How seldom noise may do as much."""

FAR_ABOVE = 1.6
"""Residual over noise from which on it is said."""

_MATTERS, _SEEN = 0.005, 1e-3
_HARMONICS, _RINGS = 8, 4
_SPOT, _SPOT_MATTERS = 8.0, 0.003
_MAGNIFIED = 0.08
_OUTSIDE_REFUSED, _OUTSIDE_WARNED = 0.05, 0.005


def signal_pixels(pair: Forward) -> Mask:
    """Pixels with light in them `[H, W]`: used, and within the blurred dot's reach."""
    rows, columns = np.indices(pair.data.shape)
    near = np.hypot(columns - pair.data_dot.x, rows - pair.data_dot.y) <= pair.data_dot.reach + 1
    return np.asarray(near & pair.used)


def asymmetry_of(pair: Forward, solution: Solution) -> tuple[float, float]:
    """How much of the blur depends on the angle, and how likely noise alone would show as much.

    The residual is expanded in the first eight harmonics of the angle, on four rings each. Under noise of known
    covariance the squared coefficients, whitened, follow a chi squared distribution.

    Returns:
        Norm of what depends on the angle, without noise's own share, over the norm of the light; and the chance.
    """
    from scipy.stats import chi2

    x, y = pair.data_dot.x + solution.moves["dx"], pair.data_dot.y + solution.moves["dy"]
    rows, columns = np.indices(pair.data.shape)
    reach = max(pair.data_dot.reach, 2.0)
    angle, place = np.arctan2(rows - y, columns - x), np.hypot(columns - x, rows - y) / reach * _RINGS
    near = (place <= _RINGS) & pair.used
    templates = []
    for ring in range(1, _RINGS + 1):
        hat = np.clip(1 - np.abs(place - ring + 0.5), 0, None) * near
        for order in range(1, _HARMONICS + 1):
            templates += [hat * np.cos(order * angle), hat * np.sin(order * angle)]
    basis = np.stack([t.ravel()[pair.flat] for t in templates], axis=1)
    basis = left_open(pair, solution, basis)
    left, values, _ = np.linalg.svd(basis, full_matrices=False)
    left = left[:, values > 1e-6 * values.max()]
    found, spread = unexplained(pair, solution, left)
    chance = float(chi2.sf(found @ np.linalg.solve(spread, found), found.size)) if np.trace(spread) > 0 else 0.0
    light = float(np.sum((pair.data[near] - solution.background) ** 2))
    share = np.sqrt(max(float(found @ found) - float(np.trace(spread)), 0.0) / light) if light > 0 else np.inf
    return float(share), chance


def unexplained(pair: Forward, solution: Solution, basis: Array) -> tuple[Array, Array]:
    """What patterns `[pixels used, n]` have in common with a fit's residual.

    Returns:
        Their products with the residual `[n]`, what the fit could have taken up left out, and the covariance `[n, n]`
        of those products under noise alone.
    """
    basis = left_open(pair, solution, basis)
    residual = pair.values - solution.model.ravel()[pair.flat]
    # a smooth deviation would take the shape itself for noise: its level beside the dot and within it is enough. And
    # noise is at most what is left: a JPEG has less of it in the dark than goes with that in the light
    near = signal_pixels(pair)
    left = float(np.sqrt(np.mean((pair.data[near] - solution.model[near]) ** 2))) if near.any() else np.inf
    deviation = np.full(residual.shape, min(noise_near(pair, solution, near), left))
    return basis.T @ residual, basis.T @ pair.noise_times(basis, deviation, pair.noise_correlation)


def left_open(pair: Forward, solution: Solution, basis: Array) -> Array:
    """Patterns without what the fit could have taken up, which is not seen in its residual."""
    slopes = solution.slopes if solution.slopes is not None else np.zeros((basis.shape[0], 0))
    known, _ = np.linalg.qr(slopes[:, np.abs(slopes).max(axis=0) > 0]) if slopes.shape[1] else (slopes, None)
    return without_level(basis - known @ (known.T @ basis), solution.model.ravel()[pair.flat])


def noise_near(pair: Forward, solution: Solution, near: Mask) -> float:
    """Deviation of a pixel's noise where the light is, from what varies from pixel to pixel in the residual."""
    residual = np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0)
    inside = near[1:-1, 1:-1]
    seen = float(np.mean(mixed_differences(residual)[inside] ** 2)) if inside.any() else 0.0
    light = float(np.mean(np.maximum(pair.data[near] - solution.background, 0.0))) if near.any() else 0.0
    dark, light = noise_of(pair.data) ** 2, pair.shot_noise * light
    known = dark / pair.fine_share + light / (pair.fine_share_of_light or pair.fine_share)
    # what is more is not noise of the camera's kind, and need not go together in neighbours
    return float(np.sqrt(known + max(seen - dark - light, 0.0)))


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
    unexplained_light = (freest.residual > _MATTERS and ratio > FAR_ABOVE) or (freest.residual > _SEEN and ratio > 2.0)
    # of a residual that is said already, only what the family adds
    most = max(2.0, 1.3 * ratio) if unexplained_light else 2.0
    if fit is not freest and fit.residual > _SEEN and fit.residual_over_noise > most:
        text = (
            f"family {fit.family!r} leaves {fit.residual_over_noise:.1f} times the noise ({100 * fit.residual:.1f} % "
            f"of the light), the free profile {ratio:.1f} times; it was chosen because what is "
            "missing would not be seen at accuracy_db: ask for more, or for a richer family"
        )
        warn(ResidualWarning(text, file=file, number=fit.residual_over_noise), stacklevel)
    if unexplained_light:
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
    if fit.asymmetry > UNEVEN and asymmetry_of(pair, solution)[1] < CHANCE:
        text = (
            f"the blur is not round: {100 * fit.asymmetry:.0f} % of it depends on the angle in a way that family "
            f"{fit.family!r} has not; is the lens decentred, the dot off the axis, or the stop a polygon? Families "
            "'auto' and 'image' take any shape"
        )
        warn(AsymmetryWarning(text, file=file, number=fit.asymmetry), stacklevel)
    if solution.family != "radial":
        _check_parameters(pair, solution, file, stacklevel + 1)


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
    remaining = gaussian_filter(
        np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0), 2.0, mode="constant"
    )
    remaining = np.where(beyond, remaining, -np.inf)
    y, x = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
    height, peak = float(remaining[y, x]), pair.data_dot.peak
    # smoothing by sigma = 2 px leaves 0.14 of white noise, and more of noise that goes together in neighbours
    smooth = pair.fine_share * independent_share(pair.noise_correlation)
    around = remaining[beyond]
    usual = 1.4826 * float(np.median(np.abs(around - np.median(around))))  # of a JPEG's blocks, too
    if height > max(_SPOT * max(0.14 * noise_of(pair.data) / np.sqrt(smooth), usual), _SPOT_MATTERS * peak):
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
            if name in ("m", "curvature"):
                continue  # the exponent of a tilt that is not there; blades that are straight, or leave a circle
            text = f"{name} ended on its bound {float(value):.4g}; it is only a limit"
            warn(BoundaryWarning(text, file=file, number=float(value)), stacklevel)
    size, error = size_of_blur(pair, solution)
    if not error < 0.5 * size:
        text = f"the blur's rms radius of {size:.3g} +- {error:.2g} px is not determined: too little blur, or too noisy"
        warn(FlatProfileWarning(text, file=file, number=error / size if size else np.inf), stacklevel)


def size_of_blur(pair: Forward, solution: Solution) -> tuple[float, float]:
    """The PSF's rms radius and its standard error, px; single parameters may trade with each other."""
    if solution.family == "radial":
        return _size_of_profile(solution)
    shape = list(solution.params)
    steps = {n: 1e-3 * max(abs(float(solution.params[n])), 0.1) for n in shape}
    varied = {n: np.full(len(shape) + 1, float(solution.params[n])) for n in shape}
    for i, n in enumerate(shape):
        varied[n][i + 1] += steps[n]
    rms = pair.rms(solution.family, varied)
    slope = np.array([(rms[i + 1] - rms[0]) / steps[n] for i, n in enumerate(shape)])
    index = [solution.names.index(n) for n in shape]
    covariance = solution.covariance[np.ix_(index, index)]
    known = np.isfinite(np.diag(covariance))
    if known.all():
        variance = max(float(slope @ covariance @ slope), 0.0)
        return float(rms[0]), float(np.sqrt(variance + (_error_of_moment(pair, solution, float(rms[0])) ** 2)))
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


def _error_of_moment(pair: Forward, solution: Solution, rms: float) -> float:
    """What noise does to the rms radius of a kernel whose shape is free: only the picture's second moment fixes it."""
    if solution.family != "image":
        return 0.0
    near = signal_pixels(pair)
    squared = pair.distance[near] ** 2
    light = pair.data[near] - solution.background
    away = squared - float(light @ squared / light.sum())
    noise = noise_near(pair, solution, near) / np.sqrt(independent_share(pair.noise_correlation))
    return float(noise * np.linalg.norm(away) / abs(light.sum()) / (2 * max(rms, 1e-9)))


def _size_of_profile(solution: Solution) -> tuple[float, float]:
    """The same of a free profile, whose second moment is linear in its values."""
    values, radius = np.asarray(solution.params["values"]), float(solution.params["radius"])
    r = np.linspace(0, radius, 64 * values.size + 1)
    place = r / radius * (values.size - 1)
    hats = np.clip(1 - np.abs(place[None, :] - np.arange(values.size)[:, None]), 0, None)
    light, moment = hats @ r, hats @ r**3
    rms = float(np.sqrt(moment @ values / (light @ values)))
    # of a quotient: the total light is part of both
    slope = (moment - rms**2 * light) / (light @ values) / (2 * rms)
    return rms, float(np.sqrt(max(slope @ solution.covariance @ slope, 0.0)))


def _size(pair: Forward) -> str:
    return f"{pair.data.shape[1]}x{pair.data.shape[0]} px"
