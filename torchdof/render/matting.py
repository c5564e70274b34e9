"""Matting of mixed pixels: what part of a pixel on a depth edge belongs to which of the two surfaces there.

A sharp image is anti-aliased, its depth is not. Along every depth edge pixels carry the light of two surfaces and the
depth of one; blurred with that depth alone, a bright emitter draws a wrong ring and a foreground a fringe. Such pixels
are split between their surfaces, without touching texture within a surface. Everything is computed at the pixels of
edges only.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import pixels
from ..tensors import is_traced

__all__ = ["NEVER_PX", "Matted", "attribute_emitters", "matte"]

NEVER_PX = 1e9
"""A coc that no pixel has."""

_EDGE_PX = 0.5  # difference in coc of neighbours from which on they may be two surfaces
_UNCLEAN = 1e-2  # weight of a pixel that may be mixed itself
_FALLOFF = math.exp(-1 / 4.5)
_TRUST = 4.0  # how much texture discredits the contrast of the two surfaces
_ALIKE = 1.0 / 255.0  # contrast, as a share of the brightest light around, that is worth as much as none
_UNBOUNDED = 1e6  # times the brightest pixel around: so bright is neither part of a pixel
_EMITTER_REACH = 3  # pixels around a highlight that tell on which surface it lies
_TOUCHING = 2  # pixels around an emitter into which a soft picture spreads its light
_DIM = 0.1  # times the light of a highlight's pixel: what is darker is as sure to be none of it
_MOST_WEIGHT = 0.98  # of a highlight's pixel that an emitter of another surface may have


class Matted(NamedTuple):
    """Surfaces of pixels: light of the own and of the other one ``[B, C, H, W]``, the other's coc and its weight.

    The last two are ``[B, 1, H, W]``; the weight is the part of the pixel that the other surface covers, 0 away from
    edges.
    """

    own: Tensor
    other: Tensor
    other_coc_px: Tensor
    other_weight: Tensor


def matte(light: Tensor, coc_px: Tensor, valid: Tensor | None = None) -> Matted:
    """Matting of pixels at depth edges: the surface they are attributed to, and the one across the edge.

    With F and B the light of the two surfaces beside the pixel, the weight ``a`` of F in a pixel is the least-squares
    solution of ``I = a F + (1 - a) B``, kept on the side of 1/2 that the pixel's own depth states (its centre lies on
    that surface) and drawn towards one surface alone where the contrast of the two is small against their texture. The
    light of the two parts sums to the pixel's, and neither leaves the image's range.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is to be left out; None counts all.

    Returns:
        The surfaces; the weight of the other one is in [0, 1/2].
    """
    # pixels beside another surface
    known = None if valid is None else valid > 0
    high, low = (c if known is None else torch.where(known, c, -NEVER_PX) for c in (coc_px.detach(), -coc_px.detach()))
    high, low = (functional.max_pool2d(c, 3, stride=1, padding=1) for c in (high, low))
    is_edge = high + low > _EDGE_PX
    edge_pixels = pixels.indices(is_edge if known is None else is_edge & known)

    # the two surfaces are as near and as far as the pixels around; no absolute level of light decides
    own_coc, colour = pixels.pick(coc_px, edge_pixels)[0], pixels.pick(light, edge_pixels)
    window = pixels.around(edge_pixels, coc_px, 1)
    window_light, window_coc = pixels.pick(light, window), pixels.pick(coc_px, window)[0]  # [C, 9, P], [9, P]
    brightest = window_light.detach().abs().amax((0, 1)).clamp_min(torch.finfo(light.dtype).tiny)
    colour, window_light = colour / brightest, window_light / brightest
    near = far = window_coc
    if known is not None:
        window_known = pixels.pick(known, window)[0]
        near, far = torch.where(window_known, near, NEVER_PX), torch.where(window_known, far, -NEVER_PX)
    near, far = near.amin(0), far.amax(0)
    is_near = own_coc - near < far - own_coc
    edge = ((far - near) / _EDGE_PX - 1.0).clamp(0.0, 1.0)  # how surely there are two
    edges = pixels.put(torch.zeros_like(coc_px), edge_pixels, edge)
    gap = (far - near).clamp_min(1e-6)

    # their light: means over pixels around that lie on one of them and are hardly mixed themselves
    weight = (1.0 - pixels.pick(edges, window)[0] + _UNCLEAN) * _falloff(light, 1)
    if valid is not None:
        weight = weight * pixels.pick(valid, window)[0]
    nearness = (far - window_coc) / gap
    near_weight, far_weight = weight * (4 * nearness - 2.8).clamp(0, 1), weight * (1.2 - 4 * nearness).clamp(0, 1)
    back, back_variance = _mean_of(window_light, far_weight)
    # a thin foreground has no clean pixel: trust the one that differs most from what is behind
    differs = ((window_light - back[:, None]) ** 2).sum(0)
    differs = (differs + _ALIKE**2) / (differs.amax(0) + _ALIKE**2)
    clean = (0.1 * near_weight.sum(0) / _UNCLEAN - 1.0).clamp(0.0, 1.0)
    front, front_variance = _mean_of(window_light, near_weight * torch.lerp(differs, torch.ones_like(clean), clean))

    # a = (I - B) (F - B) / (F - B)^2, as far as it can be trusted
    contrast = front - back
    strength = (contrast**2).sum(0)
    fitted = (((colour - back) * contrast).sum(0) / strength.clamp_min(1e-12)).clamp(0.0, 1.0)
    misfit = ((colour - back - fitted * contrast) ** 2).sum(0)
    trust = strength / (strength + _TRUST * (back_variance + front_variance + misfit) + _ALIKE**2)
    # the pixel's depth must be that of one of the two: in between, a steep surface goes on
    sided = ((own_coc - near) - (far - own_coc)).abs() / gap
    certainty = edge * trust * (4.0 * sided - 2.0).clamp(0.0, 1.0)
    weight = torch.where(is_near, 1.0 - fitted, fitted).clamp(max=0.5) * certainty  # of the other surface

    # what the mean colours do not explain goes to both; no light is lost, and none is brighter or darker than the image
    own_mean, other_mean = torch.where(is_near, front, back), torch.where(is_near, back, front)
    own_weight = 1.0 - weight
    unexplained = colour - own_weight * own_mean - weight * other_mean
    moved = weight * (other_mean + unexplained * weight / (weight**2 + own_weight**2))
    item = pixels.places(edge_pixels, *coc_px.shape[-2:])[0]
    range_of_image = light.amin((2, 3)), light.amax((2, 3))  # bounded: 0 of something infinite would be no number
    least, most = ((extreme[item].t() / brightest).clamp(-_UNBOUNDED, _UNBOUNDED) for extreme in range_of_image)
    moved = torch.minimum(moved.maximum(colour - own_weight * most), colour - own_weight * least)
    moved = torch.minimum(moved.maximum(weight * least), weight * most)
    own = (colour - moved) / own_weight
    other = torch.where(weight > 0, moved / weight.clamp_min(1e-12), 0.0)
    return Matted(
        pixels.put(light, edge_pixels, own * brightest),
        pixels.put(torch.zeros_like(light), edge_pixels, other * brightest),
        pixels.put(coc_px, edge_pixels, torch.where(is_near, far, near)),
        pixels.put(torch.zeros_like(coc_px), edge_pixels, weight),
    )


def attribute_emitters(
    light: Tensor, coc_px: Tensor, threshold: Tensor, valid: Tensor | None, surfaces: Matted
) -> Matted:
    """Gives the light of highlights to the surface on which their emitter lies.

    An emitter seen through hair or twigs shines into pixels whose depth is that of a strand, and one in front of a
    wall into pixels around it whose depth is the wall's. A highlight's pixel is such a one where its own surface is dim
    beside it and farther pixels around, or nearer ones that touch it, are about as bright. Of its light what exceeds
    the own surface's is then the other's, which may cover more than half of the pixel. In turn the emitter's own pixels
    keep what another surface would get of them that is dim beside it and nowhere as bright.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        threshold: Light from which on a pixel is a highlight's, ``[B, 1, H, W]``.
        valid: As for :func:`matte`.
        surfaces: What :func:`matte` returns.

    Returns:
        The same, changed at those pixels.
    """
    brightest = light.amax(1, keepdim=True)
    is_bright = brightest > threshold
    bright = pixels.indices(is_bright if valid is None else is_bright & (valid > 0))
    if not is_traced() and len(bright) == 0:
        return surfaces
    window = pixels.around(bright, coc_px, _EMITTER_REACH)
    seen, own_coc, limit = pixels.pick(light, bright), pixels.pick(coc_px, bright)[0], pixels.pick(threshold, bright)[0]
    peaks, own_peak = pixels.pick(brightest, window)[0], pixels.pick(brightest, bright)[0]
    scale = peaks.detach().amax(0)
    colour = pixels.pick(light, window) / scale
    seen, peaks, own_peak, limit = seen / scale, peaks / scale, own_peak / scale, limit / scale
    excess = (own_peak / limit - 1.0).clamp(0.0, 1.0)
    window_coc, near_by = pixels.pick(coc_px, window)[0], _falloff(light, _EMITTER_REACH)
    counted = torch.ones_like(peaks) if valid is None else pixels.pick(valid, window)[0]
    touches = counted * (near_by > _FALLOFF ** (2 * _TOUCHING**2 + 1))
    nearest = window_coc.amin(0)

    def beyond(coc: Tensor, side: float, share: float) -> tuple[Tensor, ...]:
        """How surely the emitter lies behind (side 1) or before (-1) surfaces of a coc, and not on them.

        It does if what is there has more than a share of their peak. And light of these surfaces where they are
        dimmest, the largest light, and the emitter's coc.
        """
        away = side * (window_coc - coc)
        there = (counted if side > 0 else touches) * (away - 1.0).clamp(0.0, 1.0)
        same = counted * (2.0 - away.abs()).clamp(0.0, 1.0)
        dim = same * near_by * (2.5 - 5.0 * peaks / own_peak.clamp_min(1e-12)).clamp(0.0, 1.0)
        emitter_peak, same_peak = (there * peaks).amax(0), (same * peaks).amax(0).clamp_min(1e-12)
        sureness = excess * (10.0 * dim.sum(0)).clamp(max=1.0)
        sureness = sureness * (10.0 * (emitter_peak / same_peak - share)).clamp(0.0, 1.0)
        dimmest = dim / (peaks**2 + (_DIM * own_peak) ** 2).clamp_min(1e-24)
        surface = (colour * dimmest).sum(1) / dimmest.sum(0).clamp_min(1e-12)
        lit = there * near_by * peaks**2
        emitter_coc = nearest + ((window_coc - nearest) * lit).sum(0) / lit.sum(0).clamp_min(1e-12)
        return sureness, surface, torch.maximum(emitter_peak, same_peak), emitter_coc

    _, other, other_coc, weight = (pixels.pick(t, bright) for t in surfaces)
    other, other_coc, weight = other / scale, other_coc[0], weight[0]
    for side, least_share in ((-1.0, 1.0), (1.0, 0.5)):
        sureness, surface, top, emitter_coc = beyond(own_coc, side, least_share)
        if side < 0:  # what is seen through a surface is not before it
            sureness = sureness * (1.0 - beyond(emitter_coc, 1.0, 0.5)[0])
        floor = surface.amax(0)
        share = ((own_peak - floor) / (top - floor).clamp_min(1e-12)).clamp(1.0 - _MOST_WEIGHT, _MOST_WEIGHT)
        emitter = (seen - (1.0 - share) * surface).clamp_min(0.0)
        # what was found without it goes on before surfaces, which are mostly the same; behind them it fades out first
        kept, given = (1.0 - sureness, sureness) if side < 0 else (1.0 - 2.0 * sureness, 2.0 * sureness - 1.0)
        kept, given = kept.clamp_min(0.0) * weight, given.clamp_min(0.0)
        moved, weight = kept * other + given * emitter, kept + given * share
        known = weight.clamp_min(1e-12)
        other = torch.where(weight > 0, moved / known, 0.0)
        other_coc = torch.lerp(other_coc, emitter_coc, given * share / known)

        # and of its own pixels another surface would get some
        bright_other = (other.amax(0) / limit.clamp_min(torch.finfo(light.dtype).tiny) - 1.0).clamp(0.0, 1.0)
        apart = (side * (own_coc - other_coc) - 1.0).clamp(0.0, 1.0)
        weight = weight * (1.0 - apart * bright_other * beyond(other_coc, side, 1.0)[0])
    own = (seen - weight * other) / (1.0 - weight)
    changed = zip(surfaces, (own * scale, other * scale, other_coc, weight), strict=True)
    return Matted(*(pixels.put(maps, bright, values) for maps, values in changed))


def _falloff(light: Tensor, reach: int) -> Tensor:
    """Weights of the pixels of a window around its middle, ``[(2 reach + 1)^2, 1]``."""
    steps = range(-reach, reach + 1)
    return light.new_tensor([_FALLOFF ** (dy * dy + dx * dx) for dy in steps for dx in steps])[:, None]


def _mean_of(colour: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean over n of colours ``[C, n, P]`` and their variance, summed over colours, ``[P]``."""
    total = weight.sum(0).clamp_min(1e-12)
    mean = (colour * weight).sum(1) / total
    # not as a difference of squares, whose rounding would decide where all colours are alike
    return mean, (((colour - mean[:, None]) ** 2 * weight).sum(1) / total).sum(0)
