"""A solution of the forward model, told as a `BlurFit`."""

from __future__ import annotations

import numpy as np

from ..result import BlurFit
from ..solve import information_criterion
from .diagnostics import asymmetry_of, noise_near, rms_left, size_of_blur
from .forward import OPENINGS, SHAPES, Forward, Solution
from .noise import independent_share

__all__ = ["bic_of", "describe"]

_LIT = 0.01  # of its peak, from which on a pixel of a free kernel counts as one of its parameters


def bic_of(pair: Forward, solution: Solution) -> float:
    """Bayesian information criterion of a solution."""
    floor = pair.values.size * (1e-6 * pair.unit) ** 2
    free = len(SHAPES[solution.family])
    if solution.family == "radial":
        free = int(np.sum(np.asarray(solution.params["values"]) > 0))
    elif solution.family == "polygon":
        free += 1  # its number of blades
    elif solution.family == "image":
        kernel = pair.kernel(solution)
        free = int(np.sum(kernel > _LIT * kernel.max()))
    # neighbours whose noise goes together are no independent witnesses
    count = pair.values.size * independent_share(pair.noise_correlation)
    squares = (solution.squares + floor) * count / pair.values.size
    return information_criterion(squares, max(round(count), 1), free + len(pair.fit_moves) + 2)


def describe(pair: Forward, solution: Solution, why: str) -> BlurFit:
    """The solution as a `BlurFit`: errors by name, residual and noise where the light is, samples for a picture."""
    x, y = pair.dot.x + solution.moves["dx"], pair.dot.y + solution.moves["dy"]
    size = float(np.sqrt(np.mean((pair.data[pair.lit] - solution.background) ** 2)))
    through = (solution.gain * pair.source.noise) ** 2 / pair.fine_share
    noise = np.sqrt(noise_near(pair, solution) ** 2 + through * float(np.sum(pair.kernel(solution) ** 2)))
    rms, rms_error = size_of_blur(pair, solution)
    spread = np.sqrt(np.diag(solution.covariance))
    stderr = {n: float(s) for n, s in zip(solution.names, spread, strict=True) if n in solution.params}
    opening = {n: float(v) for n, v in solution.params.items()} if solution.family in OPENINGS else None
    rows, columns = pair.pixels
    distance = np.hypot(columns - x, rows - y)
    near = (distance <= 1.2 * pair.dot.reach) & pair.used
    order = np.argsort(distance[near])
    samples, curve = (
        np.stack([distance[near], (levels[near] - solution.background) / (solution.gain or 1.0)])[:, order]
        for levels in (pair.data, solution.model)
    )
    return BlurFit(
        family=solution.family,
        params=dict(solution.params),
        stderr={"values": spread, "radius": 0.0} if solution.family == "radial" else stderr,
        residual=rms_left(pair, solution) / size,
        noise=float(noise) / size,
        covariance=solution.covariance,
        names=solution.names,
        bic=bic_of(pair, solution),
        count=pair.values.size,
        model="forward",
        gain=solution.gain,
        background=solution.background,
        shift=(x - pair.source.x, y - pair.source.y),
        centre=(x, y),
        magnification=solution.moves["magnification"],
        asymmetry=asymmetry_of(pair, solution)[0],
        radius=float(np.sqrt(2) * rms),
        radius_stderr=float(np.sqrt(2) * rms_error),
        why=why,
        aperture=None if opening is None else pair.opening_with(opening),
        samples=samples,
        curve=curve,
    )
