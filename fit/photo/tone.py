"""Detects an unknown tone curve, from the light of the dot and the edges of the square.

The dot's light over the paper's is its printed area, whatever the blur; a blurred edge darkens as much as it lights up.
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
"""Half side of the dot's window, relative to the square's side."""

_DOT_ERROR = 0.005  # relative error of the dot's expected light
_EXPECTED_BEND = (0.7, 0.7, 0.2)  # expected size of the three parameters
_MIN_CHI_GAIN = 9.0  # decrease of chi squared required for a tone curve; noise alone exceeds it in 1 of 30 cases
_ACROSS, _ALONG = 0.1, 0.35  # reach across and along an edge, relative to the square's side
_BIN = 0.5  # px
_SYMMETRY_ERROR, _POSITIONS = 0.006, 8  # error of the symmetry of two opposite edges, at independent positions
_MIN_EDGE_PX = 2.3  # px from 10 % to 90 % above which an edge is wide enough
_LEVELS = np.linspace(0.0, 1.0, 1025)


@dataclass(frozen=True)
class Tone:
    """A tone curve estimated from pictures."""

    bend: tuple[float, float, float]  # parameters of `untoned`; zero if noise would explain the pictures as well
    errors: Array  # steps of one standard error in independent directions [3, 3]; includes an insignificant curve


def untoned(light: Array, bend: Sequence[float] | Array) -> Array:
    """Undoes a tone curve.

    With the encoded level e and u = 2 e - 1, the slope of the inverse curve is `exp(b1 u + b2 (u^2 - 1/3) + b3 (u^3 -
    3/5 u))`, times a factor that keeps white: it is monotonic. An S-curve has b2 > 0.
    """
    u = 2 * _LEVELS - 1
    slope = np.exp(bend[0] * u + bend[1] * (u**2 - 1 / 3) + bend[2] * (u**3 - 0.6 * u))
    inverse_curve = np.concatenate([[0.0], np.cumsum(slope[1:] + slope[:-1])])
    encoded = encode(torch.from_numpy(np.clip(light, 0.0, 1.0))[None, None], "srgb", False, False)[0, 0].numpy()
    level = torch.from_numpy(np.interp(encoded, _LEVELS, inverse_curve / inverse_curve[-1]))
    return np.asarray(decode(level[None, None], "srgb", False, False)[0, 0].numpy())


def tone_curve(pictures: Sequence[tuple[Array, Target]], square_mm: float) -> Tone:
    """The tone curve for which dots and edges are as expected; zero if noise would explain them as well."""
    dots = []
    for light, target in pictures:
        half = int(WINDOW * target.side_px)
        window = target.window(light, half)
        distance = np.hypot(*(np.indices(window.shape) - half))
        inside, surroundings = distance < 0.12 * target.side_px, (distance > 0.2 * target.side_px) & (distance < half)
        area = math.pi * (DOT_MM / 2 * target.side_px / square_mm) ** 2
        # the noise of a demosaiced pixel is correlated with about nine neighbours
        noise = 3 * float(window[surroundings].std()) * math.sqrt(inside.sum()) / (target.white * area)
        dots.append((window, inside, surroundings, target.white, area, math.hypot(noise, _DOT_ERROR)))
    edges = [pair for light, target in pictures for pair in _edges(light, target)]

    def misfit(values: Array) -> Array:
        bend, residuals = values[:3], []
        for window, inside, surroundings, white, area, error in dots:
            level = untoned(window, bend)
            black, paper = float(level[surroundings].mean()), float(untoned(np.array([[white]]), bend)[0, 0])
            light = float((level - black)[inside].sum()) / (paper - black) / area
            residuals.append((math.log(max(light, 1e-3)) - values[3]) / error)
        asymmetries = [_edge_asymmetry(*untoned(np.stack(pair), bend)) for pair in edges]
        return np.concatenate([residuals, *asymmetries, bend / _EXPECTED_BEND])

    solution = least_squares(misfit, np.zeros(4), x_scale=0.1)
    uncurved = least_squares(lambda v: misfit(np.array([0.0, 0.0, 0.0, v[0]])), [0.0])
    # unexplained residuals make the curve less certain
    data_count = len(dots) + _POSITIONS * len(edges)
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)[:3, :3] * max(2 * solution.cost / data_count, 1.0)
    is_significant = 2 * (uncurved.cost - solution.cost) > _MIN_CHI_GAIN
    bend = solution.x[:3] if is_significant else np.zeros(3)
    values, directions = np.linalg.eigh(covariance + np.outer(solution.x[:3] - bend, solution.x[:3] - bend))
    return Tone((float(bend[0]), float(bend[1]), float(bend[2])), (directions * np.sqrt(np.maximum(values, 0.0))).T)


def _edges(light: Array, target: Target) -> list[tuple[Array, Array]]:
    """Levels across opposite sides of the square, from paper to ink; uneven light has opposite effects on the two."""
    reach, half_length = int(_ACROSS * target.side_px), int(_ALONG * target.side_px)
    pairs = []
    for picture, x, y in ((light, target.x, target.y), (light.T, target.y, target.x)):
        profiles = []
        for side in (-1, 1):
            left = round(x + side * target.side_px / 2) - reach
            rows = slice(round(y) - half_length, round(y) + half_length + 1)
            strip = picture[rows, max(left, 0) : left + 2 * reach + 1]
            if left < 0 or strip.shape != (2 * half_length + 1, 2 * reach + 1):
                continue
            strip = strip[:, ::-side]  # from paper to ink
            paper, ink = float(strip[:, : reach // 3].mean()), float(strip[:, -(reach // 3) :].mean())
            if reach < 12 or not paper > 1.5 * ink:
                continue
            row = np.arange(len(strip)) - half_length
            edge_positions = ((strip - ink) / (paper - ink)).sum(1) - 0.5
            slope, intercept = np.polyfit(row, edge_positions, 1)
            distance = (np.arange(strip.shape[1]) - intercept - slope * row[:, None]) / math.hypot(1, slope)
            index = np.floor((distance + 0.9 * reach) / _BIN).astype(int)
            in_range = (index >= 0) & (index < int(1.8 * reach / _BIN))
            count = np.bincount(index[in_range])
            level = np.bincount(index[in_range], strip[in_range]) / np.maximum(count, 1)
            margin = level.size // 6
            share = (level - level[-margin:].mean()) / (level[:margin].mean() - level[-margin:].mean())
            if count.all() and _BIN * float(((share > 0.1) & (share < 0.9)).sum()) > _MIN_EDGE_PX:
                profiles.append(level)
        if len(profiles) == 2:
            shorter = min(profile.size for profile in profiles)
            pairs.append((profiles[0][:shorter], profiles[1][:shorter]))
    return pairs


def _edge_asymmetry(one: Array, other: Array) -> Array:
    """Asymmetry of two opposite edges at equal distances from their centres, over its error."""
    asymmetry: Array = np.zeros(1)
    for level in (one, other):
        margin = level.size // 6
        paper, ink = float(level[:margin].mean()), float(level[-margin:].mean())
        share = (level - ink) / (paper - ink)
        centre = float(share.sum()) - 0.5  # of a symmetric edge, in bins
        offset = np.arange(1.0, level.size // 3)
        bins = np.arange(level.size)
        asymmetry = asymmetry + np.interp(centre + offset, bins, share) + np.interp(centre - offset, bins, share) - 1
    return np.asarray(asymmetry / (2 * _SYMMETRY_ERROR * math.sqrt(asymmetry.size / _POSITIONS)))
