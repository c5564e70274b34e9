"""Highlights: light far brighter than what is around it, splatted by rays to the crisp discs that a lens makes of it.

Layers know how much of the lens a blurred foreground covers, not which part. For other light that is enough; in the
disc of a highlight everybody sees it, for a post in front of a lamp draws a crisp line through its disc. A ray from a
pixel at ``p`` with coc ``c`` through the point ``u`` of the lens lands at ``p + c u``, and it passes a nearer surface
with coc ``c'`` where the image shows the position ``p + (c - c') u``. So the sharp image itself tells which rays pass.

Highlights are few. What exceeds the threshold of what is around it is extracted from the layers, and splatted as
rays: where something nearer could stand in the way, where its layer is too coarse for a crisp edge, and at the frame's
border, where layers make up for the light that is not seen with the light that is. Without occlusion nothing stands in
the way, and the rays' light is divided by the same sum of weights as the layers'.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import pixels
from ..optics.blur_table import BlurTable
from .plan import kernels_for
from .surfaces import Surface

__all__ = ["FACTOR", "Highlights", "extract", "splat", "threshold"]

FACTOR = 8.0
"""Light above so many times what is around it is a highlight's."""

_CELL = 32  # pixels over which the threshold is decided
_COARSE_CELL = 8  # pixels in which nearer surfaces are looked for
_NEARER_PX = 1.5  # difference in coc from which on a surface is another one, in front
_TAPS_PER_PIXEL = 16  # of the frame: rays beyond this number are left to the layers
_TAPS = 2**21  # rays splatted together


class Highlights(NamedTuple):
    """Light ``[C, n]`` extracted from one surface at pixels ``[n]`` (:mod:`torchdof.pixels`), and their coc."""

    pixels: Tensor
    light: Tensor
    coc_px: Tensor


