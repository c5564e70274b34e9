"""One surface of a lens: its shape, and its intersection with rays.

The shape is the even asphere of lens design: a conic plus a polynomial in even powers of the distance r from the axis,

    ``z(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A_2 r^2 + A_4 r^4 + ...``

with the curvature c = 1 / radius and the conic constant k: 0 is a sphere, -1 a paraboloid, below -1 a hyperboloid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

import numpy as np

from torchdof.validation import show

from ..result import Array, Mask
from .glass import Glass

_MIN_MM, _MAX_MM, _MAX_CONIC, _MAX_DEPTH_MM = 1e-3, 1e7, 1e6, 1e15  # beyond these, sums overflow
_STEPS = 50  # of Newton's method; four do for most aspheres
_TOLERANCE_MM = 1e-10


@dataclass(frozen=True)
class Surface:
    """A sphere or even asphere, and the medium behind it; lengths in mm."""

    radius: float  # of curvature at the vertex, inf for a flat surface; positive if convex towards the object
    thickness: float  # distance to the next surface, >= 0; unused for the last one
    glass: Glass  # the medium behind it
    diameter: float  # clear diameter
    conic: float = 0.0  # conic constant k
    polynomial: tuple[float, ...] = ()  # A_2, A_4, ...

    def __post_init__(self) -> None:
        """Raises a `ValueError` for a number outside its range; the message begins with its name."""
        if not isinstance(self.glass, Glass) or not isinstance(self.polynomial, tuple):
            raise ValueError(f"glass must be a Glass and polynomial a tuple of numbers, got {show(self)}")
        _check("diameter", self.diameter, _MIN_MM, _MAX_MM)
        _check("thickness", self.thickness, 0.0, _MAX_MM)
        _check("radius", self.radius, -math.inf, math.inf)
        if not (_MIN_MM <= abs(self.radius) <= _MAX_MM or abs(self.radius) == math.inf):
            raise ValueError(f"radius must be inf, or {_MIN_MM:g} to {_MAX_MM:g} mm long, got {self.radius}")
        _check("conic constant", self.conic, -_MAX_CONIC, _MAX_CONIC)
        for i, coefficient in enumerate(self.polynomial):
            limit = _MAX_DEPTH_MM / (self.diameter / 2.0) ** (2 * i + 2)  # limits the depth of the surface's rim
            _check(f"A{2 * i + 2}", coefficient, -limit, limit)

    def sag(self, square: Array) -> tuple[Array, Array]:
        """Height z above the vertex's plane at r^2, and its derivative by r^2; NaN beyond the conic's rim."""
        curvature = 1.0 / self.radius
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            root = np.sqrt(1.0 - (1.0 + self.conic) * curvature**2 * square)
            z, slope = curvature * square / (1.0 + root), curvature / (2.0 * root)
            for i, coefficient in enumerate(self.polynomial):
                if coefficient:
                    z, slope = z + coefficient * square ** (i + 1), slope + (i + 1) * coefficient * square**i
        exists = np.isfinite(z) & np.isfinite(slope)
        return np.where(exists, z, np.nan), np.where(exists, slope, np.nan)

    def meet(self, position: Array, direction: Array) -> tuple[Array, Array, Mask]:
        """Intersections of rays with the surface; of several the one nearest to the vertex's plane.

        Rays start at points ``[3, R]``, in mm from the vertex, along unit vectors ``[3, R]`` with a positive z. Returns
        the distance in mm ``[R]``, negative if the surface lies behind; the unit normal there ``[3, R]``, with a
        positive z; and whether a ray meets the surface ``[R]``; otherwise the other values have no meaning.

        Reference:
            Welford, "Aberrations of Optical Systems", 1986, section 4.5 (conics), 4.6 (aspheres, by iteration).
        """
        (x, y, z), (u, v, w) = position, direction
        run = -z / w
        x, y, z = x + run * u, y + run * v, np.zeros_like(x)
        curvature = 1.0 / self.radius
        half_b, offset = w - curvature * (x * u + y * v), curvature * (x * x + y * y)
        discriminant = half_b * half_b - curvature * (1.0 + self.conic * w * w) * offset
        hits = (discriminant >= 0) & (half_b > 0)
        step = np.where(hits, offset / np.where(hits, half_b + np.sqrt(np.maximum(discriminant, 0.0)), 1.0), 0.0)
        for _ in range(_STEPS):
            x, y, z, run = x + step * u, y + step * v, z + step * w, run + step
            height, slope = self.sag(x * x + y * y)
            error = z - height
            hits &= np.isfinite(error)
            if not (np.abs(error[hits]) > _TOLERANCE_MM / 10.0).any():
                break
            rate = w - 2.0 * slope * (x * u + y * v)
            step = np.where(hits & (rate > 0), -error / np.where(rate > 0, rate, 1.0), 0.0)
        hits &= np.abs(error) <= _TOLERANCE_MM  # also False for NaN
        slope = np.where(hits, slope, 0.0)
        normal = np.stack([-2.0 * slope * x, -2.0 * slope * y, np.ones_like(x)])
        return run, normal / np.sqrt((normal * normal).sum(0)), hits


def _check(name: str, value: float, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, Real) or not low <= value <= high:
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {show(value)}")
