"""Real rays through a lens: where they cross each surface, and Snell's law there."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..result import Array
from .lens import Lens

__all__ = ["Rays", "trace_rays"]

_CHUNK = 1 << 14  # rays that stay in the processor's cache on their way through the lens


class Rays(NamedTuple):
    """Rays at a plane or surface.

    Attributes:
        position: ``[3, R]`` in mm: x, y, z with z = 0 at the first vertex.
        direction: Unit vectors ``[3, R]``.
        alive: ``[R]``; False where a ray missed a surface, hit beyond a clear diameter or was totally reflected. The
            position and direction of such a ray mean nothing.
    """

    position: Array
    direction: Array
    alive: np.ndarray[tuple[int], np.dtype[np.bool_]]

    def at(self, z: float) -> tuple[Array, Array]:
        """Where the rays, or their backward extensions, cross the plane at z: x and y ``[R]`` in mm."""
        run = (z - self.position[2]) / self.direction[2]
        return self.position[0] + run * self.direction[0], self.position[1] + run * self.direction[1]


def trace_rays(
    lens: Lens, position: Array, direction: Array, wavelength_um: float | None = None, clip: bool = True
) -> Rays:
    """Trace rays to behind the last surface.

    Args:
        lens: The prescription.
        position: A point of each ray ``[3, R]`` in mm, z = 0 at the first vertex; before the lens.
        direction: Unit vectors ``[3, R]`` with a positive z.
        wavelength_um: Wavelength in micrometres; None is the d line, at which indices are listed.
        clip: Whether the clear diameters, the stop's among them, end rays.

    Returns:
        The rays on the last surface, with the direction they leave it.

    Raises:
        ValueError: If the shapes are not as described.

    Reference:
        Kolb, Mitchell, Hanrahan 1995, section 3.1 (the loop over surfaces), Snell's law in vector form.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> rays = trace_rays(lens, np.array([[0.0], [0.001], [-10.0]]), np.array([[0.0], [0.0], [1.0]]))
        >>> sensor = lens.vertices[-1] + lens.paraxial().back_focal
        >>> bool(abs(rays.at(sensor)[1][0]) < 1e-9)
        True
    """
    position, direction = (np.asarray(v, dtype=np.float64) for v in (position, direction))
    if position.ndim != 2 or position.shape[0] != 3 or direction.shape != position.shape:
        raise ValueError(
            f"position and direction must both be [3, R], got {list(position.shape)} and {list(direction.shape)}"
        )
    index, vertices = lens.indices(wavelength_um), lens.vertices
    parts = []
    for start in range(0, max(position.shape[1], 1), _CHUNK):
        part = slice(start, start + _CHUNK)
        parts.append(_trace_chunk(lens, index, vertices, position[:, part], direction[:, part], clip))
    return Rays(
        np.concatenate([p.position for p in parts], 1),
        np.concatenate([p.direction for p in parts], 1),
        np.concatenate([p.alive for p in parts]),
    )


def _trace_chunk(lens: Lens, index: Array, vertices: Array, position: Array, direction: Array, clip: bool) -> Rays:
    """Rays ``[3, R]`` through all surfaces: where each meets the sphere, whether it passes, how it is refracted."""
    (x, y, z), (u, v, w) = position.copy(), direction.copy()
    alive = np.ones(x.shape, dtype=bool)
    for i, radius in enumerate(lens.radius):
        z = z - vertices[i]  # from here on relative to this surface's vertex
        run = -z / w
        x, y = x + run * u, y + run * v
        z = np.zeros_like(x)
        if math.isfinite(radius):
            # sphere through the vertex: the crossing nearest to it
            half = w - (x * u + y * v) / radius
            discriminant = half * half - (x * x + y * y) / (radius * radius)
            alive &= (discriminant >= 0) & (half > 0)
            run = (x * x + y * y) / radius / np.where(alive, half + np.sqrt(np.maximum(discriminant, 0.0)), 1.0)
            x, y, z = x + run * u, y + run * v, run * w
        if clip:
            alive &= x * x + y * y <= (lens.diameter[i] / 2) ** 2
        if index[i + 1] != index[i]:
            nx, ny, nz = (-x / radius, -y / radius, 1.0 - z / radius)
            ratio = index[i] / index[i + 1]
            cosine = u * nx + v * ny + w * nz
            inside = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
            alive &= inside >= 0  # else totally reflected
            bend = np.sqrt(np.maximum(inside, 0.0)) - ratio * cosine
            u, v, w = ratio * u + bend * nx, ratio * v + bend * ny, ratio * w + bend * nz
        z = z + vertices[i]
        if not alive.all():  # let the dead go on along the axis, where their numbers stay small
            x, y, u, v = (np.where(alive, value, 0.0) for value in (x, y, u, v))
            z, w = np.where(alive, z, vertices[i]), np.where(alive, w, 1.0)
    return Rays(np.stack([x, y, z]), np.stack([u, v, w]), alive)
