"""A whole picture from the camera in linear light, and the windows around its dots."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.ndimage import convolve

from torchdof.io.images import read_image
from torchdof.io.metadata import camera_facts
from torchdof.io.transfer import Transfer

from ..problems import FitError
from ..result import Array
from .captures import Capture
from .dot import Dot, find_dot, find_dots

Dots = Literal["one", "centre", "each", "field"]

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Colours of the upper left 2 x 2 pixels of a mosaic, in rows."""

_MARGIN = 1.35  # window over the blur's reach
_CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
_SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4


@dataclass(frozen=True)
class Frame:
    """A picture in linear light, and facts from its file."""

    file: Path
    light: Array  # [H, W], mean of its colours
    colours: Array  # [C, H, W]
    white: float | None  # the clipping level
    encoded: bool  # whether it had integers, decoded as sRGB
    width_px: int  # of the whole picture
    middle: tuple[float, float]  # (x, y) of the whole picture's centre in px of `light`
    facts: Mapping[str, float]  # from EXIF, about the camera


def read_frame(
    path: Path,
    transfer: Transfer | None,
    dark: Frame | None = None,
    crop: tuple[int, int, int, int] | None = None,
    bayer: str | None = None,
) -> Frame:
    """Reads a picture; `crop` is left, top, width and height in px, `dark` was taken with the lens cap on.

    Raises:
        FitError: of kind "manifest" if crop, mosaic or dark frame do not fit the picture, of kind "not finite" if it
        has NaN.
        OSError: the file is missing or damaged.
    """
    refused = partial(FitError, kind="manifest", file=str(path))
    picture = read_image(path, transfer=transfer)
    pixels = picture.pixels[0].numpy().astype(np.float64)
    pixels = pixels[[i for i, name in enumerate(picture.channels) if name != "A"]]
    if bayer is not None:
        if len(pixels) != 1:
            raise refused(f"bayer = {bayer!r} is for pictures with one colour a pixel, got {len(pixels)} colours")
        if picture.orientation != 1:
            text = f"bayer = {bayer!r} is for pictures as the sensor is read, got one of EXIF orientation "
            raise refused(f"{text}{picture.orientation}; remove the tag")
        pixels = demosaiced(pixels[0], bayer)
    height, width = pixels.shape[1:]
    left, top, columns, rows = crop or (0, 0, width, height)
    if left + columns > width or top + rows > height:
        raise refused(f"crop {[left, top, columns, rows]} extends beyond the picture of {width}x{height}")
    pixels = pixels[:, top : top + rows, left : left + columns]
    if bad := int(np.sum(~np.isfinite(pixels))):
        raise FitError(f"{bad} values are NaN or infinite", "not finite", file=str(path), number=float(bad))
    white = 1.0 if picture.sample in ("8", "16") else None
    high = pixels >= 1.0 - 1e-6
    if dark is not None:
        if dark.colours.shape != pixels.shape:
            raise refused(f"the dark frame is {size_of(dark.light)}, the picture {size_of(pixels[0])}")
        pixels = pixels - dark.colours
    light = pixels.mean(axis=0)
    if white is not None:
        pixels[high] = white
        light[high.any(axis=0)] = white  # one clipped colour clips the mean
    encoded, middle = white is not None and picture.transfer == "srgb", ((width - 1) / 2 - left, (height - 1) / 2 - top)
    facts = camera_facts(picture.metadata, width, height)
    return Frame(path, light, pixels, white, encoded, width, middle, facts)


def demosaiced(mosaic: Array, pattern: str) -> Array:
    """Red, green and blue `[3, H, W]` of a mosaic `[H, W]`, interpolated bilinearly.

    Bilinear interpolation is linear, equal in the sharp and the blurred picture, and adds no false colour.
    """
    height, width = mosaic.shape
    names = np.tile(np.array(list(pattern)).reshape(2, 2), (height // 2 + 1, width // 2 + 1))[:height, :width]
    kernels = {"R": _SQUARE, "G": _CROSS, "B": _SQUARE}
    return np.stack([convolve(np.where(names == c, mosaic, 0.0), k, mode="mirror") for c, k in kernels.items()])


def size_of(picture: Array) -> str:
    """Width x height, for messages."""
    return f"{picture.shape[1]}x{picture.shape[0]}"


def cut_pairs(
    still: Frame, moved: Frame, focus_m: float, distance_m: float, dots: Dots, exposure: float | None, colours: bool
) -> list[Capture]:
    """Finds the dot, or the dots of a grid, in two frames and cuts the windows around each.

    `exposure` is the brightness of `moved` over that of `still`.

    Raises:
        FitError: no dot, several dots, or one too close to the frame's edge or to others.
    """
    frames = (still, moved)
    if dots == "one":
        matched = [(find_dot(still.light, file=str(still.file)), find_dot(moved.light, file=str(moved.file)))]
    else:
        matched = _matched(still, moved, focus_m / distance_m)[: 1 if dots == "centre" else None]
    pairs = []
    for first, second in matched:
        places = [(round(dot.x), round(dot.y)) for dot in (first, second)]
        height, width = still.light.shape
        border = [min(x, y, width - 1 - x, height - 1 - y) for x, y in places]
        needed = max(first.reach, second.reach) + 2
        half = min(*border, math.ceil(_MARGIN * needed) + 8)
        if half < needed:
            text = f"the frame cuts the blur: it reaches {needed:.0f} px from the dot, the frame ends after {half} px"
            worse = still if border[0] < first.reach + 2 else moved
            raise FitError(text, "window", file=str(worse.file), number=needed)
        cut = [(..., slice(y - half, y + half + 1), slice(x - half, x + half + 1)) for x, y in places]
        sharp, blurred = (frame.light[window].copy() for frame, window in zip(frames, cut, strict=True))
        for frame, window in ((still, sharp), (moved, blurred)):
            if (count := len(find_dots(window, file=str(frame.file)))) > 1:
                text = f"{count} dots in a window of {2 * half + 1} px: print the dots farther apart than their blur"
                raise FitError(text, "several dots", file=str(frame.file), number=float(count))
        pairs.append(
            Capture(
                sharp,
                blurred,
                distance_m,
                files=(str(still.file), str(moved.file)),
                white=still.white,
                exposure=exposure,
                position_px=(round(first.x - still.middle[0], 2), round(first.y - still.middle[1], 2)),
                colours=(still.colours[cut[0]].copy(), moved.colours[cut[1]].copy()) if colours else None,
            )
        )
    return pairs


def _matched(still: Frame, moved: Frame, magnification: float) -> list[tuple[Dot, Dot]]:
    """Pairs the dots of a grid in both pictures, from the centre outwards: each moves on its line to the centre."""
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
