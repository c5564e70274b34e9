"""A solution of the forward model, told as a `BlurFit`."""

from __future__ import annotations

import numpy as np

from torchdof.optics.aperture import Aperture

from ..result import Array, BlurFit
from ..solve import information_criterion
from .diagnostics import asymmetry_of, noise_near, signal_pixels, size_of_blur
from .forward import OPENINGS, SHAPES, Forward, Solution
from .noise import independent_share

__all__ = ["bic_of", "describe", "kernel_lists"]

_LIT = 0.01  # of its peak, from which on a pixel of a free kernel counts as one of its parameters


def kernel_lists(solution: Solution) -> dict[str, Array]:
    """Parameters of a solution, each with a leading axis of one kernel."""
    return {k: np.asarray(v, dtype=np.float64)[None] for k, v in solution.params.items()}


def bic_of(pair: Forward, solution: Solution) -> float:
    """Bayesian information criterion of a solution."""
    floor = pair.values.size * (1e-6 * pair.unit) ** 2
    free = len(SHAPES[solution.family])
    if solution.family == "radial":
        free = int(np.sum(np.asarray(solution.params["values"]) > 0))
    elif solution.family == "polygon":
        free += 1  # its number of blades
    elif solution.family == "image":
        kernel = pair.kernels("image", kernel_lists(solution))[0]
        free = int(np.sum(kernel > _LIT * kernel.max()))
    # neighbours whose noise goes together are no independent witnesses
    count = pair.values.size * independent_share(pair.noise_correlation)
    squares = (solution.squares + floor) * count / pair.values.size
    return information_criterion(squares, max(round(count), 1), free + len(pair.fit_moves) + 2)


def describe(pair: Forward, solution: Solution, why: str) -> BlurFit:
    """The solution as a `BlurFit`: errors by name, residual and noise where the light is, samples for a picture."""
    near = signal_pixels(pair)
    light = pair.data[near] - solution.background
    size = float(np.sqrt(np.sum(light**2)))
    error = pair.data[near] - solution.model[near]
    kernel = pair.kernels(solution.family, kernel_lists(solution))[0]
    through = (solution.gain * pair.source.noise) ** 2 / pair.fine_share
    own = noise_near(pair, solution, near) ** 2 + through * float(np.sum(kernel**2))
    rms, rms_error = size_of_blur(pair, solution)
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
        noise=float(np.sqrt(error.size * own)) / size,
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
        centre=(pair.data_dot.x + solution.moves["dx"], pair.data_dot.y + solution.moves["dy"]),
        magnification=solution.moves["magnification"],
        asymmetry=asymmetry_of(pair, solution)[0],
        radius=float(np.sqrt(2) * rms),
        radius_stderr=float(np.sqrt(2) * rms_error),
        why=why,
        aperture=_aperture(pair, solution),
        samples=_samples(pair, solution),
        curve=_samples(pair, solution, modelled=True),
    )


def _aperture(pair: Forward, solution: Solution) -> Aperture | None:
    """The lens's opening that a solution found, or None where its kernel is round."""
    if solution.family not in OPENINGS:
        return None
    return pair.opening_with({n: float(v) for n, v in solution.params.items()})


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
