"""Scatter of layers whose kernels depend on the place in the frame (:mod:`torchdof.optics.placed_kernels`).

Kernels are those of where light lands, block by block; highlights take that of where they come from. Pixels of one
block of its layer's resolution share a kernel: beyond a few blocks it changes by parts of a pixel.
"""

import functools
import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.placed_kernels import Shares, placed

__all__ = ["BLOCK", "scattered"]

BLOCK = (8, 16)
"""Rows and columns of a layer whose pixels share a kernel."""


def scattered(
    shares: Shares,
    light: Tensor,
    kernel: Tensor,
    half: int,
    scale: int,
    size: tuple[int, int],
) -> Tensor:
    """A layer's light scattered with the kernel of where it lands.

    Args:
        shares: Of the layer.
        light: ``[B, C, h, w]``; it begins ``half`` pixels before the frame, and one more at coarser resolutions.
        kernel: The table's own ``[1 or C, k, k]``.
        half: Pixels on each side that are not in the result ``[B, C, h - 2 half, w - 2 half]``.
        scale: Every so many pixels of the image are one of the layer's.
        size: Height and width of the image.
    """
    high, wide = BLOCK
    (batch, channels), (rows, columns) = light.shape[:2], (n - 2 * half for n in light.shape[2:])
    light = functional.pad(light, (0, -columns % wide, 0, -rows % high))
    shares, whole = shares.to(light), light.new_ones(())
    places = functools.partial(_places, scale=scale, half_diagonal=0.5 * math.hypot(*size))
    x = places(columns, wide, size[1], light)
    bands = []
    for band, y in enumerate(places(rows, high, size[0], light)):
        kernels = placed(kernel[None], [(shares, whole)], y.expand_as(x), x)  # [blocks, 1 or C, k, k]
        window = light[:, :, band * high : (band + 1) * high + 2 * half]
        blocks = window.unfold(-1, wide + 2 * half, wide).permute(0, 3, 1, 2, 4)  # [B, blocks, C, rows, columns]
        each = channels // kernels.shape[1]
        kernels = kernels.repeat(1, each, 1, 1).flatten(0, 1).flip(-2, -1).unsqueeze(1)
        spread = functional.conv2d(blocks.flatten(1, 2), kernels, groups=len(kernels))
        bands.append(spread.unflatten(1, (len(x), channels)).permute(0, 2, 3, 1, 4).flatten(3))
    return torch.cat(bands, 2)[:, :, :rows, :columns].reshape(batch, channels, rows, columns)


def _places(count: int, block: int, size: int, like: Tensor, scale: int, half_diagonal: float) -> Tensor:
    """Middles of the blocks along an axis, in half diagonals from the middle of the frame."""
    middle = torch.arange(0, count, block, dtype=like.dtype, device=like.device) + block / 2
    before = 1 if scale > 1 else 0  # pixels in front of the frame, to interpolate from
    return ((middle - before) * scale - size / 2) / half_diagonal
