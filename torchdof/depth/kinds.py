"""Depth values of any stated kind to metres along the optical axis."""

import math
from typing import Literal

import torch
from torch import Tensor

from ..validation import choice, number, one_channel

__all__ = ["DepthKind", "depth_from_values"]

DepthKind = Literal["z", "distance", "disparity", "inverse", "coc"]
KINDS: tuple[DepthKind, ...] = ("z", "distance", "disparity", "inverse", "coc")


def depth_from_values(
    values: Tensor,
    kind: DepthKind = "z",
    *,
    scale: float | None = None,
    offset: float = 0.0,
    unknown: float | None = None,
    fov_x_deg: float | None = None,
) -> Tensor:
    """Converts the numbers of a depth map to metres along the optical axis; pixels without depth become NaN.

    =========== ============================================== ==========================================
    kind        result                                         for
    =========== ============================================== ==========================================
    z           ``scale * (value + offset)``                   renderers; millimetre maps (scale 0.001)
    distance    the same, converted from ray length to z       path tracers, lidar
    disparity   ``scale / (value + offset)``                   stereo: scale = baseline [m] * focal [px]
    inverse     ``scale / (value + offset)``                   inverse depth, learned depth
    coc         ``scale * (value + offset)``, signed px        ready circles of confusion
    =========== ============================================== ==========================================

    Args:
        values: ``[B, 1, H, W]``.
        kind: Kind of the numbers.
        scale: Factor; None means 1, but is refused for disparity.
        offset: Added to the value before scaling.
        unknown: A value that marks pixels without depth, for example 0, -1 or inf. NaN always does, and so does every
            value whose result is zero, negative or NaN (a disparity of inf, for example); for coc, NaN and inf. -inf
            of "z" and "distance" means too near to be measured, and becomes the smallest depth of the item.
        fov_x_deg: Horizontal field of view in degrees; required for "distance".

    Returns:
        ``[B, 1, H, W]`` float32 in metres (pixels for coc), ``> 0`` or ``inf``, NaN where unknown.

    Raises:
        ValueError: If the kind is unknown or lacks the scale or field of view that it needs.

    Example:
        >>> depth_from_values(torch.tensor([[[[1500.0, 0.0]]]]), "z", scale=0.001)
        tensor([[[[1.5000,    nan]]]])
    """
    choice("the kind of depth", kind, KINDS)
    one_channel("depth values", values, whole=True)
    if kind == "disparity" and scale is None:
        raise ValueError(
            "disparity needs a scale (--depth-scale): the baseline in metres times the focal length in pixels; "
            "if it is unknown, treat the map as relative depth: from_relative (--depth-kind relative)"
        )
    scale = number("scale (--depth-scale)", 1.0 if scale is None else scale, -1e300, 1e300)
    if scale == 0.0:
        raise ValueError("scale (--depth-scale) must not be 0, got 0")
    offset = number("offset (--depth-offset)", offset, -1e300, 1e300)
    if unknown is not None and not math.isnan(unknown if isinstance(unknown, float) else 0.0):
        unknown = number("unknown", unknown, infinite=True)
    # in double precision and in place, because maps have millions of pixels
    depth = values.to(torch.float64, copy=True)
    if unknown is not None:
        depth.masked_fill_(depth == unknown, math.nan)
    if offset:
        depth += offset
    if kind in ("disparity", "inverse"):
        depth = scale / depth
    elif scale != 1.0:
        depth *= scale
    if kind == "distance":
        if fov_x_deg is None:
            raise ValueError("distance along the ray needs the horizontal field of view (--fov-deg) to become depth")
        number("the field of view", fov_x_deg, 0.0, 180.0, "degrees")
        slope = max(math.tan(math.radians(fov_x_deg) / 2), 1e-300) * 2 / depth.shape[-1]  # of the ray, for each pixel
        y, x = ((torch.arange(n, dtype=depth.dtype, device=depth.device) + 0.5 - n / 2) for n in depth.shape[-2:])
        depth /= torch.sqrt(1.0 + (x * slope) ** 2 + (y[:, None] * slope) ** 2)
    metres = depth.float()
    is_known = metres.isfinite() if kind == "coc" else metres > 0
    if kind in ("z", "distance") and unknown != -math.inf:
        nearest = torch.where(is_known & metres.isfinite(), metres, torch.inf).amin((1, 2, 3), keepdim=True)
        is_too_near = (values == -math.inf) & nearest.isfinite()
        metres, is_known = torch.where(is_too_near, nearest, metres), is_known | is_too_near
    return torch.where(is_known, metres, torch.nan)
