"""Restores light above white in small lamps of clipped photographs, so that they blur like lamps."""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..validation import real_tensor, show

__all__ = ["expand_highlights"]

_NEAR_WHITE = (0.87, 0.97)  # linear light; a channel is unclipped below, clipped above (8-bit codes 240 and 252)
_SHARE = (0.05, 0.2)  # share of clipped pixels in the surroundings: a lamp below, a sky or paper above
_SURROUNDINGS = 0.04  # side of these surroundings over the longer side of the image, 31 px at least
_RIM = 0.007  # side of the window for the colour of the rim, the same way, 5 px at least
_ELSEWHERE = 1e-3  # weight of the surroundings in the hue; matters where the smaller window has no unclipped light
_LITTLE = 1e-4  # weight of white in the hue; matters where all light is clipped


def expand_highlights(light: Tensor, stops: float = 3.0) -> Tensor:
    """Raises small clipped lamps above white, in the hue of their rims; large clipped areas are unchanged.

    * If all channels of a pixel are clipped, its brightest channel rises to ``2^stops`` times white.
    * If some are clipped, they rise until the pixel has the hue of the rim, at most to the same limit.
    * Both fade in from 0.87 to 0.97 of white, so that noise at a rim causes no steps.
    * Both fade out where 5 to 20 % of the surroundings are clipped: a sky, a sheet of paper. The surroundings are a
      square of 4 % of the longer side, 31 px at least.

    Args:
        light: ``[B, C, H, W]``, linear light of a photograph, 1 is white; without alpha.
        stops: Most stops above white, >= 0.

    Returns:
        The same shape, nowhere darker; the same bits where no channel is above 0.87, and ``light`` itself at 0 stops.
        Differentiable in ``light``.

    Raises:
        ValueError: If ``light`` is not ``[B, C, H, W]`` of floating-point numbers, or ``stops`` is negative or not
            finite.

    Example:
        >>> night = torch.full((1, 3, 90, 160), 0.01)
        >>> night[..., 40:43, 80:83] = 1.0
        >>> float(expand_highlights(night, stops=3.0).max())
        8.0
    """
    real_tensor("light", light, "[B, C, H, W] of linear light")
    if light.ndim != 4 or not light.numel():
        raise ValueError(f"light must be [B, C, H, W] with at least one pixel, got {list(light.shape)}")
    if isinstance(stops, bool) or not isinstance(stops, int | float) or not 0 <= stops < math.inf:
        raise ValueError(f"stops must be a finite number from 0 on, got {show(stops)}")
    if stops == 0:
        return light
    longer, most = max(light.shape[-2:]), 2.0**stops
    clipped = _rise(light, *_NEAR_WHITE)  # [B, C, H, W]
    any_clipped = clipped.amax(1, keepdim=True)
    is_lamp = 1.0 - _rise(_mean(any_clipped, max(31.0, _SURROUNDINGS * longer)), *_SHARE)
    hue = _hue_of_rim(light, 1.0 - any_clipped, longer)

    weights = (1.0 - clipped) * hue  # least squares of strength * hue = light over the unclipped channels
    strength = ((weights * light).sum(1, keepdim=True) + _LITTLE) / ((weights * hue).sum(1, keepdim=True) + _LITTLE)
    strength = strength.clamp_max(most).lerp(torch.full_like(strength, most), clipped.amin(1, keepdim=True))
    risen = light + clipped * is_lamp * (strength * hue - light).clamp_min(0.0)
    return torch.where(clipped > 0, risen, light)


def _hue_of_rim(light: Tensor, unclipped: Tensor, longer: int) -> Tensor:
    """Colour of the brightest unclipped light around each pixel, its largest channel 1, ``[B, C, H, W]``."""
    weight = unclipped * light.amax(1, keepdim=True).clamp(0.0, 1.0) ** 4
    weighted = torch.cat([light * weight, weight], 1)
    near, far = _mean(weighted, max(5.0, _RIM * longer)), _mean(weighted, max(31.0, _SURROUNDINGS * longer))
    sums = near + _ELSEWHERE * far
    colour = (sums[:, :-1] + _LITTLE * _ELSEWHERE) / (sums[:, -1:] + _LITTLE * _ELSEWHERE)
    return colour / colour.amax(1, keepdim=True)


def _mean(values: Tensor, width: float) -> Tensor:
    """Mean over a square window about ``width`` pixels wide, cut off at the frame."""
    side = 2 * int(width / 2) + 1
    rows = functional.avg_pool2d(values, (side, 1), 1, (side // 2, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, side), 1, (0, side // 2), count_include_pad=False)


def _rise(values: Tensor, low: float, high: float) -> Tensor:
    """Smoothstep from 0 at ``low`` to 1 at ``high``."""
    share = ((values - low) / (high - low)).clamp(0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)
