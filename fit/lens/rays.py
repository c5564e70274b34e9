"""Traces real rays through a lens: intersection with each surface, and Snell's law."""

from typing import NamedTuple

import numpy as np

from ..result import Array, Mask
from .lens import Lens

_CHUNK = 1 << 14  # rays that fit into the processor's cache together
_SLACK_MM = 1e-9  # rounding may put a surface this far behind the previous one


class Rays(NamedTuple):
    """Rays at a plane or surface.

    Attributes:
        position: ``[3, R]`` in mm: x, y, z with z = 0 at the first vertex.
        direction: Unit vectors ``[3, R]``.
        alive: ``[R]``; False if a ray missed a surface, hit outside a clear diameter, was totally reflected, or met a
            surface before the one in front of it (two surfaces that intersect at their rims). Position and direction of
            a ray that is not alive are undefined.
    """

    position: Array
    direction: Array
    alive: Mask

    def at(self, z: float) -> Array:
        """Intersection of the rays, or their backward extensions, with the plane at z: x and y ``[2, R]`` in mm."""
        run = (z - self.position[2]) / self.direction[2]
        return self.position[:2] + run * self.direction[:2]


def trace_rays(
    lens: Lens, position: Array, direction: Array, wavelength_um: float | None = None, clip: bool = True
) -> Rays:
    """Traces rays to the last surface; they have the direction behind it.

    Args:
        lens: The prescription.
        position: A point on each ray ``[3, R]`` in mm, z = 0 at the first vertex; in front of the lens.
        direction: Unit vectors ``[3, R]`` with a positive z.
        wavelength_um: Wavelength in micrometres; None is the d line.
        clip: Whether clear diameters, including the stop's, block rays.

    Reference:
        Kolb, Mitchell, Hanrahan 1995, section 3.1 (the loop over surfaces), Snell's law in vector form.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> rays = trace_rays(lens, np.array([[0.0], [0.001], [-10.0]]), np.array([[0.0], [0.0], [1.0]]))
        >>> sensor = lens.vertices[-1] + lens.paraxial().back_focal
        >>> bool(abs(rays.at(sensor)[1, 0]) < 1e-9)
        True
    """
    position, direction = (np.asarray(v, dtype=np.float64) for v in (position, direction))
    if position.ndim != 2 or position.shape[0] != 3 or direction.shape != position.shape:
        raise ValueError(
            f"position and direction must both be [3, R], got {list(position.shape)} and {list(direction.shape)}"
        )
    if (count := position.shape[1]) > _CHUNK:
        chunks = (slice(start, start + _CHUNK) for start in range(0, count, _CHUNK))
        parts = [trace_rays(lens, position[:, one], direction[:, one], wavelength_um, clip) for one in chunks]
        return Rays(*(np.concatenate(part, -1) for part in zip(*parts, strict=True)))
    index, along = lens.indices(wavelength_um), np.array([[0.0], [0.0], [1.0]])
    alive = np.ones(position.shape[1], dtype=bool)
    for i, (surface, vertex) in enumerate(zip(lens.surfaces, lens.vertices, strict=True)):
        run, normal, met = surface.meet(position - vertex * along, direction)
        position = position + run * direction
        alive &= met
        if i > 0:  # where two surfaces intersect there is no lens
            alive &= run >= -_SLACK_MM
        if clip:
            alive &= position[0] ** 2 + position[1] ** 2 <= (surface.diameter / 2) ** 2
        ratio = index[i] / index[i + 1]
        cosine = (direction * normal).sum(0)
        inside = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        alive &= inside >= 0  # else totally reflected
        direction = ratio * direction + (np.sqrt(np.maximum(inside, 0.0)) - ratio * cosine) * normal
        if not alive.all():  # continue blocked rays along the axis, where their numbers stay small
            position, direction = np.where(alive, position, vertex * along), np.where(alive, direction, along)
    return Rays(position, direction, alive)
