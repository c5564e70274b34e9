"""Emitters: the light of a highlight belongs to the surface of its emitter, which the depth of its pixel may not be."""

from typing import NamedTuple

import torch
from torch import Tensor

from ... import pixels
from ...tensors import is_empty
from ..rules import active
from .matting import FALLOFF, NEAR_BY_PX, Matted
from .windows import gaussian

__all__ = ["attribute_emitters"]

_EMITTER_REACH = 3  # px; half the width of the window in which an emitter's surface is searched
_TOUCHING = 2  # px; distance over which a soft image spreads the light of an emitter in front
_DIM = 0.1  # fraction of the highlight below which all pixels are equally good samples of a surface's own light
_DIM_TO, _DIM_SLOPE = 0.5, 5.0  # light, over the highlight's, below which a pixel is dim; slope of its weight as one
_SURE = 10.0  # slope of the certainty of an emitter, by the weight of dim pixels and by how far it is brighter
_BEHIND_SHARE = 0.5  # least light of an emitter behind a surface, over the brightest of the surface
_LEAST_PEAK = 0.5  # least peak of a surface around a highlight, as a fraction of it; larger: fewer emitters are found
_MOST_WEIGHT = 0.98  # largest weight of an emitter on another surface in a highlight's pixel


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
        valid: As for :func:`torchdof.render.surfaces.matting.matte`.
        surfaces: Its result.

    Returns:
        The surfaces, changed at those pixels.
    """
    brightest = light.amax(1, keepdim=True)
    is_bright = brightest > threshold
    chosen = pixels.indices(is_bright if valid is None else is_bright & (valid > 0))
    if is_empty(chosen):
        return surfaces
    bright = _bright_pixels(chosen, light, brightest, coc_px, threshold, valid)
    own, other, other_coc, weight = (pixels.pick(t, chosen) for t in surfaces)
    parts = Matted(own / bright.scale, other / bright.scale, other_coc[0], weight[0])
    parts = _of_another_surface(bright, parts, is_behind=False)
    parts = _of_another_surface(bright, parts, is_behind=True)
    parts = _of_own_surface(bright, parts, surfaces.own)
    own, other, other_coc, weight = parts
    changed = zip(surfaces, (own * bright.scale, other * bright.scale, other_coc, weight), strict=True)
    return Matted(*(pixels.put(maps, chosen, values) for maps, values in changed))


class _Bright(NamedTuple):
    """P pixels of highlights, and the n pixels of a window around each; light is relative to the brightest of these."""

    pixels: Tensor  # [P]
    window: Tensor  # pixels around, [n, P]
    scale: Tensor  # brightest light around, [P]
    light: Tensor  # of the pixel, [C, P]
    peak: Tensor  # its brightest channel, [P]
    limit: Tensor  # light above which it is a highlight, [P]
    coc_px: Tensor  # [P]
    around: Tensor  # light around it, [C, n, P]
    peaks: Tensor  # its brightest channel, [n, P]
    coc_around: Tensor  # [n, P]
    counts: Tensor  # 0 where a pixel around is left out, [n, P]
    near_by: Tensor  # weight of a pixel around by its distance, [n, 1]

    def among(self, is_behind: bool) -> Tensor:
        """Pixels around that may show an emitter: all show one behind, those that touch the pixel one in front."""
        if is_behind:
            return self.counts
        return self.counts * (self.near_by > FALLOFF ** (2 * _TOUCHING**2 + 1))

    @property
    def brightness(self) -> Tensor:
        """Weight of the pixels around as samples of an emitter, ``[n, P]``."""
        return (self.peaks**2).clamp(max=1e30)  # 0 * inf would be NaN, beside negative light


class _Emitter(NamedTuple):
    """What :func:`_found` finds around highlights."""

    certainty: Tensor  # confidence that there is an emitter, [P]
    there: Tensor  # weight of the pixels around on its surface, [n, P]
    dim: Tensor  # weight of the dim pixels around on the surface it was searched from, [n, P]
    peak: Tensor  # largest peak on both surfaces, [P]


def _bright_pixels(
    chosen: Tensor, light: Tensor, brightest: Tensor, coc_px: Tensor, threshold: Tensor, valid: Tensor | None
) -> _Bright:
    """The pixels ``chosen``, of maps as for :func:`attribute_emitters`, whose brightest channel is given."""
    window = pixels.around(chosen, coc_px, _EMITTER_REACH)
    peaks = pixels.pick(brightest, window)[0]
    scale = peaks.detach().amax(0)
    counts = torch.ones_like(peaks) if valid is None else pixels.pick(valid, window)[0]
    return _Bright(
        chosen,
        window,
        scale,
        light=pixels.pick(light, chosen) / scale,
        peak=pixels.pick(brightest, chosen)[0] / scale,
        limit=pixels.pick(threshold, chosen)[0] / scale,
        coc_px=pixels.pick(coc_px, chosen)[0],
        around=pixels.pick(light, window) / scale,
        peaks=peaks / scale,
        coc_around=pixels.pick(coc_px, window)[0],
        counts=counts,
        near_by=gaussian(_EMITTER_REACH, NEAR_BY_PX, light.dtype, light.device),
    )


def _found(bright: _Bright, coc: Tensor, side: float | Tensor, among: Tensor, share: float, peaks: Tensor) -> _Emitter:
    """Searches for emitters behind (side 1) or in front of (-1) surfaces with coc ``[P]``.

    There is one only if pixels there, ``among`` some of the window, have a peak above ``share`` times that of the
    surfaces. ``peaks`` are those around, ``[n, P]``. The peak of a surface that hardly any pixel lies on is taken to be
    :data:`_LEAST_PEAK` of the highlight: a ratio of two tiny peaks would depend on rounding.
    """
    away = side * (bright.coc_around - coc)
    there = among * (away - 1.0).clamp(0.0, 1.0)
    same = bright.counts * (2.0 - away.abs()).clamp(0.0, 1.0)
    dim = same * bright.near_by * (_DIM_SLOPE * (_DIM_TO - peaks / bright.peak.clamp_min(1e-12))).clamp(0.0, 1.0)
    emitter_peak = (there * peaks).amax(0)
    same_peak = torch.maximum((same * peaks).amax(0), _LEAST_PEAK * bright.peak).clamp_min(1e-12)
    excess = (bright.peak / bright.limit - 1.0).clamp(0.0, 1.0)
    certainty = excess * (_SURE * dim.sum(0)).clamp(max=1.0)
    certainty = certainty * (_SURE * (emitter_peak / same_peak - share)).clamp(0.0, 1.0)
    return _Emitter(certainty, there, dim, torch.maximum(emitter_peak, same_peak))


def _of_another_surface(bright: _Bright, parts: Matted, is_behind: bool) -> Matted:
    """Steps 1 and 2 of :func:`attribute_emitters`: gives their light to emitters behind the pixels, or in front.

    ``parts`` are the surfaces of the pixels: light ``[C, P]``, coc and weight ``[P]``.
    """
    own, other, other_coc, weight = parts
    side, least_share = (1.0, _BEHIND_SHARE) if is_behind else (-1.0, 1.0)
    emitter = _found(bright, bright.coc_px, side, bright.among(is_behind), least_share, bright.peaks)
    certainty, is_beyond = emitter.certainty, emitter.certainty > 0

    # light of the pixel's own surface where it is dimmest
    dimmest = emitter.dim * (1.0 / (bright.brightness + (_DIM * bright.peak) ** 2).clamp_min(1e-24))
    surface = (bright.around * dimmest).sum(1) / dimmest.sum(0).clamp_min(1e-12)
    lit = emitter.there * bright.near_by * bright.brightness
    nearest = bright.coc_around.amin(0)
    emitter_coc = nearest + ((bright.coc_around - nearest) * lit).sum(0) / lit.sum(0).clamp_min(1e-12)
    if not is_behind:  # an emitter seen through a surface is not in front of it
        seen_through = _found(bright, emitter_coc, 1.0, bright.counts, _BEHIND_SHARE, bright.peaks)
        certainty = certainty * (1.0 - seen_through.certainty)
    floor = surface.amax(0)
    share = (bright.peak - floor) / (emitter.peak - floor).clamp_min(1e-12)
    share = share.clamp(1.0 - _MOST_WEIGHT, _MOST_WEIGHT)
    emitted = (bright.light - (1.0 - share) * surface).clamp_min(0.0)

    # The earlier result fades into the new one in front, which is mostly the same surface. Behind is another surface:
    # the earlier result fades out before the new one fades in, so that their coc do not mix.
    kept, given = (1.0 - 2.0 * certainty, 2.0 * certainty - 1.0) if is_behind else (1.0 - certainty, certainty)
    kept, given = kept.clamp_min(0.0) * weight, given.clamp_min(0.0)
    moved, weight = kept * other + given * emitted, kept + given * share
    known = weight.clamp_min(1e-12)
    other = torch.where(weight > 0, moved / known, 0.0)
    other_coc = torch.lerp(other_coc, emitter_coc, given * share / known)
    own = torch.where(is_beyond, (bright.light - weight * other) / (1.0 - weight), own)
    return Matted(own, other, other_coc, weight)


def _of_own_surface(bright: _Bright, parts: Matted, own_light: Tensor) -> Matted:
    """Step 3 of :func:`attribute_emitters`: takes the light of the pixels' own emitters from the other surface.

    It does where that surface is dark around the pixel. ``own_light`` is the light of each pixel's own surface before
    step 2, ``[B, C, H, W]``, and ``parts`` are the surfaces after it: light ``[C, P]``, coc and weight ``[P]``.
    """
    own, other, other_coc, weight = parts
    peaks = pixels.put(own_light, bright.pixels, own * bright.scale).amax(1, keepdim=True)
    peaks = pixels.pick(peaks, bright.window)[0] / bright.scale
    smallest = torch.finfo(own.dtype).tiny
    bright_other = (other.amax(0) / bright.limit.clamp_min(smallest) - 1.0).clamp(0.0, 1.0)
    apart = bright.coc_px - other_coc
    among = torch.where(apart > 0, bright.among(is_behind=True), bright.among(is_behind=False))
    certainty = _found(bright, other_coc, apart.sign(), among, 1.0, peaks).certainty
    taken = (apart.abs() - 1.0).clamp(0.0, 1.0) * bright_other * (certainty if active().own_emitters else 0.0)
    weight = weight * (1.0 - taken)
    own = torch.where(taken > 0, (bright.light - weight * other) / (1.0 - weight), own)
    return Matted(own, other, other_coc, weight)
