"""Highlights in a graph: their light is splatted ray by ray (:mod:`torchdof.render.highlights`), in a loop over parts.

The highlights are sorted by the width of their kernels; those of one part have kernels as wide as its widest one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import pixels
from torchdof.optics.blur_table import BlurTable
from torchdof.render.highlights import Occluders
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.frame import Highlights

from .structure import carried, last, steps

__all__ = ["Kernels", "kernels_of", "splat"]

_MAX_TAPS = 2**15  # rays of a part, about; larger: fewer steps, more memory


class Kernels(NamedTuple):
    """Kernels of all radii of a plan, from the most negative to the most positive one, packed into rows of numbers."""

    values: Tensor
    """``[1 or C, n]``: 0; then of each round kernel the eighth right of and below its centre, row by row to the
    diagonal, of other kernels all values."""

    origins: Tensor  # index of the centre's value for each kernel, [m]
    halves: Tensor  # half width of each kernel in pixels, [m]
    is_round: bool  # whether only eighths are stored
    per_px: int  # kernels for each pixel of radius
    bins: int  # range of coc in pixels, from the nearest to the farthest
    margin: int  # half width of the widest kernel in pixels


def kernels_of(table: BlurTable, plan: Plan, lens_width: int) -> Kernels:
    """Kernels for the highlights of a plan, for an image of ``lens_width`` pixels."""
    farthest = max(abs(c) for c in plan.coc_px)
    count = int(farthest * plan.kernels_per_px) + 2
    values, size, entries = [torch.zeros(table.channels, 1, dtype=torch.float32)], 1, []
    stored: dict[bytes, tuple[int, int]] = {}
    for step in range(-count, count + 1):
        kernel = table.kernels(torch.tensor([step / plan.kernels_per_px], dtype=torch.float64), lens_width)[0].float()
        half = kernel.shape[-1] // 2
        if table.is_round:
            row, column = torch.tril_indices(half + 1, half + 1)
            numbers, centre = kernel[:, half + row, half + column], 0
        else:
            numbers, centre = kernel.flatten(1), 2 * half * (half + 1)
        key = numbers.contiguous().numpy().tobytes()
        if key not in stored:  # most are equal on both sides of the focus plane
            stored[key] = (size + centre, half)
            values.append(numbers)
            size += numbers.shape[1]
        entries.append(stored[key])
    origins, halves = torch.tensor(entries).unbind(1)
    bins, margin = 2 * int(farthest) + 3, int(halves.max())
    return Kernels(torch.cat(values, 1), origins, halves, table.is_round, plan.kernels_per_px, bins, margin)


def splat(rays: Highlights, coc_px: Tensor, obstacles: Sequence[tuple[Tensor, Tensor]], kernels: Kernels) -> Tensor:
    """:func:`torchdof.render.highlights.splat` for one list of highlights, in a graph: ``[B, C, H, W]``.

    There is at least one highlight; ``obstacles`` are coc and cover of surfaces that may block rays.
    """
    batch, _, height, width = coc_px.shape
    margin, halves = kernels.margin, kernels.halves
    position = rays.coc_px * kernels.per_px + float(len(halves) // 2)
    node = position.floor().long()
    half, order = torch.maximum(halves.index_select(0, node), halves.index_select(0, node + 1)).sort()
    # a part ends after some taps, or where kernels become twice as wide
    taps, level = ((2 * half + 1) ** 2).cumsum(0) // _MAX_TAPS, torch.log2(half + 1.0).long()
    taps, level = (functional.pad(t, (1, 0), value=-1).diff() for t in (taps, level))
    part = ((taps != 0) | (level != 0)).cumsum(0)
    step = steps(functional.pad(part, (1, 0)).amax(0).item())
    is_next = part == step + 1

    across, down = width + 2 * margin, height + 2 * margin
    blank = coc_px.new_zeros(rays.light.shape[0], batch * down * across)
    splats = carried(step, blank)
    chosen = order.index_select(0, is_next.nonzero()[:, 0])
    light = rays.light.index_select(1, chosen)
    source, coc, position = (t.index_select(0, chosen) for t in (rays.pixels, rays.coc_px, position))
    item, row, column = pixels.places(source, height, width)
    reach = functional.pad(torch.where(is_next, half, 0), (1, 0)).amax(0).item()
    torch._check(reach >= 0)
    offset = torch.arange(-reach, reach + 1)
    low = position.floor()
    near, far = (_values_at(kernels, node, offset) for node in (low.long(), low.long() + 1))
    landing = (near + (far - near) * (position - low)[:, None, None]) * light[:, :, None, None]
    if obstacles:
        hidden = Occluders(obstacles, kernels.bins).hidden(item, row, column, coc, offset)
        landing = landing * (1.0 - hidden)
    lines = (item[:, None] * down + row[:, None] + margin + offset) * across
    lands = (lines[:, :, None] + (column[:, None] + margin + offset)[:, None, :]).flatten()
    added = splats.scatter_add(1, lands.expand(light.shape[0], -1), landing.flatten(1))
    frame = last(step, splats, added).unflatten(1, (batch, down, across)).transpose(0, 1)
    return frame.narrow(-2, margin, height).narrow(-1, margin, width)


def _values_at(kernels: Kernels, node: Tensor, offset: Tensor) -> Tensor:
    """Kernels ``[1 or C, n, k, k]`` at nodes ``[n]``; 0 outside."""
    half, origin = (t.index_select(0, node)[:, None, None] for t in (kernels.halves, kernels.origins))
    right, down = offset.abs(), offset.abs()[:, None]
    larger = torch.maximum(right, down)
    if kernels.is_round:
        index = larger * (larger + 1) // 2 + torch.minimum(right, down)
    else:
        index = offset[:, None] * (2 * half + 1) + offset
    index = torch.where(larger > half, 0, origin + index)
    return kernels.values.index_select(1, index.flatten()).unflatten(1, index.shape)
