"""Highlights: light far brighter than what is around it, traced ray by ray to the crisp discs that a lens makes of it.

Layers know how much of the lens a blurred foreground covers, not which part. For ordinary light that is enough; in the
disc of a highlight everybody sees it, for a post in front of a lamp draws a crisp line through its disc. A ray from a
pixel at ``p`` with coc ``c`` through the point ``u`` of the lens lands at ``p + c u``, and it passes a nearer surface
with coc ``c'`` where the image shows the position ``p + (c - c') u``. So the sharp image itself tells which rays pass.

Highlights are few. What exceeds the ordinary light around it is taken out of the layers, and added again as rays:
where something nearer could stand in the way, where its layer is too coarse for a crisp edge, and at the frame's
border, where layers make up for the light that is not seen with the light that is.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .pool import max_around, max_of_blocks, places
from .table import BlurTable

__all__ = ["FACTOR", "Rays", "ordinary", "take", "trace"]

FACTOR = 8.0
"""Light above so many times the ordinary light around it is a highlight's."""

_CELL = 32  # pixels over which light is averaged to tell what is ordinary
_COARSE_CELL = 8  # pixels in which the nearest surface is looked for
_NEARER_PX = 1.5  # difference in coc from which on a surface is another one, in front
_TAPS_PER_PIXEL = 16  # of the frame: rays beyond this number are left to the layers
_TAPS = 2**20  # rays traced together


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
    light: Tensor, coc_px: Tensor, weight: Tensor | None, limit: Tensor, nearest_px: Tensor, crisp_px: float
) -> tuple[Tensor, Rays | None]:
    """Take out of a surface the light above a limit that needs to be traced.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``.
        weight: Share of each pixel that the surface covers ``[B, 1, H, W]``; None is 1.
        limit: Largest ordinary light, ``[B, 1, H, W]``.
        nearest_px: Coc of what each pixel shows, ``[B, 1, H, W]``.
        crisp_px: Blurs from this radius on lose their edge in coarse layers, so they are traced in any case.

    Returns:
        The light that is left, and the rays; None where there are none.
    """
    brightest = light.amax(1, keepdim=True)
    bright = brightest > limit
    if weight is not None:
        bright &= weight > 0
    at = bright.flatten().nonzero()[:, 0]
    if len(at) == 0:
        return light, None
    place = coc_px.detach().flatten()[at]
    blur = place.abs()
    traced = (blur >= crisp_px) | (2.0 * blur > _to_border(at, coc_px)) | _something_nearer(at, place, nearest_px)
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


def trace(rays: Sequence[Rays], coc_px: Tensor, table: BlurTable, channels: int) -> Tensor:
    """Scatter highlights, each ray to where it lands unless a nearer surface is in its way.

    Args:
        rays: From :func:`take`.
        coc_px: What each pixel shows, ``[B, 1, H, W]``.
        table: Blur of the lens.
        channels: C.

    Returns:
        ``[B, C, H, W]``. Differentiable in the light and coc of the rays.
    """
    batch, _, height, width = coc_px.shape
    order = [torch.argsort(some.coc_px.detach().abs()) for some in rays]
    margin = max(_half(table, float(some.coc_px.detach().abs().max()), height, width) for some in rays)
    area = (height + 2 * margin) * (width + 2 * margin)
    out = rays[0].light.new_zeros(channels, batch * area)
    surfaces = _Surfaces(coc_px)
    for some, sorted_ in zip(rays, order, strict=True):
        for chunk in _chunks(some.coc_px.detach()[sorted_], table, height, width):
            chosen = sorted_[chunk]
            at, coc = some.at[chosen], some.coc_px[chosen]
            light = some.light[:, chosen]
            item, row, column = places(at, height, width)
            kernels = _kernels(table, coc, width, max(height, width)).to(light.dtype)  # [n, 1 or C, k, k]
            half = kernels.shape[-1] // 2
            step = torch.arange(-half, half + 1, device=at.device)
            passes = 1.0 - surfaces.blocked(coc, item, row, column, step)
            spread = kernels * passes.unsqueeze(1)
            lands = (row[:, None, None] + margin + step[:, None]) * (width + 2 * margin)
            lands = (item * area)[:, None, None] + lands + column[:, None, None] + margin + step
            for channel in range(channels):
                tap = spread[:, channel % spread.shape[1]] * light[channel, :, None, None]
                out[channel].index_add_(0, lands.flatten(), tap.flatten())
    frame = out.unflatten(1, (batch, height + 2 * margin, width + 2 * margin)).transpose(0, 1)
    return frame[..., margin : margin + height, margin : margin + width]


