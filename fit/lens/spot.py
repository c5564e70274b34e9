"""The spot that a point of light makes on the sensor, and where the sensor is when the lens is focused.

Object distances ``z`` are metres along the axis from a stated reference of the lens:

* ``"principal"`` (the default): the front principal plane. This is the thin lens's distance: the one that
  :class:`torchdof.Camera` computes circles of confusion from.
* ``"pupil"``: the entrance pupil, the point a picture's perspective is seen from. Depth in computer vision.
* ``"vertex"``: the first surface. A tape measure.
* ``"sensor"``: the sensor (the film plane). The scale engraved on a lens.

The focus distance and the object distances of one call always share the reference. For the 50 mm double Gauss at 2 m
the four are up to 7 cm apart, and the blur of an object at 1 m differs by 10 % between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from torchdof.validation import number, show

from ..result import Array
from .lens import Lens
from .rays import Rays, trace_rays

__all__ = ["Focus", "Reference", "Spot", "focus_sensor", "point_spread", "vertex_distance_mm"]

Reference = Literal["principal", "pupil", "vertex", "sensor"]
Focus = Literal["best", "paraxial"]

_PROBES = 64
_MOST_RAYS = 10**8
_FARTHEST_M, _WIDEST_MM = 1e12, 1e9


@dataclass(frozen=True, eq=False)
class Spot:
    """Where the light of one object point lands on the sensor. A geometric spot: no diffraction.

    Attributes:
        x: Hits relative to the centroid ``[R]``, in mm; the object's field direction is +y (its image is at -y).
        y: See x.
        weight: Share of the light that each hit carries ``[R]``; sums to 1.
        centre: The centroid's distance from the axis in mm, along the image's field direction.
        pupil_mm2: Area of the entrance pupil that lets light through, to about 1 %. Off axis over on axis: vignetting.
        meridional: True for a spot on the axis that was traced as one fan along y and stands for its full turn.
    """

    x: Array
    y: Array
    weight: Array
    centre: float
    pupil_mm2: float
    meridional: bool = False

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
        return float(np.sqrt(self.weight @ (self.x**2 + self.y**2)))

    @property
    def asymmetry(self) -> float:
        """How far the spot is from round: 0 for a round one.

        The light of each of 16 rings of equal light is expanded in the angle; this is the root mean square of the
        harmonics 1 to 4 relative to the mean, so 0.5 means that the light of a ring varies by about half of itself.
        """
        if self.meridional:
            return 0.0
        order = np.argsort(self.r)
        ring = np.minimum((np.cumsum(self.weight[order]) * 16).astype(int), 15)
        turn = np.exp(1j * np.arctan2(self.y, self.x))[order]
        total = np.bincount(ring, self.weight[order], 16)
        power = np.zeros(16)
        for harmonic in range(1, 5):
            wave = self.weight[order] * turn**harmonic
            mean = (np.bincount(ring, wave.real, 16) + 1j * np.bincount(ring, wave.imag, 16)) / total
            power += 2.0 * np.abs(mean) ** 2
        return float(np.sqrt(power.mean()))


def focus_sensor(lens: Lens, focus_m: float, kind: Focus = "best", reference: Reference = "principal") -> float:
    """Distance of the sensor behind the last vertex, in mm, that focuses on an object at ``focus_m``.

    Args:
        lens: The prescription; its stop counts for the best focus.
        focus_m: Object distance in metres from the reference; ``inf`` allowed.
        kind: ``"paraxial"`` is where rays close to the axis meet; ``"best"`` where the spot on the axis has the least
            root mean square radius, which is where a photographer (or an autofocus) puts the sensor.
        reference: What distances are measured from, see the module.

    Raises:
        ValueError: If the object is too near to be focused, or an argument is not as described.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> round(focus_sensor(lens, float("inf"), kind="paraxial"), 4)
        36.1059
    """
    if kind not in get_args(Focus):
        raise ValueError(f"focus must be one of {', '.join(get_args(Focus))}, got {kind!r}")
    first = lens.paraxial()
    sensor = first.back_focal
    for _ in range(100 if reference == "sensor" else 1):
        object_mm = vertex_distance_mm(lens, focus_m, reference, sensor)
        before, sensor = sensor, _image_mm(lens, object_mm, kind)
        if abs(sensor - before) < 1e-12 * first.focal_length:
            break
    return sensor


def point_spread(
    lens: Lens,
    z_m: float,
    sensor_mm: float,
    *,
    field_mm: float = 0.0,
    rays: int = 50_000,
    wavelength_um: float | None = None,
    reference: Reference = "principal",
    meridional: bool = False,
) -> Spot:
    """Trace the spot of an object point.

    Rays fill the part of the entrance pupil that lets them through, on a square grid, each weighted by its solid angle:
    the object point shines alike in all directions.

    Args:
        lens: The prescription, stopped down as wanted.
        z_m: Object distance in metres from the reference; ``inf`` allowed.
        sensor_mm: Sensor behind the last vertex, from :func:`focus_sensor`.
        field_mm: Image height in mm at which a pinhole camera with its hole in the front principal plane, as far from
            its sensor as H' is, would see the object point; the real image lies there up to distortion.
        rays: Number of rays aimed at the lens; the share that passes depends on the vignetting.
        wavelength_um: Wavelength in micrometres; None is the d line.
        reference: What ``z_m`` is measured from, see the module.
        meridional: On the axis only: trace a fan that stands for its full turn. Exact, and as good with 2,000 rays.

    Raises:
        ValueError: If an argument is not as described, or no ray reaches the sensor.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> sensor = focus_sensor(lens, 2.0, kind="paraxial")
        >>> round(point_spread(lens, 1.0, sensor, meridional=True).radius, 4)
        0.3705
    """
    if isinstance(rays, bool) or not isinstance(rays, int) or not 16 <= rays <= _MOST_RAYS:
        raise ValueError(f"rays must be at least 16, got {show(rays)} (and {_MOST_RAYS} at most)")
    number("field_mm", field_mm, low=-_WIDEST_MM, high=_WIDEST_MM, unit="millimetres")
    if meridional and field_mm:
        raise ValueError(f"meridional is for points on the axis, got field_mm = {field_mm}")
    object_mm = vertex_distance_mm(lens, z_m, reference, sensor_mm)
    point = _object_point(lens, object_mm, sensor_mm, field_mm)
    low, high = _pupil_box(lens, point, wavelength_um)
    if meridional:
        # rings of equal solid angle; of equal area for an object at infinity
        share = (np.arange(rays) + 0.5) / rays
        x, y = np.zeros(rays), high[1] * np.sqrt(share)
        if math.isfinite(object_mm):
            # 1 - cosine, without the cancellation that a far object would suffer
            secant = math.hypot(1.0, high[1] / point.distance)
            fall = share * (high[1] / point.distance) ** 2 / (secant * (1.0 + secant))
            y = point.distance * np.sqrt(fall * (2.0 - fall)) / (1.0 - fall)
    else:
        side = max(4, round(math.sqrt(rays)))
        steps = (np.arange(side) + 0.5) / side
        x, y = (v.ravel() for v in np.meshgrid(*(low[i] + (high[i] - low[i]) * steps for i in (0, 1))))
    traced, weight = _aim(lens, point, x, y, wavelength_um)
    keep = traced.alive
    if not keep.any():
        raise ValueError(f"no ray from z = {z_m} m at field {field_mm} mm passes lens {lens.name!r}")
    hit_x, hit_y = (v[keep] for v in traced.at(lens.vertices[-1] + sensor_mm))
    cell = float(np.prod(high - low)) / len(x)
    if meridional:
        weight = np.ones_like(weight)
        return Spot(hit_x, hit_y, weight[keep] / keep.sum(), 0.0, math.pi * float(y[keep].max()) ** 2, True)
    weight = weight[keep] / weight[keep].sum()
    centre = weight @ hit_x, weight @ hit_y
    return Spot(hit_x - centre[0], hit_y - centre[1], weight, -float(centre[1]), cell * int(keep.sum()))


def vertex_distance_mm(lens: Lens, z_m: float, reference: Reference, sensor_mm: float) -> float:
    """Distance of an object in front of the first vertex, in mm."""
    if reference not in get_args(Reference):
        raise ValueError(f"reference must be one of {', '.join(get_args(Reference))}, got {reference!r}")
    first = lens.paraxial()
    behind_vertex = {
        "principal": first.front_principal,
        "pupil": first.entrance_pupil,
        "vertex": 0.0,
        "sensor": float(lens.vertices[-1]) + sensor_mm,
    }[reference]
    object_mm = 1000.0 * z_m - behind_vertex
    if _FARTHEST_M < z_m < math.inf:
        raise ValueError(f"objects must be at most {_FARTHEST_M:g} m away, or at infinity, got {z_m} m")
    if not object_mm > 0:
        raise ValueError(
            f"objects must lie in front of the lens, more than {max(behind_vertex, 0.0) / 1000:.4g} m from its "
            f"{reference}, got {z_m} m"
        )
    return object_mm


def _image_mm(lens: Lens, object_mm: float, kind: Focus) -> float:
    """Distance behind the last vertex, in mm, at which an object on the axis is in focus."""
    first = lens.paraxial()
    distance = object_mm + first.front_principal
    if distance <= first.focal_length:
        raise ValueError(
            f"the focus must be farther than the focal length ({first.focal_length:.4g} mm) from the front principal "
            f"plane, got {distance:.4g} mm"
        )
    paraxial = first.rear_principal + 1.0 / (1.0 / first.focal_length - 1.0 / distance)
    if kind == "paraxial":
        return paraxial
    point = _object_point(lens, object_mm, paraxial, 0.0)
    _, high = _pupil_box(lens, point, None)
    fan = high[1] * np.sqrt((np.arange(4096) + 0.5) / 4096)
    traced, weight = _aim(lens, point, np.zeros_like(fan), fan, None)
    weight = weight * traced.alive
    height = traced.at(lens.vertices[-1] + paraxial)[1]
    slope = traced.direction[1] / traced.direction[2]
    # the squared radius is a parabola over the sensor's position
    steepness = float(weight @ (slope * slope))
    if steepness == 0.0:
        raise ValueError(f"no ray of a fan through lens {lens.name!r} comes to a focus; are its openings too narrow?")
    return paraxial - float(weight @ (height * slope)) / steepness


class _Point(NamedTuple):
    """An object point: the tangent of its direction seen from H, and its distance in mm before the entrance pupil."""

    tangent: float
    distance: float


def _object_point(lens: Lens, object_mm: float, sensor_mm: float, field_mm: float) -> _Point:
    first = lens.paraxial()
    distance = object_mm + first.entrance_pupil
    if distance <= 0:
        raise ValueError(f"the object at {object_mm:.4g} mm before the lens lies behind its entrance pupil")
    return _Point(field_mm / (sensor_mm - first.rear_principal), distance)


def _aim(lens: Lens, point: _Point, x: Array, y: Array, wavelength_um: float | None) -> tuple[Rays, Array]:
    """Rays of an object point through points of the entrance pupil's plane, and the solid angle each stands for."""
    first = lens.paraxial()
    pupil = first.entrance_pupil
    if math.isfinite(point.distance):
        height = point.tangent * (point.distance - pupil + first.front_principal)
        run = np.stack([x, y - height, np.full_like(x, point.distance)])
    else:
        run = np.stack([np.zeros_like(x), np.full_like(x, -point.tangent), np.ones_like(x)])
    length = np.sqrt((run * run).sum(0))
    direction = run / length
    # start at the first vertex's plane: the pupil's plane may lie inside the lens
    start = np.stack([x, y, np.full_like(x, pupil)]) - direction * (pupil / direction[2])
    return trace_rays(lens, start, direction, wavelength_um), 1.0 / length**3


