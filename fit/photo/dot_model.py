"""An ideal dot: a uniform disc with a soft edge, integrated over the pixels, fitted to a sharp picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..result import Array
from ..solve import best_of
from .dot import Dot, noise_inside, radial_mean
from .noise import correlate, correlation_of, noise_beside
from .profile_fit import inverse

__all__ = ["STEPS", "Edge", "draw_edge", "soft_edge", "with_softness"]

STEPS = {"radius": 1e-2, "softness": 0.1}
"""Steps in px over which an edge's errors are passed on."""

_FINE = 6  # samples across a pixel near the edge


@dataclass(frozen=True)
class Edge:
    """Where a dot ends, and how softly.

    Attributes:
        x: the dot's centre in px.
        y: the same, downwards.
        radius: px, where the level is half.
        softness: px, sigma of the edge beyond the pixel's own.
        level: of the dot above its background.
        exponent: 1 in linear light; of the edge's levels, where it was fitted.
        covariance: of radius and softness `[2, 2]`.
        rms: of what the ideal dot does not explain, over the dot's peak.
        misfit: the same over the noise expected there.
        steepness: by how much of its level the edge's upper half is brighter than its pixels' coverage, and the lower
            darker. An S-curve spreads the levels of half-covered pixels apart; no blur does: it brings them together.
        steepness_error: of that.
    """

    x: float
    y: float
    radius: float
    softness: float
    level: float
    exponent: float
    covariance: Array
    rms: float
    misfit: float
    steepness: float
    steepness_error: float


def with_softness(edge: Edge, softness: float) -> Edge:
    """The edge of the same dot through another blur: its light, pi (radius^2 + softness^2), stays."""
    square = edge.radius**2 + edge.softness**2 - softness**2
    return replace(edge, radius=float(np.sqrt(max(square, 0.0))), softness=softness)


def draw_edge(rows: Array, columns: Array, x: float, y: float, radius: float, softness: float) -> Array:
    """Level, 0 to 1, of a soft disc in each pixel, integrated over it.

    Args:
        rows: pixel rows `[...]`.
        columns: pixel columns `[...]`.
        x: centre in px.
        y: centre in px.
        radius: px.
        softness: px, sigma of the edge.
    """
    from scipy.special import erfc

    distance = np.hypot(columns - x, rows - y)
    level = (distance < radius).astype(np.float64)
    # within the fine grid's own step an edge is soft anyway
    sigma = max(softness, 0.3 / _FINE)
    band = np.abs(distance - radius) < 0.75 + 5 * sigma
    step = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    fine = np.hypot(
        (columns[band] - x)[:, None, None] + step[None, None, :], (rows[band] - y)[:, None, None] + step[None, :, None]
    )
    level[band] = (0.5 * erfc((fine - radius) / (np.sqrt(2) * sigma))).mean((1, 2))
    return level


