"""Highlights: light far brighter than what is around it, traced ray by ray to the crisp discs that a lens makes of it.

Layers know how much of the lens a blurred foreground covers, not which part. For ordinary light that is enough; in the
disc of a highlight everybody sees it, for a post in front of a lamp draws a crisp line through its disc. A ray from a
pixel at ``p`` with coc ``c`` through the point ``u`` of the lens lands at ``p + c u``, and it passes a nearer surface
with coc ``c'`` where the image shows the position ``p + (c - c') u``. So the sharp image itself tells which rays pass.

Highlights are few. What exceeds the ordinary light around it is taken out of the layers, and added again as rays:
where something nearer could stand in the way, where its layer is too coarse for a crisp edge, and at the frame's
border, where layers make up for the light that is not seen with the light that is. Without occlusion nothing stands in
the way, and the rays' light is divided by the same sum of weights as the layers'.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .optics.blur_table import BlurTable
from .pool import any_around, any_of_blocks, bands, between, max_around, max_of_blocks, places

__all__ = ["FACTOR", "Rays", "ordinary", "take", "trace"]

FACTOR = 8.0
"""Light above so many times the ordinary light around it is a highlight's."""

_CELL = 32  # pixels over which light is averaged to tell what is ordinary
_COARSE_CELL = 8  # pixels in which the nearest surface is looked for
_NEARER_PX = 1.5  # difference in coc from which on a surface is another one, in front
_TAPS_PER_PIXEL = 16  # of the frame: rays beyond this number are left to the layers
_TAPS = 2**21  # rays traced together
_BLOCKS = {1: 0.0, 2: 1.0, 4: 4.0}  # pixels a side whose rays look together, by blur in units of where sharing begins
_KERNELS_PER_PX = 32  # of radius
_PATCH = 16  # rays a side that are looked at together
_CLASSES = 62  # of coc, a bit each


@dataclasses.dataclass(frozen=True)
class Rays:
    """Light taken out of one surface of an image.

    Args:
        at: Flat indices of its pixels in ``[B, 1, H, W]``, ``[n]``.
        light: ``[C, n]``.
        coc_px: ``[n]``.
    """

    at: Tensor
    light: Tensor
    coc_px: Tensor


