"""A Bayer mosaic to three colours, by the mean of what was measured around each pixel."""

from __future__ import annotations

import numpy as np

from ..result import Array

__all__ = ["PATTERNS", "demosaiced"]

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Colours of the upper left four pixels, by rows."""

_CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
_SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4


def demosaiced(mosaic: Array, pattern: str) -> Array:
    """Red, green and blue of a mosaic, interpolated bilinearly.

    It is linear, alike in the sharp and the blurred picture, and adds no colour that is not there: all that a fit asks.

    Args:
        mosaic: `[H, W]`, one colour a pixel, linear light.
        pattern: one of `PATTERNS`.

    Returns:
        `[3, H, W]`.
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
