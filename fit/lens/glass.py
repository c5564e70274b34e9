"""Glasses: the refractive index in air at any wavelength.

Glasses of a catalogue have the coefficients of Sellmeier's formula, with the wavelength l in micrometres:

    ``n^2 - 1 = B1 l^2 / (l^2 - C1) + B2 l^2 / (l^2 - C2) + B3 l^2 / (l^2 - C3)``

It reproduces the catalogue's indices to the last digit. Glasses described by a few indices have Cauchy's formula, ``n =
a + b / l^2 + c / l^4``. ``glasses/schott.txt`` is included; its source is stated there.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchdof.validation import number, show

D_UM, F_UM, C_UM, G_UM = 0.58756, 0.48613, 0.65627, 0.43584


@dataclass(frozen=True)
class Glass:
    """A glass, or another medium."""

    name: str  # as in a prescription
    coefficients: tuple[float, ...]  # B1, B2, B3, C1, C2, C3 of Sellmeier's formula, C in um^2; or a, b, c of Cauchy's

    def __post_init__(self) -> None:
        """Raises a `ValueError` unless the coefficients are finite and the index from 1 to 5 between 0.4 and 0.7 um."""
        values = self.coefficients if isinstance(self.coefficients, tuple) else ()
        are_numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        if not are_numbers or len(values) not in (3, 6) or not all(abs(v) <= 1e100 for v in values):
            expected = "six finite coefficients B1 B2 B3 C1 C2 C3"
            raise ValueError(f"glass {self.name} must have {expected}, got {show(self.coefficients)}")
        for wavelength_um in (0.4, D_UM, 0.7):
            self.index(wavelength_um)

    @classmethod
    def of_numbers(cls, index: float, *dispersion: float) -> Glass:
        """A glass from its index n_d at the d line, Abbe number and partial dispersion, as listed in catalogues.

        The Abbe number is ``V = (n_d - 1) / (n_F - n_C)``; without it the index is the same at all wavelengths. The
        partial dispersion is ``P_gF = (n_g - n_F) / (n_F - n_C)``; without it that of a normal glass is assumed.

        Reference:
            SCHOTT, "TIE-29: Refractive index and dispersion", 2016 (the line of normal glasses).
        """
        name = "/".join(f"{value:.9g}" for value in (index, *dispersion))
        abbe = dispersion[0] if dispersion else math.inf
        partial = dispersion[1] if len(dispersion) > 1 else max(0.3, 0.6438 - 0.001682 * min(abbe, 1e3))
        if not (abbe >= 1 and 0 < partial < 1):
            raise ValueError(f"the Abbe number must be at least 1 and P_gF between 0 and 1, got {name}")
        d, f, c, g = (np.array([1.0, line**-2, line**-4]) for line in (D_UM, F_UM, C_UM, G_UM))
        dispersion_FC = (index - 1.0) / abbe
        terms = np.linalg.solve(np.stack([d, f - c, g - f]), [index, dispersion_FC, partial * dispersion_FC])
        return cls(name, tuple(terms.tolist()))

    def index(self, wavelength_um: float = D_UM) -> float:
        """Refractive index in air, from 0.3 to 1.2 micrometres; a `ValueError` if it is not from 1 to 5."""
        square = number("wavelength_um", wavelength_um, low=0.299, high=1.201, unit="micrometres") ** 2
        values = self.coefficients
        if len(values) == 3:
            index = values[0] + values[1] / square + values[2] / square**2
        else:
            terms = (b * square / ((square - c) or 1e-300) for b, c in zip(values[:3], values[3:], strict=True))
            index = max(1.0 + sum(terms), 0.0) ** 0.5
        if not 1.0 <= index < 5.0:
            raise ValueError(f"glass {self.name} has no refractive index from 1 to 5 at {wavelength_um:g} um")
        return index


@functools.cache
def catalogue() -> dict[str, Glass]:
    """The included glasses, those of SCHOTT, by upper-case name."""
    text = (Path(__file__).parent / "glasses" / "schott.txt").read_text(encoding="utf-8")
    lines = filter(None, (line.partition("#")[0].split() for line in text.splitlines()))
    return {name: Glass(name, tuple(map(float, numbers))) for name, *numbers in lines}


AIR = Glass("1", (1.0, 0.0, 0.0))
