"""Windows of pixels around each pixel of a map."""

import torch.nn.functional as functional
from torch import Tensor


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
