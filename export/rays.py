"""Highlights in a graph: their light is splatted ray by ray (:mod:`torchdof.render.highlights`), in a loop over parts.

Values for single sources are traced. The loop over sources, whose number is known only at run time, is a function in
ONNX, which :mod:`onnxscript` makes from the code below; the traced graph calls it through one operator. In it, sources
are in lists ``[n]``, and kernels ``[m, k, k]`` of a part of the sources are as wide as its widest kernel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdof import pixels
from torchdof.optics.blur_table import BlurTable
from torchdof.render.highlights import COARSE_CELL, NEARER_PX, covered_cells
from torchdof.render.plan import Plan
from torchdof.render.surfaces import Highlights

from .scripting import Flag, Floats, Ints, op, script
from .structure import DOMAIN, operator

__all__ = ["FUNCTIONS", "kernels_of", "splat"]

_MAX_TAPS = 2**16
"""Largest number of rays splatted together."""


class Kernels(NamedTuple):
    """Kernels of all radii of a plan, from the most negative to the most positive one, packed into rows of numbers."""

    values: Tensor
    """``[1 or C, n]``: 0; then of each round kernel the eighth right of and below its centre, row by row to the
    diagonal, of other kernels all values."""

    origins: Tensor  # index of the centre's value for each kernel, [m]
    halves: Tensor  # half width of each kernel in pixels, [m]
    round: Tensor  # whether only eighths are stored, a bool []
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
    lens = torch.cat(values, 1), origins, halves, torch.tensor(table.is_round)
    return Kernels(*lens, plan.kernels_per_px, bins, margin)


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
    splats = operator(f"{DOMAIN}::splat_all", inputs, blank.shape)
    return splats.transpose(0, 1).narrow(-2, margin, height).narrow(-1, margin, width)


@script
def values_at(values: Floats, origins: Ints, halves: Ints, round: Flag, node: Ints, step: Ints) -> Floats:
    """Kernels ``[1 or C, m, k, k]`` at nodes ``[m]``; 0 outside."""
    axes = op.Constant(value_ints=[1, 2])
    down = op.Unsqueeze(step, op.Constant(value_ints=[1]))
    larger = op.Max(op.Abs(step), op.Abs(down))
    half = op.Unsqueeze(op.Gather(halves, node), axes)
    eighth_index = larger * (larger + 1) / 2 + op.Min(op.Abs(step), op.Abs(down))
    index = op.Unsqueeze(op.Gather(origins, node), axes) + op.Where(round, eighth_index, down * (2 * half + 1) + step)
    return op.Gather(values, op.Where(larger > half, op.Constant(value_int=0), index), axis=1)


@script
def covered_at(places: Floats, covers: Floats, pixel: Ints, bin: Floats) -> Floats:
    """Share of pixels ``[p, k, k]`` covered by surfaces in bins ``[p, 1, 1, 1]``."""
    near = op.Relu(1.0 - op.Abs(op.Gather(places, pixel) - bin))
    return op.ReduceSum(op.Gather(covers, pixel) * near, op.Constant(value_ints=[3]), keepdims=0)


@script
def count_in(cells: Floats, bin: Ints, item: Ints, row: Ints, column: Ints) -> Floats:
    """Number of cells above and left of ``[m, bins]`` that may contain surfaces in bins ``[bins]``."""
    items = op.Squeeze(op.Shape(cells, start=1, end=2))
    rows = op.Squeeze(op.Shape(cells, start=2, end=3))
    columns = op.Squeeze(op.Shape(cells, start=3, end=4))
    index = (((bin * items) + item) * rows + row) * columns + column
    return op.Gather(op.Reshape(cells, op.Constant(value_ints=[-1])), index)


@script
def splat_all(
    blank: Floats,
    light: Floats,
    coc: Floats,
    item: Ints,
    row: Ints,
    column: Ints,
    first: Ints,
    node: Ints,
    part: Floats,
    half: Ints,
    values: Floats,
    origins: Ints,
    halves: Ints,
    round: Flag,
    height: Ints,
    width: Ints,
    across: Ints,
    places: Floats,
    covers: Floats,
    cells: Floats,
    nearest: Floats,
) -> Floats:
    """Light ``[C, B, H, W]`` of all sources on a blank frame with a margin, except light blocked by nearer surfaces.

    1. Take the next part of the sources, which are sorted by width, and interpolate their kernels.
    2. Find the pairs of source and bin for which the bin may contain a surface within the reach of the rays.
    3. Interpolate the cover of that bin where each ray crosses it, and add up those of all bins of a source, at most 1.
    4. Add the light that is not blocked where the rays land.
    """
    zero = op.Constant(value_int=0)
    one = op.Constant(value_int=1)
    axis_1 = op.Constant(value_ints=[1])
    axis_2 = op.Constant(value_ints=[2])
    axes = op.Constant(value_ints=[1, 2])
    rest_axis = op.Constant(value_ints=[-1])
    last_row = op.Cast(height - 1, to=1)
    last_column = op.Cast(width - 1, to=1)
    to_right = op.Min(width - 1, one)
    to_below = op.Min(height - 1, one) * width
    bin = op.Range(zero, op.Squeeze(op.Shape(cells, start=0, end=1)), one)
    splats = op.Reshape(blank, op.Constant(value_ints=[0, -1]))
    start = op.Constant(value_int=0)
    has_more = op.Size(half) > 0
    while has_more:
        # as many sources as the taps allow, by the first width, then by the last
        side = 2 * op.Gather(half, start) + 1
        limit = op.Min(start + op.Max(_MAX_TAPS / (side * side), 1), op.Size(half))
        side = 2 * op.Gather(half, limit - 1) + 1
        stop = op.Min(start + op.Max(_MAX_TAPS / (side * side), 1), limit)
        index = op.Range(start, stop, 1)
        reach_px = op.Gather(half, stop - 1)
        step = op.Range(-reach_px, reach_px + 1, 1)
        offset = op.Cast(step, to=1)

        # kernels [1 or C, m, k, k], interpolated between nodes
        before = op.Gather(node, index)
        near = values_at(values, origins, halves, round, before, step)
        far = values_at(values, origins, halves, round, before + 1, step)
        kernels = near + (far - near) * op.Unsqueeze(op.Gather(part, index), axes)

        # pairs of a source and a bin that may contain a surface within reach of its rays
        coc_px = op.Unsqueeze(op.Gather(coc, index), axis_1)
        of_item = op.Unsqueeze(op.Gather(item, index), axis_1)
        y = op.Cast(op.Unsqueeze(op.Gather(row, index), axis_1), to=1)
        x = op.Cast(op.Unsqueeze(op.Gather(column, index), axis_1), to=1)
        nearer = op.Gather(nearest, of_item) + op.Cast(bin, to=1)
        scale = 1.0 - nearer / coc_px
        fade = op.Clip(coc_px - NEARER_PX - nearer, 0.0, 1.0)
        reach = op.Abs(scale) * op.ReduceMax(offset, keepdims=0)
        top = op.Cast(op.Clip(y - reach, 0.0, last_row), to=7) / COARSE_CELL
        bottom = op.Cast(op.Clip(y + reach + 1.0, 0.0, last_row), to=7) / COARSE_CELL + 1
        left = op.Cast(op.Clip(x - reach, 0.0, last_column), to=7) / COARSE_CELL
        right = op.Cast(op.Clip(x + reach + 1.0, 0.0, last_column), to=7) / COARSE_CELL + 1
        below = count_in(cells, bin, of_item, bottom, right) - count_in(cells, bin, of_item, top, right)
        count = below - count_in(cells, bin, of_item, bottom, left) + count_in(cells, bin, of_item, top, left)
        pairs = op.NonZero(op.And(count > 0.0, fade > 0.0))
        pair = op.Transpose(pairs, perm=[1, 0])
        source = op.Gather(pairs, zero)
        pair_bin = op.Unsqueeze(op.Cast(op.Gather(pairs, one), to=1), op.Constant(value_ints=[1, 2, 3]))

        # each ray of a pair crosses the bin's surface between four pixels
        way = op.Unsqueeze(op.GatherND(scale, pair), axis_1) * offset
        rows = op.Clip(op.Gather(y, source) + way, 0.0, last_row)
        columns = op.Clip(op.Gather(x, source) + way, 0.0, last_column)
        upper_row = op.Min(op.Floor(rows), op.Max(last_row - 1.0, 0.0))
        left_column = op.Min(op.Floor(columns), op.Max(last_column - 1.0, 0.0))
        line = (op.Gather(of_item, source) * height + op.Cast(upper_row, to=7)) * width
        corner = op.Unsqueeze(line, axis_2) + op.Unsqueeze(op.Cast(left_column, to=7), axis_1)
        right_share = op.Unsqueeze(columns - left_column, axis_1)
        upper = covered_at(places, covers, corner, pair_bin)
        upper = upper + (covered_at(places, covers, corner + to_right, pair_bin) - upper) * right_share
        corner = corner + to_below
        lower = covered_at(places, covers, corner, pair_bin)
        lower = lower + (covered_at(places, covers, corner + to_right, pair_bin) - lower) * right_share
        covered = upper + (lower - upper) * op.Unsqueeze(rows - upper_row, axis_2)
        blocked = covered * op.Unsqueeze(op.GatherND(fade, pair), axes)
        across_rays = op.Shape(step)
        nothing = op.ConstantOfShape(op.Concat(op.Shape(of_item, start=0, end=1), across_rays, across_rays, axis=0))
        # not ScatterND: runtimes add in parallel there, and would lose some bins of a source that has several
        target = op.Expand(op.Unsqueeze(source, axes), op.Shape(blocked))
        hidden = op.Min(op.ScatterElements(nothing, target, blocked, axis=0, reduction="add"), 1.0)

        colours = op.Unsqueeze(op.Transpose(op.Gather(light, index), perm=[1, 0]), op.Constant(value_ints=[2, 3]))
        scattered = (kernels * (1.0 - hidden)) * colours
        scattered = op.Reshape(scattered, op.Concat(op.Shape(scattered, start=0, end=1), rest_axis, axis=0))
        lands = op.Unsqueeze(op.Gather(first, index), axes) + (op.Unsqueeze(step * across, axis_1) + step)
        lands = op.Expand(op.Reshape(lands, rest_axis), op.Shape(scattered))
        splats = op.ScatterElements(splats, lands, scattered, axis=1, reduction="add")
        start = stop
        has_more = start < op.Size(half)
    return op.Reshape(splats, op.Shape(blank))


FUNCTIONS = (values_at, covered_at, count_in, splat_all)
"""The functions that a graph calls."""
