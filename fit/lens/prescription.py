"""The text of a lens prescription: a table of surfaces, front to rear, one a line.

::

    # source: US patent 2,673,491 (Tronnier)
    # radius  thickness  index  diameter
    29.475    3.76       1.67   25.2
    0         4.5        0      17.1

Millimetres. ``thickness`` is the distance to the next surface, ``index`` the refractive index behind the surface and
``diameter`` the clear diameter. Radius 0 is a flat aperture stop in the medium before it (its index 0), ``inf`` a flat
surface. Behind the columns ``stop`` says that any other surface is the stop, and an even asphere has its conic constant
and polynomial, ``k=-0.6 A4=1.2e-6 A6=-3e-9`` (:mod:`torchdof.fit.lens.surface`).
``1.67/47.1`` is an index at 587.56 nm (the d line) with its Abbe number V, and ``1.67/47.1/0.557`` has its partial
dispersion P_gF too, as glass catalogues list them; without any the glass has the same index at any wavelength. Instead
of an index there may be the name of a glass: one of SCHOTT's (``N-BK7``), or one that a line before it defines by its
coefficients of Sellmeier's formula, ``glass NAME B1 B2 B3 C1 C2 C3``. ``#`` starts a comment; ``# source:`` is kept.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..result import Array
from .glass import D_UM, Glass

__all__ = ["COLUMNS", "fault", "lines", "parse"]

COLUMNS = ("radius", "thickness", "index", "diameter")
"""The columns of a line."""

_SMALLEST_MM, _LARGEST_MM = 1e-3, 1e7
_MOST_SURFACES = 1000
_POWERS = tuple(range(2, 18, 2))  # of a polynomial


def parse(text: str) -> tuple[dict[str, Any], int, str]:
    r"""Read the text of a prescription.

    Returns:
        The columns by name (``radius``, ``thickness``, ``index``, ``abbe``, ``partial``, ``diameter``, ``conic``,
        ``polynomial``, ``glass``), the number of the stop's surface, and the source.

    Raises:
        ValueError: If it is not a prescription; the message names line and column.

    Example:
        >>> columns, stop, _ = parse("50 5 1.5/64 20 \n 0 1 0 18 \n -50 0 1 20")
        >>> columns["abbe"].tolist(), stop
        ([64.0, 64.0, inf], 1)
    """
    rows: list[list[float]] = []
    shapes: list[list[float]] = []
    glasses: list[Glass | None] = []
    defined: dict[str, Glass] = {}
    stop, source = None, ""
    for number, line in enumerate(text.splitlines(), start=1):
        content, _, comment = line.partition("#")
        if comment.strip().startswith("source:"):
            source = comment.split(":", 1)[1].strip()
        fields = content.split()
        if not fields:
            continue
        if fields[0] == "glass":
            glass = _defined(fields[1:], number)
            defined[glass.name] = glass
            continue
        if len(fields) < len(COLUMNS):
            raise ValueError(f"line {number}: expected the columns {' '.join(COLUMNS)}, got {len(fields)}: {line!r}")
        medium = _glass(fields[2], defined, number)
        if medium is not None:
            fields[2] = f"{medium.index(D_UM)!r}/{medium.abbe!r}/{medium.partial!r}"
        row = [_number(text, column, number) for text, column in zip(fields, COLUMNS, strict=False)]
        words = fields[len(COLUMNS) :]
        is_stop = "stop" in words
        shapes.append(_shape([word for word in words if word != "stop"], number))
        radius, thickness, (index, abbe, partial), diameter = row[0][0], row[1][0], row[2], row[3][0]
        before = rows[-1][2:5] if rows else [1.0, math.inf, math.nan]
        if (is_stop or radius == 0.0) and stop is not None:
            raise ValueError(f"line {number}, column radius: a second stop (radius 0, or stop); write inf for flat")
        if radius == 0.0:
            if index not in (0.0, before[0]):
                raise ValueError(f"line {number}, column index: the stop does not change the index, write 0")
            is_stop, radius, (index, abbe, partial) = True, math.inf, before
            medium = glasses[-1] if glasses else None
        stop = len(rows) if is_stop else stop
        for column, value in zip(COLUMNS, (radius, thickness, index, diameter), strict=True):
            if problem := fault(column, value):
                raise ValueError(f"line {number}, column {column}: {problem}")
        if len(rows) == _MOST_SURFACES:
            raise ValueError(f"line {number}: a lens has at most {_MOST_SURFACES} surfaces")
        rows.append([radius, thickness, index, abbe, partial, diameter])
        glasses.append(medium)
    if stop is None:
        raise ValueError(f"no aperture stop among {len(rows)} surfaces; one line must have radius 0, or end in stop")
    names = ("radius", "thickness", "index", "abbe", "partial", "diameter")
    columns: dict[str, Any] = {
        name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    columns["conic"], polynomial = np.array(shapes)[:, 0], np.array(shapes)[:, 1:]
    used = np.flatnonzero(polynomial.any(0))
    columns["polynomial"] = polynomial[:, : used[-1] + 1 if len(used) else 0]
    columns["glass"] = tuple(glasses)
    return columns, stop, source


def lines(
    radius: Array,
    thickness: Array,
    index: Array,
    abbe: Array,
    partial: Array,
    diameter: Array,
    conic: Array,
    polynomial: Array,
    glasses: tuple[Glass | None, ...],
    stop: int,
) -> list[str]:
    """Surfaces as lines of a prescription, the inverse of :func:`parse`."""
    own = {glass.name: glass for glass in glasses if glass is not None and not _is_in_catalogue(glass)}
    written = [" ".join(["glass", name, *(f"{b!r}" for b in glass.sellmeier)]) for name, glass in own.items()]
    for i, row in enumerate(zip(radius, thickness, index, abbe, partial, diameter, strict=True)):
        medium = glasses[i]
        glass = f"{row[2]:.9g}/{row[3]:.9g}" if math.isfinite(row[3]) else f"{row[2]:.9g}"
        glass += f"/{row[4]:.9g}" if math.isfinite(row[3]) and math.isfinite(row[4]) else ""
        glass = glass if medium is None else medium.name
        curve, words = f"{row[0]:.9g}", [f"k={conic[i]:.9g}"] if conic[i] else []
        words += [f"A{power}={a:.9g}" for power, a in zip(_POWERS, polynomial[i], strict=False) if a]
        if i == stop:
            before = (index[i - 1], abbe[i - 1]) if i else (1.0, math.inf)
            if not words and math.isinf(row[0]) and before == (row[2], row[3]):
                curve, glass = "0", "0"
            else:
                words.append("stop")
        written.append(" ".join([curve, f"{row[1]:.9g}", glass, f"{row[5]:.9g}", *words]))
    return written


def _defined(fields: list[str], line: int) -> Glass:
    """The glass that a line defines."""
    try:
        name, *numbers = fields
        b1, b2, b3, c1, c2, c3 = map(float, numbers)
    except ValueError:
        raise ValueError(f"line {line}: expected glass NAME B1 B2 B3 C1 C2 C3, got {' '.join(fields)!r}") from None
    try:
        return Glass(name, (b1, b2, b3, c1, c2, c3))
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from None


def _glass(text: str, defined: dict[str, Glass], line: int) -> Glass | None:
    """The glass of a name; None for what is a number."""
    if text in defined:
        return defined[text]
    if not text[0].isalpha() or text.lower() in ("inf", "nan"):
        return None
    try:
        return Glass.named(text)
    except ValueError as error:
        raise ValueError(f"line {line}, column index: {error}") from None


def _is_in_catalogue(glass: Glass) -> bool:
    try:
        return Glass.named(glass.name) == glass
    except ValueError:
        return False


def _shape(words: list[str], line: int) -> list[float]:
    """Conic constant and polynomial of a surface, from what stands behind its columns."""
    names = ("k", *(f"A{power}" for power in _POWERS))
    shape = dict.fromkeys(names, 0.0)
    for word in words:
        name, _, text = word.partition("=")
        try:
            if name not in names:
                raise ValueError
            shape[name] = float(text)
        except ValueError:
            raise ValueError(
                f"line {line}: behind the columns expected stop, k=NUMBER or A2=NUMBER to A{_POWERS[-1]}=NUMBER, "
                f"got {word!r}"
            ) from None
        if not math.isfinite(shape[name]):
            raise ValueError(f"line {line}: {name} must be finite, got {text!r}")
    return list(shape.values())


def _number(text: str, column: str, line: int) -> tuple[float, float, float]:
    """A field's number, and for an index its Abbe number (inf without one) and partial dispersion (NaN without one)."""
    value, *dispersion = text.split("/")
    try:
        if len(dispersion) > (2 if column == "index" else 0):
            raise ValueError
        number = float(value)
        abbe = float(dispersion[0]) if dispersion else math.inf
        partial = float(dispersion[1]) if len(dispersion) == 2 else math.nan
    except ValueError:
        kind = "a number, index/V, index/V/P_gF or a glass" if column == "index" else "a number"
        raise ValueError(f"line {line}, column {column}: expected {kind}, got {text!r}") from None
    if problem := fault("abbe", abbe):
        raise ValueError(f"line {line}, column {column}: {problem}")
    if len(dispersion) == 2 and not 0 < partial < 1:
        raise ValueError(f"line {line}, column {column}: P_gF must be between 0 and 1, got {partial:g}")
    return number, abbe, partial


def fault(column: str, value: float) -> str:
    """What is wrong with a number of a column, or nothing."""
    if column == "radius" and not (abs(value) == math.inf or _SMALLEST_MM <= abs(value) <= _LARGEST_MM):
        return f"radius must be a number other than 0, {_SMALLEST_MM:g} to {_LARGEST_MM:g} mm or inf, got {value:g}"
    if column == "thickness" and not 0 <= value <= _LARGEST_MM:
        return f"thickness must be >= 0 and finite, at most {_LARGEST_MM:g} mm, got {value:g}"
    if column == "index" and not 1 <= value < 5:
        return f"index must be between 1 and 5 (0 at the stop only), got {value:g}"
    if column == "abbe" and not value >= 1:
        return f"the Abbe number must be positive, at least 1, got {value:g}"
    if column == "diameter" and not _SMALLEST_MM <= value <= _LARGEST_MM:
        return f"diameter must be positive and finite, {_SMALLEST_MM:g} to {_LARGEST_MM:g} mm, got {value:g}"
    return ""
