"""Gives to a blurred foreground what the map of depth misses of it: hair, fur, twigs, rims.

A map often ends some pixels before the last hairs of its foreground. Left with the background they would stay sharp,
before a smooth background the most visible fault of all. This module compares the pixels beside a more blurred near
surface with the background farther from it. If many of those near the edges are unlike the background and few of those
farther away are, the map has missed parts of its foregrounds, which then grow. A foreground also grows where the
background is smooth, which is not seen there. A map with exact edges stays unchanged, as things of the background do
not prefer places beside an edge. Cells of pixels are counted from the top left, so that a few pixels of a mirrored
frame may be decided otherwise.
"""

import itertools

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import native
from ...optics.kernel_cache import kept
from ...tensors import is_traced
from ...validation import engine_reads
from ..engines.compiled_steps import by_items
from ..engines.ops import EAGER, Ops
from ..engines.traced import is_compiled, one_operator
from ..rules import active
from .edge_colours import finite_light
from .windows import highest

__all__ = ["completed"]

_RINGS_PX = (1, 2, 3, 10, 22)  # px; distance from the near surface at which each ring ends
_RIM = 3  # rings in which the map may have missed something; the first is mixed by the image itself
_SAMPLED = 2  # every second row is compared; larger: faster, coarser
_CELL = 4  # px; side of the cells in which pixels are summed
_NEARBY = 2  # cells; half the width of the window of the background around a pixel; larger: smoother backgrounds
_GRAIN = 4e-4  # least variance of the square root of light, over its square; larger: fewer pixels are unlike
_SMOOTH = 5e-4  # the same variance below which the background is smooth; larger: more backgrounds
_OUTLIER = 9.0  # squared deviation at which a sample of the background counts by a quarter
_UNLIKE = 9.0  # squared deviation at which a pixel counts by half as unlike the background
_MOST_UNLIKE = 1e3  # largest deviation that is compared with `_UNLIKE`, whose square is finite
_MISSED = 0.08  # share of unlike pixels, above that of the background, from which the map has missed parts
_MANY_MISSED = 0.15  # the same from which near surfaces grow by `_GROWTH_PX`
_LEAST_LIKE = 0.1  # least share of the background that is taken to be like it
_COUNTED = 300.0  # compared pixels of a frame at which the share counts by half; larger: small edges count less
_GROWTH_PX = 22  # px; by which near surfaces grow at most; larger: longer hairs
_GROWTH_OVER_SMOOTH_PX = 10.0  # px; by which they grow over a smooth background
_ON_SURFACE = 0.25  # deviation of the coc of samples, over the difference of both surfaces, up to which they are one
_LEAST_SAMPLES = 0.006  # fraction of the window that samples fill
_FAR_PX = 1e9  # px; a coc that marks pixels without a near surface
_SHARPER = 0.7037  # largest blur of a pixel beyond an edge, over that of the near surface; no simple fraction
_APART_PX = 2.0  # px; subtracted from it; larger: fewer edges
_LARGEST_PX = 1e6  # px; largest valid coc, whose square is exact enough
_BRIGHTEST = 1e15  # largest light that is compared


def _hiding_px(blur_px: Tensor) -> Tensor:
    """Blur from which a near surface is clearly more blurred than, and thus in front of, a pixel with this blur."""
    return (blur_px + _APART_PX) * (1.0 / _SHARPER)


