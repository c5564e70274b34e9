"""Nodes of a traced table: where they are, and kernels fitted to the spots of all of them, smooth over depth.

Everything is compared in the frequency domain: the transfer function of a spot (its Hankel transform, a sum of Bessel
functions over the rays) against that of a profile, weighted by the spectrum of natural images (amplitude 1/frequency)
and the area of a pixel. The squared difference is the squared error in a photograph, up to a constant.

The default family ``"radial"`` is linear in its values once the radius is set, and the radius is geometry: that of the
outermost ray. So the fit is a convex problem without branches to jump between, and it is solved for all nodes at once
against spots at the nodes *and between them*, where the table will interpolate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls
from scipy.special import j0

from torchdof.optics.psf import FAMILIES, LENGTHS

from ..result import Array
from .shape import fit_shape
from .spot import Spot

__all__ = ["NodeEquations", "Tracer", "fit_radial", "fit_shapes", "place_nodes"]

_FINEST = 3.0  # cycles a pixel; kernels are sampled on the pixel grid, so frequencies beyond it fold back
_BETWEEN = (0.25, 0.5, 0.75)  # where between two nodes spots are traced for the joint fit
_SWEEPS = 6
_PULL = 1e-4  # weight of a ray histogram where spots say nothing (details far below a pixel)
_NARROW = 0.01  # pixels of coc; an interval that narrow is not divided
_WANTED_DB = 62.0  # PSNR of a natural image in the middle of an interval; beside it it may be some dB less
_CONTRAST = 0.22  # standard deviation of natural images over their peak


@dataclass(frozen=True, eq=False)
class NodeEquations:
    """A traced spot as a quadratic form: values v miss it, squared, by ``v @ gram @ v - 2 pull @ v + constant``."""

    radius: float
    gram: Array
    pull: Array
    constant: float
    histogram: Array
    area: Array

    def error(self, values: Array) -> float:
        """Weighted squared error of profile values."""
        return max(float(values @ self.gram @ values - 2.0 * self.pull @ values + self.constant), 0.0)


class Tracer:
    """Traces spots by coc and keeps their equations; between nodes these are for the radius interpolated there."""

    def __init__(self, spot: Callable[[float], Spot], points: int, pixel: float) -> None:
        self.spot, self.points, self.pixel = spot, points, pixel
        self.frequency = np.linspace(1 / 256, _FINEST, 400)
        # amplitude of natural images times the area of a ring of frequencies; flat beyond Nyquist, where it folds back
        spectrum = np.minimum(self.frequency, 0.5) ** -0.5
        self.weight = spectrum / np.sqrt(1.0 + (np.pi * self.frequency) ** 2)
        self._nodes: dict[float, NodeEquations] = {}
        self._spots: dict[float, tuple[Array, Array, Array]] = {}

    def traced(self, coc: float) -> tuple[Array, Array, Array]:
        """Radii in pixels, weights and transfer function of the spot."""
        if coc not in self._spots:
            spot = self.spot(coc)
            r = np.maximum(spot.r / self.pixel, 1e-9)
            self._spots[coc] = r, spot.weight, transfer(self.frequency, r, spot.weight)
        return self._spots[coc]

    def node(self, coc: float) -> NodeEquations:
        """The equations of the spot at a node, whose radius is that of the outermost ray."""
        if coc not in self._nodes:
            self._nodes[coc] = self.equations(coc, float(self.traced(coc)[0].max()))
        return self._nodes[coc]

    def equations(self, coc: float, radius: float) -> NodeEquations:
        """The equations of the spot at a coc, for profiles that end at ``radius`` pixels."""
        r, light, spot_transfer = self.traced(coc)
        basis, area = _hats(self.frequency, radius, self.points)
        basis = basis * self.weight[:, None]
        # all light, whatever the frequencies say
        heavy = 1e4 * self.weight.max() ** 2
        gram = basis.T @ basis + heavy * np.outer(area, area)
        pull = basis.T @ (spot_transfer * self.weight) + heavy * area
        place = np.minimum(r / radius, 1.0) * (self.points - 1)
        low = np.minimum(place.astype(int), self.points - 2)
        upper = place - low
        ring = np.bincount(low, light * (1 - upper), self.points) + np.bincount(low + 1, light * upper, self.points)
        constant = float(((spot_transfer * self.weight) ** 2).sum() + heavy)
        return NodeEquations(radius, gram, pull, constant, ring / area, area)

    def relative(self, error: float) -> float:
        """Root of a squared error over that of a kernel that passes no light."""
        return math.sqrt(error / float((self.weight**2).sum()))


def transfer(frequency: Array, r: Array, light: Array) -> Array:
    """Hankel transform of light at distances r from the centre: the spot's transfer function."""
    parts = [
        j0(2.0 * np.pi * np.outer(frequency, r[i : i + 4096])) @ light[i : i + 4096] for i in range(0, len(r), 4096)
    ]
    return np.sum(parts, axis=0)


def _hats(frequency: Array, radius: float, points: int) -> tuple[Array, Array]:
    """Transfer functions ``[F, P]`` of the piecewise linear profile's basis, and the light in each basis function.

    Lengths within the profile are relative to its radius, so that values mean the same at every radius.
    """
    fine = 12 * (points - 1)
    r = (np.arange(fine) + 0.5) / fine
    place = r * (points - 1)
    low = place.astype(int)
    hats = np.zeros((fine, points))
    hats[np.arange(fine), low], hats[np.arange(fine), low + 1] = 1.0 - (place - low), place - low
    light = hats * (2.0 * np.pi * r / fine)[:, None]
    return j0(2.0 * np.pi * np.outer(frequency, r * radius)) @ light, light.sum(0)


