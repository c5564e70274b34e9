"""Matting of mixed pixels: splits a pixel on a depth edge between the two surfaces that meet there.

A sharp image is anti-aliased, its depth map is not. So the pixels along a depth edge have the light of two surfaces and
the depth of one. Blurred with that depth alone, a bright emitter draws a wrong ring and a foreground a fringe. Matting
gives each surface its part of the light, only at edges, and leaves texture within a surface unchanged.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ... import native
from ...pixels import Selected
from ..engines.compiled_steps import compiled_step
from ..engines.ops import EAGER, Ops
from ..rules import active
from .windows import gaussian, highest

__all__ = ["FALLOFF", "NEAR_BY_PX", "NEVER_PX", "PLACE_SLOPE", "Matted", "matte", "on_near", "with_covered"]

NEVER_PX = 1e9
"""A coc in pixels that no pixel has: marks the absence of a surface."""

_EDGE_PX = 0.5  # px; smallest difference in coc of neighbours on two surfaces; larger: fewer edges
_SAME_BLUR = 0.1  # difference in coc, over the smaller blur, that one surface may have as well; larger: fewer edges
NEAR_BY_PX = 1.5  # standard deviation of the Gaussian by which neighbours count
FALLOFF = math.exp(-0.5 / NEAR_BY_PX**2)  # its weight at a distance of 1 px
_UNCLEAN = 1e-2  # weight in a surface's mean colour of pixels that may be mixed; others have 1
_FEW_CLEAN = 10 * _UNCLEAN  # sum of these weights up to which the light of unmixed pixels is unknown
PLACE_SLOPE = 4.0  # of weights by the place between two surfaces, from 0 at the far one to 1 at the near one
_ON_NEAR_FROM, _ON_FAR_TO = 0.7, 0.3  # place above which a pixel counts to the near one, and below which to the far one
_SIDED_FROM = 0.5  # distance from the middle, over half the gap, above which a pixel lies on one of both surfaces
_TRUST = 10.0  # weight of variance against contrast; larger: texture stops more splits by colour
_TEXTURE = 50.0  # weight of variance against contrast; larger: texture keeps more of a neighbour's mixed light
_MOST_CLEAN = 4.0  # upper limit for a neighbour's clean light, as a multiple of the brightest neighbour
_SOFTNESS_PX = 0.6  # standard deviation of the Gaussian by which two surfaces mix where their colours are alike
_SOFTNESS_FALLOFF = math.exp(-0.5 / _SOFTNESS_PX**2)  # its weight at a distance of 1 px, read by C++ and CUDA
_ALIKE = 1.0 / 255.0  # contrast at which trust is halved, as a fraction of the brightest light around
_UNBOUNDED = 1e6  # upper limit for either part, as a multiple of the brightest neighbour; avoids 0 * inf


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
        covered: Other surfaces by a matte, as from :func:`torchdof.render.surfaces.coverage.covered_by`, or None.

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
    return surfaces if covered is None else with_covered(light, surfaces, covered)


def with_covered(light: Tensor, surfaces: Matted, covered: Tensor) -> Matted:
    """The surfaces of each pixel: those of a matte by their certainty, those given for the rest."""
    share, coc, weight, certainty = covered.split([light.shape[1], 1, 1, 1], 1)
    kept, given = (1.0 - certainty) * surfaces.other_weight, certainty * weight
    both = kept + given
    known = both.clamp_min(1e-12)
    other = torch.where(both > 0, (kept * surfaces.other + certainty * share * light) / known, 0.0)
    other_coc = torch.where(both > 0, (kept * surfaces.other_coc_px + given * coc) / known, surfaces.other_coc_px)
    split = Matted((light - both * other) / (1.0 - both), other, other_coc, both)
    return Matted(*(torch.where(certainty > 0, new, old) for new, old in zip(split, surfaces, strict=True)))


class _EdgePixels(NamedTuple):
    """P pixels at depth edges, with the 3 x 3 pixels around each. Light is relative to the brightest of these."""

    chosen: Selected
    brightest: Tensor  # [P]
    light: Tensor  # of the pixel, [C, P]
    around: Tensor  # light around it, [C, 9, P]
    coc_px: Tensor  # [P]
    coc_around: Tensor  # [9, P]
    counts: Tensor | None  # 0 where a pixel around is left out, [9, P]
    near_px: Tensor  # coc of the near surface, [P]
    far_px: Tensor  # coc of the far surface, [P]
    certainty: Tensor  # confidence that there are two surfaces, [P]

    @property
    def gap_px(self) -> Tensor:
        """Difference in coc of both surfaces, at least 1e-6."""
        return (self.far_px - self.near_px).clamp_min(1e-6)

    @property
    def nearness(self) -> Tensor:
        """Place of the pixels around between the far surface, 0, and the near one, 1: ``[9, P]``."""
        return (self.far_px - self.coc_around) / self.gap_px

    def by_owner(self, if_near: Tensor, if_far: Tensor) -> Tensor:
        """Values of pixels whose own surface is the near one, and of those whose own surface is the far one."""
        return torch.where(self.coc_px - self.near_px < self.far_px - self.coc_px, if_near, if_far)


class _Colour(NamedTuple):
    """Mean colour of a surface, ``[C, P]``, and its variance, ``[P]``, summed over channels."""

    mean: Tensor
    variance: Tensor


def _split(light: Tensor, coc_px: Tensor, valid: Tensor | None = None, ops: Ops = EAGER) -> Matted:
    """:func:`matte` by PyTorch, without a matte."""
    if not active().matting:
        return Matted(light, torch.zeros_like(light), coc_px, torch.zeros_like(coc_px))
    edge = _edge_pixels(light, coc_px, valid, ops)
    near, far = _colours(edge, light, coc_px)
    weight = _weight_of_other(edge, near, far)
    own, other = _parts(edge, near, far, weight, light)
    put = edge.chosen.put
    return Matted(
        put(light, own * edge.brightest),
        put(torch.zeros_like(light), other * edge.brightest),
        put(coc_px, edge.by_owner(edge.far_px, edge.near_px)),
        put(torch.zeros_like(coc_px), weight),
    )


def _edge_pixels(light: Tensor, coc_px: Tensor, valid: Tensor | None, ops: Ops) -> _EdgePixels:
    """Step 1 of :func:`matte`: the pixels beside another surface, and the coc of the two surfaces around each."""
    known = None if valid is None else valid > 0
    high, low = (c if known is None else torch.where(known, c, -NEVER_PX) for c in (coc_px.detach(), -coc_px.detach()))
    high, low = (highest(c, 1) for c in (high, low))
    is_edge = _apart_px(-low, high) > _EDGE_PX
    chosen = ops.select(is_edge if known is None else is_edge & known)

    own_light, around, coc_around = chosen.pick(light), chosen.around(light), chosen.around(coc_px)[0]
    brightest = around.detach().abs().amax((0, 1)).clamp_min(torch.finfo(light.dtype).tiny)
    near_px = far_px = coc_around
    counts = None if valid is None else chosen.around(valid)[0]
    if counts is not None:
        near_px, far_px = torch.where(counts > 0, near_px, NEVER_PX), torch.where(counts > 0, far_px, -NEVER_PX)
    near_px, far_px = near_px.amin(0), far_px.amax(0)
    certainty = (_apart_px(near_px, far_px) / _EDGE_PX - 1.0).clamp(0.0, 1.0)
    lights, cocs = (own_light / brightest, around / brightest), (chosen.pick(coc_px)[0], coc_around)
    return _EdgePixels(chosen, brightest, *lights, *cocs, counts, near_px, far_px, certainty)


def _apart_px(near_px: Tensor, far_px: Tensor) -> Tensor:
    """Difference in coc of two surfaces, less the part that is not seen in a strong blur.

    A split for this part would keep the hidden sample out of the pixel.
    """
    return far_px - near_px - _SAME_BLUR * torch.minimum(near_px.abs(), far_px.abs())


def on_near(place: Tensor) -> Tensor:
    """How far a pixel counts to the near one of two surfaces, at its place from 0, the far one, to 1, the near one."""
    return (PLACE_SLOPE * (place - _ON_NEAR_FROM)).clamp(0.0, 1.0)


def _on_far(place: Tensor) -> Tensor:
    """The same for the far surface."""
    return (PLACE_SLOPE * (_ON_FAR_TO - place)).clamp(0.0, 1.0)


def _colours(edge: _EdgePixels, light: Tensor, coc_px: Tensor) -> tuple[_Colour, _Colour]:
    """Step 2 of :func:`matte`: the colours of the near and the far surface, mostly of unmixed pixels."""
    certainty = edge.chosen.put(torch.zeros_like(coc_px), edge.certainty)
    weight = (1.0 - edge.chosen.around(certainty)[0] + _UNCLEAN) * gaussian(1, NEAR_BY_PX, light.dtype, light.device)
    weight = weight if edge.counts is None else weight * edge.counts
    nearness = edge.nearness
    weights = weight * on_near(nearness), weight * _on_far(nearness)
    around = edge.around
    if active().mixed_neighbours:
        around = around - _mixed_light(around, _clean_light(edge, weight, light), *weights)
    near, far = (_mean_of(around, each) for each in weights)
    return near, far


def _clean_light(edge: _EdgePixels, weight: Tensor, light: Tensor) -> Tensor:
    """Light around each pixel without that of another surface, ``[C, 9, P]``.

    A mixed pixel gets the mean of the pixels around it that lie on its own surface, by their ``weight``, ``[9, P]``; it
    keeps its light if all of them may be mixed.
    """
    same = weight * (2.0 - 2.0 * (edge.coc_around - edge.coc_px).abs() / _EDGE_PX).clamp(0.0, 1.0)
    mean = (edge.around * same).sum(1) / same.sum(0).clamp_min(1e-12)
    clean = torch.lerp(edge.light, mean, edge.certainty * (same.sum(0) - _FEW_CLEAN).clamp(0.0, 1.0))
    around = edge.chosen.around(edge.chosen.put(light, clean * edge.brightest)) / edge.brightest
    return around.clamp(-_MOST_CLEAN, _MOST_CLEAN)


def _weight_of_other(edge: _EdgePixels, near: _Colour, far: _Colour) -> Tensor:
    """Steps 3 and 4 of :func:`matte`: the part of each pixel that its other surface covers, ``[P]``."""
    # a = (I - B) (F - B) / |F - B|^2, and the trust in it
    contrast = near.mean - far.mean
    strength = (contrast**2).sum(0)
    fitted = (((edge.light - far.mean) * contrast).sum(0) / strength.clamp_min(1e-12)).clamp(0.0, 1.0)
    misfit = ((edge.light - far.mean - fitted * contrast) ** 2).sum(0)
    trust = strength / (strength + _TRUST * (far.variance + near.variance + misfit) + _ALIKE**2)
    # a depth between the two belongs to a steep surface, not to an edge
    sided = ((edge.coc_px - edge.near_px) - (edge.far_px - edge.coc_px)).abs() / edge.gap_px
    clear = edge.certainty * (PLACE_SLOPE * (sided - _SIDED_FROM)).clamp(0.0, 1.0)
    by_colour = edge.by_owner(1.0 - fitted, fitted).clamp(max=0.5) * clear * trust

    # the near surface's share under a small Gaussian
    small = gaussian(1, _SOFTNESS_PX, edge.light.dtype, edge.light.device)
    small = small if edge.counts is None else small * edge.counts
    covered = (small * edge.nearness).sum(0) / small.sum(0).clamp_min(1e-12)
    by_place = edge.by_owner(1.0 - covered, covered).clamp(max=0.5) * clear * (1.0 - trust)
    # below 1 px of coc the two may be a steep surface, and nothing is to be seen of a soft edge
    by_place = by_place * ((edge.gap_px / _EDGE_PX - 2.0).clamp(0.0, 1.0) if active().alike_colours else 0.0)
    noise, misfit = far.variance + near.variance + _ALIKE**2, misfit + (covered - fitted) ** 2 * strength
    return by_colour + by_place * noise / (noise + misfit)


def _parts(edge: _EdgePixels, near: _Colour, far: _Colour, weight: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
    """Step 5 of :func:`matte`: light of the own and of the other surface, ``[C, P]``, with ``weight`` of the other.

    Each part gets a share of the residual in proportion to its weight squared: the smallest change of both colours. A
    sharper other surface gets none: texture and noise of this pixel would stay there as dots beside a blurred edge.
    """
    own_mean, other_mean = edge.by_owner(near.mean, far.mean), edge.by_owner(far.mean, near.mean)
    own_weight = 1.0 - weight
    residual = edge.light - own_weight * own_mean - weight * other_mean
    sharper_px = edge.coc_px.abs() - edge.by_owner(edge.far_px, edge.near_px).abs()
    lent = (1.0 - sharper_px).clamp(0.0, 1.0) if active().sharper_surface else 1.0
    moved = weight * (other_mean + residual * lent * weight / (weight**2 + own_weight**2))
    # neither part leaves the image's range
    extremes = (edge.chosen.of_item(ends) / edge.brightest for ends in (light.amin((2, 3)), light.amax((2, 3))))
    least, most = (extreme.clamp(-_UNBOUNDED, _UNBOUNDED) for extreme in extremes)  # 0 * inf would be NaN
    moved = torch.minimum(moved.maximum(edge.light - own_weight * most), edge.light - own_weight * least)
    moved = torch.minimum(moved.maximum(weight * least), weight * most)
    return (edge.light - moved) / own_weight, torch.where(weight > 0, moved / weight.clamp_min(1e-12), 0.0)


def _mixed_light(around: Tensor, clean: Tensor, near_weight: Tensor, far_weight: Tensor) -> Tensor:
    """Light of the other surface in neighbours ``[C, 9, P]``, which have clean light ``[C, 9, P]``.

    It is the part of their difference on the line between the colours of both surfaces, less where texture is strong.
    """
    near, far = _mean_of(clean, near_weight), _mean_of(clean, far_weight)
    contrast = (near.mean - far.mean)[:, None]
    strength = (contrast**2).sum(0) + _TEXTURE * (far.variance + near.variance) + _ALIKE**2
    share = ((around - clean) * contrast).sum(0) / strength
    return torch.where(near_weight > far_weight, share.clamp(-1.0, 0.0), share.clamp(0.0, 1.0)) * contrast


def _mean_of(colour: Tensor, weight: Tensor) -> _Colour:
    """Weighted mean of colours ``[C, n, P]`` over n, and their variance."""
    total = weight.sum(0).clamp_min(1e-12)
    mean = (colour * weight).sum(1) / total
    # not E[x^2] - E[x]^2, whose rounding error dominates where all colours are alike
    return _Colour(mean, (((colour - mean[:, None]) ** 2 * weight).sum(1) / total).sum(0))