def soft_edge(picture: Array, dot: Dot, white: float | None = None, *, fit_exponent: bool = False) -> Edge:
    """Fit a soft disc to a dot.

    Args:
        picture: `[H, W]`.
        dot: where the dot is.
        white: pixels at this level or above are allowed to be brighter than they look.
        fit_exponent: let the levels be a power of the light. A round white dot has as much light missing inside its
            edge as there is outside; encoding (a power of about 0.45) breaks that balance and so shows itself.
    """
    grid: Array = np.indices(picture.shape).astype(np.float64)
    near = np.hypot(grid[1] - dot.x, grid[0] - dot.y) <= dot.reach + 3
    rows, columns, levels = grid[0][near], grid[1][near], (picture[near] - dot.background) / dot.peak
    top = np.inf if white is None else (white - dot.background) / dot.peak

    def model(_: Array, *p: float) -> Array:
        dx, dy, radius, softness, level = p[:5]
        coverage = draw_edge(rows, columns, dot.x + dx, dot.y + dy, radius, softness)
        return np.minimum(level * (coverage ** p[5] if fit_exponent else coverage), top)

    def jacobian(_: Array, *p: float) -> Array:
        params: Array = np.array(p, dtype=np.float64)
        columns_: list[Array] = []
        for i, h in enumerate((1e-2, 1e-2, 1e-2, 1e-2, 1e-4, 1e-4)[: len(p)]):
            up, down = params.copy(), params.copy()
            up[i], down[i] = up[i] + h, max(down[i] - h, 0.0) if i > 1 else down[i] - h
            columns_.append((model(_, *up) - model(_, *down)) / (up[i] - down[i]))
        return np.stack(columns_, axis=1)

    bounds = ([-3, -3, 0.2, 0.0, 0.3], [3, 3, dot.reach + 3, dot.reach + 3, 30.0])
    starts = [[0, 0, dot.radius, 0.4, 1.0], [0, 0, dot.radius, 0.3 * dot.radius + 0.1, 1.1]]
    if fit_exponent:
        bounds = [*bounds[0], 0.2], [*bounds[1], 3.0]
        starts = [[0, 0, dot.radius - 0.4, s, 1.0, 0.45] for s in (0.1, 0.6, 1.5)]
    solution = best_of(model, levels, starts, bounds, jacobian=jacobian, tolerance=1e-7)
    residual = levels - model(levels, *solution)
    slope = jacobian(levels, *solution)
    # a soft edge shows by its variance: a step that is finite has a slope even where the softness is 0
    for i, h in ((2, STEPS["radius"]), (3, STEPS["softness"])):
        moved = solution.copy()
        moved[i] += h
        slope[:, i] = (model(levels, *moved) - model(levels, *solution)) / h
    variance = float(residual @ residual) / max(levels.size - len(solution), 1)
    smooth = noise_beside(picture, dot.background, ~near)[1]
    expected = float(np.sqrt(np.mean(_variance(picture, dot)[near]) / smooth)) / dot.peak
    # a mosaic errs at the edge far more than within the dot, and noise that goes together in neighbours does not
    # average out along the edge
    shown = np.zeros(picture.shape)
    shown[near] = residual
    distance = np.hypot(grid[1] - dot.x - solution[0], grid[0] - dot.y - solution[1])
    rings, _ = radial_mean(shown**2, distance)
    deviation = np.sqrt(rings)[np.minimum(np.floor(distance + 0.5).astype(np.int64), rings.size - 1)]
    pictures = np.zeros((slope.shape[1], *picture.shape))
    pictures[:, near] = deviation[near] * slope.T
    correlation = correlation_of(shown / np.maximum(deviation, np.finfo(float).tiny), near)
    together = deviation[near] * correlate(pictures, correlation)[:, near]
    bread = inverse(slope.T @ slope)
    bread = np.where(np.isfinite(bread), bread, 0.0)
    covariance = bread @ (slope.T @ together.T) @ bread * levels.size / max(levels.size - len(solution), 1)
    coverage = draw_edge(rows, columns, dot.x + solution[0], dot.y + solution[1], solution[2], solution[3])
    steepness, steepness_error = _steepness(residual / solution[4], coverage)
    return Edge(
        x=dot.x + float(solution[0]),
        y=dot.y + float(solution[1]),
        radius=float(solution[2]),
        softness=float(solution[3]),
        level=float(solution[4]) * dot.peak,
        exponent=float(solution[5]) if fit_exponent else 1.0,
        covariance=covariance[2:4, 2:4],
        rms=float(np.sqrt(variance)),
        misfit=float(np.sqrt(variance)) / expected if expected > 0 else np.inf,
        steepness=steepness,
        steepness_error=steepness_error,
    )


def _steepness(residual: Array, coverage: Array) -> tuple[float, float]:
    """Steepness of an edge and its error, from what a soft disc leaves of the levels of pixels so far covered."""
    low, high = (coverage > 0.02) & (coverage < 0.4), (coverage > 0.6) & (coverage < 0.98)
    if min(low.sum(), high.sum()) < 8:
        return 0.0, np.inf
    error = np.sqrt(sum(float(residual[side].var(ddof=1)) / side.sum() for side in (low, high)))
    return float(residual[high].mean() - residual[low].mean()), float(error)


def _variance(picture: Array, dot: Dot) -> Array:
    """Noise variance of each pixel: the background's, growing with the level to that inside the dot (shot noise)."""
    bright = noise_inside(picture, dot)
    level = np.clip((picture - dot.background) / dot.peak, 0, 1)
    return np.asarray(dot.noise**2 + (max(bright[0] ** 2 - dot.noise**2, 0.0) if bright is not None else 0.0) * level)
