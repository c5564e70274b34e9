"""Nodes of a traced table: where they are, and kernels fitted to the spots of all of them, smooth over depth.

Everything is compared in the frequency domain: the transfer function of a spot (its Hankel transform, a sum of Bessel
functions over the rays) against that of a profile, weighted by the spectrum of natural images (amplitude 1/frequency)
and the area of a pixel. The squared difference is the squared error in a photograph, up to a constant.

The default family ``"radial"`` is linear in its values once the radius is set, and the radius is geometry: that of the
outermost ray. So the fit is a convex problem without branches to jump between, and it is solved for all nodes at once
against spots at the nodes *and between them*, where the table will interpolate.
"""

import functools
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls
from scipy.special import j0, j1

from torchdof.optics.psf import FAMILIES, LENGTHS, profile

from ..result import Array
from ..solve import best_of
from .spot import Spot

_FINEST = 3.0  # cycles a pixel; kernels are sampled on the pixel grid, so frequencies beyond it fold back
_BETWEEN = (0.25, 0.5, 0.75)  # where between two nodes spots are traced for the joint fit
_SWEEPS = 6
_PULL = 1e-4  # weight of a ray histogram where spots tell nothing (details far below a pixel)
_NARROW = 0.01  # pixels of coc; an interval that narrow is not divided
_WANTED_DB = 62.0  # PSNR of a natural image in the middle of an interval; beside it it may be some dB less
_CONTRAST = 0.22  # standard deviation of natural images over their peak
# of named shapes: where parameters may lie, lengths relative to the outermost ray; the profile's samples, up to so many
# times that ray; the weight of staying like the neighbour, so that parameters that hardly matter do not jump
_RANGES = {"radius": (0.02, 1.3), "sigma": (0.01, 1.0), "r_c": (0.0, 1.3), "b": (-1.0, 20.0), "m": (0.5, 12.0)}
_STEPS, _REACH, _KEEP = 400, 2.0, 1e-3


class NodeEquations(NamedTuple):
    """A traced spot as a quadratic form: values v miss it, squared, by ``v @ gram @ v - 2 pull @ v + constant``."""

    radius: float
    gram: Array
    pull: Array
    constant: float
    histogram: Array

    def error(self, values: Array) -> float:
        """Weighted squared error of profile values."""
        return max(float(values @ self.gram @ values - 2.0 * self.pull @ values + self.constant), 0.0)


class Tracer:
    """Traces spots by coc and keeps them; their equations are for profiles piecewise linear at ``points`` radii."""

    def __init__(self, spot: Callable[[float], Spot], points: int, pixel: float) -> None:
        self.spot, self.points, self.pixel = spot, points, pixel
        self.frequency = np.linspace(1 / 256, _FINEST, 400)
        # amplitude of natural images times the area of a ring of frequencies; flat beyond Nyquist, where it folds back
        spectrum = np.minimum(self.frequency, 0.5) ** -0.5
        self.weight = spectrum / np.sqrt(1.0 + (np.pi * self.frequency) ** 2)
        fine = 12 * (points - 1)
        self._r = (np.arange(fine) + 0.5) / fine  # within a profile, relative to its radius
        self._light = _hats(self._r, points) * (2.0 * np.pi * self._r / fine)[:, None]
        self.area = self._light.sum(0)  # of each hat, which is the light in it
        self.traced, self.alone = functools.cache(self._traced), functools.cache(self._alone)

    def _traced(self, coc: float) -> tuple[Array, Array, Array]:
        """Radii in pixels, weights and transfer function (a Hankel transform) of the spot."""
        spot = self.spot(coc)
        r, light = np.maximum(spot.r / self.pixel, 1e-9), spot.weight
        pieces = (slice(i, i + 4096) for i in range(0, len(r), 4096))
        return r, light, np.sum([j0(2.0 * np.pi * np.outer(self.frequency, r[i])) @ light[i] for i in pieces], axis=0)

    def _alone(self, coc: float) -> tuple[NodeEquations, Array]:
        """The equations of the spot at a node, whose radius is that of the outermost ray, and values that fit it."""
        node = self.equations(coc, float(self.traced(coc)[0].max()))
        return node, self.fitted(node.gram, node.pull, node.histogram)

    def equations(self, coc: float, radius: float) -> NodeEquations:
        """The equations of the spot at a coc, for profiles that end at ``radius`` pixels."""
        r, light, transfer = self.traced(coc)
        basis = j0(2.0 * np.pi * np.outer(self.frequency, self._r * radius)) @ self._light * self.weight[:, None]
        heavy = 1e4 * self.weight.max() ** 2  # all light, whatever the frequencies tell
        gram = basis.T @ basis + heavy * np.outer(self.area, self.area)
        pull = basis.T @ (transfer * self.weight) + heavy * self.area
        histogram = light @ _hats(np.minimum(r / radius, 1.0), self.points) / self.area
        return NodeEquations(radius, gram, pull, float(((transfer * self.weight) ** 2).sum() + heavy), histogram)

    def fitted(self, gram: Array, pull: Array, prior: Array) -> Array:
        """Non-negative least squares of a quadratic form, towards a prior where it is flat; light sums to 1."""
        scale = _PULL**2 * np.trace(gram) / np.sum(self.area) * self.area
        factor = cholesky(gram + np.diag(scale), lower=True)
        values, _ = nnls(factor.T, solve_triangular(factor, pull + scale * prior, lower=True), maxiter=50 * len(pull))
        return values / (self.area @ values)

    def relative(self, error: float) -> float:
        """Root of a squared error over that of a kernel that passes no light."""
        return math.sqrt(error / float((self.weight**2).sum()))


