"""Two frames to pairs of windows, one for each dot that is found in both."""

from __future__ import annotations

import math
from typing import Literal

from ..problems import FitError
from ..result import Array
from .captures import Capture
from .dot import Dot, find_dot, find_dots
from .frame import Frame

__all__ = ["Dots", "cut_pairs"]

Dots = Literal["one", "centre", "each", "field"]

_MARGIN = 1.35  # window over the blur's reach


def cut_pairs(
    still: Frame,
    moved: Frame,
    distance_m: float,
    magnification: float,
    dots: Dots = "one",
    exposure: float | None = None,
    colours: bool = False,
) -> list[Capture]:
    """Find the dot, or the dots of a grid, in two frames and cut the windows around each.

    Args:
        still: in focus.
        moved: at another distance.
        distance_m: that distance.
        magnification: expected size of a dot in `moved` over that in `still`.
        dots: "one", "centre" of a grid, or all others for "each" of it.
        exposure: of `moved` over `still`, or None.
        colours: whether to cut red, green and blue, too.

    Raises:
        FitError: no dot, several, one too near to the frame's edge or to others.
    """
    if dots == "one":
        chosen = [(find_dot(still.light, file=str(still.file)), find_dot(moved.light, file=str(moved.file)))]
    else:
        chosen = _matched(still, moved, magnification)
        chosen = chosen[:1] if dots == "centre" else chosen
    pairs = []
    for first, second in chosen:
        half = _half_width(still, moved, first, second)
        pairs.append(
            Capture(
                sharp=_one_dot(still, first, half),
                blurred=_one_dot(moved, second, half),
                distance_m=distance_m,
                files=(str(still.file), str(moved.file)),
                white=still.white,
                exposure=exposure,
                position_px=(round(first.x - still.middle[0], 2), round(first.y - still.middle[1], 2)),
                colours=(_cut(still.colours, first, half), _cut(moved.colours, second, half)) if colours else None,
            )
        )
    return pairs


def _matched(still: Frame, moved: Frame, magnification: float) -> list[tuple[Dot, Dot]]:
    """Dots of a grid in both pictures, from the centre outwards: each moves along the line to the centre."""
    first, second = (find_dots(frame.light, file=str(frame.file), smallest=0.3) for frame in (still, moved))
    middle, pairs = still.middle, []
    for dot in sorted(first, key=lambda d: math.dist((d.x, d.y), middle)):
        where = [m + magnification * (v - m) for m, v in zip(middle, (dot.x, dot.y), strict=True)]
        near = min(second, key=lambda d: math.dist((d.x, d.y), where))
        apart = min((math.dist((d.x, d.y), (dot.x, dot.y)) for d in first if d is not dot), default=math.inf)
        if math.dist((near.x, near.y), where) < 0.4 * magnification * apart:
            pairs.append((dot, near))
    if not pairs:
        text = f"none of the {len(first)} dots of {still.file.name} is found again; are the distances right?"
        raise FitError(text, "no dot", file=str(moved.file), number=float(len(second)))
    return pairs


def _half_width(still: Frame, moved: Frame, first: Dot, second: Dot) -> int:
    """Half the side of an odd square around either dot, wide enough for the blur."""
    needed = max(first.reach, second.reach) + 2
    room = [_pixels_to_edge(still.light, first), _pixels_to_edge(moved.light, second)]
    half_width = min(*room, int(math.ceil(_MARGIN * needed)) + 8)
    if half_width < needed:
        text = f"the frame cuts the blur: it reaches {needed:.0f} px from the dot, the frame ends after {half_width} px"
        worse = still if room[0] < first.reach + 2 else moved
        raise FitError(text, "window", file=str(worse.file), number=needed)
    return half_width


def _one_dot(frame: Frame, dot: Dot, half_width: int) -> Array:
    """The window around a dot, or a refusal where another one lies in it."""
    window = _cut(frame.light, dot, half_width)
    count = len(find_dots(window, file=str(frame.file)))
    if count > 1:
        text = f"{count} dots in a window of {window.shape[0]} px: print the dots farther apart than their blur"
        raise FitError(text, "several dots", file=str(frame.file), number=float(count))
    return window


def _cut(picture: Array, dot: Dot, half_width: int) -> Array:
    """The window around a dot in a picture `[..., H, W]`."""
    x, y = int(round(dot.x)), int(round(dot.y))
    return picture[..., y - half_width : y + half_width + 1, x - half_width : x + half_width + 1].copy()


def _pixels_to_edge(picture: Array, dot: Dot) -> int:
    """Whole pixels between a dot's pixel and the nearest edge of the picture."""
    x, y = int(round(dot.x)), int(round(dot.y))
    return min(x, y, picture.shape[1] - 1 - x, picture.shape[0] - 1 - y)
