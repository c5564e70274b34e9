"""kornia's filter2d with discs of 16 radii; each pixel takes the result with the nearest radius."""

import torch
from kornia.filters import filter2d
from torch import Tensor

NAME = "kornia, 16 bins"
_BINS = 16
_SAMPLES_PER_PX = 8  # samples along a pixel


def blur(image: Tensor, coc_px: Tensor) -> Tensor:
    """Blurs ``image`` ``[1, C, H, W]`` by ``coc_px`` ``[1, 1, H, W]``."""
    radius = coc_px.abs()
    radii = torch.linspace(0.0, float(radius.max()), _BINS)
    nearest = (radius[..., None] - radii).abs().argmin(-1)
    out = torch.zeros_like(image)
    for index, size in enumerate(radii.tolist()):
        if bool((nearest == index).any()):
            blurred = image if size < 0.5 else filter2d(image, _disc(size), border_type="replicate")
            out = torch.where(nearest == index, blurred, out)
    return out


def _disc(radius: float) -> Tensor:
    """A disc's share of each pixel, ``[1, k, k]``."""
    half = int(radius + 0.5)
    samples = (torch.arange((2 * half + 1) * _SAMPLES_PER_PX) + 0.5) / _SAMPLES_PER_PX - half - 0.5
    inside = (samples[:, None] ** 2 + samples**2 <= radius**2).float()
    coverage = torch.nn.functional.avg_pool2d(inside[None], _SAMPLES_PER_PX)
    return coverage / coverage.sum()