def completed(image: Tensor, coc_px: Tensor, before: Tensor, ops: Ops = EAGER) -> tuple[Tensor, Tensor]:
    """Lets blurred foregrounds grow by what the map misses of them.

    Maps that the repair of edges has left as they are count as exact, and stay.

    1. Rings around a near surface: the pixels of a less blurred one across an edge, by their distance from it.
    2. The background around each pixel: mean and variance of the square root of light in the outer two rings. A second
       pass gives less weight to pixels that are far from the first mean.
    3. A pixel's squared deviation ``z^2`` from that mean, over the variance; it is unlike the background by
       ``z^4 / (z^4 + 81)``.
    4. The mean of this in the second and third ring of the whole frame, less that in the last one: ``(inner - outer) /
       (1 - outer)``. From :data:`_MISSED` on, near surfaces grow, at :data:`_MANY_MISSED` by :data:`_GROWTH_PX`.
       Where the background varies by less than :data:`_SMOOTH`, they grow by :data:`_GROWTH_OVER_SMOOTH_PX` at least.
    5. Rings whose middle is within this growth become the near surface.

    Args:
        image: ``[B, C, H, W]``, linear light; its scale does not matter if it is above 1e-8.
        coc_px: ``[B or 1, 1, H, W]``, signed, with repaired edges. Invalid values stay and affect no other pixel.
        before: The map before the repair, like ``coc_px``.
        ops: Skips frames without such edges.

    Returns:
        The map; gradients flow to unchanged pixels. And how far the map has missed parts, 0 (the share of step 4 is at
        most :data:`_MISSED`) to 1 (:data:`_MANY_MISSED`), ``[B, 1, 1, 1]``: some are still beyond its growth.
    """
    light = image.detach().float()
    repaired, before = (t.detach().float().expand(image.shape[0], -1, -1, -1) for t in (coc_px, before))
    is_inexact = ((repaired - before).abs() > 0).flatten(1).any(1)
    share = light.new_zeros(image.shape[0], 1, 1, 1)
    if not active().missed_parts or (not is_traced() and not is_inexact.any()):
        return coc_px, share
    if is_compiled():
        near_px, share = _operator(light, repaired, is_inexact)
    elif engine_reads(light, repaired):
        near_px, share = by_items(_completed_item, repaired, light, is_inexact)
    else:
        near_px, share = _completed(light, repaired, is_inexact, ops)
    return torch.where(near_px == repaired, coc_px, near_px.to(coc_px.dtype)), share


def _completed_item(light: Tensor, coc_px: Tensor, is_inexact: Tensor) -> tuple[Tensor, float]:
    """The map ``[H, W]`` and the share of one item."""
    return native.missed_parts(light, coc_px) if is_inexact else (coc_px, 0.0)


@torch.no_grad()
def _completed(image: Tensor, coc_px: Tensor, is_inexact: Tensor, ops: Ops) -> tuple[Tensor, Tensor]:
    """:func:`completed` by PyTorch, for float32."""
    is_valid = (coc_px.abs() <= _LARGEST_PX) & is_inexact[:, None, None, None]
    coc, hiding = torch.where(is_valid, coc_px, 0.0), torch.where(is_valid, _hiding_px(coc_px.abs()), _FAR_PX)
    # blur of the near surface, of which each ring takes the largest around it; negative behind the focus
    values = torch.where(is_valid, -coc_px, -_FAR_PX)
    near, ring = torch.full_like(coc, -_FAR_PX), torch.zeros_like(coc)
    for k, (start_px, end_px) in enumerate(itertools.pairwise((0, *_RINGS_PX)), 1):
        around = highest(values, end_px - start_px)
        is_new = (ring == 0) & (around > hiding)
        near, ring = torch.where(is_new, around, near), torch.where(is_new, float(k), ring)
        values = near
    has_edges = ring.any()
    if not is_traced() and not has_edges:
        return coc_px, coc.new_zeros(coc.shape[0], 1, 1, 1)

    light = finite_light(image, _BRIGHTEST).sqrt()
    is_sampled = (torch.arange(coc.shape[-2], device=coc.device) % _SAMPLED == 0)[:, None]
    samples, on_surface = ((ring > _RIM) & is_sampled).to(coc.dtype), torch.where(ring > 0, coc, 0.0)
    deviation = _compared(light, on_surface, samples)[0]
    weight = samples / (1.0 + deviation / _OUTLIER).square()
    deviation, is_smooth, middle, spread, seen = _compared(light, on_surface, weight)
    is_one = spread.sqrt() + (middle - on_surface).abs() < _ON_SURFACE * (on_surface + near)
    known = (ring > 0) & (seen > _LEAST_SAMPLES) & is_one
    odds = (deviation / _UNLIKE).clamp(max=_MOST_UNLIKE).square()
    unlike = odds / (1.0 + odds)
    compared = known & is_sampled
    parts = (compared & (ring > 1) & (ring <= _RIM), compared & (ring == len(_RINGS_PX)))
    sums = [torch.cat([part * unlike, part], 1).sum((2, 3), keepdim=True).split(1, 1) for part in parts]
    (found, count), (usual, of_usual) = sums
    usual = usual / of_usual.clamp_min(1.0)
    excess = (found / count.clamp_min(1.0) - usual) / (1.0 - usual).clamp_min(_LEAST_LIKE) * count / (count + _COUNTED)
    share = ((excess - _MISSED) / (_MANY_MISSED - _MISSED)).clamp(0.0, 1.0)
    growth = _GROWTH_PX * share
    growth = torch.where(is_smooth > 0, growth.clamp_min(_GROWTH_OVER_SMOOTH_PX), growth)
    is_taken = known & (growth > _middles_px(coc.dtype, coc.device)[ring.long()])
    return ops.equal_unless(lambda: has_edges, torch.where(is_taken, -near, coc_px), coc_px), share


