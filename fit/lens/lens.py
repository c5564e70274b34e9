"""Lenses: a list of surfaces, their first-order optics, and real rays through them.

Light travels to the right, along +z; z = 0 at the first surface's vertex. A positive radius is convex towards the
object. Lengths are in millimetres. :mod:`torchdof.fit.lens.prescription` describes the file format.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchdof.io.paths import named_file
from torchdof.validation import number, show, whole

from ..result import Array, Mask
from . import prescription
from .glass import AIR, C_UM, D_UM, F_UM, catalogue
from .surface import Surface

RGB_UM = (C_UM, 0.54607, F_UM)  # wavelengths for red, green and blue, in micrometres: the lines C, e and F
_SHIPPED = Path(__file__).parent / "lenses"
_MAX_MM = 1e12  # mm; limit of focal lengths and other first-order properties
_RAYS_AT_ONCE = 1 << 14  # rays that fit into the processor's cache together
_OVERLAP_MM = 1e-9  # rounding may put a surface this far behind the previous one
_F_NUMBER_ROUNDING = 1.03  # the f-number of a lens is rounded: f/2.03 is marked f/2


class Paraxial(NamedTuple):
    """First-order properties of a lens in air in the d line, object at infinity. Millimetres; positions along +z."""

    focal_length: float  # f
    back_focal: float  # rear focal point, from the last vertex
    front_principal: float  # principal plane H, from the first vertex; a thin lens's object distances start here
    rear_principal: float  # principal plane H', from the last vertex; a thin lens's image distances start here
    entrance_pupil: float  # the stop's image in object space, from the first vertex
    entrance_pupil_diameter: float  # A
    f_number: float  # f / A


class Rays(NamedTuple):
    """Rays at a plane or surface; those that are not alive have no meaningful position and direction."""

    position: Array  # [3, R] in mm: x, y, z with z = 0 at the first vertex
    direction: Array  # unit vectors [3, R]
    alive: Mask  # [R]; False if blocked, totally reflected, or beyond the rim where two surfaces intersect

    def at(self, z: float) -> Array:
        """Intersection of the rays, or their backward extensions, with the plane at z: x and y ``[2, R]`` in mm."""
        return self.position[:2] + (z - self.position[2]) / self.direction[2] * self.direction[:2]


@dataclass(frozen=True, eq=False)
class Lens:
    """Surfaces on one axis, one of them the aperture stop, in air.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> round(lens.paraxial().focal_length, 4), round(lens.paraxial().back_focal, 4)
        (50.3582, 36.1059)
    """

    surfaces: tuple[Surface, ...]  # front to rear; the medium behind the last one has index 1
    stop: int  # index of the surface that is the aperture stop
    name: str = ""
    source: str = ""  # origin of the numbers

    def __post_init__(self) -> None:
        """Raises a `ValueError` for invalid surfaces or an invalid stop."""
        if not isinstance(self.surfaces, tuple) or not all(isinstance(surface, Surface) for surface in self.surfaces):
            raise ValueError(f"surfaces must be a tuple of Surface, got {show(self.surfaces)}")
        whole("stop", self.stop, 0, len(self.surfaces) - 1)
        if (index := self.surfaces[-1].glass.index()) != 1.0:
            raise ValueError(f"the index behind the last surface must be 1 (air), got {index:g}")

    @classmethod
    def read(cls, source: str | os.PathLike[str]) -> Lens:
        """Reads a prescription or a Zemax file (.zmx) by its path, or an included prescription by its name.

        The names are ``"double_gauss_50mm"``, ``"wide_22mm"`` and ``"telephoto_250mm"``.

        Raises:
            ValueError: If the content is not a prescription; the message contains file, line and column.
            FileNotFoundError: If there is no such file and no included lens of this name.
        """
        path = named_file(source, _SHIPPED, ".txt", "lens prescription")
        try:
            parse = prescription.parse_zemax if path.suffix.lower() == ".zmx" else prescription.parse
            surfaces, stop, comment = parse(path.read_bytes())
            return cls(surfaces, stop, path.stem, comment)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @property
    def vertices(self) -> Array:
        """Position of each surface's vertex on the axis ``[S]``; the first is 0."""
        return np.cumsum([0.0, *(surface.thickness for surface in self.surfaces[:-1])])

    def indices(self, wavelength_um: float | None = None) -> Array:
        """Refractive indices before the first surface (air) and behind each surface ``[S + 1]``; None is the d line."""
        line_um = D_UM if wavelength_um is None else wavelength_um
        return np.array([1.0, *(surface.glass.index(line_um) for surface in self.surfaces)])

    def paraxial(self) -> Paraxial:
        """First-order properties, by ray transfer matrices; a `ValueError` if the lens does not converge light."""
        n, matrix, to_stop, gap = self.indices(), np.eye(2), np.eye(2), 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            for i, surface in enumerate(self.surfaces):
                matrix = np.array([[1.0, gap], [0.0, 1.0]]) @ matrix
                if i == self.stop:
                    to_stop = matrix
                power = (n[i + 1] - n[i]) * (1.0 / surface.radius + 2.0 * sum(surface.polynomial[:1]))
                matrix = np.array([[1.0, 0.0], [-power / n[i + 1], n[i] / n[i + 1]]]) @ matrix
                gap = surface.thickness
        if not (np.abs(matrix) < _MAX_MM).all():
            raise ValueError(f"lens {self.name!r} bends light beyond measure; check its radii and polynomials")
        (a, _), (c, d) = matrix.tolist()
        if not c < -1.0 / _MAX_MM:
            raise ValueError(f"lens {self.name!r} must have a positive focal length: it does not converge light")
        if abs(to_stop[0, 0]) < 1.0 / _MAX_MM:
            raise ValueError(f"lens {self.name!r} must have its entrance pupil somewhere: its stop is seen at infinity")
        focal, (scale, offset) = -1.0 / c, to_stop[0].tolist()
        pupil = self.surfaces[self.stop].diameter / abs(scale)
        return Paraxial(focal, a * focal, (1.0 - d) * focal, (a - 1.0) * focal, offset / scale, pupil, focal / pupil)

    def with_stop(self, diameter: float) -> Lens:
        """The lens with its stop opened or closed to a diameter in millimetres."""
        surfaces = [replace(s, diameter=diameter) if i == self.stop else s for i, s in enumerate(self.surfaces)]
        return replace(self, surfaces=tuple(surfaces))

    def with_f_number(self, f_number: float) -> Lens:
        """The lens stopped down to a paraxial f-number; up to 3 % below that of the open stop means fully open."""
        number("f_number", f_number, 0, 1e9)
        open_at = self.paraxial().f_number
        if f_number * _F_NUMBER_ROUNDING < open_at:
            raise ValueError(f"f_number must be at least {open_at:.3g} for lens {self.name!r}, got {f_number:g}")
        return self.with_stop(self.surfaces[self.stop].diameter * min(1.0, open_at / f_number))

    def lines(self) -> list[str]:
        """The surfaces as lines of a prescription file, which :meth:`read` turns back into the same lens."""
        media = [AIR, *(surface.glass for surface in self.surfaces)]
        named = {g.name: g for g in media if len(g.coefficients) == 6 and g not in catalogue().values()}
        lines = [" ".join(["glass", name, *map(repr, glass.coefficients)]) for name, glass in named.items()]
        for i, surface in enumerate(self.surfaces):
            shape = zip(prescription.SHAPE, (surface.conic, *surface.polynomial), strict=False)
            words = [f"{name}={value:.9g}" for name, value in shape if value]
            is_plain = not words and math.isinf(surface.radius) and media[i + 1] == media[i]
            curve, index = ("0", "0") if i == self.stop and is_plain else (f"{surface.radius:.9g}", surface.glass.name)
            words += ["stop"] * (i == self.stop and not is_plain)
            lines.append(" ".join([curve, f"{surface.thickness:.9g}", index, f"{surface.diameter:.9g}", *words]))
        return lines


