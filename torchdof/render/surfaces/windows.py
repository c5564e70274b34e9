"""Windows of pixels around each pixel of a map."""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...optics.kernel_cache import kept

LARGEST = 1e15  # largest valid nearness or coc, whose square is finite in float32
NEVER = 1e30  # negated, replaces invalid nearness in maxima


def highest(values: Tensor, reach: int) -> Tensor:
    """The largest of the ``2 reach + 1`` by ``2 reach + 1`` values ``[B, C, H, W]`` around each, within the frame."""
    side = 2 * reach + 1
    if reach == 1:
        return functional.max_pool2d(values, side, stride=1, padding=reach)
    rows = functional.max_pool2d(values, (1, side), stride=1, padding=(0, reach))
    return functional.max_pool2d(rows, (side, 1), stride=1, padding=(reach, 0))


def mean_around(values: Tensor, reach: int) -> Tensor:
    """The mean of these values, with the border's continued beyond the frame."""
    side = 2 * reach + 1
    rows = functional.avg_pool2d(functional.pad(values, (reach,) * 4, mode="replicate"), (1, side), stride=1)
    return functional.avg_pool2d(rows, (side, 1), stride=1)


@kept
def gaussian(reach: int, sigma: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Gaussian weights ``[(2 reach + 1)^2, 1]`` of a square, in the order of :func:`torchdof.pixels.around`."""
    steps = range(-reach, reach + 1)
    weights = [math.exp(-(dy * dy + dx * dx) / (2.0 * sigma**2)) for dy in steps for dx in steps]
    return torch.tensor(weights, dtype=dtype, device=device)[:, None]