def threshold(light: Tensor, valid: Tensor | None = None) -> Tensor:
    """Largest light ``[B, 1, H, W]`` that is no highlight's, where light ``[B, C, H, W]`` is valid.

    It is :data:`FACTOR` times what four fifths of the pixels of a cell stay below, interpolated between cells.
    """
    height, width = light.shape[-2:]
    brightest = light.detach()[..., ::2, ::2].amax(1, keepdim=True)
    if valid is not None:
        brightest = torch.where(valid[..., ::2, ::2] > 0, brightest, torch.inf)
    # as in `disocclusion`: in this form exported code knows that the sizes are multiples
    cell, (rows, columns) = _CELL // 2, brightest.shape[-2:]
    more = 2 * cell - 1
    ends = (0, (columns + more) // cell * cell - columns, 0, (rows + more) // cell * cell - rows)
    cells = functional.pixel_unshuffle(functional.pad(brightest, ends, mode="replicate"), cell)
    level = torch.topk(cells, cells.shape[1] // 5, dim=1)[0][:, -1:]
    level = FACTOR * level.clamp(0.0, torch.finfo(light.dtype).max / FACTOR)
    level = functional.interpolate(level, scale_factor=float(_CELL), mode="bilinear", align_corners=False)
    return level[..., :height, :width]


def extract(
    surface: Surface, limit: Tensor, nearest_px: Tensor | None, crisp_px: float
) -> tuple[Surface, Highlights | None]:
    """Take the light above a limit out of a surface of an image, where it needs to be splatted ray by ray.

    Args:
        surface: Of an image.
        limit: As :func:`threshold` gives it, ``[B, 1, H, W]``.
        nearest_px: Coc of what each pixel shows, ``[B, 1, H, W]``; None if nothing hides anything.
        crisp_px: Blurs from this radius on lose their edge in coarse layers, so they are splatted in any case.

    Returns:
        The surface with what is left of its light, and the highlights if there are any.
    """
    light, coc_px, weight = surface
    brightest = light.amax(1, keepdim=True)
    is_bright = brightest > limit
    bright = pixels.indices(is_bright if weight is None else is_bright & (weight > 0))
    coc = pixels.pick(coc_px.detach(), bright)[0]
    needed = coc.abs() >= crisp_px
    if nearest_px is not None and len(bright):
        needed |= _need_splats(bright, coc, nearest_px)
    bright = bright[needed & (coc.abs() > 1.0)]
    peak, coc, most = (pixels.pick(t, bright)[0] for t in (brightest, coc_px, limit))
    order = torch.argsort(peak.detach(), descending=True)
    taps = ((2.0 * coc.detach().abs() + 1.0) ** 2)[order].cumsum(0)
    count = int((taps <= _TAPS_PER_PIXEL * coc_px.numel()).sum())
    if count == 0:
        return surface, None
    if count < len(bright):  # too many: the brightest of them, and only what they are brighter by
        most = torch.maximum(most, peak[order[count]].detach())
        bright, peak, coc, most = (t[order[:count]] for t in (bright, peak, coc, most))
    # from nothing at a radius of 1 px to all of it at 2
    excess = pixels.pick(light, bright) * ((1.0 - most / peak) * (coc.abs() - 1.0).clamp(max=1.0))
    left = pixels.put(light, bright, pixels.pick(light, bright) - excess)
    highlights = Highlights(bright, excess if weight is None else excess * pixels.pick(weight, bright), coc)
    return surface._replace(light=left), highlights


def _need_splats(bright: Tensor, coc: Tensor, nearest_px: Tensor) -> Tensor:
    """Whether a ray of a pixel could meet a nearer surface, or land where layers would scale it; none too few.

    They do so beside the border and beside what is nearer. Wider and wider windows are looked at, in cells: a surface
    that is nearer by ``d`` hides from at most ``d`` pixels away.
    """
    height, width = nearest_px.shape[-2:]
    item, row, column = pixels.places(bright, height, width)
    to_border = torch.minimum(torch.minimum(row, height - 1 - row), torch.minimum(column, width - 1 - column)) + 0.5
    needed = 2.0 * coc.abs() > to_border
    cells = functional.max_pool2d(-nearest_px.detach(), _COARSE_CELL, ceil_mode=True)
    rows, columns = row // _COARSE_CELL, column // _COARSE_CELL
    inner, radius = _NEARER_PX, 1  # of the window, in pixels and cells
    farthest = float(torch.maximum(coc.max() + cells.max(), 2.0 * coc.abs().max()))
    while inner < farthest:
        down, right = (min(radius, n) for n in cells.shape[-2:])
        around = functional.max_pool2d(cells, (2 * down + 1, 1), stride=1, padding=(down, 0))
        around = functional.max_pool2d(around, (1, 2 * right + 1), stride=1, padding=(0, right))
        near = -around[item, 0, rows, columns]
        needed |= (near < coc - inner) | ((near < coc - _NEARER_PX) & (2.0 * coc.abs() > inner))
        inner, radius = max(_NEARER_PX, float(radius * _COARSE_CELL)), 2 * radius
    return needed


def splat(rays: Sequence[Highlights], coc_px: Tensor, table: BlurTable, occlusion: bool = True) -> Tensor:
    """Scatter highlights to ``[B, C, H, W]``, each ray to where it lands unless a nearer surface is in its way.

    What is in the way is told by the coc that each pixel shows, ``[B, 1, H, W]``; without occlusion all rays pass.
    Differentiable in the light and coc of the rays.
    """
    batch, _, height, width = coc_px.shape
    longest = max(height, width)
    source, light, coc = (torch.cat(parts, -1) for parts in zip(*rays, strict=True))
    order = torch.argsort(coc.detach().abs())
    item, row, column = pixels.places(source[order], height, width)
    light, coc = light[:, order], coc[order]
    radii = coc.detach().tolist()

    def half_of(radius: float) -> int:
        return min(math.ceil(table.reach_px(radius, width) + 0.5), longest - 1)

    margin = half_of(radii[-1])
    across = width + 2 * margin
    area = (height + 2 * margin) * across
    splats = light.new_zeros(len(light), batch * area)
    hiding = _Hiding(coc_px) if occlusion else None
    start = 0
    while start < len(radii):  # sources of increasing blur, as many as make a bounded number of taps
        stop = min(len(radii), start + max(1, _TAPS // (2 * half_of(radii[start]) + 1) ** 2))
        stop = min(stop, start + max(1, _TAPS // (2 * half_of(radii[stop - 1]) + 1) ** 2))
        part = slice(start, stop)
        kernels = kernels_for(table, coc[part], width, longest).to(light.dtype)  # [n, 1 or C, k, k]
        half = kernels.shape[-1] // 2
        step = torch.arange(-half, half + 1, device=light.device)
        landing = kernels * light[:, part].t()[:, :, None, None]
        if hiding is not None:
            hidden = hiding.hidden(item[part], row[part], column[part], coc[part], step, max(radii[part]))
            landing = landing * (1.0 - hidden).unsqueeze(1)
        lines = item[part, None] * area + (row[part, None] + margin + step) * across
        lands = lines[:, :, None] + (column[part, None] + margin + step)[:, None, :]  # [n, k, k]
        splats.index_add_(1, lands.flatten(), landing.transpose(0, 1).flatten(1))
        start = stop
    frame = splats.unflatten(1, (batch, height + 2 * margin, across)).transpose(0, 1)
    return frame[..., margin : margin + height, margin : margin + width]


class _Hiding:
    """What may stand in the way of rays: what an image shows, in bins of 1 px of its coc ``[B, 1, H, W]``."""

    def __init__(self, coc_px: Tensor) -> None:
        self.height, self.width = int(coc_px.shape[-2]), int(coc_px.shape[-1])
        self.low = float(coc_px.detach().min())
        self.place = (coc_px[:, 0] - self.low).flatten()  # in bins
        counts = torch.bincount(self.place.detach().floor().long()).tolist()
        self.bins = sorted({k for i, count in enumerate(counts) if count for k in (i, i + 1)})
        # how many cells of 8 px above and left of each place show something in a bin
        self.sums = []
        for k in self.bins:
            shown = ((coc_px.detach() - self.low - k).abs() < 1.0).to(torch.float32)
            cells = functional.max_pool2d(shown, _COARSE_CELL, ceil_mode=True)[:, 0]
            self.sums.append(functional.pad(cells.cumsum(-1).cumsum(-2), (1, 0, 1, 0)))

    def hidden(self, item: Tensor, row: Tensor, column: Tensor, coc: Tensor, step: Tensor, farthest: float) -> Tensor:
        """Share of each ray that nearer surfaces take, ``[n, k, k]``: from sources ``[n]`` of a coc up to the farthest.

        They land so many pixels ``[k]`` from their source along each axis.
        """
        hidden = coc.new_zeros(len(coc), len(step), len(step))
        for k, sums in zip(self.bins, self.sums, strict=True):
            nearer = self.low + k
            if farthest < nearer:
                break
            scale = 1.0 - nearer / coc  # a ray passes this surface so far on its way, as a share of its step
            reach = scale.detach().abs() * step[-1]
            (top, bottom), (left, right) = (
                [(place + end).clamp(0, size - 1).long() // _COARSE_CELL for end in (-reach, reach + 1.0)]
                for place, size in ((row, self.height), (column, self.width))
            )
            count = sums[item, bottom + 1, right + 1] - sums[item, top, right + 1]
            count = count - sums[item, bottom + 1, left] + sums[item, top, left]
            hit = ((count > 0) & (coc.detach() - _NEARER_PX >= nearer)).nonzero()[:, 0]
            if len(hit):
                way = scale[hit, None] * step
                rows, columns = (row[hit, None] + way)[:, :, None], (column[hit, None] + way)[:, None, :]
                around, down, right = pixels.corners(item[hit, None, None], rows, columns, self.height, self.width)
                shown = [(1.0 - (self.place[pixel] - k).abs()).clamp_min(0.0) for pixel in around]
                upper, lower = torch.lerp(shown[0], shown[1], right), torch.lerp(shown[2], shown[3], right)
                hidden = hidden.index_add(0, hit, torch.lerp(upper, lower, down))
        return hidden.clamp(max=1.0)
