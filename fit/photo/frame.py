"""A whole picture as the camera took it: in linear light, demosaiced, the dark subtracted; and what its file says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchdof.io.images import read_image
from torchdof.io.metadata import camera_facts, original_width
from torchdof.io.transfer import Transfer

from ..problems import FitError
from ..result import Array

__all__ = ["PATTERNS", "Frame", "demosaiced", "read_frame", "size_of"]

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Colours of the upper left four pixels of a mosaic, by rows."""

_CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
_SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4


@dataclass(frozen=True)
class Frame:
    """A picture in linear light, and what its file says.

    Attributes:
        file: where it came from.
        light: `[H, W]`, mean of its colours.
        colours: `[C, H, W]`.
        white: the level at which it is clipped, or None.
        encoded: whether it was stored in integers, and decoded as sRGB.
        width_px: of the whole picture.
        middle: (x, y) of the whole picture's centre in px of `light`.
        facts: what EXIF says about the camera.
        original_width_px: width at which EXIF says it was taken, where that is larger than its own.
    """

    file: Path
    light: Array
    colours: Array
    white: float | None
    encoded: bool
    width_px: int
    middle: tuple[float, float]
    facts: Mapping[str, float]
    original_width_px: int | None


def read_frame(
    path: Path,
    transfer: Transfer | None,
    dark: Frame | None = None,
    crop: tuple[int, int, int, int] | None = None,
    bayer: str | None = None,
) -> Frame:
    """Read a picture.

    Args:
        path: of its file.
        transfer: how it is encoded; None takes integers as sRGB and floats as linear.
        dark: with the lens cap on, to subtract.
        crop: left, top, width and height in px; what lies outside is left out.
        bayer: one of `PATTERNS`, of a picture with one colour a pixel.

    Raises:
        FitError: of kind "manifest" where crop or mosaic do not go with the picture, of kind "not finite" for NaN in
            it, or a dark frame of another size.
        OSError: it is missing or damaged.
    """
    picture = read_image(path, transfer=transfer)
    pixels = picture.pixels[0].numpy().astype(np.float64)
    pixels = pixels[[i for i, name in enumerate(picture.channels) if name != "A"]]
    if bayer is not None:
        if len(pixels) != 1:
            text = f"bayer = {bayer!r} is for pictures with one colour a pixel, got {len(pixels)} colours"
            raise FitError(text, "manifest", file=str(path))
        pixels = demosaiced(pixels[0], bayer)
    height, width = pixels.shape[1:]
    left, top, columns, rows = crop or (0, 0, width, height)
    if left + columns > width or top + rows > height:
        raise FitError(f"crop {[left, top, columns, rows]} leaves the picture of {width}x{height}", "manifest", file=str(path))
    pixels = pixels[:, top : top + rows, left : left + columns]
    bad = int(np.sum(~np.isfinite(pixels)))
    if bad:
        raise FitError(f"{bad} values are NaN or infinite", "not finite", file=str(path), number=float(bad))
    white = 1.0 if picture.sample in ("8", "16") else None
    high = pixels >= 1.0 - 1e-6
    if dark is not None:
        if dark.colours.shape != pixels.shape:
            raise FitError(f"the dark frame is {size_of(dark.light)}, the picture {size_of(pixels[0])}", file=str(path))
        pixels = pixels - dark.colours
    light = pixels.mean(axis=0)
    if white is not None:
        pixels[high] = white
        light[high.any(axis=0)] = white  # one clipped colour clips the mean
    facts = camera_facts(picture.metadata, width)
    if height > width and "sensor_width_mm" in facts:  # turned upright: EXIF speaks of the longer side
        facts["sensor_width_mm"] *= width / height
    original = original_width(picture.metadata)
    return Frame(
        file=path,
        light=light,
        colours=pixels,
        white=white,
        encoded=white is not None and picture.transfer == "srgb",
        width_px=width,
        middle=((width - 1) / 2 - left, (height - 1) / 2 - top),
        facts=facts,
        original_width_px=original if original is not None and original > width else None,
    )


def demosaiced(mosaic: Array, pattern: str) -> Array:
    """Red, green and blue `[3, H, W]` of a mosaic `[H, W]`, interpolated bilinearly.

    It is linear, alike in the sharp and the blurred picture, and adds no colour that is not there: all that a fit asks.
    """
    from scipy.ndimage import convolve

    colours = []
    for colour, kernel in (("R", _SQUARE), ("G", _CROSS), ("B", _SQUARE)):
        sampled = np.zeros_like(mosaic)
        for i, name in enumerate(pattern):
            if name == colour:
                sampled[i // 2 :: 2, i % 2 :: 2] = mosaic[i // 2 :: 2, i % 2 :: 2]
        colours.append(convolve(sampled, kernel, mode="mirror"))
    return np.stack(colours)


def size_of(picture: Array) -> str:
    """Width x height, for messages."""
    return f"{picture.shape[1]}x{picture.shape[0]}"
