"""Representations of the sharp dot in the forward model: its picture, an ideal dot fitted to it, or a point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import affine_transform, spline_filter
from scipy.special import erfc

from ..result import Array
from ..solve import best_of
from .dot import Dot, distance_from, fine_variance, inner_pixels, noise_beside, noise_of

UNFOCUSED_PX = 1.0  # sigma of an edge, px, above which it is out of focus; every camera gives a sharper edge in focus
_FOCUSED_PX = 0.5  # typical for cameras: between a perfect lens and a demosaiced picture
_SAMPLES_PER_PX = 6  # samples across a pixel near the edge


@dataclass(frozen=True)
class Source:
    """A representation of the sharp dot; lengths in px."""

    x: float  # position in the sharp picture
    y: float
    radius: float  # of a uniform disc with the same second moment
    reach: float  # dark beyond this radius
    draw: Callable[..., Array]  # a picture, from its shape, and the centre (x, y) and the magnification of the dot
    noise: float = 0.0  # standard deviation of its pixels
    ideal: bool = False  # whether it is an ideal dot: without noise, and not softer than in focus


def picture_of_dot(picture: Array, dot: Dot) -> Source:
    """The dot as photographed `[H, W]`, interpolated by cubic splines; dark beyond its reach."""
    reach = dot.reach + 2.0
    inside = distance_from(dot, picture.shape) <= reach
    draw = _drawn_by_splines(np.where(inside, picture - dot.background, 0.0), dot.x, dot.y)
    return Source(dot.x, dot.y, dot.radius, reach, draw, noise_of(picture))


def point_source(shape: tuple[int, ...], dot: Dot) -> Source:
    """A point of light at the pixel nearest to a blurred dot's centre, blurred by that pixel."""
    (x, y), box, picture = (round(dot.x), round(dot.y)), np.array([1.0, 22.0, 1.0]) / 24.0, np.zeros(shape)
    picture[y - 1 : y + 2, x - 1 : x + 2] = np.outer(box, box)
    return Source(x, y, 0.0, 4.0, _drawn_by_splines(picture, x, y))


def _drawn_by_splines(picture: Array, x: float, y: float) -> Callable[..., Array]:
    spline = spline_filter(picture, order=3)

    def draw(shape: tuple[int, ...], centre_x: float, centre_y: float, magnification: float) -> Array:
        offset = (y - centre_y / magnification, x - centre_x / magnification)
        return np.asarray(affine_transform(spline, [1 / magnification] * 2, offset, shape, order=3, prefilter=False))

    return draw


def ideal_dot(edge: Edge) -> Source:
    """A soft disc fitted to the photographed dot, drawn as in focus; the softness, the sensor's, is not magnified."""
    edge = edge.with_softness(_FOCUSED_PX) if edge.softness > UNFOCUSED_PX else edge
    radius, softness = edge.radius, edge.softness

    def draw(shape: tuple[int, ...], x: float, y: float, magnification: float) -> Array:
        rows, columns = np.indices(shape)
        square = magnification**2 * (radius**2 + softness**2) - softness**2  # from the light of a soft disc
        return edge.level * _coverage(rows, columns, x, y, np.sqrt(max(square, 0.0)), softness)

    return Source(edge.x, edge.y, radius, radius + 5 * softness + 1.0, draw, ideal=True)


@dataclass(frozen=True)
class Edge:
    """A dot's edge: a uniform disc with a soft edge, integrated over the pixels; lengths in px."""

    x: float
    y: float
    radius: float  # at half the level
    softness: float  # sigma of the edge, without the pixel's own blur
    level: float  # of the dot above its background
    exponent: float  # of the light in the edge's levels, if fitted; 1 in linear light
    rms: float  # residual of the ideal dot, over the dot's peak
    misfit: float  # the same over the expected noise
    steepness: float  # mean residual of the edge's upper half minus that of its lower, over the level; S-curve: above 0
    steepness_error: float
    shot_noise: float  # growth of a pixel's noise variance from the paper to the dot

    def with_softness(self, softness: float) -> Edge:
        """The edge of the same dot with another softness: its light, pi (radius^2 + softness^2), is kept."""
        square = self.radius**2 + self.softness**2 - softness**2
        return replace(self, radius=float(np.sqrt(max(square, 0.0))), softness=softness)


