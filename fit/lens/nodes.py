"""Nodes of a traced table: their positions, and profiles fitted to their spots.

Spots and profiles are compared by their transfer functions, which are Hankel transforms; a spot's is a sum of Bessel
functions over its rays. Both are weighted by the spectrum of natural images (amplitude 1/frequency) and the area of a
pixel. The squared difference is then the squared error in a photograph, up to a constant.

A profile has the radius of the outermost ray, and is linear in its values. So the fit is a convex problem with a single
solution. Nodes are added until profiles interpolated between them fit the spots there too.
"""

import functools
from collections.abc import Callable
from itertools import pairwise

import numpy as np
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
_PRIOR_WEIGHT = 1e-4  # weight of the ray histogram, which determines details of the profile far below a pixel


class Tracer:
    """Traces spots by coc, and fits profiles that are piecewise linear at ``points`` radii; keeps the results."""

    def __init__(self, spot: Callable[[float], Spot], points: int, pixel: float) -> None:
        self.spot, self.points, self.pixel = spot, points, pixel
        self.frequency = np.linspace(1 / 256, _MAX_FREQUENCY, 400)
        # amplitude of natural images times the area of a ring of frequencies; constant beyond Nyquist (aliasing)
        spectrum = np.minimum(self.frequency, 0.5) ** -0.5
        self.weight = spectrum / np.sqrt(1.0 + (np.pi * self.frequency) ** 2)
        count = 12 * (points - 1)
        self._r = (np.arange(count) + 0.5) / count  # radii relative to the profile's
        self._light = _hats(self._r, points) * (2.0 * np.pi * self._r / count)[:, None]
        self.traced, self.fitted = functools.cache(self._traced), functools.cache(self._fitted)

    def _traced(self, coc: float) -> tuple[Array, Array, Array]:
        """Radii in pixels, weights, and weighted transfer function (a Hankel transform) of the spot."""
        spot = self.spot(coc)
        r, light = np.maximum(spot.r / self.pixel, 1e-9), spot.weight
        slices = (slice(i, i + 4096) for i in range(0, len(r), 4096))
        parts = [j0(2.0 * np.pi * np.outer(self.frequency, r[i])) @ light[i] for i in slices]
        return r, light, np.sum(parts, axis=0) * self.weight

    def _basis(self, radius: float) -> Array:
        """Weighted transfer functions ``[F, P]`` of the hats of a profile that ends at ``radius`` pixels."""
        return j0(2.0 * np.pi * np.outer(self.frequency, self._r * radius)) @ self._light * self.weight[:, None]

    def _fitted(self, coc: float) -> tuple[float, Array]:
        """Radius in pixels of the outermost ray, and values of the profile that fits the spot, with a light of 1."""
        r, light, transfer = self.traced(coc)
        radius, area = float(r.max()), self._light.sum(0)  # integral of each hat
        # a large weight fixes the total light, a small one of the rays' histogram the details that no picture shows
        basis, total = self._basis(radius), 100.0 * self.weight.max() * area
        prior = _PRIOR_WEIGHT * np.sqrt((np.sum(basis**2) + np.sum(total**2)) * area / area.sum())
        histogram = light @ _hats(r / radius, self.points) / area
        rows = np.vstack([basis, total, np.diag(prior)])
        target = np.concatenate([transfer, [100.0 * self.weight.max()], prior * histogram])
        values, _ = nnls(rows, target, maxiter=50 * self.points)
        return radius, values / (area @ values)

    def error(self, coc: float, radius: float, values: Array) -> float:
        """Root of the weighted squared error of a profile against the spot, relative to that of an empty kernel."""
        difference = self._basis(radius) @ values - self.traced(coc)[2]
        return float(np.linalg.norm(difference) / np.linalg.norm(self.weight))


def _hats(r: Array, points: int) -> Array:
    """Values at radii ``[R]`` from 0 to 1 of the piecewise linear profile's basis ``[R, P]``."""
    return np.maximum(1.0 - np.abs(r[:, None] * (points - 1) - np.arange(points)), 0.0)


def place_nodes(tracer: Tracer, near: float, far: float, nodes: int | None) -> list[float]:
    """Signed coc of ``nodes`` nodes, or of as many as 50 dB need: halves the interval with the worst interpolation."""

    def interval_error(left: float, right: float) -> float:
        (radius, values), (next_radius, next_values) = tracer.fitted(left), tracer.fitted(right)
        if max(radius, next_radius) <= 0.5 or right - left < _MIN_INTERVAL_PX * tracer.pixel:
            return 0.0
        return tracer.error((left + right) / 2, (radius + next_radius) / 2, (values + next_values) / 2)

    cocs = [near, near / 2, 0.0, far / 2, far] if far > 0 else [near, near / 2, 0.0]
    errors = [interval_error(*pair) for pair in pairwise(cocs)]
    accepted_error = 10.0 ** (-_TARGET_DB / 20.0) / _CONTRAST
    while len(cocs) < nodes if nodes is not None else max(errors) > accepted_error:
        worst = int(np.argmax(errors))
        if errors[worst] == 0.0:
            most = f"{len(cocs)} for this lens and width_px, got {nodes}"
            raise ValueError(f"nodes must be at most {most}: more would hardly differ; take a larger width_px")
        left, right = cocs[worst : worst + 2]
        middle = (left + right) / 2
        cocs.insert(worst + 1, middle)
        errors[worst : worst + 1] = [interval_error(left, middle), interval_error(middle, right)]
    return cocs
