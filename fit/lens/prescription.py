"""The text format of lens prescriptions: a table of surfaces, front to rear, one on each line.

::

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
"""

import math
from collections.abc import Sequence

from .glass import AIR, Glass, catalogue
from .surface import Surface

_COLUMNS = "radius thickness index diameter"
_MAX_SURFACES = 1000
_SHAPE = ("k", *(f"A{power}" for power in range(2, 18, 2)))


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
                numbers = tuple(number_of(f"glass {words[1]}", text) for text in words[2:])
                defined[words[1]] = Glass(words[1], numbers)
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
        raise ValueError(f"expected the columns {_COLUMNS}, got {len(words)}: {' '.join(words)!r}")
    radius, thickness, diameter = (number_of(_COLUMNS.split()[i], words[i]) for i in (0, 1, 3))
    is_stop, shape = "stop" in words[4:], dict.fromkeys(_SHAPE, 0.0)
    for word in words[4:]:
        name, _, text = word.partition("=")
        if name in shape:
            shape[name] = number_of(name, text)
        elif word != "stop":
            raise ValueError(f"behind the columns expected stop, k=NUMBER or A2=NUMBER to A16=NUMBER, got {word!r}")
    glass = medium if radius == 0.0 and words[2] == "0" else _glass(words[2], defined)
    if radius == 0.0:
        if glass.index() != medium.index():
            raise ValueError("index: the stop does not change the index, write 0")
        radius, glass, is_stop = math.inf, medium, True
    conic, *polynomial = shape.values()
    return Surface(radius, thickness, glass, diameter, conic, tuple(polynomial) * any(polynomial)), is_stop


def _glass(text: str, defined: dict[str, Glass]) -> Glass:
    if text in defined:
        return defined[text]
    if text[0].isalpha() and text.lower() not in ("inf", "nan"):
        return Glass.named(text)
    numbers = [number_of("index", part) for part in text.split("/")]
    if len(numbers) > 3:
        raise ValueError(f"index: expected a number, index/V, index/V/P_gF or a glass, got {text!r}")
    return Glass.of_numbers(*numbers)


def number_of(name: str, text: str) -> float:
    """The number that a text states; the error has its name."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{name}: expected a number, got {text!r}") from None


def lines(surfaces: Sequence[Surface], stop: int) -> list[str]:
    """Surfaces as lines of a prescription; the inverse of :func:`parse`."""
    media = [AIR, *(surface.glass for surface in surfaces)]
    named = {glass.name: glass for glass in media if len(glass.coefficients) == 6 and glass not in catalogue().values()}
    text_lines = [" ".join(["glass", name, *map(repr, glass.coefficients)]) for name, glass in named.items()]
    for i, surface in enumerate(surfaces):
        shape = zip(_SHAPE, (surface.conic, *surface.polynomial), strict=False)
        shape_words = [f"{name}={value:.9g}" for name, value in shape if value]
        is_plain = not shape_words and math.isinf(surface.radius) and media[i + 1] == media[i]
        curve, index = ("0", "0") if i == stop and is_plain else (f"{surface.radius:.9g}", surface.glass.name)
        shape_words += ["stop"] * (i == stop and not is_plain)
        text_lines.append(" ".join([curve, f"{surface.thickness:.9g}", index, f"{surface.diameter:.9g}", *shape_words]))
    return text_lines
