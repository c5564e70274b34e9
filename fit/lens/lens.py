"""Lenses: a list of surfaces, and their first-order optics.

Light travels to the right, along +z; z = 0 at the first surface's vertex. A positive radius is convex towards the
object. Lengths are in millimetres. :mod:`torchdof.fit.lens.prescription` describes the file format.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchdof.validation import number, show, whole

from ..result import Array
from . import prescription, zmx
from .glass import AIR, C_UM, D_UM, F_UM
from .surface import Surface

RGB_UM = (C_UM, 0.54607, F_UM)
"""Wavelengths for red, green and blue, in micrometres: the lines C, e and F."""

_SHIPPED = Path(__file__).parent / "lenses"
_LARGEST = 1e12  # mm; limit of focal lengths and other first-order properties
_MARKED = 1.03  # the f-number of a lens is rounded: f/2.03 is marked f/2


class Paraxial(NamedTuple):
    """First-order properties of a lens in air, object at infinity. Millimetres; positions along +z.

    For the front focal point and the exit pupil, take the rear focal point and the entrance pupil of
    :meth:`Lens.turned`.

    Attributes:
        focal_length: f.
        back_focal: rear focal point, from the last vertex (the back focal distance).
        front_principal: front principal plane H, from the first vertex. A thin lens's object distances start here.
        rear_principal: rear principal plane H', from the last vertex. A thin lens's image distances start here.
        entrance_pupil: the stop's image in object space, from the first vertex.
        entrance_pupil_diameter: its diameter A.
        f_number: f / A.
    """

    focal_length: float
    back_focal: float
    front_principal: float
    rear_principal: float
    entrance_pupil: float
    entrance_pupil_diameter: float
    f_number: float


@dataclass(frozen=True, eq=False)
class Lens:
    """Surfaces on one axis, one of them the aperture stop, in air.

    Args:
        surfaces: Front to rear; the medium behind the last one has index 1.
        stop: Index of the surface that is the aperture stop.
        name: Short name.
        source: Origin of the numbers.

    Raises:
        ValueError: If an argument is invalid.

    Reference:
        Kolb, Mitchell, Hanrahan, "A realistic camera model for computer graphics", SIGGRAPH 1995, section 3.1.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> round(lens.paraxial().focal_length, 4), round(lens.paraxial().back_focal, 4)
        (50.3582, 36.1059)
    """

    surfaces: tuple[Surface, ...]
    stop: int
    name: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        """Validates the surfaces and the stop."""
        if not isinstance(self.surfaces, tuple) or not all(isinstance(one, Surface) for one in self.surfaces):
            raise ValueError(f"surfaces must be a tuple of Surface, got {show(self.surfaces)}")
        whole("stop", self.stop, 0, len(self.surfaces) - 1)
        if (index := self.surfaces[-1].glass.index()) != 1.0:
            raise ValueError(f"the index behind the last surface must be 1 (air), got {index:g}")

    @classmethod
    def read(cls, source: str | os.PathLike[str]) -> Lens:
        """Reads a prescription or a Zemax file (.zmx), or an included prescription by name.

        Args:
            source: Path of a file, or a name: ``"double_gauss_50mm"``, ``"wide_22mm"``, ``"telephoto_250mm"``.

        Raises:
            ValueError: If the content is not a prescription; the message contains file, line and column.
            FileNotFoundError: If there is no such file and no included lens of this name.
        """
        if not isinstance(source, str | os.PathLike):
            raise ValueError(f"source must be the name or the path of a prescription, got {show(source)}")
        path = Path(source)
        if not path.suffix and not path.exists():
            path = _SHIPPED / f"{path}.txt"
        if not path.is_file():
            shipped = ", ".join(sorted(p.stem for p in _SHIPPED.glob("*.txt")))
            raise FileNotFoundError(f"no lens {str(source)!r}: neither a file nor one of the shipped ({shipped})")
        try:
            parse = zmx.parse if path.suffix.lower() == ".zmx" else prescription.parse
            surfaces, stop, comment = parse(path.read_bytes())
            return cls(surfaces, stop, path.stem, comment)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @property
    def vertices(self) -> Array:
        """Position of each surface's vertex on the axis ``[S]``; the first is 0."""
        return np.cumsum([0.0, *(surface.thickness for surface in self.surfaces[:-1])])

    @property
    def dispersive(self) -> bool:
        """Whether any glass has different indices for different colours."""
        return bool((self.indices(F_UM) != self.indices(C_UM)).any())

    def indices(self, wavelength_um: float | None = None) -> Array:
        """Refractive indices before the first surface (air) and behind each surface ``[S + 1]``; None is the d line."""
        wavelength_um = D_UM if wavelength_um is None else wavelength_um
        return np.array([1.0, *(surface.glass.index(wavelength_um) for surface in self.surfaces)])

    def paraxial(self, wavelength_um: float | None = None) -> Paraxial:
        """First-order properties, by ray transfer matrices.

        Raises:
            ValueError: If the lens does not converge light.
        """
        n, matrix, to_stop, gap = self.indices(wavelength_um), np.eye(2), np.eye(2), 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            for i, surface in enumerate(self.surfaces):
                matrix = np.array([[1.0, gap], [0.0, 1.0]]) @ matrix
                if i == self.stop:
                    to_stop = matrix
                power = (n[i + 1] - n[i]) * (1.0 / surface.radius + 2.0 * sum(surface.polynomial[:1]))
                matrix = np.array([[1.0, 0.0], [-power / n[i + 1], n[i] / n[i + 1]]]) @ matrix
                gap = surface.thickness
        if not (np.abs(matrix) < _LARGEST).all():
            raise ValueError(f"lens {self.name!r} bends light beyond measure; check its radii and polynomials")
        (a, _), (c, d) = matrix.tolist()
        if not c < -1.0 / _LARGEST:
            raise ValueError(f"lens {self.name!r} must have a positive focal length: it does not converge light")
        if abs(to_stop[0, 0]) < 1.0 / _LARGEST:
            raise ValueError(f"lens {self.name!r} must have its entrance pupil somewhere: its stop is seen at infinity")
        focal, pupil = -1.0 / c, self.surfaces[self.stop].diameter / abs(float(to_stop[0, 0]))
        at = float(to_stop[0, 1] / to_stop[0, 0])
        return Paraxial(focal, a * focal, (1.0 - d) * focal, (a - 1.0) * focal, at, pupil, focal / pupil)

    def with_stop(self, diameter: float) -> Lens:
        """The lens with its stop opened or closed to a diameter in millimetres."""
        changed = [replace(s, diameter=diameter) if i == self.stop else s for i, s in enumerate(self.surfaces)]
        return replace(self, surfaces=tuple(changed))

    def with_f_number(self, f_number: float) -> Lens:
        """The lens stopped down so that its paraxial f-number is ``f_number``.

        The f-number of a lens is rounded. An ``f_number`` up to 3 % below that of the open stop means fully open.

        Raises:
            ValueError: If the lens cannot be opened that far.
        """
        number("f_number", f_number, 0, 1e9)
        open_at = self.paraxial().f_number
        if f_number * _MARKED < open_at:
            raise ValueError(f"f_number must be at least {open_at:.3g} for lens {self.name!r}, got {f_number:g}")
        return self.with_stop(self.surfaces[self.stop].diameter * min(1.0, open_at / f_number))

    def scaled(self, focal_length_mm: float) -> Lens:
        """The lens scaled to another focal length; its f-number is unchanged."""
        factor = number("focal_length_mm", focal_length_mm, 0, 1e9) / self.paraxial().focal_length
        scaled = [
            replace(one, thickness=one.thickness * factor, diameter=one.diameter * factor).bent(factor)
            for one in self.surfaces
        ]
        return replace(self, surfaces=tuple(scaled))

    def turned(self) -> Lens:
        """The lens with front and rear exchanged.

        Example:
            >>> lens = Lens.read("double_gauss_50mm")
            >>> bool(abs(lens.turned().paraxial().focal_length - lens.paraxial().focal_length) < 1e-9)
            True
        """
        ahead = [(AIR, 0.0), *((one.glass, one.thickness) for one in self.surfaces[:-1])]
        turned = [
            replace(one.bent(-1.0), glass=glass, thickness=gap)
            for one, (glass, gap) in zip(self.surfaces, ahead, strict=True)
        ]
        return replace(self, surfaces=tuple(turned[::-1]), stop=len(turned) - 1 - self.stop)

    def lines(self) -> list[str]:
        """The surfaces as lines of a prescription file."""
        return prescription.lines(self.surfaces, self.stop)