def _hats(r: Array, points: int) -> Array:
    """Values at radii ``[R]`` from 0 to 1 of the piecewise linear profile's basis ``[R, P]``."""
    return np.maximum(1.0 - np.abs(r[:, None] * (points - 1) - np.arange(points)), 0.0)


def place_nodes(tracer: Tracer, near: float, far: float, nodes: int | None) -> list[float]:
    """Signed coc of the nodes: intervals are halved where the table's interpolation is worst in the middle.

    None halves as many as it takes for 50 dB between the nodes.

    Raises:
        ValueError: If there are no more intervals to halve.
    """

    def gap(left: float, right: float) -> float:
        (node, values), (after, next_values) = tracer.alone(left), tracer.alone(right)
        if max(node.radius, after.radius) <= 0.5 or right - left < _NARROW * tracer.pixel:
            return 0.0
        between = tracer.equations((left + right) / 2, (node.radius + after.radius) / 2)
        return between.error((values + next_values) / 2)

    places = [near, near / 2, 0.0, far / 2, far] if far > 0 else [near, near / 2, 0.0]
    gaps = [gap(*pair) for pair in pairwise(places)]
    enough = 10.0 ** (-_WANTED_DB / 20.0) / _CONTRAST
    while len(places) < nodes if nodes is not None else tracer.relative(max(gaps)) > enough:
        worst = int(np.argmax(gaps))
        if gaps[worst] == 0.0:
            raise ValueError(
                f"nodes must be at most {len(places)} for this lens and width_px, got {nodes}: between those the spots "
                "stay within one pixel, or hardly differ; take fewer nodes or a larger width_px"
            )
        left, right = places[worst : worst + 2]
        middle = (left + right) / 2
        places.insert(worst + 1, middle)
        gaps[worst : worst + 1] = [gap(left, middle), gap(middle, right)]
    return places


