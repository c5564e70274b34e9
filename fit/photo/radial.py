"""The `radial` family: a table over r by non-negative least squares, with a smoothness chosen by the data."""

import numpy as np
import torch
from scipy.optimize import nnls

from torchdof.optics.psf import pixel_kernels

from ..result import Array
from .forward import Forward, Solution, without_level

# Factor of the effective parameters in cross-validation; larger: smoother profiles. The usual factor 1 sometimes fits
# the noise; 3 is equally good without noise, and up to 12 dB better with it.
_CAUTION = 3.0
_SMOOTHNESS = 10.0 ** np.arange(-8.0, 0.0)
_MAX_STEP = {"dx": 0.5, "dy": 0.5, "magnification": 0.02}  # largest step of an iteration


def solve_radial(pair: Forward, moves: dict[str, float], radius: float, knots: int | None = None) -> Solution:
    """Fits values of the profile, densities per square pixel, at equal steps of r up to `radius` px; refines the moves.

    Each value is the weight of a hat function. A penalty on second differences, chosen by generalised cross-validation,
    smooths values that the data do not determine. Without `knots` there are two values for each pixel, from 8 to 48.
    """
    count = knots if knots is not None else int(np.clip(np.ceil(2 * radius), 8, 48))
    half = min(int(np.ceil(radius)) + 1, pair.half)
    values = torch.eye(count, dtype=torch.float64)
    hats = pixel_kernels("radial", {"values": values, "radius": radius}, 2 * half + 1).numpy()
    h = radius / (count - 1)
    hat_light = 2 * np.pi * h * h * np.arange(count, dtype=np.float64)  # integral of each hat over the plane
    hat_light[0], hat_light[-1] = np.pi * h * h / 3, 2 * np.pi * (radius * h / 2 - h * h / 6)
    moves = dict(moves)
    for _ in range(10):
        columns = hat_light[:, None] * pair.blurred(pair.drawn(moves), hats)[:, pair.used]  # [knots, pixels]
        weights, smoothing = _non_negative(columns, pair.values)
        gain = float(hat_light @ weights)
        kernel = np.tensordot(hat_light * weights / gain, hats, 1)
        shaped = columns.T @ weights / gain
        fitted, gain, background = pair.project(shaped)
        residual = pair.values - fitted
        # one Gauss-Newton step of the moves, for a constant kernel
        slopes = gain * pair.move_columns(moves, pair.fit_moves, kernel).T
        step = np.linalg.lstsq(without_level(slopes, shaped), residual, rcond=None)[0]
        for name, change in zip(pair.fit_moves, step, strict=True):
            moves[name] += float(np.clip(change, -_MAX_STEP[name], _MAX_STEP[name]))
        if np.all(np.abs(step) < 3e-4):
            break
    free = weights > 0
    centred = (columns - columns.mean(axis=1, keepdims=True))[free].T
    free_covariance = pair.covariance(centred, residual, kernel, gain, smoothing[np.ix_(free, free)])
    covariance = np.zeros((count, count))
    covariance[np.ix_(free, free)] = np.where(np.isfinite(free_covariance), free_covariance, 0.0)
    params: dict[str, float | Array] = {"values": weights / float(hat_light @ weights), "radius": radius}
    names = tuple(f"values[{i}]" for i in range(count))
    slopes = pair.move_columns(moves, ("dx", "dy"), kernel).T
    return Solution(pair, "radial", params, moves, gain, background, fitted, names, covariance / gain**2, slopes)


def _non_negative(columns: Array, data: Array) -> tuple[Array, Array]:
    """Weights `[knots]`, and the matrix of the penalty with which they were found."""
    centred = columns - columns.mean(axis=1, keepdims=True)
    level = data - data.mean()
    normal, right, total = centred @ centred.T, centred @ level, float(level @ level)
    differences = np.diff(np.eye(columns.shape[0]), 2, axis=0)
    penalty = differences.T @ differences * float(np.trace(normal)) / columns.shape[0]
    candidates = []
    for strength in _SMOOTHNESS:
        smooth = strength * penalty
        # the Cholesky factor of the normal equations has the same minimum as the tall matrix
        factor = np.linalg.cholesky(normal + smooth + 1e-12 * np.trace(normal) * np.eye(len(normal)))
        weights, _ = nnls(factor.T, np.linalg.solve(factor, right))
        free = weights > 0
        effective = np.trace(np.linalg.solve((normal + smooth)[np.ix_(free, free)], normal[np.ix_(free, free)]))
        squares = max(total - 2 * float(right @ weights) + float(weights @ normal @ weights), 1e-14 * total)
        score = squares / (data.size - min(_CAUTION * float(effective), 0.9 * data.size)) ** 2
        candidates.append((score, weights, smooth))
    return min(candidates, key=lambda t: t[0])[1:]
