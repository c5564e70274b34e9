"""Degrades exact depth like measured and estimated depth.

Estimators and upsampling smooth 1 / depth across edges; stereo displaces edges; files quantise. Rendering with degraded
depth and comparing with the unchanged truth gives the cost of the degradation.
"""

from collections.abc import Callable, Mapping

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["KINDS", "degrade"]


def degrade(depth: Tensor, kind: str) -> Tensor:
    """Exact depth ``[1, 1, H, W]`` in metres, degraded in one way, the name of one of :data:`KINDS`.

    Example:
        >>> degrade(torch.tensor([[[[2.0, 2.0, 1.0, 1.0]]]]), "shift 1px")
        tensor([[[[1., 2., 2., 1.]]]])
    """
    return KINDS[kind](depth)


def _resampled(depth: Tensor, factor: int) -> Tensor:
    small = functional.interpolate(1 / depth, size=[n // factor for n in depth.shape[-2:]], mode="area")
    return 1 / functional.interpolate(small, size=depth.shape[-2:], mode="bilinear", align_corners=False)


def _blurred(depth: Tensor, sigma: float) -> Tensor:
    reach = int(3 * sigma + 0.5)
    kernel = torch.exp(-(torch.arange(-reach, reach + 1, dtype=depth.dtype) ** 2) / (2 * sigma**2))
    kernel = kernel / kernel.sum()
    inverse = functional.pad(1 / depth, (reach,) * 4, mode="replicate")
    rows = functional.conv2d(inverse, kernel.view(1, 1, 1, -1))
    return 1 / functional.conv2d(rows, kernel.view(1, 1, -1, 1))


def _quantised(depth: Tensor, levels: int) -> Tensor:
    inverse = 1 / depth
    low, high = inverse.min(), inverse.max()
    steps = ((inverse - low) / (high - low).clamp_min(1e-12) * levels).round()
    return 1 / (steps / levels * (high - low) + low).clamp_min(1e-6)


def _dilated(depth: Tensor, reach: int) -> Tensor:
    """The nearest depth within ``reach`` pixels (square window), or the farthest within ``-reach``."""
    side = 2 * abs(reach) + 1
    sign = -1.0 if reach > 0 else 1.0
    return sign * functional.max_pool2d(sign * depth, side, 1, abs(reach))


def _displaced(depth: Tensor, sigma: float) -> Tensor:
    """Displaces edges by some pixels, with slowly varying direction."""
    height, width = depth.shape[-2:]
    generator = torch.Generator().manual_seed(0)
    coarse = torch.randn(1, 2, height // 12 + 1, width // 12 + 1, generator=generator)
    offset = sigma * functional.interpolate(coarse, size=(height, width), mode="bicubic")[0]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    grid = torch.stack([(x + offset[0]) / width * 2 - 1, (y + offset[1]) / height * 2 - 1], -1)[None]
    return functional.grid_sample(depth, grid.to(depth), mode="nearest", padding_mode="border", align_corners=False)


KINDS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "exact": lambda z: z,
    "half-res": lambda z: _resampled(z, 2),
    "quarter-res": lambda z: _resampled(z, 4),
    "shift 1px": lambda z: torch.roll(z, 1, -1),
    "near -1px": lambda z: _dilated(z, -1),  # foreground colour on background depth
    "near -2px": lambda z: _dilated(z, -2),
    "near +1px": lambda z: _dilated(z, 1),
    "displaced": lambda z: _displaced(z, 1.5),
    "blur 1.5": lambda z: _blurred(z, 1.5),  # typical of estimators
    "8 bit": lambda z: _quantised(z, 255),
    "noise 1%": lambda z: z * (1 + 0.01 * torch.randn(z.shape, generator=torch.Generator().manual_seed(0))),
}
"""The degradations, by name."""
