"""Matting of mixed pixels: splits a pixel on a depth edge between the two surfaces that meet there.

A sharp image is anti-aliased, its depth map is not. So the pixels along a depth edge have the light of two surfaces and
the depth of one. Blurred with that depth alone, a bright emitter draws a wrong ring and a foreground a fringe. Matting
gives each surface its part of the light, only at edges, and leaves texture within a surface unchanged.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import native, pixels
from ..tensors import is_empty
from .compiled_steps import compiled_step
from .ops import EAGER, Ops
from .rules import active

__all__ = ["NEVER_PX", "Matted", "attribute_emitters", "matte"]

NEVER_PX = 1e9
"""A coc in pixels that no pixel has: marks the absence of a surface."""

# Mixed pixels
_EDGE_PX = 0.5  # px; smallest difference in coc of neighbours on two surfaces; larger: fewer edges
_FALLOFF = math.exp(-1 / 4.5)  # weight of a neighbour at a distance of 1 px: a Gaussian of sigma 1.5
_UNCLEAN = 1e-2  # weight in a surface's mean colour of pixels that may be mixed; others have 1
_TRUST = 10.0  # weight of variance against contrast; larger: texture stops more splits by colour
_TEXTURE = 50.0  # weight of variance against contrast; larger: texture keeps more of a neighbour's mixed light
_MOST_CLEAN = 4.0  # upper limit for a neighbour's clean light, as a multiple of the brightest neighbour
_SOFTNESS_PX = 0.6  # standard deviation of the Gaussian by which two surfaces mix where their colours are alike
_SOFTNESS_FALLOFF = math.exp(-0.5 / _SOFTNESS_PX**2)  # its weight at a distance of 1 px
_ALIKE = 1.0 / 255.0  # contrast at which trust is halved, as a fraction of the brightest light around
_UNBOUNDED = 1e6  # upper limit for either part, as a multiple of the brightest neighbour; avoids 0 * inf

# Emitters
_EMITTER_REACH = 3  # px; half the width of the window in which an emitter's surface is searched
_TOUCHING = 2  # px; distance over which a soft image spreads the light of an emitter in front
_DIM = 0.1  # fraction of the highlight below which all pixels are equally good samples of a surface's own light
_LEAST_PEAK = 0.5  # least peak of a surface around a highlight, as a fraction of it; larger: fewer emitters are found
_MOST_WEIGHT = 0.98  # largest weight of an emitter on another surface in a highlight's pixel


class Matted(NamedTuple):
    """The two surfaces of each pixel: its own, whose coc the pixel has, and the other one, across the edge.

    Light is ``[B, C, H, W]``, coc and weight ``[B, 1, H, W]``. The weight is the fraction of the pixel that the other
    surface covers, 0 away from edges.
    """

    own: Tensor
    other: Tensor
    other_coc_px: Tensor
    other_weight: Tensor


def matte(
    light: Tensor,
    coc_px: Tensor,
    valid: Tensor | None = None,
    ops: Ops = EAGER,
    covered: Tensor | None = None,
) -> Matted:
    """Splits pixels at depth edges between their own surface and the one across the edge.

    1. Take the nearest and the farthest coc of the 3 x 3 pixels around as those of the two surfaces.
    2. Take their colours F (near) and B (far), each ``[C]``, as means of neighbours on one surface. Mixed neighbours
       count without the light of the other surface: a photograph's edges are wider than a pixel.
    3. Fit ``I = a F + (1 - a) B`` to the pixel's light I by least squares: ``a = (I - B) (F - B) / |F - B|^2``.
    4. Keep a on the side of 1/2 of the pixel's own surface, on which its centre lies. Where contrast is small against
       texture, a is the near surface's share under a small Gaussian, as far as the pixel's colour agrees.
    5. Distribute the residual over both parts, but none of it to an other surface that is less blurred: they sum to I,
       and neither leaves the image's range.
    6. Replace these guesses by the surfaces of a matte, where there is one.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is left out; None means all count.
        ops: Selects the pixels at edges.
        covered: Other surfaces by a matte, as :func:`torchdof.render.coverage.covered_by` returns them, or None.

    Returns:
        The surfaces; the weight of the other one is in [0, 1/2].
    """
    found = compiled_step(
        native.matte,
        native.matte_gradient,
        lambda *maps: torch.cat(_split(*maps), 1),
        light,
        coc_px,
        *([] if valid is None else [valid]),
    )
    if found is None:
        surfaces = _split(light, coc_px, valid, ops)
    else:
        surfaces = Matted(*found.split([light.shape[1], light.shape[1], 1, 1], 1))
    return surfaces if covered is None else _with_covered(light, surfaces, covered)


def _with_covered(light: Tensor, surfaces: Matted, covered: Tensor) -> Matted:
    """The surfaces of each pixel: those of a matte by their certainty, those given for the rest."""
    share, coc, weight, certainty = covered.split([light.shape[1], 1, 1, 1], 1)
    kept, given = (1.0 - certainty) * surfaces.other_weight, certainty * weight
    both = kept + given
    known = both.clamp_min(1e-12)
    other = torch.where(both > 0, (kept * surfaces.other + certainty * share * light) / known, 0.0)
    other_coc = torch.where(both > 0, (kept * surfaces.other_coc_px + given * coc) / known, surfaces.other_coc_px)
    split = Matted((light - both * other) / (1.0 - both), other, other_coc, both)
    return Matted(*(torch.where(certainty > 0, new, old) for new, old in zip(split, surfaces, strict=True)))


def _split(light: Tensor, coc_px: Tensor, valid: Tensor | None = None, ops: Ops = EAGER) -> Matted:
    """:func:`matte` by PyTorch."""
    rules = active()
    if not rules.matting:
        return Matted(light, torch.zeros_like(light), coc_px, torch.zeros_like(coc_px))
    # pixels beside another surface
    known = None if valid is None else valid > 0
    high, low = (c if known is None else torch.where(known, c, -NEVER_PX) for c in (coc_px.detach(), -coc_px.detach()))
    high, low = (functional.max_pool2d(c, 3, stride=1, padding=1) for c in (high, low))
    is_edge = high + low > _EDGE_PX
    selected = ops.select(is_edge if known is None else is_edge & known)

    # coc of the two surfaces; light relative to the brightest neighbour, so that its scale does not matter
    own_coc, colour = selected.pick(coc_px)[0], selected.pick(light)
    window_light, window_coc = selected.around(light), selected.around(coc_px)[0]  # [C, 9, P], [9, P]
    brightest = window_light.detach().abs().amax((0, 1)).clamp_min(torch.finfo(light.dtype).tiny)
    colour, window_light = colour / brightest, window_light / brightest
    near = far = window_coc
    counted = None if valid is None else selected.around(valid)[0]
    if counted is not None:
        near, far = torch.where(counted > 0, near, NEVER_PX), torch.where(counted > 0, far, -NEVER_PX)
    near, far = near.amin(0), far.amax(0)
    is_near = own_coc - near < far - own_coc
    edge = ((far - near) / _EDGE_PX - 1.0).clamp(0.0, 1.0)  # confidence that there are two surfaces
    edges = selected.put(torch.zeros_like(coc_px), edge)
    gap = (far - near).clamp_min(1e-6)

    # their colours: means over neighbours that lie on one of them, mostly unmixed ones
    falloff = _falloff(light, 1)
    weight = (1.0 - selected.around(edges)[0] + _UNCLEAN) * falloff
    if counted is not None:
        weight = weight * counted
    nearness = (far - window_coc) / gap
    near_weight, far_weight = weight * (4 * nearness - 2.8).clamp(0, 1), weight * (1.2 - 4 * nearness).clamp(0, 1)
    # a photograph's edges are wider than a pixel: mixed neighbours count without the light of the other surface
    same = weight * (2.0 - 2.0 * (window_coc - own_coc).abs() / _EDGE_PX).clamp(0.0, 1.0)
    clean = (window_light * same).sum(1) / same.sum(0).clamp_min(1e-12)
    clean = torch.lerp(colour, clean, edge * (same.sum(0) - 10.0 * _UNCLEAN).clamp(0.0, 1.0))
    clean = selected.around(selected.put(light, clean * brightest)) / brightest
    clean = clean.clamp(-_MOST_CLEAN, _MOST_CLEAN)
    if rules.mixed_neighbours:
        window_light = window_light - _mixed_light(window_light, clean, near_weight, far_weight)
    back, back_variance = _mean_of(window_light, far_weight)
    front, front_variance = _mean_of(window_light, near_weight)

    # a = (I - B) (F - B) / |F - B|^2, and the trust in it
    contrast = front - back
    strength = (contrast**2).sum(0)
    fitted = (((colour - back) * contrast).sum(0) / strength.clamp_min(1e-12)).clamp(0.0, 1.0)
    misfit = ((colour - back - fitted * contrast) ** 2).sum(0)
    trust = strength / (strength + _TRUST * (back_variance + front_variance + misfit) + _ALIKE**2)
    # a depth between the two belongs to a steep surface, not to an edge
    sided = ((own_coc - near) - (far - own_coc)).abs() / gap
    clear = edge * (4.0 * sided - 2.0).clamp(0.0, 1.0)
    weight = torch.where(is_near, 1.0 - fitted, fitted).clamp(max=0.5) * clear * trust  # of the other surface
    small = _falloff(light, 1, _SOFTNESS_FALLOFF)
    small = small if counted is None else small * counted
    covered = (small * nearness).sum(0) / small.sum(0).clamp_min(1e-12)  # by the near surface, under the Gaussian
    noise, misfit = back_variance + front_variance + _ALIKE**2, misfit + (covered - fitted) ** 2 * strength
    # below 1 px of coc the two may be a steep surface, and nothing is to be seen of a soft edge
    geometric = torch.where(is_near, 1.0 - covered, covered).clamp(max=0.5) * clear * (1.0 - trust)
    geometric = geometric * ((gap / _EDGE_PX - 2.0).clamp(0.0, 1.0) if rules.alike_colours else 0.0)
    weight = weight + geometric * noise / (noise + misfit)

    # Each part gets a share of the residual in proportion to its weight squared: the smallest change of both colours.
    # A sharper other surface gets none: texture and noise of this pixel would stay there as dots beside a blurred edge.
    # Then limit the parts to the image's range.
    own_mean, other_mean = torch.where(is_near, front, back), torch.where(is_near, back, front)
    own_weight = 1.0 - weight
    unexplained = colour - own_weight * own_mean - weight * other_mean
    sharper = own_coc.abs() - torch.where(is_near, far, near).abs()  # px by which the other surface is less blurred
    lent = (1.0 - sharper).clamp(0.0, 1.0) if rules.sharper_surface else 1.0
    moved = weight * (other_mean + unexplained * lent * weight / (weight**2 + own_weight**2))
    range_of_image = light.amin((2, 3)), light.amax((2, 3))
    extremes = (selected.of_item(extreme) / brightest for extreme in range_of_image)
    least, most = (extreme.clamp(-_UNBOUNDED, _UNBOUNDED) for extreme in extremes)  # 0 * inf would be NaN
    moved = torch.minimum(moved.maximum(colour - own_weight * most), colour - own_weight * least)
    moved = torch.minimum(moved.maximum(weight * least), weight * most)
    own = (colour - moved) / own_weight
    other = torch.where(weight > 0, moved / weight.clamp_min(1e-12), 0.0)
    return Matted(
        selected.put(light, own * brightest),
        selected.put(torch.zeros_like(light), other * brightest),
        selected.put(coc_px, torch.where(is_near, far, near)),
        selected.put(torch.zeros_like(coc_px), weight),
    )


def attribute_emitters(
    light: Tensor, coc_px: Tensor, threshold: Tensor, valid: Tensor | None, surfaces: Matted
) -> Matted:
    """Gives the light of highlights to the surface on which their emitter lies.

    An emitter seen through hair shines into pixels that have the depth of a strand. An emitter in front of a wall
    shines into pixels around it that have the depth of the wall. In a highlight's pixel, for emitters in front and then
    for emitters behind:

    1. Test for an emitter on another surface: its own surface is dim around it, and farther pixels, or nearer ones that
       touch it, are about as bright as the highlight.
    2. If so, the other surface gets the light above that of the own one, and may cover more than half of the pixel.
    3. Conversely, if the emitter lies on the pixel's own surface, reduce the weight of the other surface. It does if
       the other surface is dim around the pixel and nowhere as bright as the highlight.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        threshold: Light above which a pixel is a highlight, ``[B, 1, H, W]``.
        valid: As for :func:`matte`.
        surfaces: The result of :func:`matte`.

    Returns:
        The surfaces, changed at those pixels.
    """
    brightest = light.amax(1, keepdim=True)
    is_bright = brightest > threshold
    bright = pixels.indices(is_bright if valid is None else is_bright & (valid > 0))
    if is_empty(bright):
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

    brightness = (peaks**2).clamp(max=1e30)  # 0 * inf would be NaN, beside negative light
    dimness = 1.0 / (brightness + (_DIM * own_peak) ** 2).clamp_min(1e-24)

    def beyond(
        coc: Tensor, side: float | Tensor, among: Tensor, share: float, peaks: Tensor = peaks
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Confidence that the emitter lies behind (side 1) or in front of (-1) surfaces with coc ``coc``, 0 to 1.

        It is above 0 only if pixels there, ``among`` some of the window, have a peak above ``share`` times that of the
        surfaces. The peak of a surface that hardly any pixel lies on is taken to be :data:`_LEAST_PEAK` of the
        highlight: a ratio of two tiny peaks would depend on rounding. Also returns the weights of the window's pixels
        beyond the surfaces, those of dim pixels on them, and the larger of both peaks.
        """
        away = side * (window_coc - coc)
        there = among * (away - 1.0).clamp(0.0, 1.0)
        same = counted * (2.0 - away.abs()).clamp(0.0, 1.0)
        dim = same * near_by * (2.5 - 5.0 * peaks / own_peak.clamp_min(1e-12)).clamp(0.0, 1.0)
        emitter_peak = (there * peaks).amax(0)
        same_peak = torch.maximum((same * peaks).amax(0), _LEAST_PEAK * own_peak).clamp_min(1e-12)
        sureness = excess * (10.0 * dim.sum(0)).clamp(max=1.0)
        sureness = sureness * (10.0 * (emitter_peak / same_peak - share)).clamp(0.0, 1.0)
        return sureness, there, dim, torch.maximum(emitter_peak, same_peak)

    own, other, other_coc, weight = (pixels.pick(t, bright) for t in surfaces)
    own, other, other_coc, weight = own / scale, other / scale, other_coc[0], weight[0]
    for side, among, least_share in ((-1.0, touches, 1.0), (1.0, counted, 0.5)):
        sureness, there, dim, top = beyond(own_coc, side, among, least_share)
        is_beyond = sureness > 0
        dimmest = dim * dimness
        surface = (colour * dimmest).sum(1) / dimmest.sum(0).clamp_min(1e-12)  # its light where it is dimmest
        lit = there * near_by * brightness
        emitter_coc = nearest + ((window_coc - nearest) * lit).sum(0) / lit.sum(0).clamp_min(1e-12)
        if side < 0:  # an emitter seen through a surface is not in front of it
            sureness = sureness * (1.0 - beyond(emitter_coc, 1.0, counted, 0.5)[0])
        floor = surface.amax(0)
        share = ((own_peak - floor) / (top - floor).clamp_min(1e-12)).clamp(1.0 - _MOST_WEIGHT, _MOST_WEIGHT)
        emitter = (seen - (1.0 - share) * surface).clamp_min(0.0)
        # The earlier result fades into the new one in front, which is mostly the same surface. Behind is another
        # surface: the earlier result fades out before the new one fades in, so that their coc do not mix.
        kept, given = (1.0 - sureness, sureness) if side < 0 else (1.0 - 2.0 * sureness, 2.0 * sureness - 1.0)
        kept, given = kept.clamp_min(0.0) * weight, given.clamp_min(0.0)
        moved, weight = kept * other + given * emitter, kept + given * share
        known = weight.clamp_min(1e-12)
        other = torch.where(weight > 0, moved / known, 0.0)
        other_coc = torch.lerp(other_coc, emitter_coc, given * share / known)
        own = torch.where(is_beyond, (seen - weight * other) / (1.0 - weight), own)

    # The other way round: an emitter on the own surface. The other surface is dark around the pixel, without the light
    # of emitters seen through it, which was taken from it above.
    own_peaks = pixels.put(surfaces.own, bright, own * scale).amax(1, keepdim=True)
    own_peaks = pixels.pick(own_peaks, window)[0] / scale
    bright_other = (other.amax(0) / limit.clamp_min(torch.finfo(light.dtype).tiny) - 1.0).clamp(0.0, 1.0)
    apart = own_coc - other_coc
    sureness = beyond(other_coc, apart.sign(), torch.where(apart > 0, counted, touches), 1.0, own_peaks)[0]
    taken = (apart.abs() - 1.0).clamp(0.0, 1.0) * bright_other * (sureness if active().own_emitters else 0.0)
    weight = weight * (1.0 - taken)
    own = torch.where(taken > 0, (seen - weight * other) / (1.0 - weight), own)
    changed = zip(surfaces, (own * scale, other * scale, other_coc, weight), strict=True)
    return Matted(*(pixels.put(maps, bright, values) for maps, values in changed))