def soft_edge(picture: Array, dot: Dot, white: float | None = None, *, fit_exponent: bool = False) -> Edge:
    """Fits a soft disc to a dot in a picture `[H, W]`; pixels from level `white` up may be clipped.

    With `fit_exponent`, levels are a power of the light (encoding: about 0.45), which breaks the symmetry of the edge.
    """
    grid = np.indices(picture.shape).astype(np.float64)
    is_near = distance_from(dot, picture.shape) <= dot.reach + 3
    rows, columns, levels = grid[0][is_near], grid[1][is_near], (picture[is_near] - dot.background) / dot.peak
    clip_level = np.inf if white is None else (white - dot.background) / dot.peak

    def model(p: Array) -> Array:
        dx, dy, radius, softness, level = p[:5]
        coverage = _coverage(rows, columns, dot.x + dx, dot.y + dy, radius, softness)
        return np.minimum(level * (coverage ** p[5] if fit_exponent else coverage), clip_level)

    def jacobian(p: Array) -> Array:
        steps = np.diag((1e-2, 1e-2, 1e-2, 1e-2, 1e-4, 1e-4)[: len(p)])
        up, down = p + steps, np.maximum(p - steps, bounds[0])
        changes = [model(more) - model(less) for more, less in zip(up, down, strict=True)]
        return np.stack(changes, axis=1) / np.diag(up - down)

    bounds = ([-3, -3, 0.2, 0.0, 0.3], [3, 3, dot.reach + 3, dot.reach + 3, 30.0])
    starts = [[0, 0, dot.radius, 0.4, 1.0], [0, 0, dot.radius, 0.3 * dot.radius + 0.1, 1.1]]
    if fit_exponent:
        bounds = [*bounds[0], 0.2], [*bounds[1], 3.0]
        starts = [[0, 0, dot.radius - 0.4, s, 1.0, 0.45] for s in (0.1, 0.6, 1.5)]
    solution = best_of(model, levels, starts, bounds, jacobian=jacobian, tolerance=1e-7)
    residual = levels - model(solution)
    rms = float(np.sqrt(residual @ residual / max(levels.size - len(solution), 1)))
    inside = inner_pixels(picture, dot)
    shot_noise = 0.0 if inside is None else max(fine_variance(picture, inside) - dot.noise**2, 0.0)
    fine_share = noise_beside(picture, dot.background, ~is_near)[1]
    expected = float(np.sqrt(np.mean(dot.noise**2 + shot_noise * np.clip(levels, 0, 1)) / fine_share)) / dot.peak
    dx, dy, radius, softness, level, exponent = [*solution.tolist(), 1.0][:6]
    coverage = _coverage(rows, columns, dot.x + dx, dot.y + dy, radius, softness)
    halves = [residual[(coverage > least) & (coverage < least + 0.38)] / level for least in (0.02, 0.6)]
    steepness, steepness_error = 0.0, np.inf
    if min(map(len, halves)) >= 8:
        steepness = float(halves[1].mean() - halves[0].mean())
        steepness_error = float(np.sqrt(sum(half.var(ddof=1) / len(half) for half in halves)))
    misfit = rms / expected if expected > 0 else np.inf
    found = radius, softness, level * dot.peak, exponent, rms, misfit, steepness, steepness_error, shot_noise
    return Edge(dot.x + dx, dot.y + dy, *found)


def _coverage(rows: Array, columns: Array, x: float, y: float, radius: float, softness: float) -> Array:
    """Level, 0 to 1, of a soft disc, integrated over each pixel."""
    distance = np.hypot(columns - x, rows - y)
    level = (distance < radius).astype(np.float64)
    sigma = max(softness, 0.3 / _SAMPLES_PER_PX)  # the fine grid's own step softens the edge
    band = np.abs(distance - radius) < 0.75 + 5 * sigma
    step = (np.arange(_SAMPLES_PER_PX) + 0.5) / _SAMPLES_PER_PX - 0.5
    fine_x, fine_y = (columns[band] - x)[:, None, None] + step, (rows[band] - y)[:, None, None] + step[:, None]
    level[band] = (0.5 * erfc((np.hypot(fine_x, fine_y) - radius) / (np.sqrt(2) * sigma))).mean((1, 2))
    return level
