"""Restores light above white in small lamps of clipped photographs, so that they blur like lamps."""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..validation import real_tensor, show

__all__ = ["expand_highlights"]

_CLIPPING = (0.87, 0.97)  # linear light; a channel is unclipped below, clipped above (8-bit codes 240 and 252)
_CLIPPED_SHARE = (0.05, 0.2)  # share of clipped pixels in the surroundings: a lamp below, a sky or paper above
# Sides of square windows: a share of the longer side of the image, and the smallest side in px.
_SURROUNDINGS, _SURROUNDINGS_PX = 0.04, 31.0  # window of the share of clipped pixels; a larger one raises larger lamps
_RIM, _RIM_PX = 0.007, 5.0  # window of the hue; a larger one mixes in more of the objects beside the lamp
_FAR_HUE = 1e-3  # weight of the surroundings in the hue; matters where the rim has no unclipped light
_WHITE = 1e-4  # weight of white in the hue; matters where all light is clipped


def expand_highlights(light: Tensor, stops: float = 3.0) -> Tensor:
    """Raises small clipped lamps above white, in the hue of their rims; large clipped areas are unchanged.

    * If all channels of a pixel are clipped, its brightest channel rises to ``2^stops`` times white.
    * If some are clipped, they rise until the pixel has the hue of the rim, at most to the same limit.
    * Both fade in from 0.87 to 0.97 of white, so that noise at a rim causes no steps.
    * Both fade out where 5 to 20 % of the surroundings are clipped: a sky, a sheet of paper. The surroundings are a
      square of 4 % of the longer side, 31 px at least.

    Args:
        light: ``[B, C, H, W]``, linear light of a photograph, 1 is white; without alpha.
        stops: Largest rise above white in stops, >= 0; each stop doubles the light.

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
    limit = 2.0**stops
    clipped = _smoothstep(light, *_CLIPPING)  # [B, C, H, W]
    any_clipped = clipped.amax(1, keepdim=True)
    surroundings_px = max(_SURROUNDINGS_PX, _SURROUNDINGS * max(light.shape[-2:]))
    is_lamp = 1.0 - _smoothstep(_window_mean(any_clipped, surroundings_px), *_CLIPPED_SHARE)
    hue = _hue_of_rim(light, 1.0 - any_clipped, surroundings_px)

    weights = (1.0 - clipped) * hue  # least squares of strength * hue = light over the unclipped channels
    strength = ((weights * light).sum(1, keepdim=True) + _WHITE) / ((weights * hue).sum(1, keepdim=True) + _WHITE)
    strength = strength.clamp_max(limit).lerp(torch.full_like(strength, limit), clipped.amin(1, keepdim=True))
    raised = light + clipped * is_lamp * (strength * hue - light).clamp_min(0.0)
    return torch.where(clipped > 0, raised, light)


def _hue_of_rim(light: Tensor, unclipped: Tensor, surroundings_px: float) -> Tensor:
    """Colour of the brightest unclipped light around each pixel, its largest channel 1, ``[B, C, H, W]``."""
    weight = unclipped * light.amax(1, keepdim=True).clamp(0.0, 1.0) ** 4
    weighted = torch.cat([light * weight, weight], 1)
    rim = _window_mean(weighted, max(_RIM_PX, _RIM * max(light.shape[-2:])))
    sums = rim + _FAR_HUE * _window_mean(weighted, surroundings_px)
    colour = (sums[:, :-1] + _WHITE * _FAR_HUE) / (sums[:, -1:] + _WHITE * _FAR_HUE)
    return colour / colour.amax(1, keepdim=True)


def _window_mean(values: Tensor, width: float) -> Tensor:
    """Mean over a square window about ``width`` pixels wide, cut off at the frame."""
    side = 2 * int(width / 2) + 1
    rows = functional.avg_pool2d(values, (side, 1), 1, (side // 2, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, side), 1, (0, side // 2), count_include_pad=False)


def _smoothstep(values: Tensor, low: float, high: float) -> Tensor:
    """Smoothstep from 0 at ``low`` to 1 at ``high``."""
    share = ((values - low) / (high - low)).clamp(0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)
