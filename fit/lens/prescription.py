"""The files of lenses: prescriptions, which are tables of surfaces from front to rear, and Zemax files.

A prescription has one surface on each line::

    # source: US patent 2,673,491 (Tronnier)
    # radius  thickness  index  diameter
    29.475    3.76       1.67   25.2
    0         4.5        0      17.1

Lengths are in millimetres. ``thickness`` is the distance to the next surface, ``index`` the refractive index behind the
surface and ``diameter`` the clear diameter. Radius 0 is a flat aperture stop in the medium before it (its index is 0),
``inf`` a flat surface. After the columns, ``stop`` makes any other surface the stop, and an even asphere has its conic
constant and polynomial, ``k=-0.6 A4=1.2e-6 A6=-3e-9`` (:mod:`torchdof.fit.lens.surface`).
``1.67/47.1`` is an index at 587.56 nm (the d line) with its Abbe number V, and ``1.67/47.1/0.557`` also has its partial
dispersion P_gF, as listed in glass catalogues; an index alone is the same at any wavelength. Instead of an index there
may be the name of a glass: one of SCHOTT's (``N-BK7``), or one defined on an earlier line by its coefficients of
Sellmeier's formula, ``glass NAME B1 B2 B3 C1 C2 C3``. ``#`` starts a comment; ``# source:`` is kept.

Of a Zemax file (.zmx) the unit is read and, for each surface, curvature, thickness, clear semi-diameter, glass, conic
constant, even asphere, and whether it is the stop. The first surface is the object and the last the sensor; flat
surfaces in air, except the stop, are skipped. Glasses are SCHOTT's by name, otherwise they have the file's index and
Abbe number. Mirrors, tilts, other surfaces and apertures, and several configurations raise errors.
"""

import math
from dataclasses import replace

from .glass import AIR, Glass, catalogue
from .surface import Surface

_COLUMNS = ("radius", "thickness", "index", "diameter")
_MAX_SURFACES = 1000
SHAPE = ("k", *(f"A{power}" for power in range(2, 18, 2)))
_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
_APERTURES = {"SQAP", "ELAP", "OBSC", "SQOB", "ELOB", "SPID", "UDAD", "UDOB"}


def parse(content: bytes) -> tuple[tuple[Surface, ...], int, str]:
    """The surfaces of a prescription, the index of the stop, and the source; an error has line and column."""
    surfaces: list[Surface] = []
    defined: dict[str, Glass] = {}
    stop, source = None, ""
    for line_number, line in enumerate(content.decode("utf-8").splitlines(), start=1):
        text, _, comment = line.partition("#")
        if comment.strip().startswith("source:"):
            source = comment.split(":", 1)[1].strip()
        words = text.split()
        try:
            if words[:1] == ["glass"]:
                if len(words) != 8 or not words[1][0].isalpha():
                    raise ValueError(f"expected glass NAME B1 B2 B3 C1 C2 C3, got {' '.join(words[1:])!r}")
                defined[words[1]] = Glass(words[1], tuple(_number(f"glass {words[1]}", text) for text in words[2:]))
            elif words:
                surface, is_stop = _surface(words, surfaces[-1].glass if surfaces else AIR, defined)
                if is_stop and stop is not None:
                    raise ValueError("radius: a second stop (radius 0, or stop); write inf for flat")
                if len(surfaces) == _MAX_SURFACES:
                    raise ValueError(f"a lens has at most {_MAX_SURFACES} surfaces")
                stop = len(surfaces) if is_stop else stop
                surfaces.append(surface)
        except ValueError as error:
            raise ValueError(f"line {line_number}: {error}") from None
    if stop is None:
        raise ValueError(f"no aperture stop among {len(surfaces)} surfaces; one line must have radius 0 or end in stop")
    return tuple(surfaces), stop, source


