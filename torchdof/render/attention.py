"""Attention: the picture keeps its tolerance where the viewer looks, and has that of a draft elsewhere.

Reference:
    Mulder, van Liere, "Fast perception-based depth of field rendering", VRST 2000.
"""

import math
from typing import Any

import torch
from torch import Tensor

from ..tensors import floating
from ..validation import real_tensor, show

Attention = tuple[float, float, float] | Tensor
"""A disc ``(x, y, radius)`` in pixels at which the viewer looks, or a map ``[B or 1, 1, H, W]``, 0 to 1."""

_FADE = 0.25  # width of the fade around the disc, as a fraction of its radius
_ALIGN = 64  # crops begin and end at multiples of it, in pixels, so that cells match those of the whole frame


def weight_map(attention: Any, image: Tensor) -> Tensor:
    """Weight of the viewer's attention at each pixel: ``[B or 1, 1, H, W]``, 0 to 1.

    Raises:
        ValueError: If ``attention`` is neither three numbers with a radius > 0 nor a map of the image's size.
    """
    batch, _, height, width = image.shape
    if isinstance(attention, Tensor):
        fits = floating(attention) and attention.shape in ((1, 1, height, width), (batch, 1, height, width))
        if fits:
            real_tensor("attention", attention, "[B, 1, H, W]")
        if not fits or not bool(((attention >= 0) & (attention <= 1)).all()):
            raise ValueError(
                f"attention must be a map [{batch} or 1, 1, {height}, {width}] of floating point values from 0 to 1, "
                f"or (x, y, radius) in pixels, got {show(attention)}"
            )
        return attention.to(image.device)
    numbers: list[Any] = list(attention) if isinstance(attention, tuple | list) else []
    plain = [isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in numbers]
    if len(plain) != 3 or not all(plain) or not numbers[2] > 0:
        raise ValueError(f"attention must be (x, y, radius) in pixels, radius > 0, or a map, got {show(attention)}")
    x, y, radius = (float(v) for v in numbers)
    rows = torch.arange(height, device=image.device, dtype=torch.float64)[:, None] + 0.5 - y
    columns = torch.arange(width, device=image.device, dtype=torch.float64) + 0.5 - x
    beyond = ((rows**2 + columns**2).sqrt() - radius) / (_FADE * radius)
    return (1.0 - beyond).clamp(0.0, 1.0)[None, None]


def box_around(weight: Tensor, reach_px: float) -> tuple[slice, slice] | None:
    """Rows and columns of the pixels with ``weight > 0``, plus ``reach_px`` on each side; None without such pixels."""
    seen = (weight > 0).flatten(0, 1).any(0)
    if not bool(seen.any()):
        return None
    box = []
    for dim in (1, 0):
        lines = seen.any(dim).nonzero()[:, 0]
        first, last = int(lines[0]) - math.ceil(reach_px), int(lines[-1]) + 1 + math.ceil(reach_px)
        box.append(slice(max(0, first // _ALIGN * _ALIGN), min(-(-last // _ALIGN) * _ALIGN, seen.shape[1 - dim])))
    return box[0], box[1]