def _half(table: BlurTable, coc_px: float, height: int, width: int) -> int:
    return min(math.ceil(table.reach_px(coc_px, width) + 0.5), max(height, width) - 1)


def _chunks(sorted_coc: Tensor, table: BlurTable, height: int, width: int) -> list[slice]:
    """Rays of increasing blur in parts of a bounded number of taps."""
    chunks, start = [], 0
    while start < len(sorted_coc):
        stop = start
        # the first guess is for the first ray; the last ray of the part needs the widest kernel
        count = _TAPS // (2 * _half(table, float(sorted_coc[start].abs()), height, width) + 1) ** 2
        stop = min(len(sorted_coc), start + max(1, count))
        widest = 2 * _half(table, float(sorted_coc[stop - 1].abs()), height, width) + 1
        stop = min(stop, start + max(1, _TAPS // widest**2))
        chunks.append(slice(start, stop))
        start = stop
    return chunks


def _kernels(table: BlurTable, coc: Tensor, width: int, largest: int) -> Tensor:
    """Kernels ``[n, 1 or C, k, k]``, each as exact as 1/32 px of radius where no gradient asks for more."""
    if torch.is_grad_enabled() and coc.requires_grad:
        kernels = table.kernels(coc, width)
    else:
        values, which = torch.unique((coc.double() * 32).round() / 32, return_inverse=True)
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
    height, width = values.shape[-2:]
    ends = (0, -width % _COARSE_CELL, 0, -height % _COARSE_CELL)
    return max_of_blocks(functional.pad(values, ends, mode="replicate"), _COARSE_CELL)


class _Surfaces:
    """What an image shows, in bins of 1 px of coc."""

    def __init__(self, coc_px: Tensor) -> None:
        self.size = (int(coc_px.shape[-2]), int(coc_px.shape[-1]))
        self.low = float(coc_px.detach().min())
        self.place = (coc_px[:, 0] - self.low).flatten()
        below = self.place.detach().floor().long()
        self.bins = (torch.bincount(below) > 0).nonzero()[:, 0].tolist()
        self.bins = sorted({*self.bins, *(k + 1 for k in self.bins)})
        self.ends = [_cells((coc_px.detach() - self.low) * sign) for sign in (-1, 1)]

    def blocked(self, coc: Tensor, item: Tensor, row: Tensor, column: Tensor, step: Tensor) -> Tensor:
        """Share of each ray ``[n, k, k]`` that nearer surfaces take."""
        height, width = self.size
        blocked = coc.new_zeros(len(coc), len(step), len(step))
        y, x = row[:, None].to(coc.dtype), column[:, None].to(coc.dtype)
        # least and greatest place of what a ray can meet
        reach = len(step) // 2 * float((1.0 - self.low / coc.detach()).abs().max())
        radius = min(math.ceil(reach / _COARSE_CELL) + 1, max(self.ends[0].shape[-2:]))
        cell = (item, 0, row // _COARSE_CELL, column // _COARSE_CELL)
        least, most = (sign * max_around(end, radius)[cell] for sign, end in zip((-1, 1), self.ends, strict=True))
        for k in self.bins:
            behind = coc - _NEARER_PX >= self.low + k
            if not bool(behind.any()):
                break
            meets = behind & (least < k + 1) & (most > k - 1)
            if not bool(meets.any()):
                continue
            scale = (1.0 - (self.low + k) / coc[meets])[:, None]
            at_y = (y[meets] + step * scale).clamp(0, height - 1)  # surfaces go on beyond the border
            at_x = (x[meets] + step * scale).clamp(0, width - 1)
            top, left = at_y.floor(), at_x.floor()
            down, right = (at_y - top)[:, :, None], (at_x - left)[:, None, :]
            first = item[meets][:, None] * height
            rows = [(first + r.long().clamp(max=height - 1)) * width for r in (top, top + 1)]
            columns = [c.long().clamp(max=width - 1) for c in (left, left + 1)]
            upper, lower = (
                self._share(r[:, :, None] + columns[0][:, None, :], k) * (1 - right)
                + self._share(r[:, :, None] + columns[1][:, None, :], k) * right
                for r in rows
            )
            blocked = blocked.index_add(0, meets.nonzero()[:, 0], upper * (1 - down) + lower * down)
        return blocked.clamp(max=1.0)

    def _share(self, at: Tensor, k: int) -> Tensor:
        """How much of pixels lies in bin k."""
        return (1.0 - (self.place.index_select(0, at.flatten()).view(at.shape) - k).abs()).clamp_min(0.0)
