"""Real rays through a lens: where they cross each surface, and Snell's law there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..result import Array
from .lens import Lens
from .surface import meet

__all__ = ["Rays", "trace_rays"]

_CHUNK = 1 << 14  # rays that stay in the processor's cache on their way through the lens
_SLACK_MM = 1e-9  # by which rounding may put a surface behind the one before it


class Rays(NamedTuple):
    """Rays at a plane or surface.

    Attributes:
        position: ``[3, R]`` in mm: x, y, z with z = 0 at the first vertex.
        direction: Unit vectors ``[3, R]``.
        alive: ``[R]``; False where a ray missed a surface, hit beyond a clear diameter, was totally reflected, or met
            a surface before the one in front of it (two that cross at their rims). The position and direction of such
            a ray mean nothing.
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
    """Rays ``[3, R]`` through all surfaces: where each meets them in turn, whether it passes, how it is refracted."""
    (x, y, z), (u, v, w) = position.copy(), direction.copy()
    alive = np.ones(x.shape, dtype=bool)
    for i in range(len(lens.radius)):
        z = z - vertices[i]  # from here on relative to this surface's vertex
        met = meet(x, y, z, u, v, w, lens.shape(i))
        alive &= met.met
        if i > 0:  # a surface that lies behind the one before it there is no lens's
            alive &= met.run >= -_SLACK_MM
        x, y, z = met.x, met.y, met.z
        if clip:
            alive &= x * x + y * y <= (lens.diameter[i] / 2) ** 2
        if index[i + 1] != index[i]:
            nx, ny, nz = met.normal
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
