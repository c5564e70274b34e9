"""A tone curve that nobody told of: it gives itself away in the light of the dot and in the edges of the square.

The light of the dot, in units of the white paper beside it, must be its printed area however it is blurred. And a
blurred edge between black and white must be as much brighter on its dark side as it is darker on its bright side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from torchdof.io.transfer import decode, encode

from ..result import Array
from .target import DOT_MM, Target

__all__ = ["WINDOW", "tone_curve", "untoned"]

WINDOW = 0.36
"""Half the dot's window, of the square's side."""

_PRINTED = 0.01  # how exactly the dot's light can be known
_BENT = (0.15, 0.3)  # expected size of a and b
_CERTAIN = 9.0  # drop of chi squared that calls for a tone curve
_ASIDE, _ALONG = 0.1, 0.35  # how far an edge is looked at to either side, and along it, of the square's side
_BIN = 0.5  # px
_EVEN = 0.008  # how exactly an edge can be known to be even, at eight places
_BLURRED = 1.2  # px, sigma of an edge from which on it is wide enough to look at


def untoned(light: Array, tone: tuple[float, float]) -> Array:
    """Light with a tone curve undone: on the encoded level e, `e + a e (1 - e) + b e (1 - e) (1 - 2 e)`.

    An S-curve `e - t e (1 - e) (1 - 2 e)`, which is `(1 - t) e + t e^2 (3 - 2 e)`, is undone by b near t.
    """
    e = encode(torch.from_numpy(np.clip(light, 0.0, 1.0))[None, None], "srgb", False, False)
    e = e + e * (1 - e) * (tone[0] + tone[1] * (1 - 2 * e))
    return np.asarray(decode(e.clamp(0.0, 1.0), "srgb", False, False)[0, 0].numpy())


def tone_curve(pictures: Sequence[tuple[Array, Target]], square_mm: float) -> tuple[float, float]:
    """The tone curve under which dots and edges are what they must be; none where noise would explain them as well.

    Args:
        pictures: light `[H, W]`, and where the target is in it.
        square_mm: side of the square as printed.

    Returns:
        (a, b) as :func:`untoned` takes them.
    """
    from scipy.optimize import least_squares

    dots = [_dot(light, target, square_mm) for light, target in pictures]
    edges = [edge for light, target in pictures for edge in _edges(light, target)]

    def misfit(values: Array) -> Array:
        tone, found = (float(values[0]), float(values[1])), []
        for window, inside, around, white, area, error in dots:
            level = untoned(window, tone)
            black, paper = float(level[around].mean()), float(untoned(np.array([[white]]), tone)[0, 0])
            light = float((level - black)[inside].sum()) / (paper - black) / area
            found.append((math.log(max(light, 1e-3)) - values[2]) / error)
        uneven = [_unevenness(untoned(edge[None], tone)[0]) for edge in edges]
        return np.concatenate([found, *uneven, values[:2] / _BENT])

    bounds = ([-0.8, -0.8, -1.0], [0.8, 0.8, 1.0])
    solution = least_squares(misfit, [0.0, 0.0, 0.0], bounds=bounds, x_scale=0.1)
    straight = least_squares(lambda v: misfit(np.array([0.0, 0.0, v[0]])), [0.0])
    if 2 * (straight.cost - solution.cost) < _CERTAIN:
        return 0.0, 0.0
    return float(solution.x[0]), float(solution.x[1])


def _dot(light: Array, target: Target, square_mm: float) -> tuple[Array, Array, Array, float, float, float]:
    """The dot's window, which of it holds the dot, which the ink around it; white, the dot's area and its error."""
    half = int(WINDOW * target.side_px)
    y, x = round(target.y), round(target.x)
    window = light[y - half : y + half + 1, x - half : x + half + 1]
    distance = np.hypot(*(np.indices(window.shape) - half))
    inside, around = distance < 0.12 * target.side_px, (distance > 0.2 * target.side_px) & (distance < half)
    area = math.pi * (DOT_MM / 2 * target.side_px / square_mm) ** 2
    # a demosaiced pixel's noise goes together in about nine neighbours
    noise = 3 * float(window[around].std()) * math.sqrt(inside.sum()) / (target.white * area)
    return window, inside, around, target.white, area, math.hypot(noise, _PRINTED)


def _edges(light: Array, target: Target) -> list[Array]:
    """Levels across each side of the square from the paper to the ink, in steps of `_BIN`; of blurred sides alone."""
    reach, along = int(_ASIDE * target.side_px), int(_ALONG * target.side_px)
    profiles = []
    for picture, x, y in ((light, target.x, target.y), (light.T, target.y, target.x)):
        for side in (-1, 1):
            left = round(x + side * target.side_px / 2) - reach
            rows = slice(round(y) - along, round(y) + along + 1)
            strip = picture[rows, max(left, 0) : left + 2 * reach + 1]
            if left < 0 or strip.shape != (2 * along + 1, 2 * reach + 1):
                continue
            strip = strip[:, ::-side]  # from paper to ink
            paper, ink = float(strip[:, : reach // 3].mean()), float(strip[:, -(reach // 3) :].mean())
            if reach < 12 or not paper > 1.5 * ink:
                continue
            row = np.arange(len(strip)) - along
            place = ((strip - ink) / (paper - ink)).sum(1) - 0.5
            slope, start = np.polyfit(row, place, 1)
            away = (np.arange(strip.shape[1]) - start - slope * row[:, None]) / math.hypot(1, slope)
            index = np.floor((away + 0.9 * reach) / _BIN).astype(int)
            kept = (index >= 0) & (index < int(1.8 * reach / _BIN))
            count = np.bincount(index[kept])
            level = np.bincount(index[kept], strip[kept]) / np.maximum(count, 1)
            fall = np.maximum(-np.diff(level), 0.0)
            steps = _BIN * np.arange(fall.size)
            middle = float(fall @ steps / fall.sum())
            near = np.abs(steps - middle) < 0.6 * reach
            if count.all() and math.sqrt(float((fall * (steps - middle) ** 2)[near].sum() / fall.sum())) > _BLURRED:
                profiles.append(level)
    return profiles


def _unevenness(level: Array) -> Array:
    """How far both sides of an edge are from being alike, at equal distances from its middle, over the error."""
    end = level.size // 6
    paper, ink = float(level[:end].mean()), float(level[-end:].mean())
    share = (level - ink) / (paper - ink)
    middle = float(share.sum()) - 0.5  # of an even edge, in bins
    away = np.arange(1.0, level.size // 3)
    bins = np.arange(level.size)
    uneven = np.interp(middle + away, bins, share) + np.interp(middle - away, bins, share) - 1
    return np.asarray(uneven / (_EVEN * math.sqrt(away.size / 8)))
