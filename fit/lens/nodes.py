"""Nodes of a traced table: their positions, and kernels fitted to their spots, smooth over depth.

Spots and profiles are compared by their transfer functions, which are Hankel transforms; a spot's is a sum of Bessel
functions over its rays. Both are weighted by the spectrum of natural images (amplitude 1/frequency) and the area of a
pixel. The squared difference is then the squared error in a photograph, up to a constant.

A profile has the radius of the outermost ray, and is linear in its values. So the fit is a convex problem with a single
solution. It is solved for all nodes at once, against spots at the nodes *and between them*, where the table
interpolates.
"""

import functools
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls
from scipy.special import j0

from ..result import Array
from .spot import Spot

# Places of the nodes
_MIN_INTERVAL_PX = 0.01  # pixels of coc; narrower intervals are not divided
_TARGET_DB = 62.0  # PSNR of a natural image in the middle of an interval; elsewhere it may be a few dB less
_CONTRAST = 0.22  # standard deviation of natural images over their peak

# Fit of the profiles
_MAX_FREQUENCY = 3.0  # cycles for each pixel; kernels are sampled on the pixel grid, so higher frequencies are aliased
_FRACTIONS = (0.25, 0.5, 0.75)  # of the interval between two nodes: where more spots are traced for the joint fit
_SWEEPS = 6  # passes over all nodes of the joint fit
_PRIOR_WEIGHT = 1e-4  # weight of the ray histogram, which determines details of the profile far below a pixel


class NodeEquations(NamedTuple):
    """A traced spot as a quadratic form: the squared error of values v is ``v @ gram @ v - 2 pull @ v + constant``."""

    radius: float
    gram: Array
    pull: Array
    constant: float
    histogram: Array

    def error(self, values: Array) -> float:
        """Weighted squared error of a profile's values."""
        return max(float(values @ self.gram @ values - 2.0 * self.pull @ values + self.constant), 0.0)


class Tracer:
    """Traces spots by coc, with a cache; equations are for profiles that are piecewise linear at ``points`` radii."""

    def __init__(self, spot: Callable[[float], Spot], points: int, pixel: float) -> None:
        self.spot, self.points, self.pixel = spot, points, pixel
        self.frequency = np.linspace(1 / 256, _MAX_FREQUENCY, 400)
        # amplitude of natural images times the area of a ring of frequencies; constant beyond Nyquist, because of
        # aliasing
        spectrum = np.minimum(self.frequency, 0.5) ** -0.5
        self.weight = spectrum / np.sqrt(1.0 + (np.pi * self.frequency) ** 2)
        count = 12 * (points - 1)
        self._r = (np.arange(count) + 0.5) / count  # radii relative to the profile's
        self._light = _hats(self._r, points) * (2.0 * np.pi * self._r / count)[:, None]
        self.area = self._light.sum(0)  # integral of each hat
        self.traced, self.alone = functools.cache(self._traced), functools.cache(self._alone)

    def _traced(self, coc: float) -> tuple[Array, Array, Array]:
        """Radii in pixels, weights and transfer function (a Hankel transform) of the spot."""
        spot = self.spot(coc)
        r, light = np.maximum(spot.r / self.pixel, 1e-9), spot.weight
        slices = (slice(i, i + 4096) for i in range(0, len(r), 4096))
        return r, light, np.sum([j0(2.0 * np.pi * np.outer(self.frequency, r[i])) @ light[i] for i in slices], axis=0)

    def _alone(self, coc: float) -> tuple[NodeEquations, Array]:
        """Equations of the spot at a node, with the radius of the outermost ray, and values that fit it."""
        node = self.equations(coc, float(self.traced(coc)[0].max()))
        return node, self.fitted(node.gram, node.pull, node.histogram)

    def equations(self, coc: float, radius: float) -> NodeEquations:
        """Equations of the spot at a coc, for profiles that end at ``radius`` pixels."""
        r, light, transfer = self.traced(coc)
        basis = j0(2.0 * np.pi * np.outer(self.frequency, self._r * radius)) @ self._light * self.weight[:, None]
        light_weight = 1e4 * self.weight.max() ** 2  # fixes the total light, whatever the frequencies
        gram = basis.T @ basis + light_weight * np.outer(self.area, self.area)
        pull = basis.T @ (transfer * self.weight) + light_weight * self.area
        histogram = light @ _hats(np.minimum(r / radius, 1.0), self.points) / self.area
        return NodeEquations(radius, gram, pull, float(((transfer * self.weight) ** 2).sum() + light_weight), histogram)

    def fitted(self, gram: Array, pull: Array, prior: Array) -> Array:
        """Non-negative least squares of a quadratic form, with a prior where it is flat; the light sums to 1."""
        scale = _PRIOR_WEIGHT**2 * np.trace(gram) / np.sum(self.area) * self.area
        factor = cholesky(gram + np.diag(scale), lower=True)
        values, _ = nnls(factor.T, solve_triangular(factor, pull + scale * prior, lower=True), maxiter=50 * len(pull))
        return values / (self.area @ values)

    def relative(self, error: float) -> float:
        """Root of a squared error, relative to that of an empty kernel."""
        return math.sqrt(error / float((self.weight**2).sum()))


