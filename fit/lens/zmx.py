"""Reads lenses from Zemax files (.zmx): the sequential subset used for camera lenses.

Reads the unit and, for each surface, curvature, thickness, clear semi-diameter, glass, conic constant, even asphere,
and whether it is the stop. The first surface is the object and the last the sensor; flat surfaces in air, except the
stop, are skipped. Glasses are SCHOTT's by name, otherwise they have the file's index and Abbe number. Mirrors, tilts,
other kinds of surfaces and apertures, and several configurations raise errors.
"""

import math
from dataclasses import replace

from .glass import AIR, Glass, catalogue
from .prescription import number_of
from .surface import Surface

_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
_APERTURES = {"SQAP", "ELAP", "OBSC", "SQOB", "ELOB", "SPID", "UDAD", "UDOB"}


def parse(content: bytes) -> tuple[tuple[Surface, ...], int, str]:
    """The surfaces of a .zmx file, UTF-16 or plain, the index of the stop, and the source; an error has the surface."""
    text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    records: list[dict[str, list[str]]] = []
    unit, name = 1.0, ""
    for line in text.splitlines():
        word, *fields = line.split() or [""]
        if word == "SURF":
            records.append({})
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
        elif records:
            records[-1][f"PARM {fields[0]}" if word == "PARM" and fields else word] = fields
    if len(records) < 3:
        raise ValueError(f"expected an object, surfaces of a lens and an image (SURF), got {len(records)} surfaces")
    surfaces: list[Surface] = []
    stops = []
    for surface_number, record in enumerate(records[1:-1], start=1):
        try:
            surface = _surface(record, unit, surfaces[-1].glass if surfaces else AIR)
            if isinstance(surface, Surface):
                stops += [len(surfaces)] * ("STOP" in record)
                surfaces.append(surface)
            elif surfaces:
                surfaces[-1] = replace(surfaces[-1], thickness=surfaces[-1].thickness + surface)
        except ValueError as error:
            raise ValueError(f"surface {surface_number}: {error}") from None
    if len(stops) != 1:
        raise ValueError(f"expected one stop (STOP) among the surfaces of the lens, got {len(stops)}")
    surfaces[-1] = replace(surfaces[-1], thickness=0.0)
    return tuple(surfaces), stops[0], f"Zemax file{f': {name}' if name else ''}"


def _surface(record: dict[str, list[str]], unit: float, medium: Glass) -> Surface | float:
    """A surface behind a medium; for a flat one in air, which is not part of the lens, only its thickness in mm."""

    def number(word: str, index: int = 0) -> float:
        fields = record.get(word, [])
        return number_of(word, fields[index]) if len(fields) > index else 0.0

    kind = (record.get("TYPE") or ["STANDARD"])[0]
    if kind not in ("STANDARD", "EVENASPH"):
        raise ValueError(f"TYPE must be STANDARD or EVENASPH, got {kind}")
    if unsupported := _APERTURES.intersection(record):
        raise ValueError(f"only round apertures without obstruction are read, got {min(unsupported)}")
    curvature, thickness, glass = number("CURV") / unit, number("DISZ") * unit, _glass(record.get("GLAS", []))
    powers = range(1, 9) if kind == "EVENASPH" else ()
    polynomial = tuple(number(f"PARM {i}", 1) * unit ** (1 - 2 * i) for i in powers)
    if medium == glass == AIR and not (curvature or any(polynomial) or "STOP" in record):
        return thickness
    diameter = 2.0 * unit * (number("CLAP", 1) if "CLAP" in record else number("DIAM"))
    if not diameter:
        raise ValueError("no clear semi-diameter (DIAM); state it in the file")
    return Surface(1.0 / curvature if curvature else math.inf, thickness, glass, diameter, number("CONI"), polynomial)


def _glass(fields: list[str]) -> Glass:
    """A glass of the catalogue, or from index and Abbe number; air without fields."""
    if not fields:
        return AIR
    if fields[0] == "MIRROR":
        raise ValueError("mirrors are not traced")
    if fields[0].upper() in catalogue():
        return Glass.named(fields[0])
    try:
        index, abbe = float(fields[3]), float(fields[4])
    except (IndexError, ValueError):
        index, abbe = 0.0, 0.0
    if not index > 1.0:
        missing = "the file gives no index and Abbe number for it (GLAS, fourth and fifth)"
        raise ValueError(f"glass {fields[0]} is not in the catalogue of SCHOTT, and {missing}")
    return Glass.of_numbers(index, *[abbe] * (abbe > 0))