def fit_radial(tracer: Tracer, places: Sequence[float]) -> tuple[dict[str, Array], Array]:
    """Values of all nodes at once, by sweeps from both ends to the focus and back."""
    nodes, values = map(list, zip(*(tracer.alone(coc) for coc in places), strict=True))
    # of each node: equations that its values enter, with what weight, and the node that has the rest of it
    spots: list[list[tuple[NodeEquations, float, int]]] = [[(node, 1.0, i)] for i, node in enumerate(nodes)]
    for i, (left, right) in enumerate(pairwise(zip(places, nodes, strict=True))):
        for share in _BETWEEN:
            coc = (1 - share) * left[0] + share * right[0]
            equations = tracer.equations(coc, (1 - share) * left[1].radius + share * right[1].radius)
            spots[i].append((equations, 1 - share, i + 1))
            spots[i + 1].append((equations, share, i))
    for order in (_to_focus(places), _to_focus(places)[::-1]) * (_SWEEPS // 2):
        for i in order:
            gram = np.sum([share**2 * spot.gram for spot, share, _ in spots[i]], axis=0)
            pulls = [share * (spot.pull - (1 - share) * spot.gram @ values[other]) for spot, share, other in spots[i]]
            values[i] = tracer.fitted(gram, np.sum(pulls, axis=0), nodes[i].histogram)
    residual = np.array([tracer.relative(node.error(v)) for node, v in zip(nodes, values, strict=True)])
    return {"values": np.stack(values), "radius": np.array([node.radius for node in nodes]) * tracer.pixel}, residual


def fit_shapes(tracer: Tracer, places: Sequence[float], family: str) -> tuple[dict[str, Array], Array]:
    """A named shape at each node, each started from its neighbour, from both ends to the focus."""
    names = FAMILIES[family]
    params, residual, before = np.zeros((len(names), len(places))), np.zeros(len(places)), None
    for i in _to_focus(places):
        r, light, transfer = tracer.traced(places[i])
        outermost, rms = float(r.max()), math.sqrt(float(light @ (r * r)))
        before = None if i == len(places) - 1 else before  # there the other side begins
        before, error = _fit_shape(family, tracer, outermost, transfer, rms / outermost, before)
        params[:, i] = before * [outermost * tracer.pixel if name in LENGTHS else 1.0 for name in names]
        residual[i] = tracer.relative(error)
    return dict(zip(names, params, strict=True)), residual


def _to_focus(places: Sequence[float]) -> list[int]:
    """Numbers of the nodes from both ends to the focus."""
    focus = int(np.argmin(np.abs(places)))
    return [*range(focus), *range(len(places) - 1, focus - 1, -1)]


def _fit_shape(
    family: str, tracer: Tracer, outermost: float, spot_transfer: Array, rms: float, before: Array | None
) -> tuple[Array, float]:
    """Parameters of a shape whose transfer function is nearest to a spot's, and the weighted squared error.

    Lengths are relative to the spot's outermost ray. A neighbour's parameters are a start and a weak pull.
    """
    names, weight, frequency = FAMILIES[family], tracer.weight, tracer.frequency * outermost
    low, high = np.array([_RANGES[name] for name in names]).T
    if family == "softm":  # a small radius with a wide edge and a large tilt would be a second branch
        low[0] = 0.5
    sigma = {"gaussian": 0.5**0.5, "ring": 0.5}.get(family, 0.05) * rms
    geometry = {"radius": 2.0**0.5 * rms, "sigma": sigma, "r_c": 0.7 * rms, "b": 0.0, "m": 2.0}
    r = (np.arange(_STEPS) + 0.5) * (_REACH / _STEPS)
    waves = j0(2.0 * np.pi * np.outer(frequency, r))

    def seen(values: Array) -> Array:
        params = dict(zip(names, values, strict=True))
        if family == "gaussian":
            transfer = np.exp(-2.0 * (np.pi * params["sigma"] * frequency) ** 2)
        elif family == "disc":
            phase = 2.0 * np.pi * params["radius"] * frequency
            transfer = 2.0 * j1(phase) / phase
        else:
            light = profile(family, torch.from_numpy(r), params).numpy() * r
            transfer = waves @ (light / light.sum())
        return np.asarray(weight * transfer)

    start, keep = np.array([geometry[name] for name in names]), 0.0 if before is None else _KEEP
    near = start if before is None else before
    best = best_of(
        lambda values: np.concatenate([seen(values), keep * values]),
        np.concatenate([weight * spot_transfer, keep * near]),
        [near, start] if keep else [start],
        (low, high),
        tolerance=1e-8,
    )
    return best, float(((seen(best) - weight * spot_transfer) ** 2).sum())