def _mixed_light(window: Tensor, clean: Tensor, near_weight: Tensor, far_weight: Tensor) -> Tensor:
    """Light of the other surface in neighbours ``[C, 9, P]``, which have clean light ``[C, 9, P]``.

    It is the part of their difference on the line between the colours of both surfaces, less where texture is strong.
    """
    back, back_variance = _mean_of(clean, far_weight)
    front, front_variance = _mean_of(clean, near_weight)
    contrast = (front - back)[:, None]
    strength = (contrast**2).sum(0) + _TEXTURE * (back_variance + front_variance) + _ALIKE**2
    share = ((window - clean) * contrast).sum(0) / strength
    return torch.where(near_weight > far_weight, share.clamp(-1.0, 0.0), share.clamp(0.0, 1.0)) * contrast


def _falloff(light: Tensor, reach: int, beside: float = _FALLOFF) -> Tensor:
    """Gaussian weights of the pixels of a window, ``[(2 reach + 1)^2, 1]``; ``beside`` is that at 1 px."""
    steps = range(-reach, reach + 1)
    return light.new_tensor([beside ** (dy * dy + dx * dx) for dy in steps for dx in steps])[:, None]


def _mean_of(colour: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean ``[C, P]`` of colours ``[C, n, P]`` over n, and their variance ``[P]``, summed over channels."""
    total = weight.sum(0).clamp_min(1e-12)
    mean = (colour * weight).sum(1) / total
    # not E[x^2] - E[x]^2, whose rounding error dominates where all colours are alike
    return mean, (((colour - mean[:, None]) ** 2 * weight).sum(1) / total).sum(0)
