"""A lens's spots across the field: traced at distances from the axis and in depth, gathered in boxes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from torchdof.optics.field import Field

from ..result import Array
from .lens import Lens
from .spot import Reference, Spot, point_spread

__all__ = ["chief_ray_mm", "coc_nodes", "field_height_mm", "spot_of_place", "trace_field"]

_CELLS = (128, 64)  # of half a spot, along and across
_GROWING = 1.5  # power of the number of a node that its coc grows with
_CHIEF = 0.1  # of the stop's diameter, through which a place in the sharp image is seen
_CHIEF_RAYS = 900
_TRIES = 3  # to hit a place in the frame, past the lens's distortion


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
    """Trace spots at signed coc and places in the frame.

    Args:
        lens: The prescription, stopped down as wanted.
        sensor_mm: Sensor behind the last vertex.
        distance_m: Object distance in metres of a signed coc.
        coc_mm: Signed coc of the nodes.
        radius_mm: Distances from the middle of the frame, from 0.
        wavelengths_um: One a channel; None is the d line.
        rays: Rays a spot.
        reference: What distances are measured from.

    Raises:
        ValueError: If no ray reaches a place.
    """
    focus_m = distance_m(0.0)
    heights = [field_height_mm(lens, focus_m, sensor_mm, radius, reference) for radius in radius_mm]
    boxes, light = [], []
    for coc in coc_mm:
        for height in heights:
            spots = [
                spot_of_place(lens, distance_m(coc), sensor_mm, height, rays, wavelength, reference)
                for wavelength in (wavelengths_um or (None,))
            ]
            ends = [(u.min(), u.max(), np.abs(v).max()) for u, v, _ in spots]
            low, high, wide = min(e[0] for e in ends), max(e[1] for e in ends), max(e[2] for e in ends)
            # a ray's light goes to the cells around it, so it lies half a cell inside the box
            length, wide = (
                max(high - low, 1e-9) / 2 * _CELLS[0] / (_CELLS[0] - 1),
                max(wide, 1e-9) * 2 * _CELLS[1] / (2 * _CELLS[1] - 1),
            )
            boxes.append(((low + high) / 2, length, wide))
            light.append([_gathered((u - boxes[-1][0]) / length, np.abs(v) / wide, w) for u, v, w in spots])
    nodes = (len(coc_mm), len(radius_mm))
    gathered = torch.from_numpy(np.array(light)).transpose(0, 1)  # [channels, K F, U, V]
    return Field(
        torch.tensor(list(coc_mm), dtype=torch.float64),
        torch.tensor(list(radius_mm), dtype=torch.float64),
        torch.tensor(boxes, dtype=torch.float64).unflatten(0, nodes),
        gathered.unflatten(1, nodes),
    )


def _gathered(u: Array, v: Array, weight: Array) -> Array:
    """Light of rays at places from -1 to 1 along and 0 to 1 across, divided among the four cells around each."""
    rows, columns = _CELLS
    along, across = (u + 1.0) * (rows / 2) - 0.5, v * columns - 0.5
    row = np.clip(np.floor(along).astype(int), 0, rows - 2)
    column = np.floor(across).astype(int)
    down, right = np.clip(along - row, 0.0, 1.0), np.clip(across - column, 0.0, 1.0)
    cells = np.zeros(rows * columns)
    for row_of, part in ((row, 1.0 - down), (row + 1, down)):
        for column_of, share in (
            (np.abs(column + 0.5) - 0.5, 1.0 - right),
            (np.minimum(column + 1, columns - 1), right),
        ):
            cells += np.bincount(row_of * columns + column_of.astype(int), weight * part * share, cells.size)
    return cells.reshape(rows, columns)


def spot_of_place(
    lens: Lens,
    z_m: float,
    sensor_mm: float,
    field_mm: float,
    rays: int,
    wavelength_um: float | None = None,
    reference: Reference = "principal",
) -> tuple[Array, Array, Array]:
    """Where the light of a point falls, from where its sharp image is: away from the axis, across, and its weight.

    The sharp image is the one that the lens makes of it in the d line through a small stop. Arguments are those of
    :func:`torchdof.fit.lens.spot.point_spread`; lengths in mm ``[R]``.
    """
    spot: Spot = point_spread(
        lens, z_m, sensor_mm, field_mm=field_mm, rays=rays, wavelength_um=wavelength_um, reference=reference
    )
    aside = spot.centre - chief_ray_mm(lens, z_m, sensor_mm, field_mm, reference)
    return aside - spot.y, spot.x, spot.weight


def chief_ray_mm(lens: Lens, z_m: float, sensor_mm: float, field_mm: float, reference: Reference) -> float:
    """Distance from the axis at which a small stop shows a point, in the d line."""
    if field_mm == 0.0:
        return 0.0
    stopped = lens.with_stop(float(lens.diameter[lens.stop]) * _CHIEF)
    return point_spread(stopped, z_m, sensor_mm, field_mm=field_mm, rays=_CHIEF_RAYS, reference=reference).centre


def field_height_mm(lens: Lens, z_m: float, sensor_mm: float, radius_mm: float, reference: Reference) -> float:
    """The ``field_mm`` of a point that is seen at a distance from the middle of the frame, past the distortion."""
    height = radius_mm
    for _ in range(_TRIES if radius_mm else 0):
        height *= radius_mm / chief_ray_mm(lens, z_m, sensor_mm, height, reference)
    return height


def coc_nodes(near_mm: float, far_mm: float, count: int) -> list[float]:
    """Signed coc from the nearest to the farthest, closer to each other near focus; so many on either side on average.

    The side that reaches farther has more of them, by the square root of how far.

    Example:
        >>> [round(coc, 3) for coc in coc_nodes(-0.8, 0.2, 3)]
        [-0.8, -0.52, -0.283, -0.1, 0.0, 0.071, 0.2]
    """
    share = math.sqrt(far_mm) / (math.sqrt(far_mm) + math.sqrt(-near_mm)) if far_mm > 0 else 0.0
    of_far = min(max(2, round(2 * count * share)), 2 * count - 2) if far_mm > 0 else 0
    nodes = [0.0]
    for end, of_side in ((near_mm, 2 * count - of_far if of_far else count), (far_mm, of_far)):
        nodes += [end * (i / of_side) ** _GROWING for i in range(1, of_side + 1)]
    return sorted(nodes)
