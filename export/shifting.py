"""Linear interpolation by whole maps that are enlarged and shifted: runtimes are slow at lists of single pixels."""

from collections.abc import Iterator

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["samples"]


def samples(
    values: Tensor, size: tuple[int, int], ratio: float, half_px: tuple[Tensor, Tensor]
) -> Iterator[tuple[Tensor, Tensor]]:
    """The samples around each pixel of a map, and their shares of the linear mean.

    Args:
        values: Samples ``[B, C, h, w]`` at every ``ratio``-th pixel of the map; beyond a ratio of 1 one more on each
            side.
        size: Height and width of the map.
        ratio: 1/2, 1 or more powers of two. Up to 1 both have one centre.
        half_px: How many halves of a pixel of the map, 0 or 1, its centre lies below and right of that of the samples.
    """
    if ratio < 1:  # midway between four
        share = values.new_full((), 0.25)
        yield from ((values[..., row::2, column::2], share) for row in (0, 1) for column in (0, 1))
        return
    if ratio == 1:
        yield values, values.new_ones(())
        return
    step = int(ratio)
    enlarged = functional.interpolate(values, scale_factor=float(step), mode="nearest")
    first = step // 2  # of the samples before the first pixel
    shares = []
    for n, half in zip(size, half_px, strict=True):
        place = 2 * torch.arange(n, device=values.device) + 2 * first + 1
        share = ((place % (2 * step)).to(values.dtype) + half) / (2 * step)
        shares.append((1.0 - share, share))
    down, right = shares
    for row in (0, 1):
        for column in (0, 1):
            shifted = enlarged.narrow(-2, first + row * step, size[0]).narrow(-1, first + column * step, size[1])
            yield shifted, down[row][:, None] * right[column]
