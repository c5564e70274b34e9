"""The spot of a point of light on the sensor, the sensor's position for a focus distance, and spots over the field.

Object distances ``z`` are in metres along the axis from the front principal plane, as in the thin lens formula of
:class:`torchdof.Camera`. Depth in computer vision starts at the entrance pupil, a tape measure's distance at the first
surface: add ``paraxial().front_principal`` minus ``paraxial().entrance_pupil`` or 0, in mm.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal, get_args

import numpy as np
import torch

from torchdof.optics.field import Field
from torchdof.validation import choice, number, whole

from ..result import Array
from .lens import Lens, Rays, trace_rays

Focus = Literal["best", "paraxial"]

_PUPIL_INTERVALS = 64  # grid intervals along each side of a box in the pupil
_FAN_RAYS = 4096
_MAX_DISTANCE_M = 1e12
_CELLS = (128, 64)  # of half a spot over the field, along and across the radial direction
_SPACING_POWER = 1.5  # coc grows with this power of the node's index
_CHIEF_STOP = 0.1  # diameter, relative to the stop's, of the small stop that defines a position in the sharp image
_CHIEF_RAYS = 900
_DISTORTION_STEPS = 3  # iterations that correct the lens's distortion


@dataclass(frozen=True, eq=False)
class Spot:
    """Positions of the light of one object point on the sensor, in mm. A geometric spot, without diffraction."""

    x: Array  # hits relative to the centroid [R]
    y: Array  # the same; the object lies in the direction +y of the field, its image at -y
    weight: Array  # share of the light of each hit [R]; sums to 1
    centre: float  # the centroid's distance from the axis, along the image's field direction
    pupil_mm2: float  # unvignetted area of the entrance pupil, to about 1 %; off axis over on axis: vignetting

    @property
    def r(self) -> Array:
        """Distance of each hit from the centroid ``[R]``, in mm."""
        return np.hypot(self.x, self.y)

    @property
    def radius(self) -> float:
        """Largest distance of a hit from the centroid, in mm."""
        return float(self.r.max())

    @property
    def rms(self) -> float:
        """Root of the mean squared distance from the centroid, in mm."""
        return float(np.sqrt(self.weight @ self.r**2))

    @property
    def asymmetry(self) -> float:
        """Rms of the harmonics 1 to 4 of the light around 16 rings of equal light, over its mean: 0 if round."""
        order = np.argsort(self.r)
        light = self.weight[order]
        ring = np.minimum((np.cumsum(light) * 16).astype(int), 15)
        angle = np.arctan2(self.y, self.x)[order]
        waves = [np.bincount(ring, light * wave(n * angle), 16) for n in range(1, 5) for wave in (np.cos, np.sin)]
        return math.sqrt(2.0 * float(np.mean(np.sum(np.square(waves), 0) / np.bincount(ring, light, 16) ** 2)))


def focus_sensor(lens: Lens, focus_m: float, kind: Focus = "best") -> float:
    """Distance of the sensor behind the last vertex, in mm, for an object at ``focus_m`` (``inf`` allowed) in focus.

    The kind ``"paraxial"`` is where rays close to the axis meet; ``"best"`` is where the spot on the axis has the
    smallest rms radius, as autofocus finds it; it depends on the stop.

    Raises:
        ValueError: If the object is too near for focusing, or an argument is invalid.
    """
    choice("focus", kind, get_args(Focus))
    paraxial, object_mm, distance = lens.paraxial(), _vertex_distance_mm(lens, focus_m), 1000.0 * focus_m
    if distance <= (focal := paraxial.focal_length):
        text = f"the focus must be farther than the focal length ({focal:.4g} mm) from the front principal plane"
        raise ValueError(f"{text}, got {distance:.4g} mm")
    sensor = paraxial.rear_principal + 1.0 / (1.0 / focal - 1.0 / distance)
    if kind == "best":
        aim, _, high = _rays_of_point(lens, object_mm, sensor)
        traced, weight = aim(_fan(high[1], _FAN_RAYS))
        weight, height = weight * traced.alive, traced.at(lens.vertices[-1] + sensor)[1]
        slope = traced.direction[1] / traced.direction[2]
        # the mean squared radius is a parabola over the sensor's position
        steepness = float(weight @ (slope * slope))
        if steepness == 0.0:
            raise ValueError(f"no ray through lens {lens.name!r} comes to a focus; are its openings too narrow?")
        sensor -= float(weight @ (height * slope)) / steepness
    return sensor


def point_spread(
    lens: Lens,
    z_m: float,
    sensor_mm: float,
    *,
    field_mm: float = 0.0,
    rays: int = 50_000,
    wavelength_um: float | None = None,
    meridional: bool = False,
) -> Spot:
    """Traces the spot of an object point: rays on a square grid over the open pupil, weighted by solid angle.

    Args:
        lens: The prescription, stopped down as needed.
        z_m: Object distance in metres from the front principal plane; ``inf`` allowed.
        sensor_mm: Distance of the sensor behind the last vertex, from :func:`focus_sensor`.
        field_mm: Height in mm of the image of a pinhole in the front principal plane; distortion moves the real one.
        rays: Number of rays aimed at the lens; vignetting blocks some.
        wavelength_um: None is the d line.
        meridional: On the axis only: trace a fan that represents its rotation; as accurate with 2,000 rays.

    Raises:
        ValueError: If an argument is invalid, or no ray reaches the sensor.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> sensor = focus_sensor(lens, 2.0, kind="paraxial")
        >>> round(point_spread(lens, 1.0, sensor, meridional=True).radius, 4)
        0.3705
    """
    whole("rays", rays, 16, 10**8)
    if number("field_mm", field_mm, low=-1e9, high=1e9, unit="millimetres") and meridional:
        raise ValueError(f"meridional is for points on the axis, got field_mm = {field_mm}")
    object_mm, side = _vertex_distance_mm(lens, z_m), max(4, round(math.sqrt(rays)))
    aim, low, high = _rays_of_point(lens, object_mm, sensor_mm, field_mm, wavelength_um)
    points = _fan(high[1], rays) if meridional else _grid(low, high, (np.arange(side) + 0.5) / side)
    traced, weight = aim(points)
    passed = traced.alive
    if not passed.any():
        raise ValueError(f"no ray from z = {z_m} m at field {field_mm} mm passes lens {lens.name!r}")
    hits, weight = traced.at(lens.vertices[-1] + sensor_mm)[:, passed], weight[passed] / weight[passed].sum()
    if meridional:
        return Spot(hits[0], hits[1], weight, 0.0, math.pi * float(points[1, passed].max()) ** 2)
    centre = hits @ weight
    x, y = hits - centre[:, None]
    return Spot(x, y, weight, -float(centre[1]), float(np.prod(high - low) * passed.mean()))


def _vertex_distance_mm(lens: Lens, z_m: float) -> float:
    """Distance in mm of an object in front of the first vertex."""
    paraxial = lens.paraxial()
    object_mm = 1000.0 * z_m - paraxial.front_principal
    if _MAX_DISTANCE_M < z_m < math.inf:
        raise ValueError(f"objects must be at most {_MAX_DISTANCE_M:g} m away, or at infinity, got {z_m} m")
    if not object_mm > max(0.0, -paraxial.entrance_pupil):
        least = f"{max(paraxial.front_principal, 0.0) / 1000:.4g} m from its front principal plane"
        raise ValueError(f"objects must lie in front of the lens, more than {least}, got {z_m} m")
    return object_mm


def _fan(reach: float, rays: int) -> Array:
    """Points ``[2, N]`` of the pupil along y, each representing a ring of equal area."""
    return np.stack([np.zeros(rays), reach * np.sqrt((np.arange(rays) + 0.5) / rays)])


def _grid(low: Array, high: Array, steps: Array) -> Array:
    """Points ``[2, N^2]`` of a box, at fractions ``[N]`` of its sides."""
    return np.stack(np.meshgrid(*(low + (high - low) * steps[:, None]).T)).reshape(2, -1)


def _rays_of_point(
    lens: Lens, object_mm: float, sensor_mm: float, field_mm: float = 0.0, wavelength_um: float | None = None
) -> tuple[Callable[[Array], tuple[Rays, Array]], Array, Array]:
    """A function from points ``[2, R]`` in the pupil to rays and their solid angles, and the box of those that pass."""
    paraxial = lens.paraxial()
    pupil, front_diameter = paraxial.entrance_pupil, lens.surfaces[0].diameter
    distance = object_mm + pupil  # from the entrance pupil
    tangent = field_mm / (sensor_mm - paraxial.rear_principal)  # of the point's direction, seen from H
    slope = tangent * (1.0 + (paraxial.front_principal - pupil) / distance)  # from the pupil

    def aim(points: Array) -> tuple[Rays, Array]:
        slopes = points / distance - np.array([[0.0], [slope]])
        rays = np.concatenate([slopes, np.ones_like(slopes[:1])])
        length = np.sqrt((rays * rays).sum(0))
        # start in the plane of the first vertex: the pupil's plane may lie inside the lens
        start = np.concatenate([points - pupil * slopes, np.zeros_like(slopes[:1])])
        return trace_rays(lens, start, rays / length, wavelength_um), length**-3

    # every passing ray crosses the first surface's clear diameter
    reach = front_diameter / 2 + abs(pupil) * (abs(tangent) + front_diameter / distance)
    low, high, steps = np.array([-reach, -reach]), np.array([reach, reach]), np.linspace(0.0, 1.0, _PUPIL_INTERVALS + 1)
    for _ in range(8):
        # seen from the axis the passing rays fill a circle, so that those in one plane give its radius
        points = _grid(low, high, steps) if field_mm else np.stack([0.0 * steps, low[1] + (high - low)[1] * steps])
        passed = points[:, aim(points)[0].alive]
        if not passed.size:
            raise ValueError(f"no ray of the object point passes lens {lens.name!r}; is it in the field of view?")
        cell, old_area = (high - low) / _PUPIL_INTERVALS, np.prod(high - low)
        first, last = (passed.min(1), passed.max(1)) if field_mm else (passed.min(), passed.max())
        low, high = np.maximum(first - cell, low), np.minimum(last + cell, high)
        if np.prod(high - low) > 0.95 * old_area:
            break
    return aim, low, high


def trace_field(
    lens: Lens,
    sensor_mm: float,
    distance_m: Callable[[float], float],
    coc_mm: Sequence[float],
    radius_mm: Sequence[float],
    wavelengths_um: Sequence[float] | None,
    rays: int,
) -> Field:
    """Traces spots at signed coc, whose object distances `distance_m` gives, and at distances from the centre."""
    rows, columns = _CELLS
    heights = [field_height_mm(lens, distance_m(0.0), sensor_mm, radius) for radius in radius_mm]
    boxes, light = [], []  # of the spots of all nodes; light is [channels, U, V]
    for coc, height in product(coc_mm, heights):
        place = lens, distance_m(coc), sensor_mm, height
        spots = [spot_of_place(*place, rays=rays, wavelength_um=line) for line in wavelengths_um or (None,)]
        low, high = min(u.min() for u, _, _ in spots), max(u.max() for u, _, _ in spots)
        # a ray's light is split among the cells around it, so rays lie half a cell inside the box
        centre, length = (low + high) / 2, max(high - low, 1e-9) / 2 * rows / (rows - 1)
        width = max(1e-9, *(np.abs(v).max() for _, v, _ in spots)) * 2 * columns / (2 * columns - 1)
        boxes.append((centre, length, width))
        light.append([_binned((u - centre) / length, np.abs(v) / width, weight) for u, v, weight in spots])
    nodes = (len(coc_mm), len(radius_mm))
    cocs, radii, box, cells = (torch.from_numpy(np.array(values)) for values in (coc_mm, radius_mm, boxes, light))
    return Field(cocs, radii, box.unflatten(0, nodes), cells.transpose(0, 1).unflatten(1, nodes))


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


def spot_of_place(lens: Lens, z_m: float, sensor_mm: float, field_mm: float, **options: Any) -> list[Array]:
    """Positions ``[R]`` in mm of a point's light, from its sharp image away from the axis, and across; and weight."""
    spot = point_spread(lens, z_m, sensor_mm, field_mm=field_mm, **options)
    return [spot.centre - _chief_ray_mm(lens, z_m, sensor_mm, field_mm) - spot.y, spot.x, spot.weight]


