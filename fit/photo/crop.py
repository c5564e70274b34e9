"""Two frames to pairs of windows, one for each dot that is found in both."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..problems import DotNotFoundError, SeveralDotsError, WindowError
from ..result import Array
from .dot import Dot, find_dot, find_dots

__all__ = ["Capture", "Dots", "cut_pairs", "size_of"]

Dots = Literal["one", "centre", "each", "field"]

_MARGIN = 1.35  # window over the blur's reach


@dataclass(frozen=True)
class Capture:
    """One pair of windows of the same dot: in focus, and at another distance.

    Attributes:
        sharp: `[H, W]`, linear light, in focus.
        blurred: `[H, W]`, linear light, the same size.
        distance_m: of the dot in `blurred`, from the lens.
        files: where the two came from.
        white: level of clipping in both, or None where it is not known.
        exposure: of `blurred` over `sharp`, as stated, or None.
        position_px: the dot's place (x, y) in the sharp frame, from the frame's centre.
        colours: red, green and blue of `sharp` and of `blurred`, `[3, H, W]` each; None fits their mean alone.
        uncertain: `sharp` and `blurred` again, as they would be with what was guessed about them (a tone curve) one
            standard error off, in independent directions. Standard errors count what that does to a fit.
    """

    sharp: Array
    blurred: Array
    distance_m: float
    files: tuple[str | None, str | None] = (None, None)
    white: float | None = None
    exposure: float | None = None
    position_px: tuple[float, float] = (0.0, 0.0)
    colours: tuple[Array, Array] | None = None
    uncertain: tuple[tuple[Array, Array], ...] = ()


def cut_pairs(
    still: Array,
    moved: Array,
    distance: float,
    magnification: float,
    dots: Dots,
    files: tuple[str, str],
    white: float | None,
    exposure: float | None,
    middle: tuple[float, float],
    colours: tuple[Array, Array] | None = None,
) -> list[Capture]:
    """Find the dot, or the dots of a grid, in two frames and cut the windows around each.

    `middle` is the frame's; `colours` are red, green and blue of either frame, to be cut alike.
    """
    if dots == "one":
        chosen = [(find_dot(still, file=files[0]), find_dot(moved, file=files[1]))]
    else:
        chosen = _matched(still, moved, magnification, middle, files)
        chosen = chosen[:1] if dots == "centre" else chosen
    half_width = [_half_width(still, moved, first, second, files) for first, second in chosen]
    return [
        Capture(
            sharp=_one_dot(still, first, half, files[0]),
            blurred=_one_dot(moved, second, half, files[1]),
            distance_m=distance,
            files=files,
            white=white,
            exposure=exposure,
            position_px=(round(first.x - middle[0], 2), round(first.y - middle[1], 2)),
            colours=None if colours is None else (_cut(colours[0], first, half), _cut(colours[1], second, half)),
        )
        for (first, second), half in zip(chosen, half_width, strict=True)
    ]


def _matched(
    still: Array, moved: Array, magnification: float, middle: tuple[float, float], files: tuple[str, str]
) -> list[tuple[Dot, Dot]]:
    """Dots of a grid in both pictures, from the centre outwards: each moves along the line to the centre."""
    first, second = find_dots(still, file=files[0], smallest=0.3), find_dots(moved, file=files[1], smallest=0.3)
    pairs = []
    for dot in sorted(first, key=lambda d: math.hypot(d.x - middle[0], d.y - middle[1])):
        x, y = (middle[i] + magnification * (v - middle[i]) for i, v in enumerate((dot.x, dot.y)))
        near = min(second, key=lambda d: math.hypot(d.x - x, d.y - y))
        others = [math.hypot(d.x - dot.x, d.y - dot.y) for d in first if d is not dot]
        if math.hypot(near.x - x, near.y - y) < 0.4 * magnification * min(others, default=math.inf):
            pairs.append((dot, near))
    if not pairs:
        raise DotNotFoundError(
            f"none of the {len(first)} dots of {Path(files[0]).name} is found again; are the distances right?",
            file=files[1],
            number=float(len(second)),
        )
    return pairs


def _half_width(still: Array, moved: Array, first: Dot, second: Dot, files: tuple[str, str]) -> int:
    """Half the side of an odd square around either dot, wide enough for the blur."""
    needed = max(first.reach, second.reach) + 2
    half = int(math.ceil(_MARGIN * needed)) + 8
    half_width = min(min(_pixels_to_edge(still, first), _pixels_to_edge(moved, second)), half)
    if half_width < needed:
        worse = 0 if _pixels_to_edge(still, first) < first.reach + 2 else 1
        raise WindowError(
            f"the frame cuts the blur: it reaches {needed:.0f} px from the dot, the frame ends after {half_width} px",
            file=files[worse],
            number=needed,
        )
    return half_width


def _one_dot(picture: Array, dot: Dot, half_width: int, file: str) -> Array:
    """The window around a dot, or a refusal where another one lies in it."""
    window = _cut(picture, dot, half_width)
    inside = find_dots(window, file=file)
    if len(inside) > 1:
        raise SeveralDotsError(
            f"{len(inside)} dots in a window of {window.shape[0]} px: print the dots farther apart than their blur",
            file=file,
            number=float(len(inside)),
        )
    return window


def _cut(picture: Array, dot: Dot, half_width: int) -> Array:
    """The window around a dot in a picture `[..., H, W]`."""
    x, y = int(round(dot.x)), int(round(dot.y))
    return picture[..., y - half_width : y + half_width + 1, x - half_width : x + half_width + 1].copy()


def _pixels_to_edge(picture: Array, dot: Dot) -> int:
    """Whole pixels between a dot's pixel and the nearest edge of the picture."""
    x, y = int(round(dot.x)), int(round(dot.y))
    return min(x, y, picture.shape[1] - 1 - x, picture.shape[0] - 1 - y)


def size_of(picture: Array) -> str:
    """Width x height, for messages."""
    return f"{picture.shape[1]}x{picture.shape[0]}"
