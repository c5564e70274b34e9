"""Highlights: light far brighter than its surroundings, splatted ray by ray as the crisp discs that a lens draws.

Layers know which fraction of the lens a blurred foreground covers, but not which part of it. For ordinary light the
fraction is enough. In the disc of a highlight the part is visible: a post in front of a lamp draws a crisp line through
the disc. So each ray is tested. With lens coordinates ``u``, a ray from a pixel at ``p`` with coc ``c`` lands at
``p + c u``. It crosses a nearer surface with coc ``c'`` at the point that the sharp image shows at ``p + (c - c') u``,
and is blocked if that pixel has coc ``c'``.

Highlights are few: the light above a local threshold is removed from the layers and splatted as rays. Without occlusion
all rays pass. There rays serve highlights whose layers would be too coarse, and their light is divided by the same sum
of weights as that of the layers. Everything fades in without a jump: the excess over the threshold, the blur, the
occluders and the number of highlights.
"""

import functools
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import pixels
from ..optics.blur_table import BlurTable
from ..optics.kernel_bank import bank_of
from ..optics.placed_kernels import FieldMask, placed_between, ray_masks
from ..tensors import is_empty, is_traced, recomputed
from .engines import on_gpu
from .engines.ops import EAGER, Ops
from .layers.layer_cocs import mean_change
from .layers.plan import KERNELS_PER_PX, kernels_for
from .rules import active
from .surfaces.frame import HIDDEN_WEIGHT, Highlights, Surface, continuation_weight

FACTOR = 8.0
"""A highlight is brighter than its surroundings by more than this factor."""

COARSE_CELL = 8
"""Side in pixels of the cells in which occluders are counted."""

NEARER_PX = 1.0
"""Smallest difference in coc, in pixels, at which a surface blocks a ray; it blocks fully at 1 px more."""

_STEP = 3  # the threshold samples every third pixel; odd, as _CELL, so that a mirrored image has mirrored samples
_CELL = 11  # samples along a side of a cell; larger: a smoother threshold
_BRIGHT_PART = 5  # the usual light of a cell is that which 1 / _BRIGHT_PART of its samples exceed
_LEAST_PX = 1.0  # smallest blur of a highlight, in pixels
_WHOLE = 4.0  # a highlight counts with min(1, _WHOLE * share splatted) of its rays against the budget
_TAPS_PER_PIXEL = 16  # budget of rays per pixel of the frame; the layers keep the light beyond it
_FREE_CHANGE_PX = 0.4  # mean change of coc between neighbours, in pixels, above which the budget shrinks
# Whole light of a highlight behind a nearer surface; larger starts: in more cases, steeper slopes: more abruptly
_DARK = 2.0  # limits of a highlight: the nearer surface is dark by 2 - its light
_BETWEEN_START, _BETWEEN_SLOPE = 3.5, 8.0  # a coc lies between two by 3.5 - 8 times its distance from their middle
_STEP_START, _STEP_SLOPE = 1.5, 10.0  # the edge is a step by 1.5 - 10 times the share of pixels that lie between
_TAPS = 2**21  # rays that are splatted at once; larger, as in the next two: faster, with more memory
_PAIRS = 2**22  # pairs of a highlight and a bin of occluders that are tested at once
_PAIR_TAPS = 2**19  # rays of these pairs that are tested at once
_PAIR_TAPS_GPU = 2**22  # the same on a GPU, which is slow at many small operations


