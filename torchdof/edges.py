"""Pixels at a depth edge that hold two surfaces: light of both, depth of one.

A sharp image is anti-aliased, its depth map is not. Along every edge some pixels mix the light of the surface in front
with that of the one behind, and carry the depth of only one of them; blurred with that depth, the other's share goes to
the wrong place, as a thin line beside an edge or a ring around a highlight.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["Surface", "split_edges"]

_REACH = 2  # pixels to each side in which the two surfaces' own light is looked for
_PRIOR = 0.25  # standard deviation of the cover that the depth map's outline alone tells
_NOISE = 1e-5  # smallest variance of a surface's light, for light around 1


class Surface(NamedTuple):
    """One surface a pixel: its own light (not multiplied by its cover), signed coc, and cover in [0, 1]."""

    light: Tensor
    coc_px: Tensor
    cover: Tensor


def split_edges(image: Tensor, coc_px: Tensor, edge_px: float = 1.0) -> tuple[Surface, Surface]:
    """Splits every pixel at a depth edge into the surface in front and the one behind.

    The light of both is estimated from the neighbours that lie wholly on one of them; the cover is the share that
    explains the pixel, held by the outline that the depth map draws where the two look alike. What neither explains
    goes to the surface whose light is less certain, so that no light is lost or made.

    Args:
        image: ``[B, C, H, W]``, linear light, >= 0.
        coc_px: ``[B, 1, H, W]``, signed circle of confusion.
        edge_px: Neighbours whose coc differs by more than this lie on different surfaces.

    Returns:
        The surface in front (cover 1 away from edges) and the one behind (cover 1 at edges, 0 elsewhere).
        ``front.cover * front.light + (1 - front.cover) * back.light`` is the image at edges.

    Example:
        >>> image = torch.tensor([1.0, 1.0, 0.3, 0.0, 0.0]).expand(1, 1, 5, 5)
        >>> coc = torch.tensor([-9.0, -9.0, 0.0, 0.0, 0.0]).expand(1, 1, 5, 5)
        >>> front, _ = split_edges(image, coc)
        >>> [round(x, 1) for x in front.cover[0, 0, 2].tolist()]
        [1.0, 1.0, 0.3, 1.0, 1.0]
    """
    near3, far3 = _neighbours(coc_px, 1).amin(2), _neighbours(coc_px, 1).amax(2)
    behind = coc_px - near3 > edge_px
    front_coc, back_coc = torch.where(behind, near3, coc_px), torch.where(behind, coc_px, far3)
    edge = back_coc - front_coc > edge_px
    front, front_variance = _own_light(image, coc_px, front_coc, ~edge, edge_px)
    back, back_variance = _own_light(image, coc_px, back_coc, ~edge, edge_px)

    weights = image.new_tensor([1.0, 2.0, 1.0, 2.0, 4.0, 2.0, 1.0, 2.0, 1.0]).reshape(1, 1, 9, 1, 1) / 16
    around = _neighbours(coc_px, 1)
    nearer = (around - front_coc[:, :, None]).abs() < (around - back_coc[:, :, None]).abs()
    outline = (nearer * weights).sum(2)
    contrast = front - back
    power = contrast.square().sum(1, keepdim=True)
    explained = ((image - back) * contrast).sum(1, keepdim=True) / power.clamp_min(1e-12)
    variance = outline**2 * front_variance + (1 - outline) ** 2 * back_variance
    certainty = power / image.shape[1] / variance
    cover = ((certainty * explained + outline / _PRIOR**2) / (certainty + 1 / _PRIOR**2)).clamp(0.0, 1.0)

    rest = image - (cover * front + (1 - cover) * back)
    blame = cover**2 * front_variance + (1 - cover) ** 2 * back_variance
    back = (back + rest * (1 - cover) * back_variance / blame.clamp_min(1e-12)).clamp_min(0.0)
    back = torch.minimum(back, image / (1 - cover).clamp_min(1e-6))
    front = ((image - (1 - cover) * back) / cover.clamp_min(1e-6)).clamp_min(0.0)
    front = torch.where(edge & (cover > 1e-3), front, image)
    return (
        Surface(front, torch.where(edge, front_coc, coc_px), torch.where(edge, cover, 1.0)),
        Surface(torch.where(edge, back, image), torch.where(edge, back_coc, coc_px), edge.to(image.dtype)),
    )


def _neighbours(values: Tensor, reach: int) -> Tensor:
    """``[B, C, (2 reach + 1)^2, H, W]``; beyond the frame its border is repeated."""
    side = 2 * reach + 1
    padded = functional.pad(values, (reach,) * 4, mode="replicate")
    windows = padded.unfold(2, side, 1).unfold(3, side, 1)  # [B, C, H, W, side, side]
    return windows.flatten(4).permute(0, 1, 4, 2, 3)


def _own_light(image: Tensor, coc: Tensor, wanted: Tensor, whole: Tensor, edge_px: float) -> tuple[Tensor, Tensor]:
    """Mean and variance of the light of the neighbours at a coc; pixels that are not at an edge count far more."""
    axis = torch.arange(-_REACH, _REACH + 1, device=image.device, dtype=image.dtype)
    nearness = torch.exp(-(axis[:, None] ** 2 + axis[None, :] ** 2) / 3.0).reshape(1, 1, -1, 1, 1)
    same = (_neighbours(coc, _REACH) - wanted[:, :, None]).abs() < edge_px / 2
    weight = nearness * same * (_neighbours(whole.to(image.dtype), _REACH) + 1e-3)
    total = weight.sum(2).clamp_min(1e-12)
    light = _neighbours(image, _REACH)
    mean = (light * weight).sum(2) / total
    variance = ((light - mean[:, :, None]).square() * weight).sum(2) / total
    return mean, variance.mean(1, keepdim=True) + _NOISE