def _surface(words: list[str], medium: Glass, defined: dict[str, Glass]) -> tuple[Surface, bool]:
    """The surface on a line, behind a medium, and whether it is the stop."""
    if len(words) < 4:
        raise ValueError(f"expected the columns {' '.join(_COLUMNS)}, got {len(words)}: {' '.join(words)!r}")
    radius, thickness, diameter = (_number(_COLUMNS[i], words[i]) for i in (0, 1, 3))
    is_stop, shape, index = "stop" in words[4:], dict.fromkeys(SHAPE, 0.0), words[2]
    for word in words[4:]:
        name, _, text = word.partition("=")
        if name in shape:
            shape[name] = _number(name, text)
        elif word != "stop":
            raise ValueError(f"behind the columns expected stop, k=NUMBER or A2=NUMBER to A16=NUMBER, got {word!r}")
    if radius == 0.0 and index == "0":
        glass = medium
    elif index in defined:
        glass = defined[index]
    elif index[0].isalpha() and index.lower() not in ("inf", "nan"):
        glass = Glass.named(index)
    elif len(numbers := [_number("index", part) for part in index.split("/")]) <= 3:
        glass = Glass.of_numbers(*numbers)
    else:
        raise ValueError(f"index: expected a number, index/V, index/V/P_gF or a glass, got {index!r}")
    if radius == 0.0:
        if glass.index() != medium.index():
            raise ValueError("index: the stop does not change the index, write 0")
        radius, glass, is_stop = math.inf, medium, True
    conic, *polynomial = shape.values()
    return Surface(radius, thickness, glass, diameter, conic, tuple(polynomial) * any(polynomial)), is_stop


def _number(name: str, text: str) -> float:
    """The number that a text states; the error has its name."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{name}: expected a number, got {text!r}") from None


def parse_zemax(content: bytes) -> tuple[tuple[Surface, ...], int, str]:
    """The surfaces of a .zmx file, UTF-16 or plain, the index of the stop, and the source; an error has the surface."""
    text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    records: list[dict[str, list[str]]] = []
    unit, name = "MM", ""
    for line in text.splitlines():
        word, *fields = line.split() or [""]
        if word == "SURF":
            records.append({})
        elif word == "MODE" and fields[:1] != ["SEQ"]:
            raise ValueError(f"a sequential lens was expected (MODE SEQ), got {line.strip()!r}")
        elif word == "MNUM" and fields[:1] not in ([], ["0"], ["1"]):
            raise ValueError(f"one configuration was expected, got {fields[0]}; save the one that is wanted alone")
        elif word == "UNIT":
            unit = " ".join(fields[:1])
        elif word == "NAME":
            name = " ".join(fields)
        elif records:
            records[-1][f"PARM {fields[0]}" if word == "PARM" and fields else word] = fields
    if unit not in _UNITS:
        raise ValueError(f"UNIT must be one of {', '.join(_UNITS)}, got {unit!r}")
    if len(records) < 3:
        raise ValueError(f"expected an object, surfaces of a lens and an image (SURF), got {len(records)} surfaces")
    surfaces: list[Surface] = []
    stops = []
    for surface_number, record in enumerate(records[1:-1], start=1):
        try:
            surface = _zemax_surface(record, _UNITS[unit], surfaces[-1].glass if surfaces else AIR)
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


def _zemax_surface(record: dict[str, list[str]], unit: float, medium: Glass) -> Surface | float:
    """A surface behind a medium; for a flat one in air, which is not part of the lens, only its thickness in mm."""

    def number(word: str, index: int = 0) -> float:
        fields = record.get(word, [])
        return _number(word, fields[index]) if len(fields) > index else 0.0

    kind = (record.get("TYPE") or ["STANDARD"])[0]
    if kind not in ("STANDARD", "EVENASPH"):
        raise ValueError(f"TYPE must be STANDARD or EVENASPH, got {kind}")
    if unsupported := _APERTURES.intersection(record):
        raise ValueError(f"only round apertures without obstruction are read, got {min(unsupported)}")
    glass_name, index, abbe = (record.get("GLAS") or [""])[0], number("GLAS", 3), number("GLAS", 4)
    if glass_name == "MIRROR":
        raise ValueError("mirrors are not traced")
    if not glass_name or glass_name.upper() in catalogue():
        glass = Glass.named(glass_name) if glass_name else AIR
    elif index > 1.0:
        glass = Glass.of_numbers(index, *[abbe] * (abbe > 0))
    else:
        missing = "the file gives no index and Abbe number for it (GLAS, fourth and fifth)"
        raise ValueError(f"glass {glass_name} is not in the catalogue of SCHOTT, and {missing}")
    curvature, thickness = number("CURV") / unit, number("DISZ") * unit
    powers = range(1, 9) if kind == "EVENASPH" else ()
    polynomial = tuple(number(f"PARM {i}", 1) * unit ** (1 - 2 * i) for i in powers)
    if medium == glass == AIR and not (curvature or any(polynomial) or "STOP" in record):
        return thickness
    diameter = 2.0 * unit * (number("CLAP", 1) if "CLAP" in record else number("DIAM"))
    if not diameter:
        raise ValueError("no clear semi-diameter (DIAM); state it in the file")
    return Surface(1.0 / curvature if curvature else math.inf, thickness, glass, diameter, number("CONI"), polynomial)
