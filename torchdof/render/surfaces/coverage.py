"""Splits mixed pixels whose coverage is known from a matte, such as that of a portrait.

A matte states how much of each pixel its subject covers. A pixel with coverage ``a`` has the light

    ``I = a S + (1 - a) T``,

S being the light of the subject there and T that of the surface beside it. Both are unknown in this pixel. Their means
``s`` and ``t`` come from pixels around that show one surface alone, and their variances ``v_s`` and ``v_t`` from more
of them. The most likely S and T share the residual ``r = I - a s - (1 - a) t`` by the variances of both parts:

    ``(1 - a) T = (1 - a) t + r (1 - a)^2 v_t / (a^2 v_s + (1 - a)^2 v_t)``, in [0, I].

So hair before a plain wall keeps its texture, and so does a wall behind plain hair. A variance counts ``1 + |coc|``
times, because errors of a blurred surface are seen less. :mod:`torchdof.render.surfaces.matting` has to guess ``a``
from these colours, which say little where hair and wall are alike.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...tensors import is_traced
from ..engines.ops import EAGER, Ops
from ..layers.downsampling import downsampled, upsampled
from .matting import PLACE_SLOPE, on_near
from .windows import highest

__all__ = ["covered_by", "is_near_edge"]

_LEVELS = 6  # levels of the pyramid that finds samples of one surface; larger: from farther away
_MANY = 64  # samples from which the means of a first guess come; larger: errors of the depth matter less
_STEP_PX = 0.5  # px; smallest difference in coc between subject and surroundings; larger: fewer edges
_RISE = 9  # px; distance over which an edge rises by `_RISEN` of its step; larger: slopes count as edges
_RISEN, _RISEN_SLOPE = 0.3, 10.0  # this part, and the slope of the certainty by it
_BEYOND = 2.0  # place beyond both surfaces up to which a coc fits, from 0 at the other surface to 1 at its own
_WRONG_FROM = 0.25  # place of a coc, from 0 at its own surface to 1 at the other one, above which it is wrong
_THIRD_FROM = 3.0  # distance from the middle of both, over half the gap, from which a coc is that of a third surface
_STEEP = 10.0  # inverse of the coverage that counts as a mixed pixel's; larger: only purer pixels are samples
_LEAST = 1e-4  # (1 %)^2: smallest variance of a surface's light, as a fraction of its mean square


def covered_by(
    image: Tensor,
    coc_px: Tensor,
    matte: Tensor,
    threshold: Callable[[Tensor, Tensor], Tensor],
    ops: Ops = EAGER,
) -> tuple[Tensor, Tensor | None]:
    """Both surfaces of the pixels at the edges of a matte, where the depth has an edge too.

    1. Guess the coc of the subject and of its surroundings, each as a mean over many pixels that the matte gives to it.
    2. Take both from the nearest of these pixels whose coc fits the guess, because depth is wrong beside edges.
    3. Where a pixel has the coc of the surface that covers less than half of it, or one between both, replace it.
    4. Give the smaller part of the pixel to the other surface, with its most likely light.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B or 1, 1, H, W]``, signed; a pixel that is not finite stays.
        matte: Coverage by the subject, ``[B or 1, 1, H, W]``, in [0, 1].
        threshold: Gives the light above which a pixel is a highlight, of an image and of the validity of its pixels:
            :func:`torchdof.render.highlights.threshold`.
        ops: Skips mattes without an edge.

    Returns:
        The map of the coc, ``[B, 1, H, W]``; and the other surfaces, ``[B, C + 3, H, W]``: their part of the pixel's
        light in each channel, their coc, the fraction of the pixel that they cover, and the certainty, 0 to 1, that
        both surfaces are known. Pixels away from the edges of the matte, or from those of the depth, keep their coc and
        have a certainty of 0. None if the matte has no edge. Gradients flow to all arguments.
    """
    matte = torch.nan_to_num(matte).clamp(0.0, 1.0)  # for unchecked input

    def has_edge() -> Tensor:
        return (_change(matte.detach(), 3) > 0).any()

    if not is_traced() and not has_edge():
        return coc_px, None
    covered = _covered_by(image, coc_px, matte, threshold)
    if is_traced():
        items, channels, height, width = image.shape
        others = torch.zeros_like(image[:, :1], dtype=covered.dtype).expand(-1, channels + 3, -1, -1)
        none = torch.cat([coc_px.to(covered.dtype).expand(items, -1, height, width), others], 1)
        covered = ops.equal_unless(has_edge, covered, none)
    return covered[:, :1], covered[:, 1:]


def _covered_by(image: Tensor, coc_px: Tensor, matte: Tensor, threshold: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """:func:`covered_by` of a matte that has an edge: the map and the other surfaces, ``[B, C + 4, H, W]``."""
    wide = torch.promote_types(torch.promote_types(image.dtype, coc_px.dtype), torch.float32)
    light, (coc, cover) = image.to(wide), (t.to(wide).expand(image.shape[0], -1, -1, -1) for t in (coc_px, matte))
    known = torch.isfinite(coc) & torch.isfinite(light).all(1, keepdim=True)
    light, coc = torch.where(known, light, 0.0), torch.where(known, coc, 0.0)
    parts = (cover, 1.0 - cover)
    pure = [(1.0 - _STEEP * (1.0 - part)).clamp_min(0.0) * known for part in parts]

    # coc of both surfaces, and the place of each pixel's coc between them
    brightest = light.detach().abs().amax((1, 2, 3), keepdim=True).clamp_min(torch.finfo(wide).tiny)
    light = light / brightest
    limit = threshold(light, known.to(wide)).clamp_min(torch.finfo(wide).tiny)
    dimmed = light * (limit / light.amax(1, keepdim=True).clamp_min(limit))  # a lamp says nothing about its surface
    maps = torch.cat([coc, dimmed, (dimmed**2).sum(1, keepdim=True)], 1)
    guesses = [_spread(maps, weight / _MANY)[0].split([1, light.shape[1], 1], 1) for weight in pure]
    place = _place(coc, guesses[0][0], guesses[1][0])
    fits = [on_near(t) * (PLACE_SLOPE * (_BEYOND - t)).clamp(0.0, 1.0) for t in (place, 1.0 - place)]
    samples = [weight * fit for weight, fit in zip(pure, fits, strict=True)]
    (subject, found), (beside, also_found) = (_spread(coc, weight) for weight in samples)
    place, step_px = _place(coc, subject, beside), (subject - beside).abs()
    is_subject = cover >= 0.5
    own, other = torch.where(is_subject, subject, beside), torch.where(is_subject, beside, subject)
    away = torch.where(is_subject, 1.0 - place, place).abs()  # 0: the coc is that of the larger part, 1: of the other
    is_wrong = (PLACE_SLOPE * (away - _WRONG_FROM)).clamp(0.0, 1.0)

    # near an edge of the matte; a wrong coc also a few pixels from it, if that of the own surface is as near
    subjects, others = (_largest(weight, _RISE) for weight in samples)
    beside_own = torch.where(is_subject, subjects, others)
    band = torch.maximum(_change(cover, 3), beside_own * is_wrong * _change(cover, _RISE)) * _STEEP
    # a third surface has its coc elsewhere; on a slope, the samples of both lie apart without an edge
    risen = _largest_around(_change(coc.detach(), _RISE)) / step_px.clamp_min(1e-6)
    is_third = (2.0 * place - 1.0).abs() - _THIRD_FROM
    doubts = (band, step_px / _STEP_PX - 1.0, -is_third, _RISEN_SLOPE * (risen - _RISEN))
    certainty = torch.where(known & (found * also_found > 0), torch.stack(doubts).clamp(0.0, 1.0).prod(0), 0.0)
    moved = torch.lerp(coc, own, certainty * is_wrong)

    # the most likely light of both surfaces
    means = [part * _spread(dimmed, weight)[0] for part, weight in zip(parts, pure, strict=True)]
    variances = [
        torch.maximum(square - (mean**2).sum(1, keepdim=True), _LEAST * square).clamp_min(torch.finfo(wide).tiny)
        for _, mean, square in guesses
    ]
    blurs = [1.0 + coc_of_part.abs() for coc_of_part in (subject, beside)]
    varied = [part**2 * variance * blur for part, variance, blur in zip(parts, variances, blurs, strict=True)]
    residual = light - means[0] - means[1]
    behind = means[1] + residual * (varied[1] / (varied[0] + varied[1]))
    share = torch.where(light > 0, behind / torch.where(light > 0, light, 1.0), parts[1]).clamp(0.0, 1.0)
    share = torch.where(is_subject, share, 1.0 - share)
    weight = torch.where(is_subject, parts[1], parts[0])
    return torch.cat([torch.where(known, moved, coc_px), share, other, weight, certainty], 1)


def is_near_edge(matte: Tensor, reach_px: int) -> Tensor:
    """Whether an edge of a matte ``[B, 1, H, W]`` is within a distance: its coverage rises by a half there."""
    return _change(torch.nan_to_num(matte).clamp(0.0, 1.0), 2 * reach_px + 1) > 0.5


def _place(coc_px: Tensor, subject: Tensor, beside: Tensor) -> Tensor:
    """Place of a coc between those of two surfaces: 1 at the subject's, 0 at that of its surroundings."""
    step = subject - beside
    return (coc_px - beside) * step / (step**2).clamp_min(1e-6)


