"""Restores what a blur has done to a map of depth: rims of interpolation, and lamps that it has averaged away."""

from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import pixels
from ..engines.ops import Ops
from .edge_search import REACH, Edges, ends_of
from .windows import gaussian, highest, mean_around

__all__ = ["Softness", "lift_lamps", "sigma_of", "without_ringing"]

_BLUR_REACH = 9  # px; half the width of the Gaussian kernel
_CLIMBED = 0.35  # standard deviation of a ramp, as a fraction of (pixels of its middle half) / (steps they climb)
_USUAL_REACH = 7  # px; half the width of the window of the usual light around a lamp
_LAMP_FALLOFF_PX = 3.0  # standard deviation of the Gaussian weights of the window of a fit
_LAMP_REACH = 2  # px; half the width of the largest lamp
_LAMP, _GLARE = 4.0, 2.0  # light, over the usual light around: least of a lamp; least of a pixel of its cover
_LAMP_PEAK = 0.1  # least light of a lamp, over the brightest in its reach
_LAMP_STEP = 0.5  # least range of nearness around it, in smallest steps
_LOST, _LOST_PER_PX = 2.4, 2.5  # part of lamps that a blur removes, if near surfaces lose no width; more for each px
_LEAST_VARIANCE = 0.004  # of a blurred cover, from which a fit counts
_PIXEL = 0.2  # px^2; variance that the area of a pixel adds to a ramp
_LEAST_BLUR_PX, _MOST_BLUR_PX = 0.2, 3.0  # range of the standard deviation
_EXPLAINED, _EXPLAINED_MORE = 0.5, 0.3  # fraction of the variance from which a fit counts; the part above, for full
_BETTER = 0.5  # fraction of the variance unexplained by a sharp shape that its blur must explain for full confidence
_RINGING_REACH = 3  # px; half the largest width of a rim of ringing; larger: wider details are flattened
_OVERSHOOT = 0.12  # largest height of a rim that is removed in full, in steps; at twice this height it stays


def without_ringing(nearness: Tensor, valid: Tensor, step: Tensor) -> Tensor:
    """Removes rims beside steps that are a little nearer, or farther, than the surface to which they belong.

    Maps enlarged by bicubic or Lanczos interpolation overshoot a step by up to a tenth of it on both sides. The rim of
    a surface near the focus would be blurred differently from the surface. Opening removes rims of at most twice
    :data:`_RINGING_REACH` pixels that are nearer, closing those that are farther. Pixels move into the range between
    the closed opening and the opened closing (the morphological centre), which leaves noise unchanged too.

    Reference:
        Serra, "Image Analysis and Mathematical Morphology, volume 2", 1988, chapter 8 (the centre).
    """
    ends = _spread(ends_of(nearness, valid))
    opened_closing, closed_opening = _spread(-_spread(_spread(-ends))).split(1, 1)
    closed_opening = -closed_opening
    ends_of_both = torch.minimum(closed_opening, opened_closing), torch.maximum(closed_opening, opened_closing)
    moved = torch.minimum(torch.maximum(nearness, ends_of_both[0]), ends_of_both[1]) - nearness
    span = ends.sum(1, keepdim=True)
    return nearness + moved * torch.where(span > step, 2.0 - moved.abs() / (_OVERSHOOT * span), 0.0).clamp(0.0, 1.0)


def _spread(values: Tensor) -> Tensor:
    return highest(values, _RINGING_REACH)


class Softness(NamedTuple):
    """How a map is blurred, ``[B, 1, 1, 1]`` each."""

    is_soft: Tensor
    sigma: Tensor  # standard deviation of the blur in pixels
    lost_px: Tensor  # width that the blur has taken from near surfaces
    doubt: Tensor  # 0 to 1, how much the image contradicts the map


def sigma_of(edges: Edges) -> Tensor:
    """Standard deviation of a map's blur in pixels, ``[B, 1, 1, 1]``."""
    is_middle = edges.is_edge & ((edges.level - 0.5).abs() < 0.25)
    climbed = (edges.climb * is_middle).sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
    ramp_px = _CLIMBED * is_middle.sum((1, 2, 3), keepdim=True) / climbed
    return (ramp_px.square() - _PIXEL).clamp_min(0.0).sqrt().clamp(_LEAST_BLUR_PX, _MOST_BLUR_PX)