def _hats(r: Array, points: int) -> Array:
    """Values at radii ``[R]`` from 0 to 1 of the piecewise linear profile's basis ``[R, P]``."""
    return np.maximum(1.0 - np.abs(r[:, None] * (points - 1) - np.arange(points)), 0.0)


def place_nodes(tracer: Tracer, near: float, far: float, nodes: int | None) -> list[float]:
    """Signed coc of the nodes: repeatedly halves the interval with the worst interpolation in its middle.

    If ``nodes`` is None, until the interpolation reaches 50 dB everywhere.
    """

    def interval_error(left: float, right: float) -> float:
        (node, values), (next_node, next_values) = tracer.alone(left), tracer.alone(right)
        if max(node.radius, next_node.radius) <= 0.5 or right - left < _MIN_INTERVAL_PX * tracer.pixel:
            return 0.0
        middle_node = tracer.equations((left + right) / 2, (node.radius + next_node.radius) / 2)
        return middle_node.error((values + next_values) / 2)

    cocs = [near, near / 2, 0.0, far / 2, far] if far > 0 else [near, near / 2, 0.0]
    errors = [interval_error(*pair) for pair in pairwise(cocs)]
    accepted_error = 10.0 ** (-_TARGET_DB / 20.0) / _CONTRAST
    while len(cocs) < nodes if nodes is not None else tracer.relative(max(errors)) > accepted_error:
        worst = int(np.argmax(errors))
        if errors[worst] == 0.0:
            raise ValueError(
                f"nodes must be at most {len(cocs)} for this lens and width_px, got {nodes}: between those the spots "
                "stay within one pixel, or hardly differ; take fewer nodes or a larger width_px"
            )
        left, right = cocs[worst : worst + 2]
        middle = (left + right) / 2
        cocs.insert(worst + 1, middle)
        errors[worst : worst + 1] = [interval_error(left, middle), interval_error(middle, right)]
    return cocs


def fit_radial(tracer: Tracer, cocs: Sequence[float]) -> tuple[dict[str, Array], Array]:
    """Values of all nodes together, in sweeps from the nearest to the farthest and back."""
    nodes, values = map(list, zip(*(tracer.alone(coc) for coc in cocs), strict=True))
    # for each node: equations that contain its values, their weight in them, and the node with the remaining weight
    spots: list[list[tuple[NodeEquations, float, int]]] = [[(node, 1.0, i)] for i, node in enumerate(nodes)]
    for i, (left, right) in enumerate(pairwise(zip(cocs, nodes, strict=True))):
        for share in _FRACTIONS:
            coc = (1 - share) * left[0] + share * right[0]
            equations = tracer.equations(coc, (1 - share) * left[1].radius + share * right[1].radius)
            spots[i].append((equations, 1 - share, i + 1))
            spots[i + 1].append((equations, share, i))
    there = range(len(cocs))
    for order in (there, there[::-1]) * (_SWEEPS // 2):
        for i in order:
            gram = np.sum([share**2 * spot.gram for spot, share, _ in spots[i]], axis=0)
            pulls = [share * (spot.pull - (1 - share) * spot.gram @ values[other]) for spot, share, other in spots[i]]
            values[i] = tracer.fitted(gram, np.sum(pulls, axis=0), nodes[i].histogram)
    residual = np.array([tracer.relative(node.error(v)) for node, v in zip(nodes, values, strict=True)])
    return {"values": np.stack(values), "radius": np.array([node.radius for node in nodes]) * tracer.pixel}, residual