def _chief_ray_mm(lens: Lens, z_m: float, sensor_mm: float, field_mm: float) -> float:
    """Distance from the axis, in mm, of a point's image through a small stop, in the d line."""
    if field_mm == 0.0:
        return 0.0
    stopped = lens.with_stop(lens.surfaces[lens.stop].diameter * _CHIEF_STOP)
    return point_spread(stopped, z_m, sensor_mm, field_mm=field_mm, rays=_CHIEF_RAYS).centre


def field_height_mm(lens: Lens, z_m: float, sensor_mm: float, radius_mm: float) -> float:
    """The ``field_mm`` of a point whose image is at `radius_mm` from the centre; corrects the distortion."""
    height = radius_mm
    for _ in range(_DISTORTION_STEPS if radius_mm else 0):
        height *= radius_mm / _chief_ray_mm(lens, z_m, sensor_mm, height)
    return height


def coc_nodes(near_mm: float, far_mm: float, count: int) -> list[float]:
    """Signed coc, denser near focus, on average `count` on each side, as the square root of that side's reach."""
    sides = [(near_mm, count)]
    if far_mm > 0:
        share = math.sqrt(far_mm) / (math.sqrt(far_mm) + math.sqrt(-near_mm))
        far_count = min(max(2, round(2 * count * share)), 2 * count - 2)
        sides = [(near_mm, 2 * count - far_count), (far_mm, far_count)]
    return sorted([0.0, *(end * (i / n) ** _SPACING_POWER for end, n in sides for i in range(1, n + 1))])