def _pupil_box(lens: Lens, point: _Point, wavelength_um: float | None) -> tuple[Array, Array]:
    """Box ``(low, high)`` in the entrance pupil's plane that just holds the rays that pass."""
    first = lens.paraxial()
    # every ray that passes goes through the first surface's clear diameter
    reach = lens.diameter[0] / 2 + abs(first.entrance_pupil) * (abs(point.tangent) + lens.diameter[0] / point.distance)
    low, high = np.array([-reach, -reach]), np.array([reach, reach])
    for _ in range(8):
        steps = np.linspace(0.0, 1.0, _PROBES + 1)
        x, y = np.meshgrid(*(low[i] + (high[i] - low[i]) * steps for i in (0, 1)))
        alive = _aim(lens, point, x.ravel(), y.ravel(), wavelength_um)[0].alive
        if not alive.any():
            raise ValueError(f"no ray of the object point passes lens {lens.name!r}; is it outside the field of view?")
        cell = (high - low) / _PROBES
        before = np.prod(high - low)
        passed = np.stack([x.ravel()[alive], y.ravel()[alive]])
        low, high = np.maximum(passed.min(1) - cell, low), np.minimum(passed.max(1) + cell, high)
        if np.prod(high - low) > 0.95 * before:
            break
    return low, high