def threshold(light: Tensor, valid: Tensor | None = None) -> Tensor:
    """Light ``[B, 1, H, W]`` above which a pixel of ``light`` ``[B, C, H, W]`` is a highlight.

    It is :data:`FACTOR` times the 80th percentile of the brightest channel in a cell, interpolated between cells.
    Pixels where ``valid`` is 0 count as infinitely bright.
    """
    height, width = light.shape[-2:]
    brightest = light.detach().amax(1, keepdim=True)
    if valid is not None:
        brightest = torch.where(valid > 0, brightest, torch.inf)
    side = _STEP * _CELL
    (top, rows), (left, columns) = (_cells(n, side, light.device) for n in (height, width))
    cells = functional.pixel_unshuffle(brightest.index_select(-2, rows).index_select(-1, columns), _CELL)
    level = torch.topk(cells, cells.shape[1] // _BRIGHT_PART, dim=1)[0][:, -1:]
    level = FACTOR * level.clamp(0.0, torch.finfo(light.dtype).max / FACTOR)
    level = functional.interpolate(level, scale_factor=float(side), mode="bilinear", align_corners=False)
    return level.narrow(-2, top, height).narrow(-1, left, width)


def _cells(size: int, side: int, device: torch.device) -> tuple[int, Tensor]:
    """Pixels by which the first cell begins before an axis of ``size`` pixels, and the indices of all samples.

    The cells, at least two, are centred on the axis, which is mirrored beyond its ends.
    """
    count = (size + 2 * side - 1) // side
    count = count + (count + size) % 2
    before = (count * side - size) // 2
    place = (torch.arange(count * _CELL, device=device) * _STEP + (_STEP // 2 - before)) % (2 * size)
    return before, torch.minimum(place, 2 * size - 1 - place)


def extract(
    surface: Surface,
    limit: Tensor,
    from_px: float | Tensor = _LEAST_PX,
    beside: tuple[Surface, Tensor] | None = None,
    most_taps: Tensor | None = None,
    ops: Ops = EAGER,
) -> tuple[Surface, Highlights | None]:
    """Removes the light above a limit from a surface of an image, to be splatted ray by ray.

    1. Select visible pixels brighter than ``limit`` and blurred by more than ``from_px``.
    2. If the rays of an item exceed ``most_taps``, raise its limit: the brightest stay, with their light above it.
    3. Split the light of each: ``excess = light (1 - limit / peak) fade``; the surface keeps the rest.
    4. Multiply the excess by the cover of the surface in its pixel.

    A highlight on the farther surface of a mixed pixel sends the light of the whole pixel (cover 1): the nearer surface
    blocks its rays, and its cover would be subtracted twice. Two cases keep the smaller cover. If the nearer surface is
    bright too, the light behind it is only the part of the pixel that two mean colours do not explain. If the depth
    around has values between the two surfaces, it is inexact, and the farther one may be nearer than the lamp.

    Args:
        surface: A surface of an image.
        limit: Threshold as from :func:`threshold`, ``[B, 1, H, W]``.
        from_px: Smallest blur of a highlight in pixels, of all items or ``[B, 1, 1, 1]``; its excess is splatted in
            full at 1 px more.
        beside: The other surface of each pixel, and coc of the image, ``[B, 1, H, W]``; None keeps the cover.
        most_taps: Largest number of rays of each item ``[B]``, as from :func:`affordable_taps`; None: 16 per pixel.
        ops: Keeps a frame without highlights as it is.

    Returns:
        The surface with its remaining light, and the highlights, or None without any.
    """
    light, coc_px, weight = surface
    area = math.prod(coc_px.shape[1:])
    from_px = from_px.clamp_min(_LEAST_PX) if isinstance(from_px, Tensor) else max(from_px, _LEAST_PX)
    brightest = light.amax(1, keepdim=True)
    is_bright = (brightest > limit) & (coc_px.detach().abs() > from_px)
    bright = pixels.indices(is_bright if weight is None else is_bright & (weight > HIDDEN_WEIGHT))
    if is_empty(bright):
        return surface, None
    peak, coc, most = (pixels.pick(t, bright)[0] for t in (brightest, coc_px, limit))
    start = pixels.pick(from_px.expand_as(coc_px), bright)[0] if isinstance(from_px, Tensor) else from_px
    fades = (coc.abs() - start).clamp(max=1.0)
    # the limit at which the rays of each item fit into its budget
    share, item = (1.0 - most / peak) * fades, bright // area
    own = item == torch.arange(coc_px.shape[0], device=item.device)[:, None]  # len() would fix a graph to one size
    peaks, cocs, shares = (torch.where(own, t.detach(), 0.0) for t in (peak, coc, share))  # 0: of other items
    if most_taps is None:  # not as_tensor(), which would fix a graph to the size of its example
        most_taps = torch.scalar_tensor(_TAPS_PER_PIXEL * area, dtype=torch.float64, device=item.device).reshape(1)
    least = _least_peak(peaks, cocs, shares, most_taps[:, None])[:, 0].index_select(0, item)
    kept = (peak.detach() > least).nonzero()[:, 0]
    if is_empty(kept):
        return surface, None
    bright, peak, fades, coc, most = (t.index_select(0, kept) for t in (bright, peak, fades, coc, most))
    taken_from, ordinary = pixels.pick(light, bright), torch.maximum(most, least.index_select(0, kept)) / peak
    excess = taken_from * ((1.0 - ordinary) * fades)
    # not light - excess, whose rounding error is brighter than a dark scene
    left = pixels.put(light, bright, taken_from * ((1.0 - fades) + fades * ordinary))
    left = ops.equal_unless(lambda: is_bright.any(), left, light)
    if weight is not None:
        cover = pixels.pick(weight, bright)
        if beside is not None and active().whole_highlights:
            other, image_coc_px = beside
            gap = coc - pixels.pick(other.coc_px, bright)[0]
            stopped = (gap - NEARER_PX).clamp(0.0, 1.0)
            beside_peak = pixels.pick(other.light, bright).amax(0)
            is_dark = (_DARK - beside_peak / most.clamp_min(torch.finfo(most.dtype).tiny)).clamp(0.0, 1.0)
            around = pixels.pick(image_coc_px, pixels.around(bright, image_coc_px, 2))[0]
            off_middle = (around - (coc - 0.5 * gap)).abs() / gap.clamp_min(NEARER_PX)  # 1/2 at the coc of a surface
            between = (_BETWEEN_START - _BETWEEN_SLOPE * off_middle).clamp(0.0, 1.0)
            is_step = (_STEP_START - _STEP_SLOPE * between.mean(0)).clamp(0.0, 1.0)
            cover = cover + continuation_weight(cover) * (stopped * is_dark * is_step)
        excess = excess * cover
    return surface._replace(light=left), Highlights(bright, excess, coc)


def affordable_taps(coc_px: Tensor, reach: Sequence[float]) -> Tensor:
    """Largest number of rays ``[B]`` of each frame with occlusion and coc ``[B, 1, H, W]``: 16 per pixel or fewer.

    Each ray is tested against each possible occluder, and a noisy depth map has many. So the number is inversely
    proportional to the mean change of the coc between neighbours, above :data:`_FREE_CHANGE_PX`. Kernels reach
    ``reach`` times as far as discs (:meth:`torchdof.render.layers.plan.Plan.reach`), one number for all frames or for
    each.
    """
    crowd = (mean_change(coc_px.detach()) / _FREE_CHANGE_PX).clamp_min(1.0)
    if not active().fewer_rays:
        crowd = torch.ones_like(crowd)
    area = reach[0] ** 2 if len(reach) == 1 else coc_px.new_tensor(reach) ** 2
    return _TAPS_PER_PIXEL * math.prod(coc_px.shape[1:]) / (crowd * area)


def _least_peak(peak: Tensor, coc: Tensor, share: Tensor, most_taps: Tensor) -> Tensor:
    """Raised limit ``[B, 1]`` for the light of highlights ``[B, n]``, at which the number of rays fits the budget.

    It is the L that solves ``sum over peaks p > L of taps (1 - L / (2 p)) = most_taps``, or 0 if all rays fit. The
    weights make L grow smoothly with the number of highlights, even equal ones; at most twice ``most_taps`` rays are
    splatted. Highlights with a peak of 0 count as none.
    """
    taps = (2.0 * coc.abs() + 1.0) ** 2 * (_WHOLE * share).clamp(max=1.0)
    values, order = functional.pad(peak.double(), (0, 1)).sort(-1, descending=True)  # with a last peak of 0
    count = functional.pad(taps.double(), (0, 1)).gather(-1, order)
    slope = torch.where(values > 0, 0.5 * count / values, 0.0).cumsum(-1)
    count = count.cumsum(-1) - most_taps.double()  # rays beyond the budget at L = 0
    at_next = count - functional.pad(values[..., 1:], (0, 1)) * slope  # rays beyond the budget at L = the next peak
    last = ((at_next < 0) & (values > 0)).sum(-1, keepdim=True)
    count, slope, value = (t.gather(-1, last) for t in (count, slope, values))
    level = count / torch.where(slope > 0, slope, 1.0)
    return torch.minimum(level.clamp_min(0.0), value).to(peak.dtype)


def splat(
    rays: Sequence[Highlights],
    shown: Sequence[Surface],
    table: BlurTable,
    occlusion: bool = True,
    kernels_per_px: int = KERNELS_PER_PX,
    ops: Ops = EAGER,
) -> Tensor:
    """Splats highlights to ``[B, C, H, W]``: each ray adds its light where it lands, times its transmittance.

    ``shown`` are the occluders, each pixel's own surface first; without ``occlusion`` all rays pass. Differentiable in
    the light and coc of ``rays`` and in the coc and cover of ``shown``.
    """
    together = Highlights(*(torch.cat(parts, -1) for parts in zip(*rays, strict=True)))
    coc_px, in_the_way = shown[0].coc_px, _obstacles(shown) if occlusion else []
    eager = functools.partial(_splatted, together, coc_px, in_the_way, table, kernels_per_px, ops.lens_width)
    return ops.splat(eager, together, coc_px, in_the_way)


def _splatted(
    rays: Highlights,
    coc_px: Tensor,
    obstacles: Sequence[tuple[Tensor, Tensor]],
    table: BlurTable,
    kernels_per_px: int,
    lens_width: int | None,
) -> Tensor:
    """Splats highlights to ``[B, C, H, W]`` in chunks of bounded memory.

    1. Sort the highlights by blur, and pad the frame by the radius of the widest kernel.
    2. Take the next chunk: at most :data:`_TAPS` rays and :data:`_PAIRS` pairs with bins of occluders.
    3. Make its kernels, for their place in the frame if the table depends on it.
    4. Multiply kernel, light and transmittance, and add the products where the rays land.
    """
    batch, _, height, width = coc_px.shape
    longest, lens_width = max(height, width), lens_width or int(width)
    source, light, coc = rays
    order = torch.argsort(coc.detach().abs())
    item, row, column = pixels.places(source[order], height, width)
    light, coc = light.index_select(1, order), coc.index_select(0, order)
    radii = coc.detach().tolist()
    masks: list[FieldMask] = []
    if table.depends_on_place:
        masks = [mask.to(light) for mask in ray_masks(table, radii, (height, width))]

    def half_of(radius: float) -> int:
        reach = max(bank_of(table).reach_px(coc_px, lens_width) for coc_px in (-radius, radius))
        return min(math.ceil(reach + 0.5), longest - 1)

    margin = max([half_of(radii[-1]), *(half_of(each.coc_px) for each in masks)])  # one of them may be the widest
    across = width + 2 * margin
    area = (height + 2 * margin) * across
    splats = light.new_zeros(len(light), batch * area)
    hiding = Occluders(obstacles) if obstacles else None
    most = len(radii) if hiding is None else max(1, _PAIRS // hiding.bins)
    start = 0
    while start < len(radii):  # bounded by the first radius of the chunk, then by its last
        stop = min(len(radii), start + most, start + max(1, _TAPS // (2 * half_of(radii[start]) + 1) ** 2))
        stop = min(stop, start + max(1, _TAPS // (2 * half_of(radii[stop - 1]) + 1) ** 2))
        part = slice(start, stop)
        kernels = kernels_for(table, coc[part], lens_width, longest, kernels_per_px)  # [n, 1 or C, k, k]
        if masks:
            half_diagonal = 0.5 * math.hypot(height, width)
            y, x = ((row[part] + 0.5 - height / 2) / half_diagonal, (column[part] + 0.5 - width / 2) / half_diagonal)
            kernels = placed_between(kernels, masks, coc[part], y, x)
        half = kernels.shape[-1] // 2
        step = torch.arange(-half, half + 1, device=light.device)
        landing = kernels * light[:, part].t()[:, :, None, None]
        if hiding is not None:
            hidden = hiding.hidden(item[part], row[part], column[part], coc[part], step)
            landing = landing * (1.0 - hidden).unsqueeze(1)
        lines = item[part, None] * area + (row[part, None] + margin + step) * across
        lands = lines[:, :, None] + (column[part, None] + margin + step)[:, None, :]  # [n, k, k]
        splats.index_add_(1, lands.flatten(), landing.transpose(0, 1).flatten(1))
        start = stop
    frame = splats.unflatten(1, (batch, height + 2 * margin, across)).transpose(0, 1)
    return frame[..., margin : margin + height, margin : margin + width]


def _obstacles(surfaces: Sequence[Surface]) -> list[tuple[Tensor, Tensor]]:
    """Coc and cover of the occluders, ``[B, 1, H, W]`` each; the cover is 0 where a surface is hidden."""
    covers = [torch.ones_like(s.coc_px) if s.weight is None else s.weight for s in surfaces]
    covers = [covers[0], *((c - HIDDEN_WEIGHT).clamp_min(0.0) for c in covers[1:])]
    return [(s.coc_px, cover) for s, cover in zip(surfaces, covers, strict=True)]


class Occluders:
    """Occluders: coc and cover of the surfaces of an image, in bins of 1 px of coc."""

    def __init__(self, obstacles: Sequence[tuple[Tensor, Tensor]], bins: int | None = None) -> None:
        coc_px = obstacles[0][0].detach()
        self.height, self.width = coc_px.shape[-2:]
        self.low = coc_px.amin((1, 2, 3))
        shown = [(coc - self.low[:, None, None, None], cover) for coc, cover in obstacles]  # coc in bins
        if bins is None:
            bins = int(torch.stack([place.detach().amax() for place, _ in shown]).amax()) + 2
        self.bins = bins
        self.counts = covered_cells([(place.detach(), cover.detach()) for place, cover in shown], self.bins)
        self.shown = [torch.stack([t[:, 0] for t in maps]) for maps in zip(*shown, strict=True)]  # [surfaces, B, H, W]

    def hidden(self, item: Tensor, row: Tensor, column: Tensor, coc: Tensor, step: Tensor) -> Tensor:
        """Fraction of each ray that is blocked, ``[n, k, k]``, of highlights ``[n]`` with their place and signed coc.

        A ray that lands ``step``, ``[k]`` pixels along each axis, from its pixel crosses a bin of coc ``c'`` at
        ``(1 - c' / coc) step``. The cover there is interpolated between four pixels.
        """
        bins = torch.arange(self.bins, device=coc.device)
        nearer = self.low.index_select(0, item)[:, None] + bins
        scale = 1.0 - nearer / coc[:, None]  # [n, bins]
        fades = (coc[:, None] - NEARER_PX - nearer).clamp(0.0, 1.0)
        # pairs of a highlight and a bin with a non-empty cell within reach
        reach = scale.detach().abs() * step[-1]
        ends = (-reach, reach + 1.0)
        (top, bottom), (left, right) = (
            [(place[:, None] + end).clamp_min(0).long().clamp(max=size - 1) // COARSE_CELL for end in ends]
            for place, size in ((row, self.height), (column, self.width))
        )
        bottom, right = bottom + 1, right + 1
        _, items, rows, columns = self.counts.shape
        line = (bins * items + item[:, None]) * rows

        def count_at(y: Tensor, x: Tensor) -> Tensor:
            return self.counts.flatten().index_select(0, ((line + y) * columns + x).flatten())

        count = count_at(bottom, right) - count_at(top, right) - count_at(bottom, left) + count_at(top, left)
        wanted = ((count > 0) & (fades.detach().flatten() > 0)).view_as(fades)
        return on_gpu.blocked(_blocked, scale, fades, wanted, (item, row, column), step, self.shown)


def _blocked(
    scale: Tensor, fades: Tensor, wanted: Tensor, at: Sequence[Tensor], step: Tensor, shown: Sequence[Tensor]
) -> Tensor:
    """Fraction of each ray that is blocked, ``[n, k, k]``.

    Args:
        scale: Way of a ray in a bin, over that on the picture, ``[n, bins]``.
        fades: How far a surface in a bin blocks a ray, like ``scale``, 0 to 1.
        wanted: Whether a bin has surfaces within reach, like ``scale``.
        at: Item, row and column of the highlights, ``[n]`` each.
        step: Pixels along each axis to where a ray lands, ``[k]``, whole numbers from -(k - 1) / 2 to (k - 1) / 2.
        shown: Coc in bins and cover of the occluders, ``[surfaces, B, H, W]`` each.
    """
    bins, maps, (height, width) = scale.shape[1], [t.flatten(1) for t in shown], shown[0].shape[-2:]
    pairs = wanted.flatten().nonzero()[:, 0]  # of a highlight and a bin
    hidden = scale.new_zeros(scale.shape[0], step.shape[0], step.shape[0])

    def of_pairs(pair: Tensor) -> Tensor:
        """Fraction of the rays of pairs ``[P]`` that is blocked, ``[P, k, k]``."""
        source, bin_of = pair // bins, pair % bins
        way = scale.flatten().index_select(0, pair)[:, None] * step
        items, rows, columns = (t.index_select(0, source)[:, None] for t in at)
        rows, columns = (rows + way)[:, :, None], (columns + way)[:, None, :]
        around, down, aside = pixels.corners(items[:, :, None], rows, columns, height, width)
        pixel = torch.stack(around)  # [4, P, k, k]
        place, cover = (t.index_select(1, pixel.flatten()).unflatten(1, pixel.shape) for t in maps)
        covered = (cover * (1.0 - (place - bin_of[:, None, None]).abs()).clamp_min(0.0)).sum(0)
        above, below = torch.lerp(covered[0::2], covered[1::2], aside)
        return torch.lerp(above, below, down) * fades.flatten().index_select(0, pair)[:, None, None]

    most = _PAIR_TAPS if scale.device.type == "cpu" else _PAIR_TAPS_GPU
    for part in [pairs] if is_traced() else pairs.split(max(1, most // len(step) ** 2)):
        hidden = hidden.index_add(0, part // bins, recomputed(functools.partial(of_pairs, part)))
    return hidden.clamp(max=1.0)


def covered_cells(places: Sequence[tuple[Tensor, Tensor]], bins: int) -> Tensor:
    """Summed-area table of the non-empty cells of each bin: ``[bins, B, rows + 1, columns + 1]``.

    ``places`` are coc in bins and cover of each surface, ``[B, 1, H, W]``. A pixel belongs to the two bins that its coc
    lies between.
    """
    batch, _, height, width = places[0][0].shape
    rows, columns = ((n + COARSE_CELL - 1) // COARSE_CELL for n in (height, width))
    item, row, column = (torch.arange(n, device=places[0][0].device) for n in (batch, height, width))
    cell = (item[:, None, None] * rows + row[:, None] // COARSE_CELL) * columns + column // COARSE_CELL
    shown = places[0][0].new_zeros((bins + 2) * batch * rows * columns)
    for place, cover in places:  # a pixel without cover goes to an extra bin
        before = torch.where(cover > 0, place, float(bins)).long()[:, 0]
        for bin_of in (before, before + 1):
            index = (bin_of * (batch * rows * columns) + cell).flatten()
            shown = shown.scatter(0, index, torch.ones_like(place).flatten())
    shown = shown.unflatten(0, (bins + 2, batch, rows, columns))[:bins]
    return functional.pad(shown.cumsum(-1).cumsum(-2), (1, 0, 1, 0))
