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
may be the name of a glass: of a maker's catalogue (``N-BK7``, ``S-LAH64``), or defined on an earlier line by its
coefficients of Sellmeier's formula, ``glass NAME B1 B2 B3 C1 C2 C3``. ``#`` starts a comment; ``# source:`` is kept.

Of a Zemax file (.zmx) the unit is read and, for each surface, curvature, thickness, clear semi-diameter, glass, conic
constant, even asphere, and whether it is the stop. The first surface is the object and the last the sensor; flat
surfaces in air, except the stop, are skipped. A glass by name is that of the catalogues that the file states
(:mod:`torchdof.fit.lens.catalogues`); the numbers behind the name are placeholders. A model glass has its index and
Abbe number in the file. Mirrors, tilts, other surfaces and apertures, and several configurations raise errors.
"""

import contextlib
import math
import re
from dataclasses import replace

from .catalogues import named_glass
from .glass import AIR, Glass
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
        try:
            glass, _ = named_glass(index)
        except ValueError as error:
            remedy = f"define it by a line `glass {index} B1 B2 B3 C1 C2 C3`, or write index/V or index/V/P_gF"
            raise ValueError(f"{error}; {remedy}") from None
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
    """The surfaces of a .zmx file in any encoding, the index of the stop, and the source; an error has the surface."""
    records: list[dict[str, list[str]]] = []
    unit, name, catalogues = "MM", "", list[str]()
    for line in re.split(r"\r\n|\r|\n", _decoded(content)):  # splitlines also splits at bytes of other encodings
        word, *fields = line.split() or [""]
        word = word.upper()
        if word == "SURF":
            records.append({})
        elif word == "MODE" and fields[:1] != ["SEQ"]:
            raise ValueError(f"a sequential lens was expected (MODE SEQ), got {line.strip()!r}")
        elif word == "MNUM" and fields[:1] not in ([], ["0"], ["1"]):
            raise ValueError(f"one configuration was expected, got {fields[0]}; save the one that is wanted alone")
        elif word == "UNIT":
            unit = " ".join(fields[:1])
        elif word == "GCAT":
            catalogues += fields
        elif word == "NAME":
            name = " ".join(fields)
        elif records:
            records[-1][f"PARM {fields[0]}" if word == "PARM" and fields else word] = fields
    if unit not in _UNITS:
        raise ValueError(f"UNIT must be one of {', '.join(_UNITS)}, got {unit!r}")
    if len(records) < 3:
        raise ValueError(f"expected an object, surfaces of a lens and an image (SURF), got {len(records)} surfaces")
    surfaces: list[Surface] = []
    stops, remarks = [], dict[str, None]()
    for surface_number, record in enumerate(records[1:-1], start=1):
        try:
            glass, remark = _zemax_glass(record.get("GLAS", []), catalogues)
            surface = _zemax_surface(record, _UNITS[unit], surfaces[-1].glass if surfaces else AIR, glass)
            if isinstance(surface, Surface):
                stops += [len(surfaces)] * ("STOP" in record)
                surfaces.append(surface)
                remarks |= {remark: None} if remark else {}
            elif surfaces:
                surfaces[-1] = replace(surfaces[-1], thickness=surfaces[-1].thickness + surface)
        except ValueError as error:
            raise ValueError(f"surface {surface_number}: {error}") from None
    if len(stops) != 1:
        raise ValueError(f"expected one stop (STOP) among the surfaces of the lens, got {len(stops)}")
    surfaces[-1] = replace(surfaces[-1], thickness=0.0)
    return tuple(surfaces), stops[0], "; ".join([f"Zemax file{f': {name}' if name else ''}", *remarks])


def _decoded(content: bytes) -> str:
    """The text of a .zmx file: UTF-8, UTF-16 with or without its mark, or a code page of Windows.

    Only names and comments have other characters than ASCII, so that a wrong code page does not change the lens.
    """
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16")
    if b"\0" in content[:2]:  # half of each ASCII character
        return content.decode("utf-16-be" if content[0] == 0 else "utf-16-le")
    has_double_bytes = re.search(rb"[\x80-\xff]{3}", content) is not None
    for encoding in ("utf-8-sig", *(("cp932", "gbk") if has_double_bytes else ())):
        with contextlib.suppress(UnicodeDecodeError):
            text = content.decode(encoding)
            if encoding != "cp932" or not re.search("[\uff61-\uff9f\ue000-\uf8ff]", text):  # rare in Japanese
                return text
    return content.decode("latin-1")


def _zemax_glass(fields: list[str], catalogues: list[str]) -> tuple[Glass, str]:
    """The glass of the fields of GLAS, and a remark with its maker and index, "" for SCHOTT's.

    The second field is 0 for a glass by name, whose numbers in the fourth and fifth field are placeholders, and 1 for a
    model glass, which has its index and Abbe number there.
    """
    name, kind = (*fields, "", "")[:2]
    if name in ("", "AIR"):
        return AIR, ""
    if name == "MIRROR":
        raise ValueError("mirrors are not traced")
    if kind in ("2", "4") or (name.startswith("___") and kind != "1"):
        expected = "a glass by name, or a model glass with its numbers (second field 1)"
        raise ValueError(f"expected {expected}, got GLAS {' '.join(fields[:5])}")
    if kind == "1":
        index, abbe = (_number("GLAS", text) for text in (*fields, "0", "0", "0", "0")[3:5])
        return Glass.of_numbers(index, *[abbe] * (abbe > 0)), ""
    try:
        glass, maker = named_glass(name, catalogues)
    except ValueError as error:
        remedy = "make it a model glass with its index and Abbe number (GLAS NAME 1 0 INDEX ABBE)"
        raise ValueError(f"{error}; the numbers behind the name of a glass are placeholders; {remedy}") from None
    is_clear = glass.name == name.upper() and maker == "SCHOTT"
    return glass, "" if is_clear else f"{name} is {maker}'s of {glass.index():.5f}"


def _zemax_surface(record: dict[str, list[str]], unit: float, medium: Glass, glass: Glass) -> Surface | float:
    """A surface between two media; for a flat one in air, not part of the lens, only its thickness in mm."""

    def number(word: str, index: int = 0) -> float:
        fields = record.get(word, [])
        return _number(word, fields[index]) if len(fields) > index else 0.0

    kind = (record.get("TYPE") or ["STANDARD"])[0]
    if kind not in ("STANDARD", "EVENASPH"):
        raise ValueError(f"TYPE must be STANDARD or EVENASPH, got {kind}")
    if unsupported := _APERTURES.intersection(record):
        raise ValueError(f"only round apertures without obstruction are read, got {min(unsupported)}")
    curvature, thickness = number("CURV") / unit, number("DISZ") * unit
    powers = range(1, 9) if kind == "EVENASPH" else ()
    polynomial = tuple(number(f"PARM {i}", 1) * unit ** (1 - 2 * i) for i in powers)
    if medium == glass == AIR and not (curvature or any(polynomial) or "STOP" in record):
        return thickness
    diameter = 2.0 * unit * (number("CLAP", 1) if "CLAP" in record else number("DIAM"))
    if not diameter:
        raise ValueError("no clear semi-diameter (DIAM); state it in the file")
    return Surface(1.0 / curvature if curvature else math.inf, thickness, glass, diameter, number("CONI"), polynomial)
