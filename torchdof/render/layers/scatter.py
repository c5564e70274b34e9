"""The paper's scatter, literally: multiply each pixel's light by a kernel centred on the pixel, and add up.

Light scattered beyond the frame's border is lost, and no light comes from there.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...optics.placed_kernels import FieldMask, placed
from ...tensors import is_traced
from .convolution import DIRECT_TAPS, widest_float

_COLUMN_BYTES = 256 * 2**20  # bytes of the columns in memory at once; larger: fewer, larger strips


def fold(
    light: Tensor,
    kernels: Tensor,
    halo: int = 0,
    weights: Tensor | None = None,
    masks: Sequence[FieldMask] | None = None,
    frame: tuple[int, int] = (0, 0),
) -> Tensor:
    """Multiply the light of each pixel by its kernel, and add the products where they land (``torch``'s ``fold``).

    The products are made for strips of rows that take at most 256 MB. Large kernels are summed in float64.

    Args:
        light: ``[B, C, H, W]``.
        kernels: ``[1 or C, k, k]``, k odd; or, with weights, a bank of them ``[n, 1 or C, k, k]``.
        halo: Pixels on each side that scatter into the result ``[B, C, H - 2 halo, W - 2 halo]`` but are not in it.
        weights: Weight of each kernel of the bank in the kernel of each pixel, ``[B, n, H, W]``.
        masks: Masks that change each kernel of the bank across the frame.
        frame: Height and width of the frame of the masks, which begins ``halo`` pixels after the light.

    Reference:
        Sato, Dobashi, Yamamoto, section 3, steps (a) to (c). The adjoint is ``unfold``.
    """
    batch, channels, height, width = light.shape
    if weights is None:
        kernels, weights = kernels.unsqueeze(0), light.new_ones(1, 1, 1, 1).expand(batch, 1, height, width)
    size, wide = kernels.shape[-1], widest_float(light.device)
    half = size // 2
    if size * size > DIRECT_TAPS and light.dtype != wide and not is_traced():
        return fold(light.to(wide), kernels.to(wide), halo, weights.to(wide), masks, frame).to(light.dtype)
    rows = max(1, _COLUMN_BYTES // (batch * channels * size * size * width * light.element_size()))
    strips = []
    for top in range(0, height, rows):
        strip, weight = (t[:, :, top : top + rows] for t in (light, weights))
        # the kernel of each pixel
        if masks is None:
            taps = torch.einsum("bnp,nct->bctp", weight.flatten(2), kernels.flatten(2))
        else:
            taps = light.new_zeros(())
            for kernel, mask, part in zip(kernels, masks, weight.flatten(2).unbind(1), strict=True):
                block = ((top - halo, -halo), (strip.shape[-2], width))
                each = _of_pixels(kernel, mask, *block, frame)  # [pixels, C, k, k]
                taps = taps + torch.einsum("bp,pct->bctp", part, each.flatten(2))
        columns = strip.flatten(2).unsqueeze(2) * taps  # [B, C, k*k, pixels]
        area = (strip.shape[-2] + 2 * half, width + 2 * half)
        strips.append((top, functional.fold(columns.flatten(1, 2), area, (size, size))))
    scattered = strips[0][1]
    if len(strips) > 1:
        scattered = light.new_zeros(batch, channels, height + 2 * half, width + 2 * half)
        for top, strip in strips:
            scattered[:, :, top : top + strip.shape[-2]] += strip
    inset = half + halo
    return scattered[:, :, inset : inset + height - 2 * halo, inset : inset + width - 2 * halo]


def _of_pixels(
    kernel: Tensor, mask: FieldMask, first: tuple[int, int], count: tuple[int, int], size: tuple[int, int]
) -> Tensor:
    """The masked kernel of each pixel of a block of a frame of ``size``, ``[n, 1 or C, k, k]``.

    ``first`` are row and column of the block's first pixel, ``count`` its rows and columns.
    """
    half_diagonal = 0.5 * math.hypot(*size)
    y, x = (
        (torch.arange(n, dtype=kernel.dtype, device=kernel.device) + (start + 0.5 - side / 2)) / half_diagonal
        for n, start, side in zip(count, first, size, strict=True)
    )
    y, x = (t.flatten() for t in torch.meshgrid(y, x, indexing="ij"))
    each = kernel[: mask.values.shape[0]] if mask.values.shape[0] > 1 else kernel  # those of C colours may be repeated
    return placed(each[None], [(mask.to(kernel), kernel.new_ones(()))], y, x).repeat(1, len(kernel) // len(each), 1, 1)
