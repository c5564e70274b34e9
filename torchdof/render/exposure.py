"""Scale very bright light down, so that sums of its powers in matting and splatting do not overflow.

The scale is a power of two, which rounds nothing; the rendered picture is scaled back.
"""

import math

import torch
from torch import Tensor

__all__ = ["scale_of"]

_SUMMED = 16  # log2 of the largest number of terms in a sum of light; larger: scales down earlier


def scale_of(light: Tensor, behind: Tensor | None = None) -> Tensor:
    """Scale of the light of each item at which no sum overflows: ``[B, 1, 1, 1]``, at most 1.

    Args:
        light: ``[B, C, H, W]``; matting sums its fourth powers. Values that are not finite are ignored.
        behind: Light behind the image, ``[B, C, H, W]``, of which only sums are computed.

    Example:
        >>> scale_of(torch.full((1, 3, 4, 5), 1e30)).log2().item()
        -72.0
    """
    excess = _excess(light, power=4)
    if behind is not None:
        excess = torch.maximum(excess, _excess(behind, power=1))
    return torch.exp2(-excess)


def _excess(light: Tensor, power: int) -> Tensor:
    """Number of times each item's light must be halved, ``[B, 1, 1, 1]``: whole numbers, as floats."""
    steps = (math.frexp(torch.finfo(light.dtype).max)[1] - _SUMMED) // power  # float32: 28 if power = 4, 112 if 1
    level = light.detach().abs()
    peak = torch.where(torch.isfinite(level), level, 0.0).amax((1, 2, 3), keepdim=True)
    return (peak / 2.0**steps).clamp_min(1.0).log2().ceil()
