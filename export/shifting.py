"""Linear interpolation by whole maps that are enlarged and shifted: runtimes are slow at lists of single pixels."""

from collections.abc import Iterator

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["samples"]


def samples(values: Tensor, size: int, ratio: float, half_px: tuple[Tensor, Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
    """The samples around each pixel of a square map, and their shares of the linear mean.

    Args:
        values: Samples ``[B, C, n, n]`` at every ``ratio``-th pixel of the map, among them all around its pixels.
        size: Of the map.
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
    first = (step * values.shape[-1] - size - step) // 2  # of the samples before the first pixel
    place = 2 * torch.arange(size, device=values.device) + 2 * first + 1
    shares = [((place % (2 * step)).to(values.dtype) + half) / (2 * step) for half in half_px]
    down, right = ((1.0 - share, share) for share in shares)
    for row in (0, 1):
        for column in (0, 1):
            top, left = first + row * step, first + column * step
            yield enlarged[..., top : top + size, left : left + size], down[row][:, None] * right[column]
