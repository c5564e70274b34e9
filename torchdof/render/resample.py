"""Resamples a depth map to the size of its image."""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import validation
from .edges import repair_edges

_LARGEST_FACTOR = 4  # largest enlargement in one step: its ramps are the widest that the repair takes for edges


def at_size_of(image: Tensor, depth: Tensor) -> Tensor:
    """Resamples a depth map to the size of its image, as 1 / depth, then moves its edges to those of the image.

    A map that is more than four times smaller is enlarged in several equal steps, each followed by the repair.

    Args:
        image: ``[B, C, H, W]``, linear light.
        depth: ``[B, 1, h, w]`` or ``[1, 1, h, w]``, metres, ``inf`` allowed, with the image's field of view. If the
            aspect ratio differs by up to 3 %, the map is stretched. Pixels without depth (NaN, zero or negative) stay
            without depth and affect no others.

    Returns:
        ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres; a map of the image's size is returned unchanged. Gradients
        flow to the depth except at repaired edges.

    Raises:
        ValueError: If the shapes are not as described, or the aspect ratios differ by more than 3 %.

    Example:
        >>> at_size_of(torch.rand(1, 3, 8, 12), torch.full((1, 1, 4, 6), 2.0)).shape
        torch.Size([1, 1, 8, 12])
    """
    validation.real_tensor("image", image, "[B, C, H, W]")
    validation.real_tensor("depth", depth, "[B, 1, h, w] in metres")
    if image.shape[-2:] == depth.shape[-2:]:
        return depth
    validation.same_aspect(image, depth)
    return _resized(image, depth)


def _resized(image: Tensor, depth: Tensor) -> Tensor:
    """The steps of :func:`at_size_of`, for shapes that are checked."""
    size, given = (image.shape[-2], image.shape[-1]), (depth.shape[-2], depth.shape[-1])
    if max(size[0] / given[0], size[1] / given[1]) > _LARGEST_FACTOR:
        between = (round(math.sqrt(size[0] * given[0])), round(math.sqrt(size[1] * given[1])))
        depth = _resized(functional.interpolate(image, between, mode="area"), depth)
        given = between
    known = (depth > 0).to(depth.dtype)
    inverse = torch.where(depth > 0, 1.0 / depth, 0.0)

    def enlarged_or_averaged(values: Tensor) -> Tensor:
        if given[0] > size[0]:
            return functional.interpolate(values, size, mode="area")
        return functional.interpolate(values, size, mode="bilinear", align_corners=False)

    share = enlarged_or_averaged(known)
    mean = enlarged_or_averaged(inverse) / share.clamp_min(torch.finfo(depth.dtype).tiny)
    return repair_edges(image, torch.where(share >= 0.5, 1.0 / mean, torch.nan))
