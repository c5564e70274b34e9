"""A solution of the forward model, told as a `BlurFit`."""

from __future__ import annotations

import numpy as np

from torchdof.optics.psf import FAMILIES

from ..result import Array, BlurFit, Mask
from ..solve import information_criterion
from .diagnostics import asymmetry_of, signal_pixels
from .dot import noise_of
from .forward import Forward, Solution

__all__ = ["bic_of", "describe", "kernel_lists"]


def kernel_lists(solution: Solution) -> dict[str, Array]:
    """Parameters of a solution, each with a leading axis of one kernel."""
    return {k: np.asarray(v, dtype=np.float64)[None] for k, v in solution.params.items()}


def bic_of(pair: Forward, solution: Solution) -> float:
    """Bayesian information criterion of a solution."""
    floor = pair.values.size * (1e-6 * pair.unit) ** 2
    free = len(FAMILIES[solution.family])
    if solution.family == "radial":
        free = int(np.sum(np.asarray(solution.params["values"]) > 0))
    return information_criterion(solution.squares + floor, pair.values.size, free + len(pair.fit_moves) + 2)


def describe(pair: Forward, solution: Solution, why: str) -> BlurFit:
    """The solution as a `BlurFit`: errors by name, residual and noise where the light is, samples for a picture."""
    near = signal_pixels(pair)
    light = pair.data[near] - solution.background
    size = float(np.sqrt(np.sum(light**2)))
    error = pair.data[near] - solution.model[near]
    kernel = pair.kernels(solution.family, kernel_lists(solution))[0]
    through = (solution.gain * pair.source.noise) ** 2 * float(np.sum(kernel**2))
    spread = np.sqrt(np.diag(solution.covariance))
    if solution.family == "radial":
        stderr: dict[str, float | Array] = {"values": spread, "radius": 0.0}
    else:
        stderr = {n: float(s) for n, s in zip(solution.names, spread, strict=True) if n in solution.params}
    return BlurFit(
        family=solution.family,
        params=dict(solution.params),
        stderr=stderr,
        residual=float(np.sqrt(np.sum(error**2))) / size,
        noise=float(np.sqrt(error.size * (_own_noise(pair, solution, near) ** 2 + through))) / size,
        covariance=solution.covariance,
        names=solution.names,
        bic=bic_of(pair, solution),
        count=pair.values.size,
        model="forward",
        gain=solution.gain,
        background=solution.background,
        shift=(
            pair.data_dot.x + solution.moves["dx"] - pair.source.dot.x,
            pair.data_dot.y + solution.moves["dy"] - pair.source.dot.y,
        ),
        magnification=solution.moves["magnification"],
        asymmetry=asymmetry_of(pair, solution),
        why=why,
        samples=_samples(pair, solution),
        curve=_samples(pair, solution, modelled=True),
    )


def _own_noise(pair: Forward, solution: Solution, near: Mask) -> float:
    """Noise of the blurred picture's pixels where the light is: what varies from pixel to pixel in the residual."""
    residual = np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0)
    rows = residual[:, 2:] - 2 * residual[:, 1:-1] + residual[:, :-2]
    mixed_differences = (rows[2:] - 2 * rows[1:-1] + rows[:-2]) / 6.0
    inside = near[1:-1, 1:-1]
    noise = float(np.sqrt(np.mean(mixed_differences[inside] ** 2))) if inside.any() else 0.0
    return max(noise, noise_of(pair.data))


def _samples(pair: Forward, solution: Solution, modelled: bool = False) -> Array:
    """Radii and levels over gain of the blurred picture (or its model) around its centre, for the picture of a fit."""
    x, y = pair.data_dot.x + solution.moves["dx"], pair.data_dot.y + solution.moves["dy"]
    rows, columns = np.indices(pair.data.shape)
    distance = np.hypot(columns - x, rows - y)
    near = (distance <= 1.2 * pair.data_dot.reach) & pair.used
    levels = (solution.model if modelled else pair.data)[near] - solution.background
    order = np.argsort(distance[near])
    scale = solution.gain if solution.gain > 0 else 1.0
    return np.stack([distance[near][order], levels[order] / scale])
