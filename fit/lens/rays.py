"""Real rays through a lens: where they cross each surface, and Snell's law there."""

from typing import NamedTuple

import numpy as np

from ..result import Array, Mask
from .lens import Lens

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
    alive: Mask

    def at(self, z: float) -> Array:
        """Where the rays, or their backward extensions, cross the plane at z: x and y ``[2, R]`` in mm."""
        run = (z - self.position[2]) / self.direction[2]
        return self.position[:2] + run * self.direction[:2]


def trace_rays(
    lens: Lens, position: Array, direction: Array, wavelength_um: float | None = None, clip: bool = True
) -> Rays:
    """Rays on the last surface, with the direction they leave it.

    Args:
        lens: The prescription.
        position: A point of each ray ``[3, R]`` in mm, z = 0 at the first vertex; before the lens.
        direction: Unit vectors ``[3, R]`` with a positive z.
        wavelength_um: Wavelength in micrometres; None is the d line.
        clip: Whether the clear diameters, the stop's among them, end rays.

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
        if i > 0:  # a surface that lies behind the one before it there is no lens's
            alive &= run >= -_SLACK_MM
        if clip:
            alive &= position[0] ** 2 + position[1] ** 2 <= (surface.diameter / 2) ** 2
        ratio = index[i] / index[i + 1]
        cosine = (direction * normal).sum(0)
        inside = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        alive &= inside >= 0  # else totally reflected
        direction = ratio * direction + (np.sqrt(np.maximum(inside, 0.0)) - ratio * cosine) * normal
        if not alive.all():  # let the dead go on along the axis, where their numbers stay small
            position, direction = np.where(alive, position, vertex * along), np.where(alive, direction, along)
    return Rays(position, direction, alive)
