"""The printed target (a white dot in a black square on white paper), and its detection in photographs.

An unknown tone curve is found from it: the dot's light over the paper's is its printed area, whatever the blur, and a
blurred edge of the square darkens as much as it lights up.
"""

import math
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import least_squares

from torchdof.io.atomic import atomic_file
from torchdof.io.transfer import decode, encode
from torchdof.validation import choice

from ..problems import FitError, checked
from ..result import Array, Mask

Paper = Literal["a4", "letter"]

SQUARE_MM = 100.0  # side of the black square, mm
DOT_MM = 5.0  # diameter of the white dot in its centre, mm
WINDOW = 0.36  # half side of the dot's window, relative to the square's side
_THUMBNAIL_PX = 500  # width of the reduced copy in which the square is searched
_THRESHOLDS = np.linspace(0.1, 0.75, 14)  # fractions of the range between dark and bright
_MIN_SHARE, _MAX_SHARE = 0.004, 0.6  # limits of the square's share of the frame
_DOT_ERROR = 0.005  # relative error of the dot's expected light
_EXPECTED_BEND = (0.7, 0.7, 0.2)  # expected size of the three parameters
_MIN_CHI_GAIN = 9.0  # decrease of chi squared required for a tone curve; noise alone exceeds it in 1 of 30 cases
_ACROSS, _ALONG = 0.1, 0.35  # reach across and along an edge, relative to the square's side
_BIN = 0.5  # px
_SYMMETRY_ERROR, _POSITIONS = 0.006, 8  # error of the symmetry of two opposite edges, at independent positions
_MIN_EDGE_PX = 2.3  # px from 10 % to 90 % above which an edge is wide enough
_LEVELS = np.linspace(0.0, 1.0, 1025)


def write_target(path: str | os.PathLike[str], paper: Paper = "a4") -> None:
    """Writes the target as a PDF of one page, to be printed at 100 %."""
    target = Path(path)
    if target.suffix.lower() != ".pdf":
        raise FitError(f"the target is written as PDF: name it {target.with_suffix('.pdf')}", file=str(path))
    checked(choice, "paper", paper, get_args(Paper))
    with atomic_file(target) as temporary:
        shutil.copyfile(Path(__file__).with_name(f"target-{paper}.pdf"), temporary)


@dataclass(frozen=True)
class Target:
    """The target in a photograph."""

    x: float  # centre of the square, px
    y: float  # the same, downwards
    side_px: float
    elongation: float  # longer side over shorter side; above 1 if seen at an angle
    white: float  # level of the paper around the square
    black: float  # level of the square

    def window(self, light: Array, half: int) -> Array:
        """Part of a picture `[..., H, W]` around the centre, `half` px on each side."""
        x, y = round(self.x), round(self.y)
        return light[..., y - half : y + half + 1, x - half : x + half + 1]


