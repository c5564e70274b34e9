"""Depth values of any stated kind to metres along the optical axis."""

import math
from typing import Literal

import torch
from torch import Tensor

from ..validation import WHOLE_NUMBERS, choice, number, real_tensor, show

__all__ = ["DepthKind", "depth_from_values", "number_map"]

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
            value whose result is zero, negative or NaN (a disparity of inf, for example); for coc, NaN and inf.
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
    number_map("depth values", values)
    if values.ndim != 4 or values.shape[1] != 1:
        raise ValueError(f"depth values must be [B, 1, H, W], got {list(values.shape)}")
    if kind == "disparity" and scale is None:
        raise ValueError(
            "disparity needs a scale (--depth-scale): the baseline in metres times the focal length in pixels; "
            "if it is unknown, treat the map as relative depth: from_relative (--depth-kind relative)"
        )
    scale = 1.0 if scale is None else scale
    for factor in (scale, offset):
        if isinstance(factor, bool) or not isinstance(factor, int | float) or not abs(factor) < 1e300 or scale == 0.0:
            got = f"got scale {show(scale)} and offset {show(offset)}"
            raise ValueError(f"scale (--depth-scale) must be finite and not 0, offset (--depth-offset) finite, {got}")
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
        depth /= _ray_length(depth, fov_x_deg)
    metres = depth.float()
    return torch.where(metres.isfinite() if kind == "coc" else metres > 0, metres, torch.nan)


def _ray_length(like: Tensor, fov_x_deg: float) -> Tensor:
    """Length of the ray to depth 1 through each pixel's centre, ``[1, 1, H, W]``."""
    number("the field of view", fov_x_deg, 0.0, 180.0, "degrees")
    height, width = like.shape[-2:]
    focal_px = width / 2 / max(math.tan(math.radians(fov_x_deg) / 2), 1e-300)
    x = (torch.arange(width, dtype=like.dtype, device=like.device) + 0.5 - width / 2) / focal_px
    y = (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5 - height / 2) / focal_px
    return torch.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)[None, None]


def number_map(name: str, values: Tensor) -> None:
    """Refuse a value that is not a non-empty tensor of floating-point or whole numbers."""
    if isinstance(values, Tensor) and values.dtype in WHOLE_NUMBERS and values.layout == torch.strided:
        values = values.double()
    real_tensor(name, values, "[B, 1, H, W]")
    if not values.numel():
        raise ValueError(f"{name} must have at least one pixel, got {list(values.shape)}")
