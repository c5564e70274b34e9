"""Scatters layers whose kernels depend on the place in the frame (:mod:`torchdof.optics.placed_kernels`).

Each block of the result has one kernel, that of the block's middle: within a few blocks a kernel changes by only a
fraction of a pixel. So layers use the kernel of the place where light lands; highlights use that of the place where it
comes from.
"""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...optics.placed_kernels import FieldMask, placed

BLOCK = (8, 16)
"""Height and width of a block whose pixels share a kernel, in pixels of the layer; larger: faster, less accurate."""


def scattered(mask: FieldMask, light: Tensor, kernel: Tensor, half: int, scale: int, size: tuple[int, int]) -> Tensor:
    """Scatters a layer's light with the kernel of the block in which it lands: ``[B, C, h - 2 half, w - 2 half]``.

    Args:
        mask: How the field changes the layer's kernel.
        light: ``[B, C, h, w]``; begins ``half`` pixels before the frame, or ``half + 1`` at coarser resolutions.
        kernel: Kernel of the blur table, ``[1 or C, k, k]``, of radius ``half``.
        half: Pixels on each side of ``light`` that the result lacks.
        scale: Pixel of the layer in pixels of the image.
        size: Height and width of the image.
    """
    high, wide = BLOCK
    (batch, channels), (rows, columns) = light.shape[:2], (n - 2 * half for n in light.shape[2:])
    light = functional.pad(light, (0, -columns % wide, 0, -rows % high))
    mask, whole = mask.to(light), light.new_ones(())

    def places(count: int, block: int, length: int) -> Tensor:
        """Middles of the blocks along an axis, as distances from the middle of the frame in half diagonals."""
        middle = torch.arange(0, count, block, dtype=light.dtype, device=light.device) + block / 2
        before = 1 if scale > 1 else 0  # pixels before the frame, for interpolation
        return ((middle - before) * scale - length / 2) / (0.5 * math.hypot(*size))

    x = places(columns, wide, size[1])
    bands = []
    for band, y in enumerate(places(rows, high, size[0])):
        kernels = placed(kernel[None], [(mask, whole)], y.expand_as(x), x)  # [blocks, 1 or C, k, k]
        window = light[:, :, band * high : (band + 1) * high + 2 * half]
        blocks = window.unfold(-1, wide + 2 * half, wide).permute(0, 3, 1, 2, 4)  # [B, blocks, C, rows, columns]
        each = channels // kernels.shape[1]
        kernels = kernels.repeat(1, each, 1, 1).flatten(0, 1).flip(-2, -1).unsqueeze(1)
        spread = functional.conv2d(blocks.flatten(1, 2), kernels, groups=len(kernels))
        bands.append(spread.unflatten(1, (len(x), channels)).permute(0, 2, 3, 1, 4).flatten(3))
    return torch.cat(bands, 2)[:, :, :rows, :columns].reshape(batch, channels, rows, columns)
