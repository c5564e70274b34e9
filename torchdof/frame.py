"""The frame and its border, whole or in tiles: what the layers read from and are laid onto.

Tiles keep work where it is needed: a layer is computed only in tiles that its light can reach. While gradients are
recorded or code is traced, the whole frame is one window.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .background import BEHIND_STEP
from .layers import share_at_or_behind
from .plan import Blur, Plan
from .pool import max_around, max_of_blocks, mean_of_blocks

__all__ = [
    "TILE",
    "TILES_AT_ONCE",
    "Frame",
    "Patch",
    "Sample",
    "Window",
    "alike",
    "cut_tiles",
    "from_tiles",
    "in_tiles",
    "margin_and_align",
]

TILE = 64
"""Pixels of a tile along each axis."""
TILES_AT_ONCE = 48
"""Tiles computed together: what fits the cache."""
_CELL = 8  # occupancy is known in cells of this many pixels
_BLOCK = 4  # pixels a side that are looked at together to find occupied layers
_CHANNELS = 16  # channels that are spread together
_COVERED = 1e-5  # so little is left uncovered by rounding alone


@dataclasses.dataclass(frozen=True)
class Sample:
    """One surface a pixel.

    Args:
        light: ``[B, C, H, W]``.
        x: Its place on the blur axis (:mod:`torchdof.layers`), ``[B, 1, H, W]``.
        weight: ``[B, 1, H, W]``; None is 1.
    """

    light: Tensor
    x: Tensor
    weight: Tensor | None = None

    def each(self, change: Callable[[Tensor], Tensor]) -> "Sample":
        """The same change to each of its maps."""
        return Sample(change(self.light), change(self.x), None if self.weight is None else change(self.weight))


@dataclasses.dataclass(frozen=True)
class Window:
    """A part of the frame with the halo that a kernel needs, or several such parts as a batch."""

    samples: Sequence[Sample]
    known: Tensor | None
    independent: bool = False

    def terms(self, nodes: Sequence[float], k: int, with_room: bool) -> list[Tensor]:
        """What layer k scatters: light, share, and with ``with_room`` the share at or behind it and the seen share."""
        light, share, room = self._independent(nodes, k) if self.independent else self._shared(nodes, k)
        if not with_room:
            return [light, share if self.known is None else share * self.known]
        return [light, share, room] if self.known is None else [light, share, room, share * self.known]

    def part(self, some: Tensor | slice, less: int) -> "Window":
        """Some of the windows, with so many pixels less of halo."""

        def cut(values: Tensor) -> Tensor:
            values = values[..., less : values.shape[-2] - less, less : values.shape[-1] - less]
            return values[some] if isinstance(some, slice) else values.index_select(0, some)

        known = None if self.known is None else cut(self.known)
        return Window([s.each(cut) for s in self.samples], known, self.independent)

    def _shared(self, nodes: Sequence[float], k: int) -> tuple[Tensor, Tensor, Tensor]:
        light = share = room = None
        for sample in self.samples:
            here = share_at_or_behind(sample.x, nodes, k)
            mine = here - share_at_or_behind(sample.x, nodes, k + 1)
            if sample.weight is not None:
                here, mine = here * sample.weight, mine * sample.weight
            light = sample.light * mine if light is None else torch.addcmul(light, sample.light, mine)
            share, room = (mine, here) if share is None or room is None else (share + mine, room + here)
        if light is None or share is None or room is None:
            raise ValueError("a window needs at least one sample")
        return light, share, room

    def _independent(self, nodes: Sequence[float], k: int) -> tuple[Tensor, Tensor, Tensor]:
        """A pixel is there for layer k as far as what is at or behind it is known, but for what that has in front."""
        room = torch.ones_like(self.samples[0].x)
        left, unknown, stopped = room, room, []
        for sample in self.samples:  # near to far
            here = share_at_or_behind(sample.x, nodes, k)
            mine = here - share_at_or_behind(sample.x, nodes, k + 1)
            cover = room.new_ones(()) if sample.weight is None else sample.weight
            there = torch.where(here > 0, 1.0 - cover * (1.0 - here), 1.0)
            stops = cover * mine / there.clamp_min(1e-6)  # of what arrives at it in this layer
            stopped.append(left * stops)
            left, room = left * (1.0 - stops), room * there
            unknown = torch.where(here > 0, unknown * (1.0 - cover), unknown)
        light = torch.stack([s.light * (room * part) for s, part in zip(self.samples, stopped, strict=True)]).sum(0)
        return light, room * torch.stack(stopped).sum(0), room * (1.0 - unknown)


@dataclasses.dataclass(frozen=True)
class Patch:
    """Some tiles of a frame, at full resolution.

    Args:
        tiles: Their places on the canvas, ``[n]``.
        window: What they show, with a halo.
        halo: Its pixels on each side.
        layers: Layers whose light falls there, in the order they were asked for, each with the tiles that it falls in
            (of the n); a slice where these are neighbours, which need no copy.
    """

    tiles: Tensor
    window: Window
    halo: int
    layers: list[tuple[int, Tensor | slice]]


class Frame:
    """Surfaces of an image, continued over its border by what lies there; light outside is 0 and unknown.

    Args:
        samples: Surfaces a pixel, all of one size.
        margin: Pixels that the widest kernel reaches beyond a pixel.
        align: The frame is continued to a multiple of this.
        tiled: Cut the frame (of one item) into tiles; False keeps it as one window.
        extend: Continue light over the border as well, as if it were known.
        independent: The samples of a pixel, near to far, each cover it by their weight, whatever the others do. False:
            their weights are shares of the pixel.
        behind: Light behind all of them, at every :data:`torchdof.background.BEHIND_STEP`-th pixel of the frame or more
            ``[B, C, h, w]``; None: nothing is.
    """

    def __init__(
        self,
        samples: Iterable[Sample],
        margin: int,
        align: int,
        tiled: bool,
        extend: bool,
        independent: bool = False,
        behind: Tensor | None = None,
    ) -> None:
        self.independent, self.margin, self.tiled = independent, margin, tiled
        align = max(align, TILE) if tiled else align
        self.samples: list[Sample] = []
        for sample in samples:
            self.size: tuple[int, ...] = tuple(sample.x.shape[-2:])
            self.area = tuple((n + align - 1) // align * align for n in self.size)
            self.samples.append(self._continued(sample, extend))
        self.known: Tensor | None = None
        if not extend:
            inside = torch.ones_like(self.samples[0].x[:1, :, : self.size[0], : self.size[1]])
            self.known = functional.pad(inside, self._ends(margin))
        self.behind = behind
        if behind is not None and not tiled:
            light = _finer(behind)[..., : self.size[0], : self.size[1]]
            self.behind = functional.pad(light, self._ends(0), mode="replicate")
        self._occupied: list[Tensor] = []

    @classmethod
    def piece(
        cls, samples: Sequence[Sample], known: Tensor | None, behind: Tensor | None, margin: int, side: int
    ) -> "Frame":
        """A square part of a frame that has its margin already, but for what is behind, as a frame of its own."""
        frame = cls.__new__(cls)
        frame.size = frame.area = (side, side)
        frame.samples, frame.known, frame.margin, frame.tiled = list(samples), known, margin, False
        frame.independent, frame.behind = False, behind
        return frame

    def _ends(self, margin: int) -> tuple[int, int, int, int]:
        """Pixels by which an image is continued to the left, the right, above and below."""
        more = [area - size for area, size in zip(self.area, self.size, strict=True)]
        return margin, margin + more[1], margin, margin + more[0]

    def _continued(self, sample: Sample, extend: bool) -> Sample:
        ends = self._ends(self.margin)
        light = functional.pad(sample.light, ends, mode="replicate" if extend else "constant")
        weight = None if sample.weight is None else functional.pad(sample.weight, ends, mode="replicate")
        return Sample(light, functional.pad(sample.x, ends, mode="replicate"), weight)

    @property
    def colours(self) -> int:
        """C of the samples."""
        return int(self.samples[0].light.shape[1])

    def canvas(self, kernels: int, scale: int = 1) -> Tensor:
        """Nothing yet: light, and after it its coverage.

        Args:
            kernels: 1, or C where each colour has its own.
            scale: Every so many pixels count; a canvas coarser than the frame has one pixel more on each side. Not for
                frames in tiles.
        """
        return self.samples[0].light.new_zeros(self._canvas_shape(kernels, scale))

    def _canvas_shape(self, kernels: int, scale: int = 1) -> tuple[int, ...]:
        if self.tiled:
            return self.area[0] // TILE * (self.area[1] // TILE), self.colours + kernels, TILE, TILE
        ring = 0 if scale == 1 else 1
        return self.samples[0].light.shape[0], self.colours + kernels, *(n // scale + 2 * ring for n in self.area)

    def image(self, canvas: Tensor) -> Tensor:
        """What a canvas, or a part of its channels, shows: ``[B, C, H, W]``."""
        if self.tiled:
            canvas = from_tiles(canvas, self.area)
        return canvas[..., : self.size[0], : self.size[1]]

    def over_behind(self, canvas: Tensor, behind: Tensor) -> Tensor:
        """Light of a canvas where all layers are laid, over what is behind them, which shows where they leave gaps.

        Args:
            canvas: As :meth:`canvas`; it may be changed.
            behind: That of this frame.

        Returns:
            The canvas's first C channels.
        """
        light, covered = canvas.tensor_split((self.colours,), 1)
        if not self.tiled:
            return torch.addcmul(light, (1.0 - covered).clamp_min(0.0), behind)
        uncovered = covered.amin((1, 2, 3)) < 1.0 - _COVERED
        columns, step = self.area[1] // TILE, TILE // BEHIND_STEP
        for row, there in enumerate(uncovered.split(columns)):
            at = there.nonzero()[:, 0]
            if len(at):
                start, above = row * step, min(row, 1)
                strip = _finer(behind[:, :, start - above : start + step + 1])
                strip = strip[:, :, above * BEHIND_STEP :][:, :, :TILE, : self.area[1]]
                strip = functional.pad(strip, (0, self.area[1] - strip.shape[3], 0, TILE - strip.shape[2]))
                tiles = row * columns + at
                left = (1.0 - covered[tiles]).clamp_min(0.0)
                light[tiles] = torch.addcmul(light[tiles], left, in_tiles(strip)[at])
        return light

    def at(self, scattered: Tensor, places: Tensor | None) -> Tensor:
        """What was scattered in a window, as tiles where the canvas is made of tiles."""
        if places is None or scattered.shape[-2:] == (TILE, TILE):
            return scattered
        return in_tiles(scattered)[places]

    def groups(self, plan: Plan, blurs: Sequence[Blur]) -> list[list[int]]:
        """Layers that are spread together, far to near: in a whole frame as many as fill the channels."""
        order = list(reversed(range(len(plan.nodes))))
        if self.tiled:
            self._occupied = self.occupancy(plan, blurs)
            return [[k] for k in order if bool(self._occupied[k].any())]
        if not _traced():
            order = [k for k in order if bool(self.any_share(plan, [k], self.margin))]
        each = (self.samples[0].light.shape[1] + 3) if blurs[0].kernel.shape[0] == 1 else _CHANNELS
        groups: list[list[int]] = []
        for k in order:
            last = groups[-1] if groups else []
            fits = last and (len(last) + 1) * each <= _CHANNELS and alike(plan, blurs, last[0], k)
            widths = [blurs[j].kernel.shape[-1] for j in [*last, k]]
            if fits and max(widths) ** 2 <= 2 * min(widths) ** 2:
                last.append(k)
            else:
                groups.append([k])
        return groups

    def terms(
        self, plan: Plan, blurs: Sequence[Blur], group: Sequence[int], with_room: bool
    ) -> Iterator[tuple[Tensor | None, list[list[Tensor]]]]:
        """What the layers of a group scatter, at their resolution, with a halo as wide as their kernels reach.

        Yields the tiles it belongs to, None if it is the frame, and for each layer what :meth:`Window.terms` returns.
        """
        scale = blurs[group[0]].scale
        window = self.whole(max(blurs[k].halo for k in group))
        layers = [window.terms(plan.nodes, k, with_room) for k in group]
        if scale > 1:
            each, lengths = len(layers[0]), [part.shape[1] for parts in layers for part in parts]
            parts = mean_of_blocks(torch.cat([part for parts in layers for part in parts], 1), scale).split(lengths, 1)
            layers = [list(parts[i : i + each]) for i in range(0, len(parts), each)]
        yield self._occupied[group[0]].flatten().nonzero()[:, 0] if self.tiled else None, layers

    def whole(self, halo: int) -> Window:
        """The frame as one window."""
        return self._window(halo, None, True)

    def is_wide(self, k: int, halo: int) -> bool:
        """Whether a layer is better spread in the whole frame than in patches."""
        count = int(self._occupied[k].sum())
        return halo > TILE or count * (TILE + 2 * halo) ** 2 > math.prod(n + 2 * halo for n in self.area)

    def patches(self, blurs: Sequence[Blur], layers: Sequence[int]) -> Iterator[Patch]:
        """Tiles that light of some layers falls in, a few at once: all layers find what is there in the cache."""
        occupied = torch.stack([self._occupied[k].flatten() for k in layers])
        halos = torch.tensor([blurs[k].halo for k in layers], device=occupied.device)
        halo = (occupied * halos[:, None]).amax(0)
        every, columns = torch.arange(len(halo), device=occupied.device), self.area[1] // TILE
        row, column = every // columns * TILE, every % columns * TILE
        inside = (row >= halo) & (row + TILE + halo <= self.size[0])
        inside &= (column >= halo) & (column + TILE + halo <= self.size[1])
        single = self._single(-(-halo // _CELL))
        places = occupied.any(0).nonzero()[:, 0]
        for there in occupied.flip(0).to(torch.int8):  # tiles of alike layers together
            places = places[torch.sort(there[places], stable=True)[1]]
        for border, alone in itertools.product((False, True), repeat=2):
            chosen = places[((inside != border) & (single == alone))[places]]
            for tiles in chosen.split(TILES_AT_ONCE) if len(chosen) else ():
                widest, there = int(halo[tiles].max()), occupied[:, tiles]
                counts = zip(layers, there, there.sum(1).tolist(), strict=True)
                some = [(k, _places(at)) for k, at, n in counts if n]
                yield Patch(tiles, self._window(widest, tiles, border, alone), widest, some)

    def _single(self, reach: Tensor) -> Tensor:
        """Tiles ``[tiles]`` that show the first sample alone, whole, as do so many cells around each."""
        m, (height, width) = self.margin, self.area
        other = self.samples[0].x.new_zeros(height // _CELL, width // _CELL)
        for i, s in enumerate(self.samples):
            if i == 0 and s.weight is None:
                continue
            weight = torch.ones_like(s.x) if s.weight is None else s.weight
            there = weight[0, 0, m : m + height, m : m + width]
            other = torch.maximum(other, max_of_blocks(1.0 - there if i == 0 else there, _CELL))
        single = torch.zeros_like(reach, dtype=torch.bool)
        for cells in reach.unique().tolist():
            single |= (reach == cells) & (_near_tiles(other, cells).flatten() == 0)
        return single

    def _window(self, halo: int, places: Tensor | None, known: bool, single: bool = False) -> Window:
        def cut(values: Tensor) -> Tensor:
            return self._cut(values, halo, places)

        first = self.samples[0]
        samples = [Sample(first.light, first.x)] if single else self.samples
        seen = cut(self.known) if known and self.known is not None else None
        return Window([s.each(cut) for s in samples], seen, self.independent)

    def _cut(self, values: Tensor, halo: int, places: Tensor | None) -> Tensor:
        start = self.margin - halo
        values = values[..., start : start + self.area[0] + 2 * halo, start : start + self.area[1] + 2 * halo]
        if places is None:
            return values
        return cut_tiles(values, halo, places)

    def any_share(self, plan: Plan, group: Sequence[int], halo: int) -> Tensor:
        """Whether a pixel of the frame, or up to ``halo`` outside it, lies in these layers, which are neighbours."""
        ends = (-torch.inf, *plan.nodes, torch.inf)
        low, high = ends[min(group)], ends[max(group) + 2]
        places = [self._cut(s.x, halo, None) for s in self.samples]
        return torch.stack([((x > low) & (x < high)).any() for x in places]).any()

    def occupancy(self, plan: Plan, blurs: Sequence[Blur]) -> list[Tensor]:
        """For each layer, the tiles that its light can reach: ``[rows, columns]``."""
        height, width = self.area
        count = len(plan.nodes)
        nodes = torch.tensor(plan.nodes, device=self.samples[0].x.device, dtype=self.samples[0].x.dtype)
        present = nodes.new_zeros(height // _CELL * (width // _CELL) * count)
        row, column = (torch.arange(0, n, _BLOCK, device=nodes.device) // _CELL for n in (height, width))
        cells = (row[:, None] * (width // _CELL) + column) * count

        def mark(x: Tensor, at: Tensor) -> Tensor:
            below = (torch.bucketize(x, nodes, right=True) - 1).clamp(0, count - 1)
            for layer in (below, below + (x > nodes[below])):
                present.index_fill_(0, (at + layer.clamp(max=count - 1)).flatten(), 1.0)
            return below

        m, first = self.margin, None
        for s in self.samples:
            x = s.x[0, 0, m : m + height, m : m + width]
            if first is not None and s.weight is not None:  # what is not there counts as what is
                x = torch.where(s.weight[0, 0, m : m + height, m : m + width] > 0, x, first)
            first = x if first is None else first
            blocks = x.unflatten(0, (-1, _BLOCK))
            low, high = (most(most(blocks, 1).unflatten(1, (-1, _BLOCK)), 2) for most in (torch.amin, torch.amax))
            # blocks that span neighbouring nodes are told by their ends, others are looked into
            spanned = mark(high, cells) - mark(low, cells) > 1
            r, c = spanned.nonzero(as_tuple=True)
            pixels = blocks.unflatten(2, (-1, _BLOCK)).permute(0, 2, 1, 3)[r, c].flatten(1)
            mark(pixels, cells[r, c, None])
        occupied = []
        for layer, blur in zip(present.unflatten(0, (height // _CELL, -1, count)).permute(2, 0, 1), blurs, strict=True):
            occupied.append(_near_tiles(layer, -(-blur.halo // _CELL)) > 0)
        return occupied


def _places(there: Tensor) -> Tensor | slice:
    """Where there is anything; a slice if that is in one piece.

    Example:
        >>> _places(torch.tensor([False, True, True])), _places(torch.tensor([True, False, True]))
        (slice(1, 3, None), tensor([0, 2]))
    """
    at = there.nonzero()[:, 0]
    first, last = int(at[0]), int(at[-1])
    return slice(first, last + 1) if len(at) == last + 1 - first else at


def _near_tiles(cells: Tensor, reach: int) -> Tensor:
    """Largest value of the cells of each tile and of so many around it: ``[rows, columns]``."""
    return max_of_blocks(max_around(cells, reach), TILE // _CELL)


def _finer(light: Tensor) -> Tensor:
    """Light at every so many pixels, as it lies behind a frame, at each."""
    return functional.interpolate(light, scale_factor=float(BEHIND_STEP), mode="bilinear", align_corners=False)


def in_tiles(values: Tensor) -> Tensor:
    """``[1, C, H, W]`` -> ``[tiles, C, TILE, TILE]``, row by row."""
    return values[0].unfold(1, TILE, TILE).unfold(2, TILE, TILE).permute(1, 2, 0, 3, 4).flatten(0, 1)


def from_tiles(tiles: Tensor, area: Sequence[int]) -> Tensor:
    """``[tiles, C, TILE, TILE]`` of an area -> ``[1, C, H, W]``."""
    rows, columns = area[0] // TILE, area[1] // TILE
    return tiles.unflatten(0, (rows, columns)).permute(2, 0, 3, 1, 4).reshape(1, -1, *area)


def cut_tiles(values: Tensor, halo: int, places: Tensor, tile: int = TILE) -> Tensor:
    """Some tiles with their halo, ``[n, C, tile + 2 halo, tile + 2 halo]``, of ``[1, C, H + 2 halo, W + 2 halo]``."""
    side, columns = tile + 2 * halo, (values.shape[-1] - 2 * halo) // tile
    _, *steps = values.stride()
    shape, first = (values.shape[1], side, side), values.storage_offset()
    corners = [(place // columns * tile, place % columns * tile) for place in places.tolist()]
    # one view a tile: slicing would make three
    return torch.stack([values.as_strided(shape, steps, first + y * steps[1] + x * steps[2]) for y, x in corners])


def margin_and_align(blurs: Sequence[Blur]) -> tuple[int, int]:
    """What :class:`Frame` needs for these layers: pixels on each side, and what they and the frame are multiples of."""
    align = max(blur.scale for blur in blurs)
    return -(-max(blur.halo for blur in blurs) // align) * align, align


def alike(plan: Plan, blurs: Sequence[Blur], j: int, k: int) -> bool:
    """Whether two layers go on one canvas: at full resolution all do, else what is between must not matter.

    So these are of one resolution and on one side of the focus.
    """
    scale, other = blurs[j].scale, blurs[k].scale
    return scale == other and (scale == 1 or (plan.nodes[j] < 0) == (plan.nodes[k] < 0))


def _traced() -> bool:
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()
