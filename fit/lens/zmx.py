"""Lenses from Zemax files (.zmx): the sequential subset that a camera lens is made of.

What is read: the unit, and of each surface the curvature, thickness, clear semi-diameter, glass, conic constant, even
asphere, and which is the stop. The first surface is the object and the last the sensor; flat surfaces between air and
air other than the stop are left out. Glasses are SCHOTT's by name, or else have the index and Abbe number that the file
gives them. Mirrors, tilts, other kinds of surfaces and apertures, and several configurations are refused by name.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from .glass import D_UM, Glass

__all__ = ["parse", "text_of"]

_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
_APERTURES = {"SQAP", "ELAP", "OBSC", "SQOB", "ELOB", "SPID", "UDAD", "UDOB"}
_MOST_POWERS = 8


def text_of(path: Path) -> str:
    """The text of a .zmx file, which is UTF-16 or plain.

    Raises:
        ValueError: If it is neither.
    """
    raw = path.read_bytes()
    return raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")


def parse(text: str) -> tuple[dict[str, Any], int, str]:
    r"""Read the text of a .zmx file.

    Returns:
        The columns of :class:`torchdof.fit.lens.Lens` by name, the number of the stop's surface, and the source.

    Raises:
        ValueError: If it is no sequential lens that this package can trace; the message names the surface.

    Example:
        >>> surface = "SURF {}\n TYPE STANDARD\n CURV {}\n DISZ {}\n DIAM 9\n"
        >>> glass = " GLAS N-BK7 0 0 1.5168 64.17\n STOP\n"
        >>> text = surface.format(0, 0, "INFINITY") + surface.format(1, 0.02, 5) + glass
        >>> columns, stop, _ = parse(text + surface.format(2, -0.02, 95) + surface.format(3, 0, 0))
        >>> columns["radius"].tolist(), columns["thickness"].tolist(), stop
        ([50.0, -50.0], [5.0, 0.0], 0)
    """
    surfaces: list[dict[str, list[str]]] = []
    unit, name = 1.0, ""
    for line in text.splitlines():
        word, *fields = line.split() or [""]
        if word == "SURF":
            surfaces.append({})
        elif word == "MODE" and fields[:1] != ["SEQ"]:
            raise ValueError(f"a sequential lens was expected (MODE SEQ), got {line.strip()!r}")
        elif word == "MNUM" and fields[:1] not in ([], ["0"], ["1"]):
            raise ValueError(f"one configuration was expected, got {fields[0]}; save the one that is wanted alone")
        elif word == "UNIT":
            if not fields or fields[0] not in _UNITS:
                raise ValueError(f"UNIT must be one of {', '.join(_UNITS)}, got {line.strip()!r}")
            unit = _UNITS[fields[0]]
        elif word == "NAME":
            name = " ".join(fields)
        elif surfaces:
            surfaces[-1][f"PARM {fields[0]}" if word == "PARM" and fields else word] = fields
    if len(surfaces) < 3:
        raise ValueError(f"expected an object, surfaces of a lens and an image (SURF), got {len(surfaces)} surfaces")
    rows: list[dict[str, Any]] = []
    before: Glass | tuple[float, float] = (1.0, math.inf)
    for number, surface in enumerate(surfaces[1:-1], start=1):
        row = _row(surface, number, unit)
        flat = math.isinf(row["radius"]) and not any(row["polynomial"])
        if flat and not row["stop"] and before == row["medium"] == (1.0, math.inf):  # no part of the lens
            if rows:
                rows[-1]["thickness"] += row["thickness"]
            continue
        if not row["diameter"] > 0:
            raise ValueError(f"surface {number}: no clear semi-diameter (DIAM); state it in the file")
        rows.append(row)
        before = row["medium"]
    stops = [i for i, row in enumerate(rows) if row["stop"]]
    if len(stops) != 1:
        raise ValueError(f"expected one stop (STOP) among the surfaces of the lens, got {len(stops)}")
    rows[-1]["thickness"] = 0.0
    columns: dict[str, Any] = {
        key: np.array([row[key] for row in rows]) for key in ("radius", "thickness", "diameter", "conic", "polynomial")
    }
    glasses = tuple(row["medium"] if isinstance(row["medium"], Glass) else None for row in rows)
    plain = [(m.index(D_UM), m.abbe) if isinstance(m, Glass) else m for m in (row["medium"] for row in rows)]
    columns["index"], columns["abbe"] = np.array(plain).T
    columns["glass"] = glasses
    return columns, stops[0], f"Zemax file{f': {name}' if name else ''}"


def _row(surface: dict[str, list[str]], number: int, unit: float) -> dict[str, Any]:
    """A surface's numbers in mm, its medium, and whether it is the stop."""
    kind = (surface.get("TYPE") or ["STANDARD"])[0]
    if kind not in ("STANDARD", "EVENASPH"):
        raise ValueError(f"surface {number}: TYPE must be STANDARD or EVENASPH, got {kind}")
    if refused := _APERTURES.intersection(surface):
        raise ValueError(f"surface {number}: only round apertures without obstruction are read, got {min(refused)}")
    curvature = _number(surface, "CURV", 0, number) / unit
    powers = range(1, _MOST_POWERS + 1) if kind == "EVENASPH" else ()
    polynomial = [_number(surface, f"PARM {i}", 1, number) * unit ** (1 - 2 * i) for i in powers]
    aperture = ("CLAP", 1) if "CLAP" in surface else ("DIAM", 0)
    return {
        "radius": 1.0 / curvature if curvature else math.inf,
        "thickness": _number(surface, "DISZ", 0, number) * unit,
        "diameter": 2.0 * _number(surface, *aperture, number) * unit,
        "conic": _number(surface, "CONI", 0, number),
        "polynomial": polynomial + [0.0] * (_MOST_POWERS - len(polynomial)),
        "medium": _medium(surface.get("GLAS", []), number),
        "stop": "STOP" in surface,
    }


def _number(surface: dict[str, list[str]], word: str, place: int, number: int) -> float:
    """A number of a surface by its keyword; 0 where the file has none."""
    fields = surface.get(word, [])
    if len(fields) <= place:
        return 0.0
    try:
        value = float(fields[place])
        if not math.isfinite(value):
            raise ValueError
    except ValueError:
        raise ValueError(f"surface {number}: {word} must be a finite number, got {fields[place]!r}") from None
    return value


def _medium(fields: list[str], number: int) -> Glass | tuple[float, float]:
    """A glass of the catalogue, or index and Abbe number; air without fields."""
    if not fields:
        return 1.0, math.inf
    if fields[0] == "MIRROR":
        raise ValueError(f"surface {number}: mirrors are not traced")
    try:
        return Glass.named(fields[0])
    except ValueError:
        pass
    try:
        index, abbe = float(fields[3]), float(fields[4])
    except (IndexError, ValueError):
        index, abbe = 0.0, 0.0
    if not index > 1.0:
        raise ValueError(
            f"surface {number}: glass {fields[0]} is not in the catalogue of SCHOTT, and the file gives no index and "
            "Abbe number for it (GLAS, fourth and fifth)"
        )
    return index, abbe if abbe > 0 else math.inf
