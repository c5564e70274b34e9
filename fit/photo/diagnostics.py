"""Statistics of a solution of the forward model: residual, size of the blur, likelihood; as a `BlurFit`."""

import numpy as np
from scipy.linalg import orth
from scipy.special import chdtrc

from ..result import Array, BlurFit
from .forward import OPENINGS, SHAPES, Solution, without_level
from .noise import fine_variance, independent_share, noise_of

ASYMMETRIC = 0.02
"""Share of a blur's light that depends on the angle, above which it is not round."""

P_VALUE = 1e-6
"""Probability of a deviation by noise alone, below which it is significant."""

_HARMONICS, _RINGS = 8, 4
_LIT_SHARE = 0.01  # share of the peak above which a pixel of a free kernel counts as a parameter


def residual_rms(solution: Solution) -> float:
    """Root mean square of the residual over the lit pixels."""
    return float(np.sqrt(np.mean(solution.residual[solution.pair.lit[solution.pair.used]] ** 2)))


def noise_near(solution: Solution) -> float:
    """Standard deviation of a pixel's noise where the light is, from the fine (pixel to pixel) part of the residual."""
    pair = solution.pair
    fine = np.nan_to_num(fine_variance(pair.picture(solution.residual), pair.lit))
    lit = pair.data[pair.lit] - solution.background
    dark, light = noise_of(pair.data) ** 2, pair.shot_noise * float(np.mean(np.maximum(lit, 0.0)))
    camera_variance = dark / pair.fine_share + light / (pair.fine_share_of_light or pair.fine_share)
    # additional fine variance is not camera noise and may be uncorrelated
    return float(np.sqrt(camera_variance + max(fine - dark - light, 0.0)))


def unexplained(solution: Solution, basis: Array) -> tuple[Array, Array, Array]:
    """Products of patterns `[pixels used, n]` with a fit's residual `[n]`, and their covariance under noise alone.

    Also returns the patterns without the parts that the fit's parameters imitate, which are not in the residual.
    """
    imitable, _ = np.linalg.qr(solution.slopes[:, np.abs(solution.slopes).max(axis=0) > 0])
    visible = without_level(basis - imitable @ (imitable.T @ basis), solution.fitted)
    # a smooth deviation must not count as noise: use the level beside the dot and inside it. Noise cannot exceed the
    # residual: in a JPEG, dark areas have less noise than the level in the light suggests
    variance = min(noise_near(solution), residual_rms(solution)) ** 2
    correlated = solution.pair.correlated_noise(visible, solution.pair.noise_correlation)
    return visible.T @ solution.residual, variance * visible.T @ correlated, visible


def asymmetry_of(solution: Solution) -> tuple[float, float]:
    """Norm of the blur's angle-dependent part over its light's, without noise, and the probability of it by noise."""
    pair = solution.pair
    (x, y), (rows, columns) = solution.centre, np.indices(pair.data.shape)
    angle = np.arctan2(rows - y, columns - x)
    ring_at = np.hypot(columns - x, rows - y) / max(pair.dot.reach, 2.0) * _RINGS
    near = (ring_at <= _RINGS) & pair.used
    hats = [(np.clip(1 - np.abs(ring_at - ring + 0.5), 0, None) * near)[pair.used] for ring in range(1, _RINGS + 1)]
    # the whitened squared coefficients of noise follow a chi squared distribution
    waves = [wave(n * angle[pair.used]) for n in range(1, _HARMONICS + 1) for wave in (np.cos, np.sin)]
    _, _, visible = unexplained(solution, np.stack([hat * wave for hat in hats for wave in waves], axis=1))
    found, spread, _ = unexplained(solution, orth(visible, rcond=1e-6))
    probability = float(chdtrc(found.size, found @ np.linalg.solve(spread, found))) if np.trace(spread) > 0 else 0.0
    light = float(np.sum((pair.data[near] - solution.background) ** 2))
    share = np.sqrt(max(float(found @ found) - float(np.trace(spread)), 0.0) / light) if light > 0 else np.inf
    return float(share), probability


