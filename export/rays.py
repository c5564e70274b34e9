"""Highlights in a graph: their light is splatted ray by ray (:mod:`torchdof.render.highlights`), in a loop over parts.

Values for single sources are traced. The loop over sources, whose number is known only at run time, is a function in
ONNX (:mod:`.ray_splats`), called through one operator in the traced graph.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdof import pixels
from torchdof.optics.blur_table import BlurTable
from torchdof.render.highlights import covered_cells
from torchdof.render.plan import Plan
from torchdof.render.surfaces import Highlights

from .operators import operator

__all__ = ["Kernels", "kernels_of", "splat"]

_BEYOND_PX = 1e6  # pixels; larger than any coc


class Kernels(NamedTuple):
    """Kernels of all radii of a plan, from the most negative to the most positive one, packed into rows of numbers.

    Args:
        values: ``[1 or C, n]``. Of each round kernel, the eighth right of and below its centre, row by row to the
            diagonal; of other kernels, all values. The first value is 0.
        origins: Index of the centre's value for each kernel, ``[m]``.
        halves: Half width of each kernel in pixels, ``[m]``.
        round: Whether only eighths are stored, a bool ``[]``.
        per_px: Kernels for each pixel of radius.
        bins: Range of coc in pixels, from the nearest to the farthest.
        margin: Half width of the widest kernel in pixels.
    """

    values: Tensor
    origins: Tensor
    halves: Tensor
    round: Tensor
    per_px: int
    bins: int
    margin: int


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
    return Kernels(
        torch.cat(values, 1), origins, halves, torch.tensor(table.is_round), plan.kernels_per_px, bins, margin
    )


def splat(rays: Highlights, coc_px: Tensor, obstacles: Sequence[tuple[Tensor, Tensor]], kernels: Kernels) -> Tensor:
    """:func:`torchdof.render.highlights.splat` for one list of highlights, in a graph: ``[B, C, H, W]``.

    Args:
        rays: The highlights of all surfaces.
        coc_px: Coc of the frame, ``[B, 1, H, W]``.
        obstacles: Coc and cover of surfaces that may block rays, each ``[B, 1, H, W]``.
        kernels: The graph's kernels.
    """
    batch, _, height, width = coc_px.shape
    *lens, per_px, bins, margin = kernels
    halves = kernels.halves
    position = rays.coc_px * per_px + float(len(halves) // 2)
    low = position.floor()
    node, fraction = low.long(), position - low
    half = torch.maximum(halves.index_select(0, node), halves.index_select(0, node + 1))
    half, order = half.sort()  # each part of the sources is processed with its widest kernel
    node, fraction, coc, source = (t.index_select(0, order) for t in (node, fraction, rays.coc_px, rays.pixels))
    light = rays.light.index_select(1, order).t()
    item, row, column = pixels.places(source, height, width)

    padded_width, padded_height = width + 2 * margin, height + 2 * margin
    first = (item * padded_height + row + margin) * padded_width + column + margin
    lists = [light, coc, item, row, column, first, node, fraction, half]
    blank = coc_px.new_zeros(rays.light.shape[0], batch, padded_height, padded_width)
    sizes = [torch.scalar_tensor(n, dtype=torch.int64) for n in (height, width, padded_width)]
    nearest = coc_px.amin((1, 2, 3))
    if obstacles:
        obstacle_bins = [(coc - nearest[:, None, None, None], cover) for coc, cover in obstacles]
        maps = [torch.stack([t.flatten() for t in part], 1) for part in zip(*obstacle_bins, strict=True)]
        maps.append(covered_cells(obstacle_bins, bins))
    else:  # no bins with surfaces
        maps = [coc_px.new_zeros(1, 1), coc_px.new_zeros(1, 1), coc_px.new_zeros(0, 1, 1, 1)]
    inputs = [blank, *lists, *lens, *sizes, *maps, nearest]
    splats = operator("splat", inputs, blank.shape)
    return splats.transpose(0, 1).narrow(-2, margin, height).narrow(-1, margin, width)
