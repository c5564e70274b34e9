"""Lens prescriptions: the list of surfaces a lens is made of, and what first-order optics says about it.

Light travels to the right, along +z; z = 0 at the first surface's vertex. A positive radius is convex to the object.
Lengths are in millimetres. :mod:`torchdof.fit.lens.prescription` describes the file format.
"""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchdof.validation import show

from ..result import Array
from . import prescription, zmx
from .glass import C_UM, D_UM, F_UM, G_UM, Glass
from .surface import Shape

__all__ = ["RGB_UM", "Lens", "Paraxial"]


RGB_UM = (C_UM, 0.54607, F_UM)
"""Wavelengths that stand for red, green and blue, in micrometres: the lines C, e and F."""

_SHIPPED = Path(__file__).parent / "lenses"
_NORMAL = 0.6438, -0.001682  # P_gF of normal glasses at V = 0, and its slope
_LARGEST = 1e12  # mm, of focal lengths and what else first-order optics tells of a lens
_MOST_CONIC, _DEEPEST_MM = 1e6, 1e15  # of a surface's shape
_MARKED = 1.03  # a lens is sold by a rounded f-number: f/2.03 is marked f/2


@dataclass(frozen=True)
class Paraxial:
    """First-order properties of a lens in air, object at infinity. Millimetres; positions along +z.

    Attributes:
        focal_length: rear focal length f.
        back_focal: rear focal point, from the last vertex (the back focal distance).
        front_focal: front focal point, from the first vertex (negative in front of it).
        front_principal: front principal plane H, from the first vertex. A thin lens's object distances start here.
        rear_principal: rear principal plane H', from the last vertex. A thin lens's image distances start here.
        entrance_pupil: the stop's image in object space, from the first vertex.
        entrance_pupil_diameter: its diameter A.
        exit_pupil: the stop's image in image space, from the last vertex; ``inf`` for a telecentric lens.
        exit_pupil_diameter: its diameter.
        f_number: f / A.
    """

    focal_length: float
    back_focal: float
    front_focal: float
    front_principal: float
    rear_principal: float
    entrance_pupil: float
    entrance_pupil_diameter: float
    exit_pupil: float
    exit_pupil_diameter: float
    f_number: float


