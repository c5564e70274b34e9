"""Rays from places on the sensor back through a lens into the scene: the picture it takes, without any table.

A lens is traced backwards by turning it: the sensor is then its object. What a ray sees of a plane is told by where the
sharp image, which the lens makes of it through a small stop, shows that point.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from .field import chief_ray_mm
from .lens import Lens
from .rays import trace_rays
from .spot import Reference, vertex_distance_mm

__all__ = ["rays_of", "turned"]

_WIDER = 1.05  # times the rear surface's clear diameter, at which rays are aimed
_HEIGHTS, _TERMS = 9, 4  # points of the sharp image whose distortion is told by a polynomial
_ASIDE = 1e-9  # mm: the middle of the frame has an azimuth
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


def turned(lens: Lens) -> Lens:
    """The lens with its rear in front.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> bool(abs(turned(lens).paraxial().focal_length - lens.paraxial().focal_length) < 1e-9)
        True
    """

    def before(behind: np.ndarray, air: float) -> np.ndarray:  # of media
        return np.concatenate([[air], behind[:-1]])[::-1]

    return dataclasses.replace(
        lens,
        radius=-lens.radius[::-1],
        thickness=np.concatenate([lens.thickness[:-1][::-1], [0.0]]),
        index=before(lens.index, 1.0),
        abbe=before(lens.abbe, math.inf),
        partial=before(np.asarray(lens.partial), math.nan),
        glass=None if lens.glass is None else (None, *lens.glass[:-1])[::-1],
        diameter=lens.diameter[::-1],
        conic=np.asarray(lens.conic)[::-1],
        polynomial=-np.asarray(lens.polynomial)[::-1],
        stop=len(lens.radius) - 1 - lens.stop,
    )


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
        distances_m: Of the planes, far to near, finite.
        sensor_mm: Sensor behind the last vertex, from :func:`torchdof.fit.lens.spot.focus_sensor`.
        size: Height and width of the frame in pixels.
        sensor_width_mm: Its width.
        samples: Rays a pixel, which are aimed at points spread over the rear surface.
        reference: What distances are measured from.

    Returns:
        ``rays(n, x, y)``: where the n-th ray of places ``[...]`` meets each plane, and its light ``[...]``.
    """
    back, pixel = turned(lens), sensor_width_mm / size[1]
    first = lens.paraxial()
    corner = 0.5 * math.hypot(*size) * pixel
    heights = corner * np.linspace(0.1, 1.1, _HEIGHTS)
    planes = []
    for z_m in distances_m:
        distance = vertex_distance_mm(lens, z_m, reference, sensor_mm)
        shown = [chief_ray_mm(lens, z_m, sensor_mm, height, reference) for height in heights]
        away = heights / (sensor_mm - first.rear_principal) * (distance + first.front_principal)
        planes.append((back.vertices[-1] + distance, np.polynomial.Polynomial.fit(away**2, shown / away, _TERMS)))
    reach = _WIDER * back.diameter[0] / 2

    def rays(n: int, x: Tensor, y: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        radius, angle = reach * math.sqrt((n + 0.5) / samples), n * _GOLDEN
        # the picture on the sensor is upside down
        start = [
            (side / 2 - place.double().numpy().ravel()) * pixel for side, place in zip(size[::-1], (x, y), strict=True)
        ]
        run = np.stack(
            [radius * math.cos(angle) - start[0], radius * math.sin(angle) - start[1], np.full(x.numel(), sensor_mm)]
        )
        length = np.sqrt((run * run).sum(0))
        traced = trace_rays(back, np.stack([*start, np.full(x.numel(), -sensor_mm)]), run / length)
        met = []
        for z, image in planes:
            across, down = traced.at(z)
            scale = image(across**2 + down**2) / pixel
            columns, rows = (
                torch.from_numpy(side / 2 + v * scale).reshape(x.shape)
                for side, v in ((size[1], across), (size[0], down))
            )
            met.append((columns, rows))
        return met, torch.from_numpy(traced.alive / length**4).reshape(x.shape)

    return rays
