"""Matting of mixed pixels: what part of a pixel on a depth edge belongs to which of the two surfaces there.

A sharp image is anti-aliased, its depth is not. Along every depth edge pixels carry the light of two surfaces and the
depth of one; blurred with that depth alone, a bright emitter draws a wrong ring and a foreground a fringe. Such pixels
are split between their surfaces, without touching texture within a surface. Everything is computed at the pixels of
edges only.
"""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from . import pixels

__all__ = ["NEVER_PX", "matte"]

NEVER_PX = 1e9
"""A coc that no pixel has."""

_EDGE_PX = 1.0  # difference in coc of neighbours from which on they may be two surfaces
_REACH = 2  # pixels around a mixed pixel that tell what its two surfaces look like
_UNCLEAN = 1e-3  # weight of a pixel that may be mixed itself
_TRUST = 4.0  # how much texture discredits the contrast of the two surfaces
_TEXTURE = 4.0 / 3.0  # times the variance of the own surface's light, all colours, is what its texture may explain
_LEAST_WEIGHT = 0.1  # a smaller weight is more likely texture than a second surface


def matte(light: Tensor, coc_px: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Matting of pixels at depth edges: the surface they are attributed to, and the one across the edge.

    With F and B the light of the two surfaces near the pixel, the weight ``a`` of F in a pixel is the least-squares
    solution of ``I = a F + (1 - a) B``, kept on the side of 1/2 that the pixel's own depth states (its centre lies on
    that surface) and drawn towards one surface alone where the contrast of the two is small against their texture, or
    where the texture of the pixel's own surface explains it and moves little light. The light of the two parts sums to
    the pixel's.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is to be left out; None counts all.

    Returns:
        ``(own, other, other_coc_px, other_weight)``: light of the pixel's own surface and the other ``[B, C, H, W]``,
        the other's coc and the part of the pixel that it covers, in [0, 1/2], ``[B, 1, H, W]``; 0 away from edges.
    """
    # pixels beside another surface
    known = None if valid is None else valid > 0
    high, low = (c if known is None else torch.where(known, c, -NEVER_PX) for c in (coc_px.detach(), -coc_px.detach()))
    high, low = (functional.max_pool2d(c, 3, stride=1, padding=1) for c in (high, low))
    is_edge = high + low > _EDGE_PX
    edge_pixels = pixels.indices(is_edge if known is None else is_edge & known)

    # the two surfaces are as near and as far as the pixel's direct neighbours
    own_coc, colour = pixels.pick(coc_px, edge_pixels)[0], pixels.pick(light, edge_pixels)
    neighbours = pixels.around(edge_pixels, coc_px, 1)
    near = far = pixels.pick(coc_px, neighbours)[0]
    if known is not None:
        known_neighbours = pixels.pick(known, neighbours)[0]
        near = torch.where(known_neighbours, near, NEVER_PX)
        far = torch.where(known_neighbours, far, -NEVER_PX)
    near, far = near.amin(0), far.amax(0)
    is_near = own_coc - near < far - own_coc
    edge = ((far - near) / _EDGE_PX - 1.0).clamp(0.0, 1.0)  # how surely there are two
    edges = pixels.put(torch.zeros_like(coc_px), edge_pixels, edge)
    gap = (far - near).clamp_min(1e-6)

    # their light: means over what is around, of pixels that lie on one of them and are hardly mixed themselves
    window = pixels.around(edge_pixels, coc_px, _REACH)
    window_light, window_coc, window_edge = (pixels.pick(t, window) for t in (light, coc_px, edges))  # [C or 1, n, P]
    reach = range(-_REACH, _REACH + 1)
    falloff = light.new_tensor([math.exp(-(dy * dy + dx * dx) / 4.5) for dy in reach for dx in reach])
    weight = (1.0 - window_edge[0] + _UNCLEAN) * falloff[:, None]
    if valid is not None:
        weight = weight * pixels.pick(valid, window)[0]
    nearness = (far - window_coc[0]) / gap
    near_weight, far_weight = weight * (4 * nearness - 2.8).clamp(0, 1), weight * (1.2 - 4 * nearness).clamp(0, 1)
    back, back_variance = _mean(window_light, far_weight)
    # a thin foreground has no clean pixel: trust the one that differs most from what is behind
    differs = near_weight * ((window_light - back[:, None]) ** 2).sum(0) + 1e-12
    front, front_variance = _mean(window_light, torch.where(near_weight.sum(0) > 20 * _UNCLEAN, near_weight, differs))

    # a = (I - B) (F - B) / (F - B)^2, as far as it can be trusted
    contrast = front - back
    strength = (contrast**2).sum(0)
    fitted = (((colour - back) * contrast).sum(0) / strength.clamp_min(1e-12)).clamp(0.0, 1.0)
    misfit = ((colour - back - fitted * contrast) ** 2).sum(0)
    trust = strength / (strength + 4e-4 + _TRUST * (back_variance + front_variance + misfit))
    fitted_weight = torch.where(is_near, 1.0 - fitted, fitted)  # weight of the other surface
    # what lies behind is seen sharp where it is nearer to focus, and so is every error of its matte
    own_variance = torch.where(is_near, front_variance, back_variance)
    texture_weight = (_TEXTURE * own_variance / strength.clamp_min(1e-12)).clamp_min(1e-12).sqrt()
    trusted = fitted_weight - torch.where(far.abs() < near.abs(), texture_weight, 0.0)
    trusted = trusted * (2.0 * trusted / _LEAST_WEIGHT - 1.0).clamp(0.0, 1.0)
    # the light of a highlight counts even where its weight is small
    moved = fitted_weight * (strength / (colour**2).sum(0).clamp_min(1e-18)).clamp_min(1e-12).sqrt()
    trusted = torch.lerp(trusted, fitted_weight, (4.0 * moved - 1.0).clamp(0.0, 1.0))
    # the pixel's depth must be that of one of the two: in between, a steep surface goes on
    sided = ((own_coc - near) - (far - own_coc)).abs() / gap
    certainty = trust * (4.0 * sided - 2.0).clamp(0.0, 1.0)
    other_weight = trusted.clamp(0.0, 0.5) * certainty * edge

    # what the mean colours do not explain goes to both; the own part takes what the other leaves: no light is lost
    own_mean, other_mean = torch.where(is_near, front, back), torch.where(is_near, back, front)
    unexplained = colour - (1.0 - other_weight) * own_mean - other_weight * other_mean
    other = other_mean + unexplained * other_weight / (other_weight**2 + (1.0 - other_weight) ** 2)
    other = torch.maximum(other, torch.minimum(colour, other_mean).clamp_max(0.0))  # no darker than dark, or than given
    own = (colour - other_weight * other) / (1.0 - other_weight)
    return (
        pixels.put(light, edge_pixels, own),
        pixels.put(torch.zeros_like(light), edge_pixels, other),
        pixels.put(coc_px, edge_pixels, torch.where(is_near, far, near)),
        pixels.put(torch.zeros_like(coc_px), edge_pixels, other_weight),
    )


def _mean(colour: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean over n of colours ``[C, n, P]`` and their variance, summed over colours, ``[P]``."""
    total = weight.sum(0).clamp_min(1e-12)
    mean = (colour * weight).sum(1) / total
    second = (colour**2 * weight).sum(1) / total
    return mean, (second - mean**2).clamp_min(0.0).sum(0)
