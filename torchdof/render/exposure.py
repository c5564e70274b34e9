"""Scale very bright light down, so that sums of its powers in matting and splatting do not overflow.

The scale is a power of two, which rounds nothing; the rendered picture is scaled back.
"""

import functools
import math

import torch
from torch import Tensor

_SUMMED = 16  # log2 of the largest number of terms in a sum of light; larger: scales down earlier


def scale_of(light: Tensor, behind: Tensor | None = None) -> Tensor:
    """Scale of the light of each item at which no sum overflows: ``[B, 1, 1, 1]``, at most 1.

    ``light`` and the light ``behind`` it are ``[B, C, H, W]``; matting sums fourth powers of the first. Values that are
    not finite are ignored.

    Example:
        >>> scale_of(torch.full((1, 3, 4, 5), 1e30)).log2().item()
        -72.0
    """
    excesses = []
    for values, power in ((light, 4), (behind, 1)):
        if values is not None:
            steps = (math.frexp(torch.finfo(values.dtype).max)[1] - _SUMMED) // power  # float32: 28, 112
            level = values.detach().abs()
            peak = torch.where(torch.isfinite(level), level, 0.0).amax((1, 2, 3), keepdim=True)
            excesses.append((peak / 2.0**steps).clamp_min(1.0).log2().ceil())  # times that light must be halved
    return torch.exp2(-functools.reduce(torch.maximum, excesses))
