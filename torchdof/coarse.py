"""Layers that are spread at a coarser resolution, on frames in tiles.

What a layer scatters is averaged to its resolution before anything else. Its own pixels are few, so only blocks of
pixels that it lies in are looked at; all else is known from the least and the largest coc of a block.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .frame import TILE, TILES_AT_ONCE, Frame, cut_tiles, from_tiles
from .layers import share_at_or_behind
from .plan import Blur, Plan
from .pool import max_of_blocks, mean_of_blocks, min_of_blocks

__all__ = ["Coarse"]

_PIXELS_AT_ONCE = 2**18  # of blocks that are averaged together: what fits the cache


class Coarse:
    """A frame at every ``scale``-th pixel, and one such pixel beyond it on each side.

    Args:
        frame: The frame, in tiles.
        scale: A power of two.
        half: Pixels of that resolution which the widest kernel reaches.
        plan: Where the layers are.
        layers: Those that are looked at.
        with_room: As in :meth:`torchdof.frame.Frame.terms`.
    """

    def __init__(self, frame: Frame, scale: int, half: int, plan: Plan, layers: range, with_room: bool) -> None:
        self.frame, self.scale, self.half, self.with_room = frame, scale, half, with_room
        self.size = tuple(n // scale + 2 for n in frame.area)
        self.area = tuple(-(-n // TILE) * TILE for n in self.size)
        channels = frame.colours + (1 if not with_room else 2 if frame.known is None else 3)
        height, width = (n + 2 * half for n in self.area)
        self.plane = frame.samples[0].light.new_zeros(channels, height, width)
        self.start = frame.margin - scale * (1 + half)  # the pixel of the frame with its margin at which blocks begin
        self.room = torch.zeros_like(self.plane[0])  # what lies wholly behind the layer that is looked at
        count = 0 if frame.independent else len(frame.samples)
        self.pieces = [some for i in range(count) for some in _Blocks(self, i, plan.nodes, layers).pieces]

    def pixels(self, values: Tensor) -> Tensor:
        """What of a frame with its margin lies in blocks: ``[1, C, ...] -> [C, scale * rows, scale * columns]``."""
        rows, columns = (slice(self.start, self.start + self.scale * (n + 2 * self.half)) for n in self.size)
        return values[0, :, rows, columns]

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
        places = plane[0, colours].unfold(0, side, TILE).unfold(1, side, TILE).amax((2, 3)).flatten().nonzero()[:, 0]
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
        if not self.pieces:
            halo = self.scale * (1 + self.half)
            terms = torch.cat(self.frame.whole(halo).terms(nodes, k, self.with_room), 1)
            self.plane[:, :rows, :columns] = mean_of_blocks(terms, self.scale)[0]
            return
        self.plane.zero_()
        if self.with_room:
            for pieces in self.pieces:
                pieces.add_behind(self.room.view(-1), k)
            self.plane[self.frame.colours + 1] = self.room
        for pieces in self.pieces:
            pieces.add(self.plane.flatten(1), nodes, k, self.with_room)


@dataclasses.dataclass
class _Pieces:
    """Parts of blocks that lie between two nodes each, from the nearest to the farthest.

    Args:
        at: Flat index of each one's block, ``[n]``.
        low: Least place in it, ``[n]``.
        high: Greatest place in it, ``[n]``; None: it has but one.
        whole: Its part of its block's means of light and 1, ``[C + 1, n]``.
        partly: The same times where between least and greatest a pixel lies, 0 to 1; None: as ``high``.
        known: 1 where its light is known, 0 where it is not, ``[n]``; None: all is.
        before: Number of those that lie before each node, but for what is too near for all layers.
        behind: Those from this node on are behind the layer that was looked at last.
    """

    at: Tensor
    low: Tensor
    high: Tensor | None
    whole: Tensor
    partly: Tensor | None
    known: Tensor | None
    before: list[int]
    behind: int

    def add_behind(self, room: Tensor, k: int) -> None:
        """Adds the share of those that have come to lie wholly behind layer k to ``[places]``."""
        some = slice(self.before[k + 1], self.before[self.behind])
        room.index_add_(0, self.at[some], self.whole[-1, some])
        self.behind = k + 1

    def add(self, terms: Tensor, nodes: Sequence[float], k: int, with_room: bool) -> None:
        """Adds what layer k scatters of them to ``[channels, places]``."""
        some = slice(self.before[max(k - 1, 0)], self.before[k + 1])
        whole, first = self.whole[:, some], _share(self.low[some], nodes, k)
        light = first * whole  # the share at a pixel is ``first + more * its part``
        if self.high is not None and self.partly is not None:
            more = _share(self.high[some], nodes, k) - first
            light = torch.addcmul(light, more, self.partly[:, some])
        light, share = light[:-1], light[-1]
        seen = share if self.known is None else share * self.known[some]
        front = self.before[k] - some.start  # so many lie before the layer's node
        here = torch.cat([share[:front], whole[-1, front:]])
        at = self.at[some]
        for channel, term in zip(terms, [*light, share, here, seen] if with_room else [*light, seen], strict=False):
            channel.index_add_(0, at, term)


def _share(x: Tensor, nodes: Sequence[float], k: int) -> Tensor:
    """Share in layer k at places."""
    return share_at_or_behind(x, nodes, k) - share_at_or_behind(x, nodes, k + 1)


class _Blocks:
    """One sample of a frame, in blocks, for some layers.

    Between two nodes the share of a layer is linear in a pixel's place. So what a layer scatters of a block that lies
    between two nodes follows from means over the block; blocks in which a node lies are taken apart into pixels.
    """

    def __init__(self, coarse: Coarse, which: int, nodes: Sequence[float], layers: range) -> None:
        self.sample, self.known, self.scale = coarse.frame.samples[which], coarse.frame.known, coarse.scale
        self.layers, self.nodes = layers, torch.tensor(nodes, device=self.sample.x.device, dtype=self.sample.x.dtype)
        x = coarse.pixels(self.sample.x)
        low, high = min_of_blocks(x, self.scale), max_of_blocks(x, self.scale)
        weight = torch.ones_like(low) if self.sample.weight is None else coarse.pixels(self.sample.weight)
        mean = weight if self.sample.weight is None else mean_of_blocks(weight, self.scale)
        near, far = (self._end(end) for end in (layers.start - 1, layers.stop))
        behind = low >= far
        if coarse.with_room:
            coarse.room[: low.shape[-2], : low.shape[-1]] += (mean * behind)[0]
        at = ((high > near) & ~behind & (mean > 0)).flatten().nonzero()[:, 0]
        row, column = at // low.shape[-1], at % low.shape[-1]
        low, high = low.flatten()[at], high.flatten()[at]
        after = torch.bucketize(low, self.nodes, right=True)  # the next node
        plain = high <= functional.pad(self.nodes, (0, 1), value=torch.inf)[after]
        known = None
        if self.known is not None:
            known = mean_of_blocks(coarse.pixels(self.known), self.scale).flatten()[at]
            plain &= (known == 0) | (known == 1)
        across = self.sample.x.shape[-1]
        corner = (coarse.start + row * self.scale) * across + coarse.start + column * self.scale
        step = torch.arange(self.scale, device=at.device)
        self.pixels = (step[:, None] * across + step).flatten()[:, None]
        at = row * coarse.plane.shape[-1] + column

        order, before = self._in_order(after, plain)
        parts = [
            self._means(low[some], high[some], corner[some]) for some in order.split(_PIXELS_AT_ONCE // self.scale**2)
        ]
        whole, partly = torch.cat(parts, 1).chunk(2)
        blocks = _Pieces(
            at[order],
            low[order],
            high[order],
            whole,
            partly,
            None if known is None else known[order],
            before,
            layers.stop,
        )
        self.pieces = [blocks, self._apart(coarse, at[~plain], corner[~plain], near, far)]

    def _apart(self, coarse: Coarse, at: Tensor, corner: Tensor, near: float, far: float) -> _Pieces:
        """The pixels of blocks in which a node lies."""
        pixels = (corner + self.pixels).flatten()
        at = at.expand(self.scale**2, -1).flatten()
        x, weight = self._at(self.sample.x, pixels)[0], self._weight(pixels)
        if coarse.with_room:
            coarse.room.view(-1).index_add_(0, at, weight * (x >= far))
        order, before = self._in_order(
            torch.bucketize(x, self.nodes, right=True), (x > near) & (x < far) & (weight > 0)
        )
        pixels, weight = pixels[order], weight[order]
        whole = torch.cat([self._at(self.sample.light, pixels) * weight, weight[None]])
        known = None if self.known is None else self._at(self.known, pixels)[0]
        return _Pieces(at[order], x[order], None, whole, None, known, before, self.layers.stop)

    def _in_order(self, after: Tensor, there: Tensor) -> tuple[Tensor, list[int]]:
        """Indices of those that are there, by the next node, and how many of them lie before each node."""
        count = len(self.nodes) + 1
        # short numbers are sorted fast
        order = torch.sort(torch.where(there, after, count).to(torch.int16), stable=True)[1]
        before = torch.bincount(after[there], minlength=count).cumsum(0).tolist()
        first = before[max(self.layers.start - 1, 0)]
        return order[first : before[self.layers.stop]], [n - first for n in before]

    def _end(self, node: int) -> float:
        """Place of a node; beyond the last ones there is none."""
        return -torch.inf if node < 0 else torch.inf if node >= len(self.nodes) else float(self.nodes[node])

    def _means(self, low: Tensor, high: Tensor, corner: Tensor) -> Tensor:
        """Of blocks the means of light and 1, and those times where a pixel lies between the block's ends, 0 to 1."""
        pixels = corner + self.pixels
        part = (self._at(self.sample.x, pixels)[0] - low) / (high - low).clamp_min(1e-12)
        weight = self._weight(pixels)
        terms = torch.cat([self._at(self.sample.light, pixels) * weight, weight[None]])
        return torch.cat([terms.sum(1), (terms * part).sum(1)])

    def _weight(self, pixels: Tensor) -> Tensor:
        """Of a block, that a pixel's surface covers; it comes first, lest a sum overflows."""
        if self.sample.weight is None:
            return self.sample.x.new_full(pixels.shape, 1.0 / self.scale**2)
        return self._at(self.sample.weight, pixels)[0] / self.scale**2

    @staticmethod
    def _at(values: Tensor, pixels: Tensor) -> Tensor:
        """Values of some pixels, ``[C, *pixels.shape]``."""
        return values[0].flatten(1).index_select(1, pixels.flatten()).unflatten(1, pixels.shape)