def _change(values: Tensor, side: int) -> Tensor:
    """Largest less smallest value of the ``side x side`` pixels around."""
    return _largest(values, side) + _largest(-values, side)


def _largest(values: Tensor, side: int) -> Tensor:
    """Largest of the ``side x side`` pixels around, side being odd; max_pool2d takes ten times as long on a CPU."""
    values = functional.pad(values, (side // 2,) * 4, value=-torch.inf)
    for dim in (-1, -2):
        width = 1  # of the windows whose largest value is known; two of them make a wider one
        while width < side:
            step = min(width, side - width)
            count = values.shape[dim] - step
            values = torch.maximum(values.narrow(dim, 0, count), values.narrow(dim, step, count))
            width += step
    return values


def _largest_around(values: Tensor) -> Tensor:
    """About the largest of the values ``[B, 1, H, W]`` from which :func:`_spread` takes samples for a pixel."""
    height, width = values.shape[-2:]
    side = 2 ** (_LEVELS - 1)
    cells = functional.max_pool2d(functional.pad(values, (0, -width % side, 0, -height % side)), side)
    return upsampled(highest(cells, 1), side)[..., :height, :width]


def _spread(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Means of the nearest samples ``[B, n, H, W]`` with weights ``[B, 1, H, W]``, at each pixel, and their weight.

    Sums of 2 x 2 samples make the coarser levels of a pyramid. A pixel reads a coarser level as far as the weight in
    the finer ones is below 1.
    """
    height, width = values.shape[-2:]
    side = 2**_LEVELS
    levels = [functional.pad(torch.cat([values * weight, weight], 1), (0, -width % side, 0, -height % side))]
    for _ in range(_LEVELS):
        summed = 4.0 * downsampled(levels[-1], 2)
        levels.append(summed / summed[:, -1:].clamp_min(1.0))
    spread = levels[-1]
    for finer in reversed(levels[:-1]):
        spread = finer + (1.0 - finer[:, -1:]) * upsampled(spread, 2)
    mean, total = spread[..., :height, :width].split([values.shape[1], 1], 1)
    return mean / total.clamp_min(1e-12), total
