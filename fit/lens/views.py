"""Rays from places on the sensor back through a lens into the scene: the picture it takes, without any table.

A lens is traced backwards by turning it: the sensor is then its object. What a ray sees of a plane is told by where the
sharp image, which the lens makes of it through a small stop, shows that point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from .field import chief_ray_mm
from .lens import Lens
from .rays import trace_rays
from .spot import Reference, vertex_distance_mm

__all__ = ["rays_of"]

_WIDER = 1.05  # times the rear surface's clear diameter, at which rays are aimed
_HEIGHTS, _TERMS = 9, 4  # points of the sharp image whose distortion is told by a polynomial
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


def rays_of(
    lens: Lens,
    distances_m: Sequence[float],
    sensor_mm: float,
    size: tuple[int, int],
    sensor_width_mm: float = 36.0,
    samples: int = 256,
    reference: Reference = "principal",
) -> Callable[[int, Tensor, Tensor], tuple[list[tuple[Tensor, Tensor]], Tensor]]:
    """Rays of a lens for :func:`torchdof.reference.scenes.plane_views`.

    Args:
        lens: The prescription, stopped down as wanted.
        distances_m: Of the planes, far to near, finite; measured from ``reference``.
        sensor_mm: Sensor behind the last vertex, from :func:`torchdof.fit.lens.spot.focus_sensor`.
        size: Height and width of the frame in pixels; ``sensor_width_mm`` is its width.
        sensor_width_mm: See size.
        samples: Rays a pixel, which are aimed at points spread over the rear surface.
        reference: See distances_m.

    Returns:
        ``rays(n, x, y)``: where the n-th ray of places ``[...]`` meets each plane, and its light ``[...]``.
    """
    back, first, pixel = lens.turned(), lens.paraxial(), sensor_width_mm / size[1]
    heights = 0.5 * math.hypot(*size) * pixel * np.linspace(0.1, 1.1, _HEIGHTS)
    planes = []
    for z_m in distances_m:
        distance = vertex_distance_mm(lens, z_m, reference, sensor_mm)
        shown = [chief_ray_mm(lens, z_m, sensor_mm, height, reference) for height in heights]
        away = heights / (sensor_mm - first.rear_principal) * (distance + first.front_principal)
        planes.append((back.vertices[-1] + distance, np.polynomial.Polynomial.fit(away**2, shown / away, _TERMS)))
    reach = _WIDER * back.surfaces[0].diameter / 2
    middle = np.array([[size[1]], [size[0]]]) / 2

    def rays(n: int, x: Tensor, y: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        radius, angle = reach * math.sqrt((n + 0.5) / samples), n * _GOLDEN
        # the picture on the sensor is upside down
        start = (middle - np.stack([x.double().numpy().ravel(), y.double().numpy().ravel()])) * pixel
        aim = radius * np.array([[math.cos(angle)], [math.sin(angle)]])
        run = np.concatenate([aim - start, np.full_like(start[:1], sensor_mm)])
        length = np.sqrt((run * run).sum(0))
        traced = trace_rays(back, np.concatenate([start, np.full_like(start[:1], -sensor_mm)]), run / length)
        met = []
        for z, image in planes:
            place = traced.at(z)
            column, row = torch.from_numpy(middle + place * image((place**2).sum(0)) / pixel)
            met.append((column.reshape(x.shape), row.reshape(x.shape)))
        return met, torch.from_numpy(traced.alive / length**4).reshape(x.shape)

    return rays