def ordinary(light: Tensor, valid: Tensor | None = None) -> Tensor:
    """Largest light that still is ordinary beside what is around it.

    It is :data:`FACTOR` times what four fifths of the pixels of a cell stay below, interpolated between cells.

    Args:
        light: ``[B, C, H, W]``.
        valid: ``[B, 1, H, W]``, 0 where the light is not known; None counts all.

    Returns:
        ``[B, 1, H, W]``.
    """
    height, width = light.shape[-2:]
    brightest = light.detach()[..., ::2, ::2].amax(1, keepdim=True)
    if valid is not None:
        brightest = torch.where(valid[..., ::2, ::2] > 0, brightest, torch.inf)
    # as in `background`: in this form exported code knows that the sizes are multiples
    cell, (rows, columns) = _CELL // 2, brightest.shape[-2:]
    more = 2 * cell - 1
    extra = (0, (columns + more) // cell * cell - columns, 0, (rows + more) // cell * cell - rows)
    cells = functional.pixel_unshuffle(functional.pad(brightest, extra, mode="replicate"), cell)
    level = torch.topk(cells, cells.shape[1] // 5, dim=1)[0][:, -1:]
    level = FACTOR * level.clamp(0.0, torch.finfo(light.dtype).max / FACTOR)
    level = functional.interpolate(level, scale_factor=float(_CELL), mode="bilinear", align_corners=False)
    return level[..., :height, :width]


def take(
    light: Tensor, coc_px: Tensor, weight: Tensor | None, limit: Tensor, nearest_px: Tensor | None, crisp_px: float
) -> tuple[Tensor, Rays | None]:
    """Take out of a surface the light above a limit that needs to be traced.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``.
        weight: Share of each pixel that the surface covers ``[B, 1, H, W]``; None is 1.
        limit: Largest ordinary light, ``[B, 1, H, W]``.
        nearest_px: Coc of what each pixel shows, ``[B, 1, H, W]``; None if nothing hides anything.
        crisp_px: Blurs from this radius on lose their edge in coarse layers, so they are traced in any case.

    Returns:
        The light that is left, and the rays; None where there are none.
    """
    brightest = light.amax(1, keepdim=True)
    bright = (brightest > limit).flatten()
    at = bright.nonzero()[:, 0] if bool(bright.any()) else bright.new_empty(0, dtype=torch.int64)
    if weight is not None:
        at = at[weight.flatten()[at] > 0]
    if len(at) == 0:
        return light, None
    place = coc_px.detach().flatten()[at]
    blur = place.abs()
    traced = blur >= crisp_px
    if nearest_px is not None:
        traced |= (2.0 * blur > _to_border(at, coc_px)) | _something_nearer(at, place, nearest_px)
    at = at[traced & (blur > 1.0)]
    if len(at) == 0:
        return light, None
    peak, coc, most = brightest.flatten()[at], coc_px.flatten()[at], limit.flatten()[at]
    order = torch.argsort(peak.detach(), descending=True)
    taps = ((2.0 * coc.detach().abs() + 1.0) ** 2)[order].cumsum(0)
    few = int((taps <= _TAPS_PER_PIXEL * coc_px.numel()).sum())
    if few < len(at):  # not few, then: the brightest of them, and only what they are brighter by
        most = torch.maximum(most, peak[order[few]].detach())
        order = order[:few]
        at, peak, coc, most = (t[order] for t in (at, peak, coc, most))
        if len(at) == 0:
            return light, None
    # from nothing at a radius of 1 px to all of it at 2
    share = (1.0 - most / peak) * (coc.abs() - 1.0).clamp(max=1.0)
    excess = light.transpose(0, 1).flatten(1)[:, at] * share
    left = light.transpose(0, 1).flatten(1).index_add(1, at, -excess)
    left = left.unflatten(1, (light.shape[0], *light.shape[-2:])).transpose(0, 1)
    return left, Rays(at, excess if weight is None else excess * weight.flatten()[at], coc)


def trace(
    rays: Sequence[Rays], coc_px: Tensor, table: BlurTable, channels: int, shared_px: float, occlusion: bool = True
) -> Tensor:
    """Scatter highlights, each ray to where it lands unless a nearer surface is in its way.

    Neighbouring pixels of one large blur share a look for what is in the way of those of their rays that land in the
    same place, as if these came from the middle of their light. Where gradients of the coc are recorded, none do.

    Args:
        rays: From :func:`take`.
        coc_px: What each pixel shows, ``[B, 1, H, W]``.
        table: Blur of the lens.
        channels: C.
        shared_px: Blur from which on neighbours share looks.
        occlusion: False lets all rays pass.

    Returns:
        ``[B, C, H, W]``. Differentiable in the light and coc of the rays.
    """
    batch, _, height, width = coc_px.shape
    every = Rays(*(torch.cat(parts, -1) for parts in zip(*((r.at, r.light, r.coc_px) for r in rays), strict=True)))
    margin = _half(table, float(every.coc_px.detach().abs().max()), height, width) + max(_BLOCKS) - 1
    across = width + 2 * margin
    area = (height + 2 * margin) * across
    out = every.light.new_zeros(channels, batch * area)
    surfaces = _Surfaces(coc_px) if occlusion else None
    for sources in _by_block(every, shared_px, height, width):
        for chunk in _chunks(sources.coc_px.detach(), sources.side, table, height, width):
            some = sources.part(chunk)
            kernels = _kernels(table, some.coc_px, width, max(height, width)).to(out.dtype)  # [n, 1 or C, k, k]
            half = kernels.shape[-1] // 2
            step = torch.arange(-half, half + sources.side, device=out.device)
            spread = some.spread(kernels)
            if surfaces is not None:
                spread = spread * (1.0 - surfaces.blocked(some, step)).unsqueeze(1)
            lands = (some.row[:, None, None] + margin + step[:, None]) * across
            lands = (some.item * area)[:, None, None] + lands + some.column[:, None, None] + margin + step
            for channel in range(channels):
                out[channel].index_add_(0, lands.flatten(), spread[:, channel].flatten())
    frame = out.unflatten(1, (batch, height + 2 * margin, across)).transpose(0, 1)
    return frame[..., margin : margin + height, margin : margin + width]


@dataclasses.dataclass(frozen=True)
class _Sources:
    """Blocks of pixels, each with light of one blur in it.

    Args:
        item: ``[n]``.
        row: Of a block's first pixel, ``[n]``.
        column: Of a block's first pixel, ``[n]``.
        coc_px: ``[n]``.
        light: Of its pixels, ``[n, C, side, side]``.
    """

    item: Tensor
    row: Tensor
    column: Tensor
    coc_px: Tensor
    light: Tensor

    @classmethod
    def of_rays(cls, rays: Rays, side: int, height: int, width: int) -> "_Sources":
        """All of some rays, by increasing blur."""
        item, row, column = places(rays.at, height, width)
        down, right = row % side, column % side
        row, column = row - down, column - right
        which = torch.arange(len(rays.at), device=rays.at.device)
        if side > 1:
            blur = (rays.coc_px.detach().double() * _KERNELS_PER_PX).round().long()
            least, most = int(blur.min()), int(blur.max())
            block = (item * height + row) * width + column
            which = torch.unique(block * (most - least + 1) + blur - least, return_inverse=True)[1]
        count = int(which.max()) + 1
        light = rays.light.new_zeros(len(rays.light), count * side**2)
        light = light.index_add(1, (which * side + down) * side + right, rays.light)
        light = light.unflatten(1, (count, side, side)).transpose(0, 1)
        every = torch.arange(len(which), device=which.device)
        first = every.new_full((count,), len(which)).scatter_reduce(0, which, every, "amin")
        sources = cls(item[first], row[first], column[first], rays.coc_px[first], light)
        return sources.part(torch.argsort(sources.coc_px.detach().abs()))

    @property
    def side(self) -> int:
        """Pixels of a block along each axis."""
        return int(self.light.shape[-1])

    def part(self, some: Tensor | slice) -> "_Sources":
        """Some of them."""
        return _Sources(self.item[some], self.row[some], self.column[some], self.coc_px[some], self.light[some])

    def middle(self) -> tuple[Tensor, Tensor]:
        """Rows and columns from a block's first pixel to the middle of its light, ``[n]`` each."""
        light = self.light.detach().amax(1).clamp_min(0.0)
        light = light / light.amax((1, 2), keepdim=True).clamp_min(torch.finfo(light.dtype).tiny)
        step, whole = torch.arange(self.side, device=light.device), light.sum((1, 2)).clamp_min(1.0)
        return (light.sum(2) * step).sum(1) / whole, (light.sum(1) * step).sum(1) / whole

    def spread(self, kernels: Tensor) -> Tensor:
        """Their light where it lands, for kernels ``[n, 1 or C, k, k]``: ``[n, C, k + side - 1, k + side - 1]``."""
        if self.side == 1:
            return kernels * self.light
        count, channels, side, _ = self.light.shape
        length = kernels.shape[-1]
        out = self.light.new_zeros(count, channels, length + side - 1, length + side - 1)
        for y, x in itertools.product(range(side), repeat=2):
            out[..., y : y + length, x : x + length].addcmul_(kernels, self.light[..., y : y + 1, x : x + 1])
        return out


def _by_block(rays: Rays, shared_px: float, height: int, width: int) -> Iterator[_Sources]:
    """Rays by the size of the blocks that their blur allows for."""
    if torch.is_grad_enabled() and rays.coc_px.requires_grad:
        yield _Sources.of_rays(rays, 1, height, width)
        return
    blur, ends = rays.coc_px.detach().abs() / shared_px, [*_BLOCKS.values(), math.inf]
    for side, (least, end) in zip(_BLOCKS, itertools.pairwise(ends), strict=True):
        some = ((blur >= least) & (blur < end)).nonzero()[:, 0]
        if len(some):
            yield _Sources.of_rays(Rays(rays.at[some], rays.light[:, some], rays.coc_px[some]), side, height, width)


def _half(table: BlurTable, coc_px: float, height: int, width: int) -> int:
    return min(math.ceil(table.reach_px(coc_px, width) + 0.5), max(height, width) - 1)


def _chunks(sorted_coc: Tensor, side: int, table: BlurTable, height: int, width: int) -> list[slice]:
    """Blocks of increasing blur in parts of a bounded number of taps."""

    def most(which: int) -> int:
        """Blocks of such a blur."""
        half = _half(table, float(sorted_coc[which].abs()), height, width)
        return max(1, _TAPS // (2 * half + side) ** 2)

    chunks, start = [], 0
    while start < len(sorted_coc):
        # the first guess is for the first block; the last one of the part needs the widest kernel
        stop = min(len(sorted_coc), start + most(start))
        stop = min(stop, start + most(stop - 1))
        chunks.append(slice(start, stop))
        start = stop
    return chunks


def _kernels(table: BlurTable, coc: Tensor, width: int, largest: int) -> Tensor:
    """Kernels ``[n, 1 or C, k, k]``, each for the nearest of so many radii a pixel where no gradient asks for more."""
    if torch.is_grad_enabled() and coc.requires_grad:
        kernels = table.kernels(coc, width)
    else:
        values, which = torch.unique((coc.double() * _KERNELS_PER_PX).round() / _KERNELS_PER_PX, return_inverse=True)
        kernels = table.kernels(values.cpu(), width).to(coc.device)[which]
    spare = max(0, kernels.shape[-1] // 2 - (largest - 1))
    return kernels[..., spare : kernels.shape[-1] - spare, spare : kernels.shape[-1] - spare]


def _to_border(at: Tensor, coc_px: Tensor) -> Tensor:
    """Pixels between pixels' centres and the nearest border; layers would scale their light up there."""
    height, width = coc_px.shape[-2:]
    _, row, column = places(at, height, width)
    rows, columns = torch.minimum(row, height - 1 - row), torch.minimum(column, width - 1 - column)
    return torch.minimum(rows, columns) + 0.5


def _something_nearer(at: Tensor, coc: Tensor, nearest_px: Tensor) -> Tensor:
    """Whether a ray of a pixel could meet a nearer surface, or land where layers would scale it; none too few."""
    item, row, column = places(at, int(nearest_px.shape[-2]), int(nearest_px.shape[-1]))
    cells = _cells(-nearest_px.detach())
    rows, columns = row // _COARSE_CELL, column // _COARSE_CELL
    found = torch.zeros_like(coc, dtype=torch.bool)
    inner, radius = _NEARER_PX, 1  # of the window, in pixels and cells
    farthest = float(torch.maximum(coc.max() + cells.max(), 2.0 * coc.abs().max()))
    while inner < farthest:
        near = -max_around(cells, radius)[item, 0, rows, columns]
        found |= (near < coc - inner) | ((near < coc - _NEARER_PX) & (2.0 * coc.abs() > inner))
        inner, radius = max(_NEARER_PX, float(radius * _COARSE_CELL)), 2 * radius
    return found


def _cells(values: Tensor) -> Tensor:
    """Largest of ``[B, 1, H, W]`` in cells of so many pixels a side, the last ones cut off by the border."""
    return max_of_blocks(_whole_cells(values), _COARSE_CELL)


def _whole_cells(values: Tensor) -> Tensor:
    """``[B, 1, H, W]`` with its last values repeated, up to sides that are multiples of a cell's."""
    height, width = values.shape[-2:]
    ends = (0, -width % _COARSE_CELL, 0, -height % _COARSE_CELL)
    return functional.pad(values, ends, mode="replicate")


class _Surfaces:
    """What an image shows, in bins of 1 px of coc."""

    def __init__(self, coc_px: Tensor) -> None:
        self.size = (int(coc_px.shape[-2]), int(coc_px.shape[-1]))
        self.low = float(coc_px.detach().min())
        self.place = (coc_px[:, 0] - self.low).flatten()
        below = self.place.detach().floor().long()
        self.bins = (torch.bincount(below) > 0).nonzero()[:, 0].tolist()
        self.bins = sorted({*self.bins, *(k + 1 for k in self.bins)})
        self.width = max(1.0, (self.bins[-1] + 1) / _CLASSES)
        self.cells = self._cells_of_bits(_whole_cells(coc_px.detach() - self.low)[:, 0])
        self.around: dict[int, Tensor] = {}

    def blocked(self, sources: _Sources, step: Tensor) -> Tensor:
        """Share of each ray that nearer surfaces take, ``[n, k, k]`` for rays that land so many pixels from the first.

        Rays of a block are looked at in patches, each only for the surfaces there are where the patch looks.
        """
        coc, item = sources.coc_px, sources.item
        down, right = sources.middle()
        side = -(-len(step) // max(1, round(len(step) / _PATCH)))
        patches = -(-len(step) // side)
        blocked = coc.new_zeros(len(coc), patches, patches, side, side)
        flat = blocked.view(-1, side, side)
        offset = torch.arange(side, device=coc.device)
        start = step[0] + side * torch.arange(patches, device=coc.device)
        start_y, start_x = start - down[:, None], start - right[:, None]
        row, column = (sources.row + down)[:, None], (sources.column + right)[:, None]
        to_middle = (side - 1) / 2
        for k in self.bins:
            behind = coc - _NEARER_PX >= self.low + k
            if not bool(behind.any()):
                break
            scale = 1.0 - (self.low + k) / coc
            along = scale.detach()[:, None]
            reach = to_middle * float(along[behind].abs().max())
            rows, columns = row + (start_y + to_middle) * along, column + (start_x + to_middle) * along
            meets = self._meets(k, reach, item, rows, columns) & behind[:, None, None]
            which = meets.flatten().nonzero()[:, 0]
            if len(which) == 0:
                continue
            ray, patch = which // patches**2, which % patches**2
            along = scale[ray][:, None]
            at_y = row[ray] + (start_y[ray, patch // patches][:, None] + offset) * along
            at_x = column[ray] + (start_x[ray, patch % patches][:, None] + offset) * along
            flat.index_add_(0, which, self._share(item[ray][:, None], at_y, at_x, k))
        blocked = blocked.transpose(2, 3).reshape(len(coc), patches * side, patches * side)
        return blocked[:, : len(step), : len(step)].clamp(max=1.0)

    def _meets(self, k: int, reach: float, item: Tensor, at_y: Tensor, at_x: Tensor) -> Tensor:
        """Whether within reach of places there is anything in bin k; bool ``[n, rows, columns]``, none too few."""
        height, width = self.size
        radius = min(math.ceil((reach + 1.0) / _COARSE_CELL), max(self.cells.shape[-2:]))
        if radius not in self.around:
            self.around[radius] = any_around(self.cells, radius)
        found = self.around[radius]
        rows = at_y.clamp(0, height - 1).long() // _COARSE_CELL
        columns = at_x.clamp(0, width - 1).long() // _COARSE_CELL
        cell = (item[:, None] * found.shape[-2] + rows)[:, :, None] * found.shape[-1] + columns[:, None, :]
        first, last = (min(int(max(0, at) / self.width), _CLASSES - 1) for at in (k - 1, k + 1))
        return (found.flatten()[cell] & ((2 << last) - (1 << first))) != 0

    def _cells_of_bits(self, place: Tensor) -> Tensor:
        """The classes that occur in each cell of ``[B, H, W]``, a bit each."""
        one = torch.ones((), dtype=torch.int64, device=place.device)
        return torch.cat(
            [
                any_of_blocks(one << (place[:, rows] / self.width).long(), _COARSE_CELL)
                for rows in bands(place, _COARSE_CELL)
            ],
            1,
        )

    def _share(self, item: Tensor, at_y: Tensor, at_x: Tensor, k: int) -> Tensor:
        """How much of what the image shows at places lies in bin k: ``[n, rows, columns]``."""
        height, width = self.size
        (top, down), (left, right) = between(at_y, height), between(at_x, width)  # surfaces go on beyond the border
        down, right = down[:, :, None], right[:, None, :]
        first = ((item * height + top) * width)[:, :, None] + left[:, None, :]

        def share(rows: int, columns: int) -> Tensor:
            """At places so many pixels down and right."""
            after = min(rows, height - 1) * width + min(columns, width - 1)
            place = self.place[after:].index_select(0, first.flatten()).view(first.shape)
            return (1.0 - (place - k).abs()).clamp_min(0.0)

        upper, lower = (torch.lerp(share(rows, 0), share(rows, 1), right) for rows in (0, 1))
        return torch.lerp(upper, lower, down)
