"""Glasses: refractive index at any wavelength, by Sellmeier's formula with a catalogue's coefficients.

    ``n^2 - 1 = B1 l^2 / (l^2 - C1) + B2 l^2 / (l^2 - C2) + B3 l^2 / (l^2 - C3)``

with the wavelength ``l`` in micrometres. It holds a catalogue's indices to their last digit, the secondary spectrum
included, which an Abbe number leaves out. What ships is ``glasses/schott.txt``; its source is said there.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

from torchdof.validation import number, show

__all__ = ["C_UM", "D_UM", "F_UM", "G_UM", "Glass"]

D_UM, F_UM, C_UM, G_UM = 0.58756, 0.48613, 0.65627, 0.43584
_LARGEST = 1e100  # coefficient, whose products are numbers too
_CATALOGUE = Path(__file__).parent / "glasses" / "schott.txt"


@dataclass(frozen=True)
class Glass:
    """A glass.

    Args:
        name: As its maker calls it.
        sellmeier: ``B1, B2, B3, C1, C2, C3``; the C in square micrometres.

    Raises:
        ValueError: If these are not six finite numbers that make an index from 1 to 5 between 0.4 and 0.7 um.

    Example:
        >>> glass = Glass.named("N-BK7")
        >>> round(glass.index(0.58756), 5), round(glass.abbe, 2)
        (1.5168, 64.17)
    """

    name: str
    sellmeier: tuple[float, float, float, float, float, float]

    def __post_init__(self) -> None:
        """Check that it is a glass."""
        given = self.sellmeier
        plain = isinstance(given, tuple) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in given)
        if not plain or len(given) != 6 or not all(abs(value) <= _LARGEST for value in given):
            raise ValueError(
                f"glass {self.name} must have six finite coefficients B1 B2 B3 C1 C2 C3, got {show(given)}"
            )
        for wavelength_um in (0.4, D_UM, 0.7):
            self.index(wavelength_um)

    @classmethod
    def named(cls, name: str) -> Glass:
        """A glass of the catalogue.

        Raises:
            ValueError: If there is none of that name; the message says how to state it.
        """
        if not isinstance(name, str) or name.upper() not in _catalogue():
            raise ValueError(
                f"no glass {show(name)} in the catalogue of SCHOTT; define it by a line "
                f"`glass {name} B1 B2 B3 C1 C2 C3` (Sellmeier, micrometres), or write index/V or index/V/P_gF instead"
            )
        return _catalogue()[name.upper()]

    def index(self, wavelength_um: float) -> float:
        """Refractive index in air.

        Raises:
            ValueError: If the formula gives none from 1 to 5 there: the wavelength is beyond what the glass lets pass.
        """
        square = number("wavelength_um", wavelength_um, low=0.0, high=1e3, unit="micrometres") ** 2
        poles, b = self.sellmeier[3:], self.sellmeier[:3]
        terms = [b_i * square / (square - c_i) for b_i, c_i in zip(b, poles, strict=True) if square != c_i]
        if len(terms) < 3 or not 1.0 <= 1.0 + sum(terms) < 25.0:
            raise ValueError(f"glass {self.name} has no refractive index from 1 to 5 at {wavelength_um:g} um")
        return math.sqrt(1.0 + sum(terms))

    @property
    def abbe(self) -> float:
        """Abbe number V, ``(n_d - 1) / (n_F - n_C)``; ``inf`` without dispersion."""
        across = self.index(F_UM) - self.index(C_UM)
        return (self.index(D_UM) - 1.0) / across if across else math.inf

    @property
    def partial(self) -> float:
        """Partial dispersion P_gF, ``(n_g - n_F) / (n_F - n_C)``; NaN without dispersion."""
        across = self.index(F_UM) - self.index(C_UM)
        return (self.index(G_UM) - self.index(F_UM)) / across if across else math.nan


@functools.cache
def _catalogue() -> dict[str, Glass]:
    glasses = {}
    for line in _CATALOGUE.read_text(encoding="utf-8").splitlines():
        name, *numbers = line.partition("#")[0].split() or [""]
        if name:
            b1, b2, b3, c1, c2, c3 = map(float, numbers)
            glasses[name] = Glass(name, (b1, b2, b3, c1, c2, c3))
    return glasses
