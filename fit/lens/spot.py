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

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from torchdof.validation import number, whole

from ..result import Array
from ..validation import a_choice
from .lens import Lens
from .rays import Rays, trace_rays

Reference = Literal["principal", "pupil", "vertex", "sensor"]
Focus = Literal["best", "paraxial"]

_PROBES = 64  # along each side of a box in the pupil
_FAN = 4096
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
        return float(np.sqrt(self.weight @ self.r**2))

    @property
    def asymmetry(self) -> float:
        """How far the spot is from round: 0 for a round one.

        The light of each of 16 rings of equal light is expanded in the angle; this is the root mean square of the
        harmonics 1 to 4 relative to the mean, so 0.5 means that the light of a ring varies by about half of itself.
        """
        if self.meridional:
            return 0.0
        order = np.argsort(self.r)
        light = self.weight[order]
        ring = np.minimum((np.cumsum(light) * 16).astype(int), 15)
        turn = np.arctan2(self.y, self.x)[order]
        waves = [np.bincount(ring, light * wave(n * turn), 16) for n in range(1, 5) for wave in (np.cos, np.sin)]
        return math.sqrt(2.0 * float(np.mean(np.sum(np.square(waves), 0) / np.bincount(ring, light, 16) ** 2)))


def focus_sensor(lens: Lens, focus_m: float, kind: Focus = "best", reference: Reference = "principal") -> float:
    """Distance of the sensor behind the last vertex, in mm, that focuses on an object at ``focus_m``.

    Args:
        lens: The prescription; its stop counts for the best focus.
        focus_m: Object distance in metres; ``inf`` allowed.
        kind: ``"paraxial"`` is where rays close to the axis meet; ``"best"`` where the spot on the axis has the least
            root mean square radius, which is where a photographer (or an autofocus) puts the sensor.
        reference: What the distance is measured from, see the module.

    Raises:
        ValueError: If the object is too near to be focused, or an argument is not as described.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> round(focus_sensor(lens, float("inf"), kind="paraxial"), 4)
        36.1059
    """
    a_choice("focus", kind, get_args(Focus))
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
        meridional: On the axis only: trace a fan that stands for its full turn. As good with 2,000 rays.

    Raises:
        ValueError: If an argument is not as described, or no ray reaches the sensor.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> sensor = focus_sensor(lens, 2.0, kind="paraxial")
        >>> round(point_spread(lens, 1.0, sensor, meridional=True).radius, 4)
        0.3705
    """
    whole("rays", rays, 16, 10**8)
    number("field_mm", field_mm, low=-_WIDEST_MM, high=_WIDEST_MM, unit="millimetres")
    if meridional and field_mm:
        raise ValueError(f"meridional is for points on the axis, got field_mm = {field_mm}")
    source = _Source(lens, vertex_distance_mm(lens, z_m, reference, sensor_mm), sensor_mm, field_mm, wavelength_um)
    low, high = source.pupil_box()
    side = max(4, round(math.sqrt(rays)))
    points = _fan(high[1], rays) if meridional else _grid(low, high, (np.arange(side) + 0.5) / side)
    traced, weight = source.aim(points)
    alive = traced.alive
    if not alive.any():
        raise ValueError(f"no ray from z = {z_m} m at field {field_mm} mm passes lens {lens.name!r}")
    hits, weight = traced.at(lens.vertices[-1] + sensor_mm)[:, alive], weight[alive] / weight[alive].sum()
    if meridional:
        return Spot(hits[0], hits[1], weight, 0.0, math.pi * float(points[1, alive].max()) ** 2, True)
    centre = hits @ weight
    x, y = hits - centre[:, None]
    return Spot(x, y, weight, -float(centre[1]), float(np.prod(high - low) * alive.mean()))


def vertex_distance_mm(lens: Lens, z_m: float, reference: Reference, sensor_mm: float) -> float:
    """Distance of an object in front of the first vertex, in mm."""
    a_choice("reference", reference, get_args(Reference))
    first = lens.paraxial()
    places = first.front_principal, first.entrance_pupil, 0.0, float(lens.vertices[-1]) + sensor_mm
    behind_vertex = dict(zip(get_args(Reference), places, strict=True))[reference]
    if _FARTHEST_M < z_m < math.inf:
        raise ValueError(f"objects must be at most {_FARTHEST_M:g} m away, or at infinity, got {z_m} m")
    if not 1000.0 * z_m - behind_vertex > max(0.0, -first.entrance_pupil):
        raise ValueError(
            f"objects must lie in front of the lens, more than {max(behind_vertex, 0.0) / 1000:.4g} m from its "
            f"{reference}, got {z_m} m"
        )
    return 1000.0 * z_m - behind_vertex


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
    source = _Source(lens, object_mm, paraxial)
    traced, weight = source.aim(_fan(source.pupil_box()[1][1], _FAN))
    weight = weight * traced.alive
    height = traced.at(lens.vertices[-1] + paraxial)[1]
    slope = traced.direction[1] / traced.direction[2]
    # the squared radius is a parabola over the sensor's position
    steepness = float(weight @ (slope * slope))
    if steepness == 0.0:
        raise ValueError(f"no ray of a fan through lens {lens.name!r} comes to a focus; are its openings too narrow?")
    return paraxial - float(weight @ (height * slope)) / steepness


def _fan(reach: float, rays: int) -> Array:
    """Points ``[2, N]`` of the pupil along y, each of which stands for a ring of the same area."""
    return np.stack([np.zeros(rays), reach * np.sqrt((np.arange(rays) + 0.5) / rays)])


def _grid(low: Array, high: Array, steps: Array) -> Array:
    """Points ``[2, N^2]`` of a box at shares ``[N]`` of its sides."""
    return np.stack(np.meshgrid(*(low + (high - low) * steps[:, None]).T)).reshape(2, -1)


class _Source:
    """An object point that sends rays of one wavelength through a lens."""

    def __init__(
        self, lens: Lens, object_mm: float, sensor_mm: float, field_mm: float = 0.0, wavelength_um: float | None = None
    ) -> None:
        self.lens, self.wavelength_um, first = lens, wavelength_um, lens.paraxial()
        self.pupil = first.entrance_pupil
        self.distance = object_mm + self.pupil  # before the entrance pupil
        self.tangent = field_mm / (sensor_mm - first.rear_principal)  # of its direction, seen from H
        self.slope = self.tangent * (1.0 + (first.front_principal - self.pupil) / self.distance)  # from the pupil

    def aim(self, points: Array) -> tuple[Rays, Array]:
        """Rays through points ``[2, R]`` of the entrance pupil's plane, and the solid angle that each stands for."""
        slopes = points / self.distance - np.array([[0.0], [self.slope]])
        run = np.concatenate([slopes, np.ones_like(slopes[:1])])
        length = np.sqrt((run * run).sum(0))
        # start at the first vertex's plane: the pupil's plane may lie inside the lens
        start = np.concatenate([points - self.pupil * slopes, np.zeros_like(slopes[:1])])
        return trace_rays(self.lens, start, run / length, self.wavelength_um), length**-3

    def pupil_box(self) -> tuple[Array, Array]:
        """Box ``(low, high)`` in the entrance pupil's plane that just holds the rays that pass."""
        # every ray that passes goes through the first surface's clear diameter
        front = self.lens.surfaces[0].diameter
        reach = front / 2 + abs(self.pupil) * (abs(self.tangent) + front / self.distance)
        low, high = np.array([-reach, -reach]), np.array([reach, reach])
        for _ in range(8):
            points = _grid(low, high, np.linspace(0.0, 1.0, _PROBES + 1))
            passed = points[:, self.aim(points)[0].alive]
            if not passed.size:
                raise ValueError(
                    f"no ray of the object point passes lens {self.lens.name!r}; is it in the field of view?"
                )
            cell, before = (high - low) / _PROBES, np.prod(high - low)
            low, high = np.maximum(passed.min(1) - cell, low), np.minimum(passed.max(1) + cell, high)
            if np.prod(high - low) > 0.95 * before:
                break
        return low, high
