"""The printed target (a white dot in a black square on white paper), and its detection in a photograph.

The square gives the scale, and so the distance; the dot gives the blur; the paper gives the level of white.
"""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy import ndimage

from torchdof.io.atomic import atomic_file
from torchdof.validation import choice

from ..problems import FitError, checked
from ..result import Array, Mask

Paper = Literal["a4", "letter"]

SQUARE_MM = 100.0
"""Side of the black square, mm."""

DOT_MM = 5.0
"""Diameter of the white dot in its centre, mm."""

_THUMBNAIL_PX = 500  # width of the reduced copy in which the square is searched
_THRESHOLDS = np.linspace(0.1, 0.75, 14)  # fractions of the range between dark and bright
_MIN_SHARE, _MAX_SHARE = 0.004, 0.6  # limits of the square's share of the frame


def write_target(path: str | os.PathLike[str], paper: Paper = "a4") -> None:
    """Writes the target as a PDF of one page, to be printed at 100 %."""
    target = Path(path)
    if target.suffix.lower() != ".pdf":
        raise FitError(f"the target is written as PDF: name it {target.with_suffix('.pdf')}", file=str(path))
    checked(choice, "paper", paper, get_args(Paper))
    page = Path(__file__).with_name(f"target-{paper}.pdf").read_bytes()
    with atomic_file(target) as temporary:
        Path(temporary).write_bytes(page)


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
        text = "no target found: show a black square with a white dot, white paper around it, evenly lit and square on"
        raise FitError(text, "no dot", file=file)
    best = max(candidates, key=lambda t: (t.white - t.black) / max(t.white + t.black, 1e-12))  # of the highest contrast
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
        square = ndimage.binary_fill_holes(labels[box] == i)
        area = float(square.sum())
        y, x = np.nonzero(square)
        covariance = np.cov(np.stack([x, y]))
        # any parallelogram has the area 12 sqrt(det cov)
        if abs(area / (12 * math.sqrt(max(float(np.linalg.det(covariance)), 1e-9))) - 1) > 0.06:
            continue
        side = math.sqrt(area)
        target = Target(left + float(x.mean()), top + float(y.mean()), side, elongation=1.0, white=0.0, black=0.0)
        distance = _square_distance(thumbnail.shape, target)
        ring = thumbnail[(distance > 1.12) & (distance < 1.2)]
        inside = thumbnail[(distance > 0.4) & (distance < 0.85)]
        middle = thumbnail[distance < 0.03 + 1.5 / side]
        if ring.size < 8 or inside.size < 8 or middle.size < 1:
            continue
        white, black = float(np.median(ring)), float(np.median(inside))
        if white > 2.5 * black and float(middle.max()) - black > max(0.05 * (white - black), 4 * float(inside.std())):
            yield replace(target, white=white, black=black)


def _square_distance(shape: tuple[int, ...], target: Target) -> Array:
    """Distance from the square's centre in half sides, the larger of both axes: 1 on its edge."""
    rows, columns = np.indices(shape)
    offset = np.maximum(np.abs(rows - target.y), np.abs(columns - target.x))
    return np.asarray(offset / (target.side_px / 2))


def _refined(light: Array, rough: Target) -> Target:
    """Centre, side and levels from the light of the whole square, which blur moves but keeps."""
    target = rough
    for _ in range(2):
        half = int(0.62 * target.side_px) + 2
        top, left = max(round(target.y) - half, 0), max(round(target.x) - half, 0)
        crop = light[top : round(target.y) + half + 1, left : round(target.x) + half + 1]
        local = replace(target, x=target.x - left, y=target.y - top)
        distance = _square_distance(crop.shape, local)
        paper, ink = (distance > 1.12) & (distance < 1.22), (distance > 0.5) & (distance < 0.85)
        rows, columns = np.indices(crop.shape)
        plane = np.stack([np.ones(crop.shape), rows - local.y, columns - local.x], axis=-1)
        white = plane @ np.linalg.lstsq(plane[paper], crop[paper], rcond=None)[0]
        black = float(np.median(crop[ink] / white[ink]))
        share = np.clip((1 - crop / white) / (1 - black), -0.2, 1.2)
        share[distance < 0.5] = 1.0  # the dot counts as part of the square
        share[distance > 1.15] = 0.0
        area = float(share.sum())
        x, y = float((share * columns).sum() / area), float((share * rows).sum() / area)
        width, height = (
            math.sqrt(12 * float((share * (axis - middle) ** 2).sum()) / area)
            for axis, middle in ((columns, x), (rows, y))
        )
        level = float(np.median(white))
        target = Target(x + left, y + top, math.sqrt(area), max(width / height, height / width), level, black * level)
    return target
