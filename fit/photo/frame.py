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
from torchdof.io.metadata import camera_settings
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
class CameraPicture:
    """A picture in linear light, and facts from its file."""

    file: Path
    light: Array  # [H, W], mean of its colours
    colours: Array  # [C, H, W]
    white: float | None  # the clipping level
    encoded: bool  # whether it had integers, decoded as sRGB
    width_px: int  # of the whole picture
    middle: tuple[float, float]  # (x, y) of the whole picture's centre in px of `light`
    facts: Mapping[str, float]  # from EXIF, about the camera


def read_picture(
    path: Path,
    transfer: Transfer | None,
    dark: CameraPicture | None = None,
    crop: tuple[int, int, int, int] | None = None,
    bayer: str | None = None,
) -> CameraPicture:
    """Reads a picture; `crop` is left, top, width and height in px, `dark` was taken with the lens cap on."""
    invalid = partial(FitError, kind="manifest", file=str(path))
    picture = read_image(path, transfer=transfer)
    pixels = picture.pixels[0].numpy().astype(np.float64)
    pixels = pixels[[i for i, name in enumerate(picture.channels) if name != "A"]]
    if bayer is not None:
        if len(pixels) != 1:
            raise invalid(f"bayer = {bayer!r} is for pictures with one colour a pixel, got {len(pixels)} colours")
        if picture.orientation != 1:
            raise invalid(f"bayer is for unturned pictures, got EXIF orientation {picture.orientation}; remove the tag")
        pixels = demosaiced(pixels[0], bayer)
    height, width = pixels.shape[1:]
    left, top, columns, rows = crop or (0, 0, width, height)
    if left + columns > width or top + rows > height:
        raise invalid(f"crop {[left, top, columns, rows]} extends beyond the picture of {width}x{height}")
    pixels = pixels[:, top : top + rows, left : left + columns]
    white = 1.0 if picture.sample in ("8", "16") else None
    is_clipped = pixels >= 1.0 - 1e-6
    if dark is not None:
        if dark.colours.shape != pixels.shape:
            raise invalid(f"the dark frame is {size_of(dark.light)}, the picture {size_of(pixels[0])}")
        pixels = pixels - dark.colours
    light = pixels.mean(axis=0)
    if white is not None:
        pixels[is_clipped] = white
        light[is_clipped.any(axis=0)] = white  # one clipped colour clips the mean
    encoded, middle = white is not None and picture.transfer == "srgb", ((width - 1) / 2 - left, (height - 1) / 2 - top)
    facts = camera_settings(picture.metadata, width, height)
    return CameraPicture(path, light, pixels, white, encoded, width, middle, facts)


def demosaiced(mosaic: Array, pattern: str) -> Array:
    """Red, green and blue `[3, H, W]` of a mosaic `[H, W]`, interpolated bilinearly, which adds no false colour."""
    height, width = mosaic.shape
    names = np.tile(np.array(list(pattern)).reshape(2, 2), (height // 2 + 1, width // 2 + 1))[:height, :width]
    kernels = {"R": _SQUARE, "G": _CROSS, "B": _SQUARE}
    return np.stack([convolve(np.where(names == c, mosaic, 0.0), k, mode="mirror") for c, k in kernels.items()])


def size_of(picture: Array) -> str:
    """Width x height, for messages."""
    return f"{picture.shape[1]}x{picture.shape[0]}"


def cut_pairs(
    pictures: tuple[CameraPicture, CameraPicture],
    focus_m: float,
    distance_m: float,
    dots: Dots,
    exposure: float | None,
    colours: bool,
) -> list[Capture]:
    """Cuts the windows around the dot, or the dots of a grid, in a sharp and a blurred photograph."""
    sharp_picture, blurred_picture = pictures
    if dots == "one":
        first, second = (find_dot(picture.light, file=str(picture.file)) for picture in pictures)
        matched = [(first, second)]
    else:
        matched = _matched(sharp_picture, blurred_picture, focus_m / distance_m)[: 1 if dots == "centre" else None]
    pairs = []
    for sharp_dot, blurred_dot in matched:
        centres = [(round(dot.x), round(dot.y)) for dot in (sharp_dot, blurred_dot)]
        height, width = sharp_picture.light.shape
        border_px = [min(x, y, width - 1 - x, height - 1 - y) for x, y in centres]
        needed = max(sharp_dot.reach, blurred_dot.reach) + 2
        half = min(*border_px, math.ceil(_MARGIN * needed) + 8)
        if half < needed:
            text = f"the frame cuts the blur: it reaches {needed:.0f} px from the dot, the frame ends after {half} px"
            cut_picture = sharp_picture if border_px[0] < sharp_dot.reach + 2 else blurred_picture
            raise FitError(text, "window", file=str(cut_picture.file), number=needed)
        windows, colour_windows = [], []
        for picture, (x, y) in zip(pictures, centres, strict=True):
            window = ..., slice(y - half, y + half + 1), slice(x - half, x + half + 1)
            windows.append(picture.light[window].copy())
            colour_windows.append(picture.colours[window].copy())
            if (count := len(find_dots(windows[-1], file=str(picture.file)))) > 1:
                text = f"{count} dots in a window of {2 * half + 1} px: print the dots farther apart than their blur"
                raise FitError(text, "several dots", file=str(picture.file), number=float(count))
        centre = sharp_picture.middle
        pairs.append(
            Capture(
                windows[0],
                windows[1],
                distance_m,
                files=(str(sharp_picture.file), str(blurred_picture.file)),
                white=sharp_picture.white,
                exposure=exposure,
                position_px=(round(sharp_dot.x - centre[0], 2), round(sharp_dot.y - centre[1], 2)),
                colours=(colour_windows[0], colour_windows[1]) if colours else None,
            )
        )
    return pairs


def _matched(sharp: CameraPicture, blurred: CameraPicture, magnification: float) -> list[tuple[Dot, Dot]]:
    """Pairs the dots of a grid in both pictures, from the centre outwards: each moves on its line to the centre."""
    sharp_dots, blurred_dots = (find_dots(f.light, file=str(f.file), smallest=0.3) for f in (sharp, blurred))
    centre, pairs = sharp.middle, []
    for dot in sorted(sharp_dots, key=lambda d: math.dist((d.x, d.y), centre)):
        expected = [m + magnification * (v - m) for m, v in zip(centre, (dot.x, dot.y), strict=True)]
        nearest = min(blurred_dots, key=lambda d: math.dist((d.x, d.y), expected))
        spacing = min((math.dist((d.x, d.y), (dot.x, dot.y)) for d in sharp_dots if d is not dot), default=math.inf)
        if math.dist((nearest.x, nearest.y), expected) < 0.4 * magnification * spacing:
            pairs.append((dot, nearest))
    if not pairs:
        text = f"none of the {len(sharp_dots)} dots of {sharp.file.name} is found again; are the distances right?"
        raise FitError(text, "no dot", file=str(blurred.file), number=float(len(blurred_dots)))
    return pairs
