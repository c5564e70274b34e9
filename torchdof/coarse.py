"""Layers that are spread at a coarser resolution, on frames in tiles.

What a layer scatters is averaged to its resolution before anything else. Its own pixels are few, so only blocks of
pixels that it lies in are looked at; all else is known from the least and the largest coc of a block.
"""

from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .frame import TILE, TILES_AT_ONCE, Frame, cut_tiles, from_tiles
from .layers import share_at_or_behind
from .plan import Blur, Plan
from .pool import max_of_blocks, mean_of_blocks

__all__ = ["Coarse"]

_PIXELS_AT_ONCE = 2**18  # of blocks that are averaged together: what fits the cache


class Coarse:
    """A frame at every ``scale``-th pixel, and one such pixel beyond it on each side.

    Args:
        frame: The frame, in tiles.
        scale: A power of two.
        half: Pixels of that resolution which the widest kernel reaches.
        with_room: As in :meth:`torchdof.frame.Frame.terms`.
    """

    def __init__(self, frame: Frame, scale: int, half: int, with_room: bool) -> None:
        self.frame, self.scale, self.half, self.with_room = frame, scale, half, with_room
        self.size = tuple(n // scale + 2 for n in frame.area)
        self.area = tuple(-(-n // TILE) * TILE for n in self.size)
        channels = frame.colours + (1 if not with_room else 2 if frame.known is None else 3)
        height, width = (n + 2 * half for n in self.area)
        self.plane = frame.samples[0].light.new_zeros(channels, height, width)
        self.samples = [] if frame.independent else [_Blocks(self, i) for i in range(len(frame.samples))]

    def pixels(self, values: Tensor) -> Tensor:
        """What of a frame with its margin lies in blocks: ``[1, C, ...] -> [C, scale * rows, scale * columns]``."""
        start, count = self.frame.margin - self.scale * (1 + self.half), [n + 2 * self.half for n in self.size]
        rows, columns = (slice(start, start + self.scale * n) for n in count)
        return values[0, :, rows, columns]

    def blocks(self, values: Tensor) -> Tensor:
        """The same, as ``[C, scale, scale, rows, columns]``."""
        parts = self.pixels(values).unflatten(1, (-1, self.scale)).unflatten(3, (-1, self.scale))
        return parts.permute(0, 2, 4, 1, 3)

    def canvas(self, kernels: int) -> Tensor:
        """As :meth:`torchdof.frame.Frame.canvas`, in tiles of this resolution."""
        count = self.area[0] // TILE * (self.area[1] // TILE)
        return self.plane.new_zeros(count, self.frame.colours + kernels, TILE, TILE)

    def image(self, canvas: Tensor) -> Tensor:
        """A canvas in one piece: ``[1, C, rows, columns]`` with one pixel beyond the frame on each side."""
        return from_tiles(canvas, self.area)[..., : self.size[0], : self.size[1]]

    def terms(
        self, plan: Plan, blurs: Sequence[Blur], group: Sequence[int], with_room: bool
    ) -> Iterator[tuple[Tensor, list[list[Tensor]]]]:
        """As :meth:`torchdof.frame.Frame.terms`, for one layer."""
        (k,) = group
        self._fill(plan.nodes, k)
        half, colours = blurs[k].half, self.frame.colours
        spare = self.half - half
        height, width = self.plane.shape[-2:]
        plane = self.plane[None, :, spare : height - spare, spare : width - spare]
        side = TILE + 2 * half
        tiles = functional.max_pool2d(plane[:, colours : colours + 1], side, TILE)
        places = tiles.flatten().nonzero()[:, 0]
        columns = self.area[1] // TILE
        row, column = places // columns * TILE - half - 1, places % columns * TILE - half - 1
        inside = (row >= 0) & (row + side <= self.frame.size[0] // self.scale)
        inside &= (column >= 0) & (column + side <= self.frame.size[1] // self.scale)
        for border in (False, True):
            more = [1] * (plane.shape[1] - colours)  # what was seen need not be told apart where all was
            lengths = [colours, *(more if border or not with_room else more[:2])]
            for some in places[inside != border].split(TILES_AT_ONCE):
                if len(some):
                    yield some, [list(cut_tiles(plane[:, : sum(lengths)], half, some).split(lengths, 1))]

    def _fill(self, nodes: Sequence[float], k: int) -> None:
        """Means of what layer k scatters, over blocks."""
        rows, columns = (n + 2 * self.half for n in self.size)
        if not self.samples:
            halo = self.scale * (1 + self.half)
            terms = torch.cat(self.frame.whole(halo).terms(nodes, k, self.with_room), 1)
            self.plane[:, :rows, :columns] = mean_of_blocks(terms, self.scale)[0]
            return
        self.plane.zero_()
        below = nodes[k - 1] if k > 0 else -torch.inf
        above = nodes[k + 1] if k + 1 < len(nodes) else torch.inf
        for sample in self.samples:
            sample.add(self.plane[:, :rows, :columns], nodes, k, below, above)


class _Blocks:
    """One sample of a frame, in blocks."""

    def __init__(self, coarse: Coarse, which: int) -> None:
        sample, frame = coarse.frame.samples[which], coarse.frame
        self.light, self.x = coarse.blocks(sample.light), coarse.blocks(sample.x)[0]
        self.weight = None if sample.weight is None else coarse.blocks(sample.weight)[0]
        self.known = None if frame.known is None else coarse.blocks(frame.known)[0]
        self.area, self.with_room = coarse.scale**2, coarse.with_room
        self.places: tuple[Tensor, ...] | None = None  # everywhere
        if which > 0 and sample.weight is not None:  # only in few places
            mean = mean_of_blocks(coarse.pixels(sample.weight), coarse.scale)[0]
            self.places = mean.nonzero(as_tuple=True)
            there = self.x.flatten(2)[..., (mean > 0).flatten()]
            low, high, mean = there.amin((0, 1)), there.amax((0, 1)), mean[self.places]
        else:
            x = coarse.pixels(sample.x)
            low, high = -max_of_blocks(-x, coarse.scale)[0], max_of_blocks(x, coarse.scale)[0]
            weight = torch.ones_like(x) if sample.weight is None else coarse.pixels(sample.weight)
            mean = mean_of_blocks(weight, coarse.scale)[0]
        self.low, self.high, self.mean = low, high, mean

    def add(self, plane: Tensor, nodes: Sequence[float], k: int, below: float, above: float) -> None:
        """Adds the means of layer k to ``[C, rows, columns]``."""
        colours = self.light.shape[0]
        partly = (self.high > below) & (self.low < above)
        if self.with_room:
            room: tuple[int | Tensor, ...] = (colours + 1, *(self.places or ()))
            plane[room] += self.mean * (self.low >= above)
        places = partly.nonzero(as_tuple=True)
        if self.places is not None:
            places = tuple(axis[places] for axis in self.places)
        for row, column in zip(*(p.split(_PIXELS_AT_ONCE // self.area) for p in places), strict=True):
            at = (..., row, column)
            x = self.x[at]
            here = share_at_or_behind(x, nodes, k)
            mine = here - share_at_or_behind(x, nodes, k + 1)
            # divided first, lest a sum overflows
            weight = 1.0 / self.area if self.weight is None else self.weight[at] / self.area
            here, mine = here * weight, mine * weight
            parts = [(self.light[at] * mine).sum((1, 2))]
            seen = mine if self.known is None else mine * self.known[at]
            if self.with_room:
                parts += [mine.sum((0, 1))[None], here.sum((0, 1))[None]]
            if not self.with_room or self.known is not None:
                parts.append(seen.sum((0, 1))[None])
            plane[at] += torch.cat(parts)
