"""Resamples a depth map to the size of its image."""

import math
import warnings

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...validation import image_and_map, real_tensor, show, stretch, stretched, upright
from .edges import repair_edges

_LARGEST_FACTOR = 4  # largest enlargement in one step: its ramps are the widest that the repair takes for edges


def at_size_of(image: Tensor, depth: Tensor) -> Tensor:
    """Resamples a depth map to the size of its image, as 1 / depth, then moves its edges to those of the image.

    A map that is more than four times smaller is enlarged in several equal steps, each followed by the repair. A map of
    another aspect ratio is stretched, with a warning: estimators work on squares, or on multiples of several pixels.

    Args:
        image: ``[B, C, H, W]``, linear light.
        depth: ``[B, 1, h, w]`` or ``[1, 1, h, w]``, metres, ``inf`` allowed, with the image's field of view. Pixels
            without depth (NaN, zero or negative) stay without depth and affect no others.

    Returns:
        ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres; a map of the image's size is returned unchanged. Gradients
        flow to the depth except at repaired edges.

    Raises:
        ValueError: If the shapes are not as described, or the map would fit only after a turn by 90 degrees.

    Example:
        >>> at_size_of(torch.rand(1, 3, 8, 12), torch.full((1, 1, 4, 6), 2.0)).shape
        torch.Size([1, 1, 8, 12])
    """
    real_tensor("image", image, "[B, C, H, W]")
    real_tensor("depth", depth, "[B, 1, h, w] in metres")
    if image.shape[-2:] == depth.shape[-2:]:
        return depth
    if stretch(image, depth) is None:
        raise ValueError(f"image must be [B, C, H, W] and depth [B, 1, h, w], got {show(image)} and {show(depth)}")
    if image.ndim == 4 and image.shape[1:3] == depth.shape[-2:]:  # height, width, channels: refused with the remedy
        image_and_map(image, "depth", depth, "in metres")
    upright(image, depth)
    if note := stretched(image, depth):
        warnings.warn(f"{note} to the shape of the image; both must show the same area", stacklevel=2)
    return resampled(image, depth)


def resampled(image: Tensor, depth: Tensor) -> Tensor:
    """The steps of :func:`at_size_of`, for shapes that are checked."""
    size, given = (image.shape[-2], image.shape[-1]), (depth.shape[-2], depth.shape[-1])
    if size == given:
        return depth
    if max(size[0] / given[0], size[1] / given[1]) > _LARGEST_FACTOR:
        between = (round(math.sqrt(size[0] * given[0])), round(math.sqrt(size[1] * given[1])))
        depth = resampled(functional.interpolate(image, between, mode="area"), depth)
        given = between
    known = (depth > 0).to(depth.dtype)
    inverse = torch.where(depth > 0, 1.0 / depth, 0.0)

    def averaged_then_enlarged(values: Tensor) -> Tensor:
        smaller = (min(size[0], given[0]), min(size[1], given[1]))
        values = functional.interpolate(values, smaller, mode="area") if smaller != given else values
        if smaller == size:
            return values
        return functional.interpolate(values, size, mode="bilinear", align_corners=False)

    share = averaged_then_enlarged(known)
    mean = averaged_then_enlarged(inverse) / share.clamp_min(torch.finfo(depth.dtype).tiny)
    return repair_edges(image, torch.where(share >= 0.5, 1.0 / mean, torch.nan))
