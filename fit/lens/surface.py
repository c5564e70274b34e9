"""One surface of a lens: its shape, and where rays meet it.

The shape is the even asphere of lens design: a conic, and a polynomial in even powers of the distance from the axis,

    ``z(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + A_2 r^2 + A_4 r^4 + ...``

with the curvature c = 1 / radius and the conic constant k: 0 is a sphere, -1 a paraboloid, below that a hyperboloid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..result import Array

__all__ = ["Meeting", "Shape", "meet"]

_STEPS = 50  # of Newton's method; four do for most aspheres
_CLOSE_MM = 1e-10


class Shape(NamedTuple):
    """What a surface looks like.

    Attributes:
        curvature: c in 1/mm, 0 for a flat surface.
        conic: The conic constant k.
        polynomial: ``A_2, A_4, ...`` in mm, 1/mm, ...; empty for a conic.
    """

    curvature: float
    conic: float = 0.0
    polynomial: tuple[float, ...] = ()

    def sag(self, square: Array) -> tuple[Array, Array]:
        """Height z over the vertex's plane at r^2, and its derivative by r^2; NaN beyond the conic's rim."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            root = np.sqrt(1.0 - (1.0 + self.conic) * self.curvature**2 * square)
            z, slope = self.curvature * square / (1.0 + root), self.curvature / (2.0 * root)
            power = np.ones_like(square)
            for i, coefficient in enumerate(self.polynomial):
                slope = slope + (i + 1) * coefficient * power
                power = power * square
                z = z + coefficient * power
        exists = np.isfinite(z) & np.isfinite(slope)
        return np.where(exists, z, np.nan), np.where(exists, slope, np.nan)


class Meeting(NamedTuple):
    """Where rays meet a surface, relative to its vertex.

    Attributes:
        x: ``[R]`` in mm.
        y: See x.
        z: See x.
        run: Length of the way there in mm; negative where the surface lies behind the start.
        normal: Unit vectors x, y, z with a positive z; the axis for a flat surface.
        met: False where a ray misses the surface: the other numbers mean nothing there.
    """

    x: Array
    y: Array
    z: Array
    run: Array
    normal: tuple[Array | float, Array | float, Array | float]
    met: np.ndarray[tuple[int], np.dtype[np.bool_]]


def meet(x: Array, y: Array, z: Array, u: Array, v: Array, w: Array, shape: Shape) -> Meeting:
    """Where rays from x, y, z ``[R]``, in mm from the vertex, along unit vectors u, v, w meet a surface.

    Of several meetings it is the one nearest to the vertex's plane.

    Reference:
        Welford, "Aberrations of Optical Systems", 1986, section 4.5 (conics), 4.6 (aspheres, by iteration).

    Example:
        >>> start = np.array([3.0]), np.array([0.0]), np.array([-5.0])
        >>> met = meet(*start, np.array([0.0]), np.array([0.0]), np.array([1.0]), Shape(0.1, conic=-1.0))
        >>> met.z.round(12).tolist(), met.run.round(12).tolist()
        ([0.45], [5.45])
    """
    run = -z / w
    x, y = x + run * u, y + run * v
    z, met = np.zeros_like(x), np.ones(x.shape, dtype=bool)
    curvature, stretch = shape.curvature, 1.0 + shape.conic
    if curvature == 0.0 and not any(shape.polynomial):
        return Meeting(x, y, z, run, (0.0, 0.0, 1.0), met)
    if curvature != 0.0:
        half = w - curvature * (x * u + y * v)
        away = curvature * (x * x + y * y)
        along = curvature * (u * u + v * v + stretch * w * w) if shape.conic else curvature
        discriminant = half * half - along * away
        met = (discriminant >= 0) & (half > 0)
        step = away / np.where(met, half + np.sqrt(np.maximum(discriminant, 0.0)), 1.0)
        x, y, z, run = x + step * u, y + step * v, step * w, run + step
    if not any(shape.polynomial):
        normal = -curvature * x, -curvature * y, 1.0 - stretch * curvature * z
        if shape.conic:
            length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            normal = normal[0] / length, normal[1] / length, normal[2] / length
        return Meeting(x, y, z, run, normal, met)
    height, slope = shape.sag(x * x + y * y)
    for _ in range(_STEPS):
        off = z - height
        met &= np.isfinite(off)
        if not (np.abs(off[met]) > _CLOSE_MM / 10.0).any():
            break
        fall = w - 2.0 * slope * (x * u + y * v)
        step = np.where(met & (fall > 0), -off / np.where(fall > 0, fall, 1.0), 0.0)
        x, y, z, run = x + step * u, y + step * v, z + step * w, run + step
        height, slope = shape.sag(x * x + y * y)
    met &= np.abs(z - height) <= _CLOSE_MM  # NaN is not
    slope = np.where(met, slope, 0.0)
    steep = 1.0 / np.sqrt(1.0 + 4.0 * slope * slope * (x * x + y * y))
    return Meeting(x, y, z, run, (-2.0 * slope * x * steep, -2.0 * slope * y * steep, steep), met)