def size_of_blur(solution: Solution) -> tuple[float, float]:
    """The PSF's rms radius and its standard error, px; better determined than single, correlated parameters."""
    if solution.family == "radial":  # light and second moment are sums over the values, each with a hat function
        values, radius = np.asarray(solution.params["values"]), float(solution.params["radius"])
        r = np.linspace(0, radius, 64 * values.size + 1)
        hats = np.clip(1 - np.abs(r / radius * (values.size - 1) - np.arange(values.size)[:, None]), 0, None)
        light, moment = hats @ r, hats @ r**3
        rms = float(np.sqrt(moment @ values / (light @ values)))
        # derivative of a quotient: the total light depends on the values too
        slope = (moment - rms**2 * light) / (light @ values) / (2 * rms)
        return rms, float(np.sqrt(max(slope @ solution.covariance @ slope, 0.0)))
    pair, shape = solution.pair, list(solution.params)
    values = np.array([float(solution.params[n]) for n in shape])
    steps = 1e-3 * np.maximum(np.abs(values), 0.1)
    varied = np.vstack([values, values + np.diag(steps)]).T  # a row for each parameter, changed in one column
    rms, *varied_rms = pair.rms(solution.family, dict(zip(shape, varied, strict=True))).tolist()
    slope = (np.array(varied_rms) - rms) / steps
    covariance = solution.covariance[: len(shape), : len(shape)]
    if np.isfinite(np.diag(covariance)).all():
        variance, moment_error = max(float(slope @ covariance @ slope), 0.0), 0.0
        if solution.family == "image":  # its shape is free: only the picture's second moment determines its size
            squared, light = pair.distance[pair.lit] ** 2, pair.data[pair.lit] - solution.background
            centred = squared - float(light @ squared / light.sum())
            noise = noise_near(solution) / np.sqrt(independent_share(pair.noise_correlation))
            moment_error = float(noise * np.linalg.norm(centred) / abs(light.sum()) / (2 * max(rms, 1e-9)))
        return rms, float(np.sqrt(variance + moment_error**2))
    # single parameters are undetermined, but their combination may determine the size
    _, values, right = np.linalg.svd(solution.slopes[:, : len(shape)], full_matrices=False)
    seen = values > 1e-6 * values.max()
    projected = right @ slope
    if not seen.any() or np.abs(projected[~seen]).sum() > 0.1 * np.abs(projected).sum():
        return rms, np.inf
    return rms, float(np.sqrt(solution.squares / pair.values.size) * np.linalg.norm(projected[seen] / values[seen]))


def bic_of(solution: Solution) -> float:
    """Bayesian information criterion of a solution, up to a constant that depends on the pictures only."""
    pair = solution.pair
    floor = pair.values.size * (1e-6 * pair.unit) ** 2
    parameters = len(SHAPES[solution.family])
    if solution.family == "radial":
        parameters = int(np.sum(np.asarray(solution.params["values"]) > 0))
    elif solution.family == "polygon":
        parameters += 1  # the number of blades
    elif solution.family == "image":
        parameters = int(np.sum(solution.kernel > _LIT_SHARE * solution.kernel.max()))
    # correlated neighbours are not independent samples
    count = max(round(pair.values.size * independent_share(pair.noise_correlation)), 1)
    variance = max((solution.squares + floor) / pair.values.size, np.finfo(float).tiny)
    return count * float(np.log(variance)) + parameters * float(np.log(count))


def describe(solution: Solution, why: str) -> BlurFit:
    """The solution as a `BlurFit`: errors by name, residual and noise of the lit pixels, samples for plotting."""
    pair = solution.pair
    (x, y), (rows, columns) = solution.centre, np.indices(pair.data.shape)
    size = float(np.sqrt(np.mean((pair.data[pair.lit] - solution.background) ** 2)))
    source_variance = (solution.gain * pair.source.noise) ** 2 / pair.fine_share
    noise = np.sqrt(noise_near(solution) ** 2 + source_variance * float(np.sum(solution.kernel**2)))
    rms, rms_error = size_of_blur(solution)
    errors = np.sqrt(np.diag(solution.covariance))
    stderr: dict[str, float | Array] = {
        n: float(s) for n, s in zip(solution.names, errors, strict=True) if n in solution.params
    }
    distance = np.hypot(columns - x, rows - y)
    is_near = (distance <= 1.2 * pair.dot.reach) & pair.used
    order = np.argsort(distance[is_near])
    samples, curve = (
        np.stack([distance[is_near], (levels - solution.background) / (solution.gain or 1.0)])[:, order]
        for levels in (pair.data[is_near], solution.fitted[is_near[pair.used]])
    )
    return BlurFit(
        family=solution.family,
        params=dict(solution.params),
        stderr={"values": errors, "radius": 0.0} if solution.family == "radial" else stderr,
        residual=residual_rms(solution) / size,
        noise=float(noise) / size,
        covariance=solution.covariance,
        names=solution.names,
        model="forward",
        gain=solution.gain,
        background=solution.background,
        shift=(x - pair.source.x, y - pair.source.y),
        centre=(x, y),
        magnification=solution.moves["magnification"],
        asymmetry=asymmetry_of(solution)[0],
        radius=float(np.sqrt(2) * rms),
        radius_stderr=float(np.sqrt(2) * rms_error),
        why=why,
        aperture=pair.opening_with(solution.params) if solution.family in OPENINGS else None,
        samples=samples,
        curve=curve,
    )
