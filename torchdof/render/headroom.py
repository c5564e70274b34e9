"""Room above the light: matting and splatting take its powers, and those must not overflow.

Light that is too bright for that is scaled down for the time of a rendering, by a power of two: nothing is rounded.
"""

import math

import torch
from torch import Tensor

from ..tensors import is_traced

__all__ = ["factor", "has_room"]

_SUMMED = 16  # the power of two of so many terms as no sum of light has


def factor(light: Tensor, behind: Tensor | None = None) -> Tensor:
    """What to multiply the light of each item with so that it has room: ``[B, 1, 1, 1]``, at most 1.

    Args:
        light: ``[B, C, H, W]``, of which fourth powers are summed; what is not finite does not count.
        behind: ``[B, C, H, W]``, of which only the light itself is.

    Example:
        >>> factor(torch.full((1, 3, 4, 5), 1e30)).log2().item()
        -72.0
    """
    excess = _excess(light, power=4)
    if behind is not None:
        excess = torch.maximum(excess, _excess(behind, power=1))
    return torch.exp2(-excess)


def has_room(scale: Tensor) -> bool:
    """Whether a :func:`factor` changes nothing; traced code, which cannot look at it, always applies it."""
    return not is_traced() and bool((scale == 1.0).all())


def _excess(light: Tensor, power: int) -> Tensor:
    """How many times each item's light must be halved, ``[B, 1, 1, 1]``: whole numbers."""
    steps = (math.frexp(torch.finfo(light.dtype).max)[1] - _SUMMED) // power  # in float32 28, or 112
    level = light.detach().abs()
    peak = torch.where(torch.isfinite(level), level, 0.0).amax((1, 2, 3), keepdim=True)
    return (peak / 2.0**steps).clamp_min(1.0).log2().ceil()