def place_nodes(tracer: Tracer, near: float, far: float, nodes: int | None) -> list[float]:
    """Signed coc of the nodes: intervals are halved where the table's interpolation is worst in the middle.

    None halves as many as it takes for 50 dB between the nodes.

    Raises:
        ValueError: If there are no more intervals to halve.
    """
    places = [near, near / 2, 0.0, far / 2, far] if far > 0 else [near, near / 2, 0.0]
    alone: dict[float, Array] = {}

    def values(coc: float) -> Array:
        if coc not in alone:
            node = tracer.node(coc)
            alone[coc] = _non_negative(node, node.gram, node.pull, node.histogram)
        return alone[coc]

    def gap(left: float, right: float) -> float:
        radii = tracer.node(left).radius, tracer.node(right).radius
        if max(radii) <= 0.5 or right - left < _NARROW * tracer.pixel:
            return 0.0
        between = tracer.equations((left + right) / 2, sum(radii) / 2)
        return between.error((values(left) + values(right)) / 2)

    gaps = [gap(*pair) for pair in zip(places, places[1:], strict=False)]
    enough = 10.0 ** (-_WANTED_DB / 20.0) / _CONTRAST
    while len(places) < nodes if nodes is not None else tracer.relative(max(gaps)) > enough:
        worst = int(np.argmax(gaps))
        if gaps[worst] == 0.0:
            raise ValueError(
                f"nodes must be at most {len(places)} for this lens and width_px, got {nodes}: between those the spots "
                "stay within one pixel, or hardly differ; take fewer nodes or a larger width_px"
            )
        left, right = places[worst], places[worst + 1]
        middle = (left + right) / 2
        places.insert(worst + 1, middle)
        gaps[worst : worst + 1] = [gap(left, middle), gap(middle, right)]
    return places


def fit_radial(tracer: Tracer, places: Sequence[float]) -> tuple[dict[str, Array], Array]:
    """Values of all nodes at once, by sweeps from both ends to the focus and back."""
    nodes = [tracer.node(coc) for coc in places]
    values = [_non_negative(node, node.gram, node.pull, node.histogram) for node in nodes]
    # every spot: the node to its left, its share of the way to the next one, its equations
    spots = [(i, 0.0, node) for i, node in enumerate(nodes)]
    for i in range(len(places) - 1):
        for fraction in _BETWEEN:
            radius = (1 - fraction) * nodes[i].radius + fraction * nodes[i + 1].radius
            spots.append((i, fraction, tracer.equations((1 - fraction) * places[i] + fraction * places[i + 1], radius)))
    focus = int(np.argmin(np.abs(places)))
    order = [*range(focus), *range(len(places) - 1, focus - 1, -1)]
    for sweep in range(_SWEEPS):
        for i in order if sweep % 2 == 0 else order[::-1]:
            gram, pull = np.zeros_like(nodes[i].gram), np.zeros_like(nodes[i].pull)
            for left, fraction, spot in spots:
                weight = 1 - fraction if left == i else fraction if left + 1 == i else 0.0
                if weight > 0.0:
                    gram += weight * weight * spot.gram
                    pull += weight * spot.pull
                    if weight < 1.0:
                        neighbour = values[left + 1 if left == i else left]
                        pull -= weight * (1 - weight) * (spot.gram @ neighbour)
            values[i] = _non_negative(nodes[i], gram, pull, nodes[i].histogram)
    radii = np.array([node.radius for node in nodes]) * tracer.pixel
    residual = np.array([tracer.relative(n.error(v)) for n, v in zip(nodes, values, strict=True)])
    return {"values": np.stack(values), "radius": radii}, residual


def fit_shapes(tracer: Tracer, places: Sequence[float], family: str) -> tuple[dict[str, Array], Array]:
    """A named shape at each node, each started from its neighbour, from both ends to the focus."""
    focus = int(np.argmin(np.abs(places)))
    fitted: dict[int, tuple[dict[str, float], float]] = {}
    for side in (range(focus), range(len(places) - 1, focus - 1, -1)):
        before: tuple[dict[str, float], float] | None = None
        for i in side:
            r, light, spot_transfer = tracer.traced(places[i])
            params, error = fit_shape(family, tracer.frequency, tracer.weight, spot_transfer, r, light, before)
            before, fitted[i] = (params, float(r.max())), (params, tracer.relative(error))
    columns = {
        key: np.array([fitted[i][0][key] for i in range(len(places))]) * (tracer.pixel if key in LENGTHS else 1.0)
        for key in FAMILIES[family]
    }
    return columns, np.array([fitted[i][1] for i in range(len(places))])


def _non_negative(node: NodeEquations, gram: Array, pull: Array, prior: Array) -> Array:
    """Non-negative least squares of a quadratic form, towards the histogram where it is flat; light sums to 1."""
    scale = _PULL**2 * np.trace(gram) / np.sum(node.area)
    factor = cholesky(gram + np.diag(scale * node.area), lower=True)
    values, _ = nnls(
        factor.T, solve_triangular(factor, pull + scale * node.area * prior, lower=True), maxiter=50 * len(pull)
    )
    return values / (node.area @ values)