@kept
def _middles_px(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Distance from the near surface to the middle of each ring; the first value is for pixels without one."""
    middles = (0.5 * (start_px + end_px) for start_px, end_px in itertools.pairwise((0, *_RINGS_PX)))
    return torch.tensor([0.0, *middles], dtype=dtype, device=device)


def _empty(image: Tensor, coc_px: Tensor, is_inexact: Tensor) -> tuple[Tensor, Tensor]:
    return coc_px.new_empty(coc_px.shape), coc_px.new_empty(coc_px.shape[0], 1, 1, 1)


# Compiled graphs do not support steps that depend on the data.
@one_operator("torchdof::missed_parts", _empty)
def _operator(image: Tensor, coc_px: Tensor, is_inexact: Tensor) -> tuple[Tensor, Tensor]:
    near_px, share = _completed(image, coc_px, is_inexact, EAGER)
    return near_px.clone(memory_format=torch.contiguous_format), share


def _compared(light: Tensor, coc: Tensor, weight: Tensor) -> tuple[Tensor, ...]:
    """Compares pixels with weighted samples around them.

    Returns:
        The squared deviation of each pixel; whether the samples are smooth, 0 or 1; mean and variance of their coc; and
        their weight.
    """
    colours, square = light.shape[1], light.square().mean(1, keepdim=True)
    sums = _around(weight * torch.cat([torch.ones_like(coc), light, square, coc, coc * coc], 1), _NEARBY)
    seen, means = sums.split([1, colours + 3], 1)
    mean, square, middle, of_coc = (means / seen.clamp_min(1e-9)).split([colours, 1, 1, 1], 1)
    bright = mean.square().mean(1, keepdim=True)
    variance = (square - bright).clamp_min(0.0) + _GRAIN * bright + 1e-12
    is_smooth = (variance < _SMOOTH * bright).to(coc.dtype)
    maps = torch.cat([mean, variance, is_smooth, middle, (of_coc - middle.square()).clamp_min(0.0), seen], 1)
    mean, variance, *others = _of_cells(maps, light).split([colours, 1, 1, 1, 1, 1], 1)
    return (light - mean).square().mean(1, keepdim=True) / variance, *others


def _around(values: Tensor, reach: int) -> Tensor:
    """Means over windows of ``2 reach + 1`` cells, of which those beyond the frame are 0: ``[B, C, h, w]``."""
    height, width = values.shape[-2:]
    ends = (0, (width + _CELL - 1) // _CELL * _CELL - width, 0, (height + _CELL - 1) // _CELL * _CELL - height)
    cells, side = functional.avg_pool2d(functional.pad(values, ends), _CELL), 2 * reach + 1
    rows = functional.avg_pool2d(cells, (1, side), stride=1, padding=(0, reach))
    return functional.avg_pool2d(rows, (side, 1), stride=1, padding=(reach, 0))


def _of_cells(cells: Tensor, like: Tensor) -> Tensor:
    """The value of each pixel's cell."""
    pixels = functional.interpolate(cells, scale_factor=float(_CELL), mode="nearest")
    return pixels[..., : like.shape[-2], : like.shape[-1]]