def lift_lamps(light: Tensor, nearness: Tensor, repaired: Tensor, step: Tensor, soft: Softness, ops: Ops) -> Tensor:
    """Raises the nearness of lamps of a few pixels, which a soft map averages with their surroundings.

    A map in doubt stays: what looks like a lamp may be a bright spot of its surroundings, which would become sharp.

    The fit ``nearness = a + b blurred(cover)`` gives the lamp ``a + b``; its cover is its light over its brightest.

    Args:
        light: ``[B, C, H, W]``, linear light.
        nearness: ``[B, 1, H, W]``, as the map has it.
        repaired: The same with repaired edges.
        step: Smallest difference of two surfaces.
        soft: How the map is blurred.
        ops: Processes lists of pixels in parts.
    """
    brightest = light.amax(1, keepdim=True)
    usual = mean_around(brightest.sqrt(), _USUAL_REACH) ** 2
    span = highest(torch.cat([nearness, -nearness], 1), REACH).sum(1, keepdim=True)
    around = highest(brightest, _LAMP_REACH)
    is_bright = (brightest > _LAMP * usual) & (brightest > _LAMP_PEAK * around)
    is_lamp = is_bright & (span > _LAMP_STEP * step) & soft.is_soft
    cover = torch.where(brightest > _GLARE * usual, brightest / around.clamp_min(1e-30), 0.0)
    lamp_pixels = pixels.indices(is_lamp)
    behind, difference, fit = _regress(nearness, cover, _blurred(cover, soft.sigma), lamp_pixels, ops)
    # all pixels of a lamp lie on one surface: average their fits
    weight = fit * pixels.pick(cover, lamp_pixels)[0]
    values = torch.stack([weight, weight * (behind + difference.clamp_min(0.0)), weight * fit])
    of_lamps = pixels.put(torch.zeros_like(nearness).repeat(1, 3, 1, 1), lamp_pixels, values)
    total, level, fit = pixels.pick(of_lamps, pixels.around(lamp_pixels, nearness, _LAMP_REACH)).sum(1).unbind(0)
    level, fit = (values / total.clamp_min(1e-9) for values in (level, fit))
    is_lost = ((_LOST + _LOST_PER_PX * soft.lost_px).clamp(0.0, 1.0) * (1.0 - soft.doubt)).flatten()
    fit = fit * is_lost[lamp_pixels // nearness[0].numel()]
    own = pixels.pick(repaired, lamp_pixels)[0]
    return pixels.put(repaired, lamp_pixels, own + fit * (level - own).clamp_min(0.0))


def _regress(
    nearness: Tensor, shape: Tensor, blurred: Tensor, chosen: Tensor, ops: Ops
) -> tuple[Tensor, Tensor, Tensor]:
    """Fits ``nearness = a + b blurred`` in windows around pixels ``[P]``: a, b and the quality of the fit, 0 to 1.

    The quality is 0 where the sharp ``shape`` explains as much of the variance: there the map is not blurred.
    """
    weight = gaussian(REACH, _LAMP_FALLOFF_PX, nearness.dtype, nearness.device)
    weight = weight / weight.sum()
    maps = pixels.rows(torch.cat([nearness, blurred, shape], 1))

    def look(part: Tensor) -> Tensor:
        samples = pixels.pick(maps, pixels.around(part, nearness, REACH))  # [3, n, P]
        means = (weight * samples).sum(1)
        off = samples - means[:, None]
        yy, *xx = (weight * off.square()).sum(1).unbind(0)
        xy = (weight * off[0] * off[1:]).sum(1).clamp_min(0.0)
        explained, unblurred = (c.square() / (v * yy).clamp_min(1e-12) for c, v in zip(xy.unbind(0), xx, strict=True))
        better = ((explained - unblurred) / (_BETTER * (1.0 - unblurred)).clamp_min(1e-6)).clamp(0.0, 1.0)
        fit = ((explained - _EXPLAINED) / _EXPLAINED_MORE).clamp(0.0, 1.0) * better
        fit = torch.where(xx[0] > _LEAST_VARIANCE, fit, 0.0)
        b = xy[0] / xx[0].clamp_min(1e-9)
        return torch.stack([means[0] - b * means[1], b, fit])

    a, b, fit = ops.by_parts(look, chosen).unbind(0)
    return a, b, fit


def _blurred(values: Tensor, sigma: Tensor) -> Tensor:
    """Blurs each item ``[B, 1, H, W]`` with a Gaussian of its own sigma ``[B, 1, 1, 1]`` in pixels."""
    offsets = torch.arange(_BLUR_REACH + 1, device=values.device, dtype=values.dtype)
    half = torch.exp(-offsets.square() / (2.0 * sigma.square()))  # [B, 1, 1, k], k = 0 is the centre
    half = half / (2.0 * half.sum(-1, keepdim=True) - 1.0)
    for dim in (-1, -2):
        across = _BLUR_REACH if dim == -1 else 0
        ends = (across, across, _BLUR_REACH - across, _BLUR_REACH - across)
        size, padded = values.shape[dim], functional.pad(values, ends, mode="replicate")
        values = half[..., :1] * values
        for k in range(1, _BLUR_REACH + 1):  # runtimes of graphs cannot convolve with a computed kernel
            both = padded.narrow(dim, _BLUR_REACH - k, size) + padded.narrow(dim, _BLUR_REACH + k, size)
            values = torch.addcmul(values, half[..., k : k + 1], both)
    return values