def find_target(light: Array, *, file: str | None = None) -> Target:
    """Finds the black square on white paper in a picture `[H, W]` in linear light, or raises an error."""
    step = max(1, round(light.shape[1] / _THUMBNAIL_PX))
    rows, columns = (n // step for n in light.shape)
    thumbnail = light[: rows * step, : columns * step].reshape(rows, step, columns, step).mean((1, 3))
    low, high = np.percentile(thumbnail, (1, 97))
    thresholds = low + _THRESHOLDS * (high - low)
    candidates = [target for level in thresholds for target in _squares(thumbnail, thumbnail < level)]
    if not candidates:
        raise FitError("no target found: show the black square with its dot on white paper, evenly lit", "no dot", file)
    best = max(candidates, key=lambda t: (t.white - t.black) / max(t.white + t.black, 1e-12))  # highest contrast
    x, y = ((v + 0.5) * step - 0.5 for v in (best.x, best.y))
    return _refined(light, replace(best, x=x, y=y, side_px=best.side_px * step))


def _squares(thumbnail: Array, dark: Mask) -> Iterator[Target]:
    """Dark areas that are square, have a bright centre and bright surroundings."""
    labels, count = ndimage.label(dark)
    for i, box in enumerate(ndimage.find_objects(labels)[:count], start=1):
        (top, bottom), (left, right) = ((s.start, s.stop) for s in box)
        height, width = bottom - top, right - left
        touches_border = top == 0 or left == 0 or bottom == thumbnail.shape[0] or right == thumbnail.shape[1]
        share = height * width / thumbnail.size
        if touches_border or not _MIN_SHARE < share < _MAX_SHARE or not 0.75 < height / width < 1.33:
            continue
        y, x = np.nonzero(ndimage.binary_fill_holes(labels[box] == i))
        # any parallelogram has the area 12 sqrt(det cov)
        if abs(x.size / (12 * math.sqrt(max(float(np.linalg.det(np.cov(np.stack([x, y])))), 1e-9))) - 1) > 0.06:
            continue
        centre_x, centre_y, side = left + float(x.mean()), top + float(y.mean()), math.sqrt(x.size)
        distance = _square_distance(thumbnail.shape, centre_x, centre_y, side)
        areas = (1.12, 1.2), (0.4, 0.85), (-1.0, 0.03 + 1.5 / side)
        ring, inside, middle = (thumbnail[(distance > low) & (distance < high)] for low, high in areas)
        if ring.size < 8 or inside.size < 8 or middle.size < 1:
            continue
        white, black = float(np.median(ring)), float(np.median(inside))
        if white > 2.5 * black and float(middle.max()) - black > max(0.05 * (white - black), 4 * float(inside.std())):
            yield Target(centre_x, centre_y, side, 1.0, white, black)


def _square_distance(shape: tuple[int, ...], x: float, y: float, side: float) -> Array:
    """Distance from a square's centre in half sides, the larger of both axes: 1 on its edge."""
    rows, columns = np.indices(shape)
    return np.asarray(np.maximum(np.abs(rows - y), np.abs(columns - x)) / (side / 2))


def _refined(light: Array, target: Target) -> Target:
    """Centre, side and levels from the light of the whole square, which blur moves but keeps."""
    for _ in range(2):
        half = int(0.62 * target.side_px) + 2
        top, left = max(round(target.y) - half, 0), max(round(target.x) - half, 0)
        crop = light[top : round(target.y) + half + 1, left : round(target.x) + half + 1]
        x, y, (rows, columns) = target.x - left, target.y - top, np.indices(crop.shape)
        distance = _square_distance(crop.shape, x, y, target.side_px)
        paper, ink = (distance > 1.12) & (distance < 1.22), (distance > 0.5) & (distance < 0.85)
        plane = np.stack([np.ones(crop.shape), rows - y, columns - x], axis=-1)
        white = plane @ np.linalg.lstsq(plane[paper], crop[paper], rcond=None)[0]
        black = float(np.median(crop[ink] / white[ink]))
        share = np.clip((1 - crop / white) / (1 - black), -0.2, 1.2)
        share[distance < 0.5] = 1.0  # the dot counts as part of the square
        share[distance > 1.15] = 0.0
        area, level = float(share.sum()), float(np.median(white))
        x, y = float((share * columns).sum() / area), float((share * rows).sum() / area)
        squares = ((share * (axis - middle) ** 2).sum() for axis, middle in ((columns, x), (rows, y)))
        width, height = (math.sqrt(12 * float(square) / area) for square in squares)
        target = Target(x + left, y + top, math.sqrt(area), max(width / height, height / width), level, black * level)
    return target


def untoned(light: Array, bend: Sequence[float] | Array) -> Array:
    """Undoes a tone curve, whose inverse has a positive slope over the encoded levels; an S-curve has `bend[1] > 0`."""
    u = 2 * _LEVELS - 1
    slope = np.exp(bend[0] * u + bend[1] * (u**2 - 1 / 3) + bend[2] * (u**3 - 0.6 * u))
    inverse_curve = np.concatenate([[0.0], np.cumsum(slope[1:] + slope[:-1])])
    encoded = encode(torch.from_numpy(np.clip(light, 0.0, 1.0))[None, None], "srgb", False, False)[0, 0].numpy()
    level = torch.from_numpy(np.interp(encoded, _LEVELS, inverse_curve / inverse_curve[-1]))
    return np.asarray(decode(level[None, None], "srgb", False, False)[0, 0].numpy())


def tone_curve(pictures: Sequence[tuple[Array, Target]], square_mm: float) -> tuple[Array, Array]:
    """The `bend` of `untoned` [3] that dots and edges show, 0 if insignificant; and its independent errors [3, 3]."""
    dots = []
    for light, target in pictures:
        side, half = target.side_px, int(WINDOW * target.side_px)
        window = target.window(light, half)
        distance = np.hypot(*(np.indices(window.shape) - half))
        inside, surroundings = distance < 0.12 * side, (distance > 0.2 * side) & (distance < half)
        area = math.pi * (DOT_MM / 2 * side / square_mm) ** 2
        # the noise of a demosaiced pixel is correlated with about nine neighbours
        noise = 3 * float(window[surroundings].std()) * math.sqrt(inside.sum()) / (target.white * area)
        dots.append((window, inside, surroundings, target.white, area, math.hypot(noise, _DOT_ERROR)))
    edges = [pair for light, target in pictures for pair in _edges(light, target)]

    def misfit(values: Array) -> Array:
        bend, residuals = values[:3], []
        for window, inside, surroundings, white, area, error in dots:
            level, paper = untoned(window, bend), float(untoned(np.array([[white]]), bend)[0, 0])
            black = float(level[surroundings].mean())
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
    return bend, (directions * np.sqrt(np.maximum(values, 0.0))).T


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
            shorter = min(map(len, profiles))
            pairs.append((profiles[0][:shorter], profiles[1][:shorter]))
    return pairs


def _edge_asymmetry(one: Array, other: Array) -> Array:
    """Asymmetry of two opposite edges at equal distances from their centres, over its error."""
    asymmetry, bins, offset = np.zeros(1), np.arange(one.size), np.arange(1.0, one.size // 3)
    for level in (one, other):
        margin = level.size // 6
        paper, ink = float(level[:margin].mean()), float(level[-margin:].mean())
        share = (level - ink) / (paper - ink)
        centre = float(share.sum()) - 0.5  # of a symmetric edge, in bins
        asymmetry = asymmetry + np.interp(centre + offset, bins, share) + np.interp(centre - offset, bins, share) - 1
    return np.asarray(asymmetry / (2 * _SYMMETRY_ERROR * math.sqrt(asymmetry.size / _POSITIONS)))
