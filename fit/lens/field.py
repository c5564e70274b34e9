"""Traces a lens's spots over the field: at several distances from the axis and in depth, as sampled boxes."""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch

from torchdof.optics.field import Field

from ..result import Array
from .lens import Lens
from .spot import Reference, point_spread

_CELLS = (128, 64)  # of half a spot, along and across the radial direction
_SPACING_POWER = 1.5  # coc grows with this power of the node's index
_CHIEF_STOP = 0.1  # diameter, relative to the stop's, of the small stop that defines a position in the sharp image
_CHIEF_RAYS = 900
_DISTORTION_STEPS = 3  # iterations that correct the lens's distortion


def trace_field(
    lens: Lens,
    sensor_mm: float,
    distance_m: Callable[[float], float],
    coc_mm: Sequence[float],
    radius_mm: Sequence[float],
    wavelengths_um: Sequence[float] | None,
    rays: int,
    reference: Reference,
) -> Field:
    """Traces spots at signed coc, whose object distances `distance_m` gives, and at distances from the centre."""
    rows, columns = _CELLS
    heights = [field_height_mm(lens, distance_m(0.0), sensor_mm, radius, reference) for radius in radius_mm]
    boxes, light = [], []
    for coc, height in product(coc_mm, heights):
        spots = [
            spot_of_place(lens, distance_m(coc), sensor_mm, height, reference, rays=rays, wavelength_um=wavelength)
            for wavelength in (wavelengths_um or (None,))
        ]
        low, high = min(u.min() for u, _, _ in spots), max(u.max() for u, _, _ in spots)
        # a ray's light is split among the cells around it, so rays lie half a cell inside the box
        centre, length = (low + high) / 2, max(high - low, 1e-9) / 2 * rows / (rows - 1)
        width = max(1e-9, *(np.abs(v).max() for _, v, _ in spots)) * 2 * columns / (2 * columns - 1)
        boxes.append((centre, length, width))
        light.append([_binned((u - centre) / length, np.abs(v) / width, weight) for u, v, weight in spots])
    nodes = (len(coc_mm), len(radius_mm))
    return Field(
        torch.tensor(list(coc_mm), dtype=torch.float64),
        torch.tensor(list(radius_mm), dtype=torch.float64),
        torch.tensor(boxes, dtype=torch.float64).unflatten(0, nodes),
        torch.from_numpy(np.array(light)).transpose(0, 1).unflatten(1, nodes),  # [channels, K, F, U, V]
    )


def _binned(u: Array, v: Array, weight: Array) -> Array:
    """Splits the light of rays, at -1 to 1 along and 0 to 1 across, among the four cells around each."""
    rows, columns = _CELLS
    along, across = (u + 1.0) * (rows / 2) - 0.5, v * columns - 0.5
    row, column = np.floor(along).astype(int), np.floor(across).astype(int)
    cells = np.zeros(rows * columns)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (1.0 - np.abs(along - row - down)) * (1.0 - np.abs(across - column - right))
        # half a spot: cells beyond its axis (column -1) are mirrored
        mirrored = np.clip(np.abs(column + right + 0.5) - 0.5, 0, columns - 1).astype(int)
        cells += np.bincount(np.clip(row + down, 0, rows - 1) * columns + mirrored, weight * share, cells.size)
    return cells.reshape(rows, columns)


def spot_of_place(
    lens: Lens, z_m: float, sensor_mm: float, field_mm: float, reference: Reference = "principal", **options: Any
) -> tuple[Array, Array, Array]:
    """Positions ``[R]`` in mm of a point's light, from its sharp image away from the axis, and across; and weight."""
    spot = point_spread(lens, z_m, sensor_mm, field_mm=field_mm, reference=reference, **options)
    image_mm = spot.centre - chief_ray_mm(lens, z_m, sensor_mm, field_mm, reference)
    return image_mm - spot.y, spot.x, spot.weight


def chief_ray_mm(lens: Lens, z_m: float, sensor_mm: float, field_mm: float, reference: Reference) -> float:
    """Distance from the axis, in mm, of a point's image through a small stop, in the d line."""
    if field_mm == 0.0:
        return 0.0
    stopped = lens.with_stop(lens.surfaces[lens.stop].diameter * _CHIEF_STOP)
    return point_spread(stopped, z_m, sensor_mm, field_mm=field_mm, rays=_CHIEF_RAYS, reference=reference).centre


def field_height_mm(lens: Lens, z_m: float, sensor_mm: float, radius_mm: float, reference: Reference) -> float:
    """The ``field_mm`` of a point whose image is at `radius_mm` from the centre; corrects the distortion."""
    height = radius_mm
    for _ in range(_DISTORTION_STEPS if radius_mm else 0):
        height *= radius_mm / chief_ray_mm(lens, z_m, sensor_mm, height, reference)
    return height


def coc_nodes(near_mm: float, far_mm: float, count: int) -> list[float]:
    """Signed coc, denser near focus, on average `count` on each side, as the square root of that side's reach.

    Example:
        >>> [round(coc, 3) for coc in coc_nodes(-0.8, 0.2, 3)]
        [-0.8, -0.52, -0.283, -0.1, 0.0, 0.071, 0.2]
    """
    sides = [(near_mm, count)]
    if far_mm > 0:
        share = math.sqrt(far_mm) / (math.sqrt(far_mm) + math.sqrt(-near_mm))
        far_count = min(max(2, round(2 * count * share)), 2 * count - 2)
        sides = [(near_mm, 2 * count - far_count), (far_mm, far_count)]
    return sorted([0.0, *(end * (i / n) ** _SPACING_POWER for end, n in sides for i in range(1, n + 1))])