@dataclass(frozen=True, eq=False)
class Lens:
    """Surfaces on one axis, spheres or even aspheres, one of them the aperture stop, in air.

    Args:
        radius: Radii of curvature at the vertex ``[S]``, ``inf`` for a flat surface.
        thickness: Distance from each surface to the next ``[S]``, >= 0; the last is not used.
        index: Refractive index behind each surface at the d line ``[S]``, >= 1; 1 behind the last.
        abbe: Abbe number V of the medium behind each surface ``[S]``, ``inf`` where there is no dispersion.
        diameter: Clear diameter of each surface ``[S]``, > 0.
        stop: Number of the surface that is the aperture stop.
        name: Short name.
        source: Where the numbers are from.
        partial: Partial dispersion P_gF of the medium behind each surface ``[S]``, as in glass catalogues; NaN, and
            None for all, takes that of a normal glass with its Abbe number.
        conic: Conic constant of each surface ``[S]``, see :mod:`torchdof.fit.lens.surface`; None is 0 for all: spheres.
        polynomial: Coefficients ``A_2, A_4, ...`` of each surface ``[S, K]`` in powers of millimetres, see there; None
            is none.
        glass: The glass behind each surface, None where there is none: one ``Glass`` or None a surface. Where there is
            one, ``index``, ``abbe`` and ``partial`` are its own, whatever was given. None is none at all.

    Raises:
        ValueError: If a number is outside its range.

    Reference:
        Kolb, Mitchell, Hanrahan, "A realistic camera model for computer graphics", SIGGRAPH 1995, section 3.1.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> round(lens.paraxial().focal_length, 4), round(lens.paraxial().back_focal, 4)
        (50.3582, 36.1059)
    """

    radius: Array
    thickness: Array
    index: Array
    abbe: Array
    diameter: Array
    stop: int
    name: str = ""
    source: str = ""
    partial: Array | None = None
    conic: Array | None = None
    polynomial: Array | None = None
    glass: tuple[Glass | None, ...] | None = None

    def __post_init__(self) -> None:
        """Check the numbers, so that whatever is computed later is about a lens."""
        glasses = [None] * np.size(self.radius) if self.glass is None else list(self.glass)
        if len(glasses) != np.size(self.radius) or not all(isinstance(one, Glass | None) for one in glasses):
            raise ValueError(f"glass must hold one Glass or None a surface, got {show(self.glass)}")
        object.__setattr__(self, "glass", tuple(glasses))
        columns = {name: getattr(self, name) for name in (*prescription.COLUMNS, "abbe")}
        for name, value in columns.items():
            try:
                array = np.asarray(value)
                if array.dtype.kind not in "iuf":
                    raise TypeError
                array = array.astype(np.float64)
            except (TypeError, ValueError, OverflowError):
                raise ValueError(f"{name} must hold one number a surface, got {show(value)}") from None
            if array.ndim != 1 or array.shape != np.shape(self.radius):
                raise ValueError(f"{name} must hold one number a surface, got shape {list(array.shape)}")
            object.__setattr__(self, name, array)
        partial = np.full(self.radius.shape, np.nan) if self.partial is None else np.asarray(self.partial, np.float64)
        if partial.shape != self.radius.shape or not np.all(np.isnan(partial) | ((partial > 0) & (partial < 1))):
            raise ValueError(f"partial must hold one number a surface, 0 to 1 or NaN, got {show(self.partial)}")
        partial = partial.copy()
        for i, glass in enumerate(glasses):
            if glass is not None:
                self.index[i], self.abbe[i], partial[i] = glass.index(D_UM), glass.abbe, glass.partial
        object.__setattr__(self, "partial", partial)
        for name, given in (("conic", self.conic), ("polynomial", self.polynomial)):
            shape = self.radius.shape if name == "conic" else (*self.radius.shape, 0)
            array = np.zeros(shape) if given is None else np.asarray(given, np.float64)
            if array.ndim != len(shape) or len(array) != len(self.radius) or not np.isfinite(array).all():
                wanted = "one number" if name == "conic" else "as many numbers"
                raise ValueError(f"{name} must hold {wanted} for each surface, all finite, got {show(given)}")
            object.__setattr__(self, name, array)
        if isinstance(self.stop, bool) or not isinstance(self.stop, int) or not 0 <= self.stop < len(self.radius):
            raise ValueError(
                f"stop must be the number of a surface (0 to {len(self.radius) - 1}), got {show(self.stop)}"
            )
        for i in range(len(self.radius)):
            for name, value in columns.items():
                if problem := prescription.fault(name, float(value[i])):
                    raise ValueError(f"surface {i}: {problem}")
            self._check_shape(i)
        if self.index[-1] != 1.0:
            raise ValueError(f"the index behind the last surface must be 1 (air), got {self.index[-1]:g}")

    def _check_shape(self, surface: int) -> None:
        """Refuse a shape that no lens has: rays would meet it at lengths beyond what numbers hold."""
        shape, rim = self.shape(surface), self.diameter[surface] / 2
        if abs(shape.conic) > _MOST_CONIC:
            raise ValueError(f"surface {surface}: the conic constant must be within 1e6, got {shape.conic:g}")
        for i, coefficient in enumerate(shape.polynomial):
            if abs(coefficient) > _DEEPEST_MM / rim ** (2 * i + 2):
                raise ValueError(
                    f"surface {surface}: A{2 * i + 2} must bend it by less than {_DEEPEST_MM:g} mm up to its rim at "
                    f"{rim:g} mm, got {coefficient:g}"
                )

    @classmethod
    def read(cls, source: str | os.PathLike[str]) -> Lens:
        """Read a prescription or a Zemax file (.zmx), or a shipped prescription by its name.

        Args:
            source: Path of a file, or a name: ``"double_gauss_50mm"``, ``"wide_22mm"``, ``"telephoto_250mm"``.

        Raises:
            ValueError: If the content is not a prescription; the message names file, line and column.
            FileNotFoundError: If there is neither such a file nor such a shipped lens.
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
            if path.suffix.lower() == ".zmx":
                columns, stop, comment = zmx.parse(zmx.text_of(path))
            else:
                columns, stop, comment = prescription.parse(path.read_text(encoding="utf-8"))
            return cls(**columns, stop=stop, name=path.stem, source=comment)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @property
    def vertices(self) -> Array:
        """Position of each surface's vertex on the axis ``[S]``; the first is 0."""
        return np.concatenate([[0.0], np.cumsum(self.thickness[:-1])])

    def shape(self, surface: int) -> Shape:
        """What a surface, by its number, looks like."""
        coefficients = tuple(float(a) for a in self.polynomial[surface])  # type: ignore[index]
        return Shape(1.0 / float(self.radius[surface]), float(self.conic[surface]), coefficients)  # type: ignore[index]

    @property
    def dispersive(self) -> bool:
        """Whether any glass has an Abbe number."""
        return bool(np.isfinite(self.abbe).any())

    def indices(self, wavelength_um: float | None = None) -> Array:
        """Refractive indices along the light's way ``[S + 1]``: before the first surface (air), then behind each.

        Sellmeier's formula for a :class:`torchdof.fit.lens.glass.Glass`. For other media Cauchy's three terms,
        ``n = a + b / wavelength^2 + c / wavelength^4``, through the index at d, of the dispersion
        ``n_F - n_C = (n_d - 1) / V`` and the partial dispersion ``n_g - n_F = P_gF (n_F - n_C)``. Where P_gF is not
        stated that of a normal glass is taken, ``0.6438 - 0.001682 V``. None is the d line.

        Reference:
            SCHOTT, "TIE-29: Refractive index and dispersion", 2016 (the line of normal glasses).
        """
        index = self.index
        if wavelength_um is not None:
            if not 0.3 <= wavelength_um <= 1.2:
                raise ValueError(f"wavelength_um must be in micrometres, 0.3 to 1.2, got {wavelength_um}")
            normal = _NORMAL[0] + _NORMAL[1] * np.where(np.isfinite(self.abbe), self.abbe, 0.0)
            partial = np.where(np.isnan(self.partial), normal, self.partial)  # type: ignore[arg-type]
            # powers of 1 / wavelength^2: between C and F, between F and g, and from d to here
            across, beyond, here = (
                np.array([a**-2 - b**-2, a**-4 - b**-4]) for a, b in ((F_UM, C_UM), (G_UM, F_UM), (wavelength_um, D_UM))
            )
            share = np.linalg.solve(np.stack([across, beyond]), np.stack([np.ones_like(partial), partial]))
            index = index + (index - 1.0) / self.abbe * (here @ share)
            for i, glass in enumerate(self.glass or ()):
                if glass is not None:
                    index[i] = glass.index(wavelength_um)
        return np.concatenate([[1.0], index])

    def matrix(self, first: int, last: int, wavelength_um: float | None = None) -> Array:
        """Ray matrix ``[2, 2]`` on (height, angle) from just before surface ``first`` to just behind ``last - 1``."""
        n = self.indices(wavelength_um)
        matrix = np.eye(2)
        with np.errstate(over="ignore", invalid="ignore"):
            for i in range(first, last):
                if i > first:
                    matrix = np.array([[1.0, self.thickness[i - 1]], [0.0, 1.0]]) @ matrix
                shape = self.shape(i)
                power = (n[i + 1] - n[i]) * (shape.curvature + 2.0 * sum(shape.polynomial[:1]))
                matrix = np.array([[1.0, 0.0], [-power / n[i + 1], n[i] / n[i + 1]]]) @ matrix
        if not (np.abs(matrix) < _LARGEST).all():
            raise ValueError(f"lens {self.name!r} bends light beyond measure; check its radii and polynomials")
        return matrix

    def paraxial(self, wavelength_um: float | None = None) -> Paraxial:
        """First-order properties.

        Raises:
            ValueError: If the lens does not converge light.
        """
        last = len(self.radius)
        a, _, c, d = self.matrix(0, last, wavelength_um).ravel()
        if not c < -1.0 / _LARGEST:
            raise ValueError(f"lens {self.name!r} must have a positive focal length: it does not converge light")
        focal = -1.0 / c
        front = self.matrix(0, self.stop, wavelength_um)  # to the stop
        if self.stop > 0:
            front = np.array([[1.0, self.thickness[self.stop - 1]], [0.0, 1.0]]) @ front
        rear = self.matrix(self.stop, last, wavelength_um)
        aperture = self.diameter[self.stop]
        if abs(front[0, 0]) < 1.0 / _LARGEST:
            raise ValueError(f"lens {self.name!r} must have its entrance pupil somewhere: its stop is seen at infinity")
        entrance = aperture / abs(front[0, 0])
        # an image of the stop's centre: height 0 at the stop, whatever the angle
        exit_at = -rear[0, 1] / rear[1, 1] if rear[1, 1] else math.inf
        exit_diameter = abs(rear[0, 0] + exit_at * rear[1, 0]) * aperture if math.isfinite(exit_at) else math.inf
        return Paraxial(
            focal_length=float(focal),
            back_focal=float(a * focal),
            front_focal=float(-d * focal),
            front_principal=float((1.0 - d) * focal),
            rear_principal=float((a - 1.0) * focal),
            entrance_pupil=float(front[0, 1] / front[0, 0]),
            entrance_pupil_diameter=float(entrance),
            exit_pupil=float(exit_at),
            exit_pupil_diameter=float(exit_diameter),
            f_number=float(focal / entrance),
        )

    def with_stop(self, diameter: float) -> Lens:
        """The lens with its stop opened or closed to a diameter in millimetres."""
        changed = self.diameter.copy()
        changed[self.stop] = diameter
        return dataclasses.replace(self, diameter=changed)

    def with_f_number(self, f_number: float) -> Lens:
        """The lens stopped down so that its paraxial f-number is ``f_number``.

        A lens is sold by a rounded f-number. An ``f_number`` up to 3 % below that of the open stop means fully open.

        Raises:
            ValueError: If the lens cannot be opened that far.
        """
        _check_positive("f_number", f_number)
        open_at = self.paraxial().f_number
        if f_number * _MARKED < open_at:
            raise ValueError(f"f_number must be at least {open_at:.3g} for lens {self.name!r}, got {f_number:g}")
        return self.with_stop(self.diameter[self.stop] * min(1.0, open_at / f_number))

    def scaled(self, focal_length_mm: float) -> Lens:
        """The lens enlarged or shrunk as a whole to another focal length; its f-number stays."""
        _check_positive("focal_length_mm", focal_length_mm)
        factor = focal_length_mm / self.paraxial().focal_length
        lengths = {name: getattr(self, name) * factor for name in ("radius", "thickness", "diameter")}
        powers = 2.0 * np.arange(self.polynomial.shape[1]) + 1.0  # type: ignore[union-attr]
        return dataclasses.replace(self, **lengths, polynomial=self.polynomial / factor**powers)  # type: ignore[operator]

    def lines(self) -> list[str]:
        """The surfaces as lines of a prescription file."""
        columns = (self.radius, self.thickness, self.index, self.abbe, self.partial, self.diameter)
        shape = self.conic, self.polynomial, self.glass
        return prescription.lines(*columns, *shape, self.stop)  # type: ignore[arg-type]


def _check_positive(name: str, value: float) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1e-9 < value < 1e9:
        raise ValueError(f"{name} must be positive and finite (below 1e9), got {show(value)}")