def trace_rays(lens: Lens, position: Array, direction: Array, wavelength_um: float | None = None) -> Rays:
    """Traces rays to the last surface; they have the direction behind it.

    Rays start at points ``[3, R]`` in mm in front of the lens, z = 0 at the first vertex, along unit vectors ``[3, R]``
    with a positive z; no wavelength means the d line.

    Reference:
        Kolb, Mitchell, Hanrahan, "A realistic camera model for computer graphics", SIGGRAPH 1995, section 3.1.
    """
    if (count := position.shape[1]) > _RAYS_AT_ONCE:
        chunks = (slice(start, start + _RAYS_AT_ONCE) for start in range(0, count, _RAYS_AT_ONCE))
        parts = [trace_rays(lens, position[:, chunk], direction[:, chunk], wavelength_um) for chunk in chunks]
        return Rays(*(np.concatenate(part, -1) for part in zip(*parts, strict=True)))
    index, axis = lens.indices(wavelength_um), np.array([[0.0], [0.0], [1.0]])
    alive = np.ones(position.shape[1], dtype=bool)
    for i, (surface, vertex) in enumerate(zip(lens.surfaces, lens.vertices, strict=True)):
        run, normal, hits = surface.meet(position - vertex * axis, direction)
        position = position + run * direction
        alive &= hits & (position[0] ** 2 + position[1] ** 2 <= (surface.diameter / 2) ** 2)
        if i > 0:  # where two surfaces intersect there is no lens
            alive &= run >= -_OVERLAP_MM
        ratio = index[i] / index[i + 1]
        cosine = (direction * normal).sum(0)
        discriminant = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        alive &= discriminant >= 0  # else totally reflected
        direction = ratio * direction + (np.sqrt(np.maximum(discriminant, 0.0)) - ratio * cosine) * normal
        if not alive.all():  # continue blocked rays along the axis, where their numbers stay small
            position, direction = np.where(alive, position, vertex * axis), np.where(alive, direction, axis)
    return Rays(position, direction, alive)
