"""Linear interpolation by whole maps that are enlarged and shifted: runtimes are slow at lists of single pixels."""

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["samples"]


def samples(values: Tensor, size: tuple[int, int], step: int, half_px: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The four samples around each pixel of a map, and their shares of the linear mean.

    Args:
        values: Samples ``[B, C, h, w]`` at every ``step``-th pixel of the map, with one more on each side.
        size: Height and width of the map.
        step: A power of two, 2 or more.
        half_px: Offset of the map's centre from the samples' centre, below and to the right, in half pixels: 0 or 1.

    Returns:
        Samples ``[B, C, 4, H, W]`` and shares ``[4, H, W]``.
    """
    enlarged = functional.interpolate(values, scale_factor=float(step), mode="nearest")
    first = step // 2  # of the samples before the first pixel
    shares = []
    for n, half in zip(size, half_px, strict=True):
        position = 2 * torch.arange(n, device=values.device) + 2 * first + 1
        share = ((position % (2 * step)).to(values.dtype) + half) / (2 * step)
        shares.append((1.0 - share, share))
    shifted = [
        enlarged.narrow(-2, first + row * step, size[0]).narrow(-1, first + column * step, size[1])
        for row in (0, 1)
        for column in (0, 1)
    ]
    return torch.stack(shifted, 2), torch.stack([y[:, None] * x for y in shares[0] for x in shares[1]])
