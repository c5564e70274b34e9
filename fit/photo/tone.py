"""A tone curve that nobody told of: it gives itself away in the light of the dot and in the edges of the square.

The light of the dot, in units of the white paper beside it, must be its printed area however it is blurred. And a
blurred edge between black and white must be as much brighter on its dark side as it is darker on its bright side.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares

from torchdof.io.transfer import decode, encode

from ..result import Array
from .target import DOT_MM, Target

WINDOW = 0.36
"""Half the dot's window, of the square's side."""

_PRINTED = 0.005  # how exactly the dot's light can be known
_BENT = (0.7, 0.7, 0.2)  # expected size of the three numbers of a tone curve
_CERTAIN = 9.0  # drop of chi squared that calls for a tone curve: noise alone does as much once in thirty times
_ASIDE, _ALONG = 0.1, 0.35  # how far an edge is looked at to either side, and along it, of the square's side
_BIN = 0.5  # px
_EVEN, _PLACES = 0.006, 8  # how exactly two opposite edges can be known to be even, at so many places
_BLURRED = 2.3  # px from a tenth to nine tenths, from which on an edge is wide enough to look at
_LEVELS = np.linspace(0.0, 1.0, 1025)


@dataclass(frozen=True)
class Tone:
    """A tone curve, as far as pictures tell it."""

    bend: tuple[float, float, float]  # see `untoned`; zeros where noise would explain the pictures as well
    errors: Array  # steps by one standard error, in independent directions [3, 3]; with what was not believed


def untoned(light: Array, bend: Sequence[float] | Array) -> Array:
    """Light with a tone curve undone.

    On the encoded level e, with u = 2 e - 1, undoing has the slope `exp(b1 u + b2 (u^2 - 1/3) + b3 (u^3 - 3/5 u))`, but
    for the factor that keeps white white: whatever the three numbers, darker stays darker. An S-curve that mixes a
    share t of `e^2 (3 - 2 e)` in is undone by b2 near t.
    """
    u = 2 * _LEVELS - 1
    slope = np.exp(bend[0] * u + bend[1] * (u**2 - 1 / 3) + bend[2] * (u**3 - 0.6 * u))
    undone = np.concatenate([[0.0], np.cumsum(slope[1:] + slope[:-1])])
    encoded = encode(torch.from_numpy(np.clip(light, 0.0, 1.0))[None, None], "srgb", False, False)[0, 0].numpy()
    level = torch.from_numpy(np.interp(encoded, _LEVELS, undone / undone[-1]))
    return np.asarray(decode(level[None, None], "srgb", False, False)[0, 0].numpy())


def tone_curve(pictures: Sequence[tuple[Array, Target]], square_mm: float) -> Tone:
    """The tone curve under which dots and edges are what they must be; none where noise would explain them as well."""
    dots = [_dot(light, target, square_mm) for light, target in pictures]
    edges = [pair for light, target in pictures for pair in _edges(light, target)]

    def misfit(values: Array) -> Array:
        bend, found = values[:3], []
        for window, inside, around, white, area, error in dots:
            level = untoned(window, bend)
            black, paper = float(level[around].mean()), float(untoned(np.array([[white]]), bend)[0, 0])
            light = float((level - black)[inside].sum()) / (paper - black) / area
            found.append((math.log(max(light, 1e-3)) - values[3]) / error)
        uneven = [_unevenness(*untoned(np.stack(pair), bend)) for pair in edges]
        return np.concatenate([found, *uneven, bend / _BENT])

    solution = least_squares(misfit, np.zeros(4), x_scale=0.1)
    straight = least_squares(lambda v: misfit(np.array([0.0, 0.0, 0.0, v[0]])), [0.0])
    # what no curve explains makes the curve less certain
    seen = len(dots) + _PLACES * len(edges)
    spread = np.linalg.inv(solution.jac.T @ solution.jac)[:3, :3] * max(2 * solution.cost / seen, 1.0)
    clear = 2 * (straight.cost - solution.cost) > _CERTAIN
    bend = solution.x[:3] if clear else np.zeros(3)
    values, directions = np.linalg.eigh(spread + np.outer(solution.x[:3] - bend, solution.x[:3] - bend))
    return Tone((float(bend[0]), float(bend[1]), float(bend[2])), (directions * np.sqrt(np.maximum(values, 0.0))).T)


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


def _edges(light: Array, target: Target) -> list[tuple[Array, Array]]:
    """Levels across two opposite sides of the square, from paper to ink in steps of `_BIN`; of blurred sides alone.

    Light that falls off from one side to the other bends both edges, against each other.
    """
    reach, along = int(_ASIDE * target.side_px), int(_ALONG * target.side_px)
    pairs = []
    for picture, x, y in ((light, target.x, target.y), (light.T, target.y, target.x)):
        profiles = []
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
            end = level.size // 6
            share = (level - level[-end:].mean()) / (level[:end].mean() - level[-end:].mean())
            if count.all() and _BIN * float(((share > 0.1) & (share < 0.9)).sum()) > _BLURRED:
                profiles.append(level)
        if len(profiles) == 2:
            shorter = min(profile.size for profile in profiles)
            pairs.append((profiles[0][:shorter], profiles[1][:shorter]))
    return pairs


def _unevenness(one: Array, other: Array) -> Array:
    """How far both sides of an edge are from alike, at equal distances from its middle: of two, over the error."""
    uneven: Array = np.zeros(1)
    for level in (one, other):
        end = level.size // 6
        paper, ink = float(level[:end].mean()), float(level[-end:].mean())
        share = (level - ink) / (paper - ink)
        middle = float(share.sum()) - 0.5  # of an even edge, in bins
        away = np.arange(1.0, level.size // 3)
        bins = np.arange(level.size)
        uneven = uneven + np.interp(middle + away, bins, share) + np.interp(middle - away, bins, share) - 1
    return np.asarray(uneven / (2 * _EVEN * math.sqrt(uneven.size / _PLACES)))
