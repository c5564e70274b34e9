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
        self.start = frame.margin - scale * (
            1 + half
        )  # pixel of the frame with its margin where the first block begins
        self.room = torch.zeros_like(self.plane[0])  # the share behind all of the layers
        count = 0 if frame.independent else len(frame.samples)
        self.samples = [_Blocks(self, i, plan.nodes, layers) for i in range(count)]

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
        if self.with_room:
            self.plane[self.frame.colours + 1] = self.room
        for sample in self.samples:
            sample.add(self.plane.flatten(1), nodes, k)


class _Blocks:
    """One sample of a frame, in blocks, for some layers.

    Between two nodes the share of a layer is linear in a pixel's place. So what a layer scatters of a block that lies
    between two nodes follows from moments of the block; blocks in which a node lies are looked at pixel by pixel.
    """

    def __init__(self, coarse: Coarse, which: int, nodes: Sequence[float], layers: range) -> None:
        frame, scale = coarse.frame, coarse.scale
        self.sample, self.known = frame.samples[which], frame.known
        self.area, self.with_room = scale**2, coarse.with_room
        x = coarse.pixels(self.sample.x)
        low, high = -max_of_blocks(-x, scale), max_of_blocks(x, scale)
        weight = torch.ones_like(low) if self.sample.weight is None else coarse.pixels(self.sample.weight)
        mean = weight if self.sample.weight is None else mean_of_blocks(weight, scale)
        near = nodes[layers.start - 1] if layers.start > 0 else -torch.inf
        far = nodes[layers.stop] if layers.stop < len(nodes) else torch.inf
        if self.with_room:
            coarse.room[: low.shape[-2], : low.shape[-1]] += (mean * (low >= far))[0]
        at = ((high > near) & (low < far) & (mean > 0)).flatten().nonzero()[:, 0]
        self.low, self.high, self.mean = low.flatten()[at], high.flatten()[at], mean.flatten()[at]
        row, column = at // low.shape[-1], at % low.shape[-1]
        self.at = row * coarse.plane.shape[-1] + column
        across = self.sample.x.shape[-1]
        self.corner = (coarse.start + row * scale) * across + coarse.start + column * scale
        step = torch.arange(scale, device=at.device)
        self.pixels = (step[:, None] * across + step).flatten()[:, None]

        axis = torch.tensor(nodes, device=low.device, dtype=low.dtype)
        after = torch.bucketize(self.low, axis, right=True)  # the next node
        plain = self.high <= functional.pad(axis, (0, 1), value=torch.inf)[after]
        if self.known is not None:
            seen = mean_of_blocks(coarse.pixels(self.known), scale).flatten()[at]
            plain &= (seen == 0) | (seen == 1)
        # by the next node, the mixed ones last; short numbers are sorted fast
        order = torch.sort(torch.where(plain, after, len(nodes) + 1).to(torch.int16), stable=True)[1]
        count = torch.bincount(after[plain], minlength=len(nodes) + 1).cumsum(0).tolist()
        first = count[max(layers.start - 1, 0)]
        self.plain, self.mixed = order[first : count[layers.stop]], order[count[-1] :]
        self.before = [n - first for n in count]
        moments = [self._moments(some) for some in self.plain.split(_PIXELS_AT_ONCE // self.area)]
        self.moments = torch.cat(moments, 1)
        self.seen = None if self.known is None else seen[self.plain]

    def add(self, terms: Tensor, nodes: Sequence[float], k: int) -> None:
        """Adds the means of layer k to ``[channels, places]``."""
        below = nodes[k - 1] if k > 0 else -torch.inf
        above = nodes[k + 1] if k + 1 < len(nodes) else torch.inf
        if self.with_room:
            colours = self.sample.light.shape[1]
            terms[colours + 1].index_add_(0, self.at, self.mean * (self.low >= above))
        some = slice(self.before[max(k - 1, 0)], self.before[k + 1])
        self._add_plain(terms, self.plain[some], some, nodes[k], below, above)
        mixed = self.mixed[(self.high[self.mixed] > below) & (self.low[self.mixed] < above)]
        for part in mixed.split(_PIXELS_AT_ONCE // self.area):
            self._add_mixed(terms, part, nodes, k)

    def _add_plain(self, terms: Tensor, which: Tensor, some: slice, node: float, below: float, above: float) -> None:
        """Blocks between the node of a layer and one beside it: the share at a pixel is ``first + more * its part``."""
        low, behind = self.low[which], self.low[which] >= node
        from_, gap = torch.where(behind, node, below), torch.where(behind, above - node, node - below)
        first, more = (low - from_) / gap, (self.high[which] - low) / gap
        first, more = torch.where(behind, 1.0 - first, first), torch.where(behind, -more, more)
        whole, part = self.moments[:, some].chunk(2)
        light = first * whole + more * part
        light, share = light[:-1], light[-1]
        here = torch.where(behind, whole[-1], share)
        seen = share if self.seen is None else share * self.seen[some]
        self._put(terms, self.at[which], light, share, here, seen)

    def _add_mixed(self, terms: Tensor, which: Tensor, nodes: Sequence[float], k: int) -> None:
        """Blocks in which a node lies, pixel by pixel."""
        pixels = self.corner[which] + self.pixels  # [scale * scale, n]
        x, weight = self._at(self.sample.x, pixels)[0], self._weight(pixels)
        here = share_at_or_behind(x, nodes, k)
        mine = (here - share_at_or_behind(x, nodes, k + 1)) * weight
        light = (self._at(self.sample.light, pixels) * mine).sum(1)
        seen = mine if self.known is None else mine * self._at(self.known, pixels)[0]
        self._put(terms, self.at[which], light, mine.sum(0), (here * weight).sum(0), seen.sum(0))

    def _put(self, terms: Tensor, at: Tensor, light: Tensor, share: Tensor, here: Tensor, seen: Tensor) -> None:
        every = [*light, share, here, seen] if self.with_room else [*light, seen]
        for channel, term in zip(terms, every, strict=False):
            channel.index_add_(0, at, term)

    def _moments(self, which: Tensor) -> Tensor:
        """Of blocks the means of light and 1, and those times where a pixel lies between the block's ends, 0 to 1."""
        pixels = self.corner[which] + self.pixels
        low = self.low[which]
        part = (self._at(self.sample.x, pixels)[0] - low) / (self.high[which] - low).clamp_min(1e-12)
        weight = self._weight(pixels)
        terms = torch.cat([self._at(self.sample.light, pixels) * weight, weight[None]])
        return torch.cat([terms.sum(1), (terms * part).sum(1)])

    def _weight(self, pixels: Tensor) -> Tensor:
        # divided first, lest a sum overflows
        if self.sample.weight is None:
            return self.sample.x.new_full(pixels.shape, 1.0 / self.area)
        return self._at(self.sample.weight, pixels)[0] / self.area

    @staticmethod
    def _at(values: Tensor, pixels: Tensor) -> Tensor:
        """Values of some pixels, ``[C, *pixels.shape]``."""
        return values[0].flatten(1).index_select(1, pixels.flatten()).unflatten(1, pixels.shape)
