"""The operations of exported graphs, in place of those of eager code (:mod:`torchdof.render.engines.ops`).

A graph cannot choose its work before it runs. In a loop over tiles each step reads a small window; branches skip layers
without pixels in the window, and the whole tile if it is in focus.
"""

import functools
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import pixels
from torchdof.optics.blur_table import BlurTable
from torchdof.pixels import Selected
from torchdof.render.engines.ops import Level, Ops, Seen, Step
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.disocclusion import counted_behind, is_another_surface, mean_behind, search
from torchdof.render.surfaces.frame import Highlights, PaddedFrame, PaddedSurface

from .rays import kernels_of, splat
from .structure import carried, choose, collect, last, operator, steps

__all__ = ["GraphOps", "WholeOps"]

_TILES = ((96, 192), (128, 256), (256, 256))
"""Rows and columns of a tile in pixels, for narrow and wide kernels. A map of a tile fits into the processor's caches.
In most pictures depth changes less along a row than along a column, so that a wide tile has few layers."""
_PART = 1024  # pixels of a list in one step; larger: fewer steps, more memory


class GraphOps(Ops):
    """Operations that use a branch for work that only some frames need, and a loop for work on parts of a frame.

    The kernels of layers and highlights are made before tracing and become constants of the graph. ``layered`` blurs
    layers at coarser resolutions where that is accurate enough; ``lens_width`` is the image width in pixels for the
    kernels of a table with lengths.
    """

    def __init__(self, plan: Plan, table: BlurTable, layered: bool, lens_width: int | None) -> None:
        self.lens_width = lens_width
        self.kernels = plan.constants(table, layered, lens_width or 1)
        self.rays = kernels_of(table, plan, lens_width or 1)

    def equal_unless(self, needed: Callable[[], Tensor], result: Tensor, given: Tensor) -> Tensor:
        """A branch."""
        return choose(needed(), result, given)

    def repeated(self, step: Step, state: Sequence[Tensor], times: int) -> Sequence[Tensor]:
        """A loop that ends early."""
        number = steps(times)
        before = carried(number, _packed(state))
        after, continues = step(_unpacked(before, state), False)
        return _unpacked(last(number, before, _packed(after), continues), state)

    def by_parts(self, look: Callable[[Tensor], Tensor], pixels: Tensor) -> Tensor:
        """A loop over parts of the list, because each pixel has many neighbours."""
        count = pixels.shape[0]
        parts = count // _PART + 1  # at least 1: an empty result has no shape in runtimes
        step = steps(parts)
        padded = torch.cat([pixels, pixels.new_zeros(1)])
        index = torch.minimum(step * _PART + torch.arange(_PART), torch.scalar_tensor(count, dtype=torch.int64))
        results = look(padded.index_select(0, index))
        lists = collect(step, results[None], parts).transpose(0, 1).flatten(1)
        ends = [torch.tensor([0]), torch.scalar_tensor(count, dtype=torch.int64).reshape(1), torch.tensor([1])]
        return operator("Slice", [lists, *ends], (results.shape[0], count))

    def seen(
        self, look: Callable[[Sequence[Level], Tensor], Seen], levels: Sequence[Level], coc_px: Tensor, mask: Tensor
    ) -> Seen:
        """Tile by tile, and only in tiles with pixels of the mask behind which a surface may lie."""
        size = (coc_px.shape[-2], coc_px.shape[-1])
        covered = [levels[0].step * n for n in levels[0].values.shape[-2:]]  # px; the levels are centred on the image
        side = _TILES[0]
        counts, missing = _counts(covered, side)
        top, left = ((w - n) // 2 for w, n in zip(covered, size, strict=True))
        halves = [torch.scalar_tensor((w - n) % 2, dtype=coc_px.dtype) for w, n in zip(covered, size, strict=True)]
        ends = [left, covered[1] + missing[1] - size[1] - left, top, covered[0] + missing[0] - size[0] - top]
        padded = functional.pad(torch.cat([coc_px, mask], 1), ends, mode="replicate")
        tiles = _Tiles(padded.shape[0], *counts)
        coc_px, mask = tiles.window(padded, side, 0).split(1, 1)
        windows, behind = [], []
        for level in levels:
            ends = [1, 1 + missing[1] // level.step, 1, 1 + missing[0] // level.step]
            of_level = (side[0] // level.step, side[1] // level.step)
            values = tiles.window(functional.pad(level.values, ends, mode="replicate"), of_level, 1)
            windows.append(values)
            samples = _samples(values, side, level.step, (halves[0], halves[1]))
            parts = [counted_behind(sample, share, coc_px) for sample, share in samples]
            behind.append(mean_behind(*(functools.reduce(torch.add, each) for each in zip(*parts, strict=True))))
        lights, weights = (torch.stack(parts) for parts in zip(*behind, strict=True))
        surfaces = torch.cat(search(levels, lights, weights, coc_px), 1)
        nearest = torch.stack([values[:, -2].max() for values in windows]).max()
        hides = (mask.max() > 0) & (is_another_surface(nearest - coc_px.min()) > 0)
        tile = choose(hides, surfaces, torch.zeros_like(surfaces))
        # narrow() instead of slices: tracing then knows the sizes of the result
        maps = tiles.joined(tile).narrow(-2, top, size[0]).narrow(-1, left, size[1])
        return maps[:, :-1], maps[:, -1:]

    def splat(
        self,
        splat_all: Callable[[], Tensor],
        rays: Highlights,
        coc_px: Tensor,
        obstacles: Sequence[tuple[Tensor, Tensor]],
    ) -> Tensor:
        """A loop over parts of the highlights, if there are any."""
        splats = splat(rays, coc_px, obstacles, self.rays)
        # broadcasts over the frame without taking its memory
        nothing = rays.coc_px.new_zeros(coc_px.shape[0], len(rays.light), 1, 1)
        return choose(torch.ones_like(rays.pixels).sum() > 0, splats, nothing)

    def render(self, frame: PaddedFrame, render: Callable[[PaddedFrame], Tensor]) -> Tensor:
        """A loop over tiles, each rendered as a frame of its own unless it is sharp."""
        margin = frame.margin
        size = next((tile for tile in _TILES if margin <= tile[0] // 2), _TILES[-1])
        counts, missing = _counts(frame.area, size)
        # pixels added to complete the tiles are farther from the frame than its margin, and have no effect in it
        ends = (0, missing[1], 0, missing[0])
        tiles = _Tiles(frame.surfaces[0].light.shape[0], *counts)

        def window(values: Tensor, margin: int) -> Tensor:
            return tiles.window(functional.pad(values, ends, mode="replicate"), size, margin)

        surfaces = [PaddedSurface(*(window(t, margin) for t in s if t is not None)) for s in frame.surfaces]
        behind = None if frame.behind is None else window(frame.behind, 0)
        inside = (..., slice(margin, margin + size[0]), slice(margin, margin + size[1]))
        tile_frame = PaddedFrame(surfaces, frame.nodes, frame.ramps, behind, margin, size, size, frame.occlusion)
        rendered, sharp = render(tile_frame), surfaces[0].light[inside]
        weights = int(rendered.shape[1]) - frame.colours  # of the light, in further channels; 1 where it is sharp
        if weights:
            sharp = torch.cat([sharp, torch.ones_like(sharp[:, :weights])], 1)
        is_blurred = torch.stack([s.x.abs().max() for s in surfaces]).max() > 0
        return tiles.joined(choose(is_blurred, rendered, sharp))[..., : frame.size[0], : frame.size[1]]


def _packed(state: Sequence[Tensor]) -> Tensor:
    """Tensors of any shape as one list."""
    return torch.cat([part.reshape(-1) for part in state])


def _unpacked(packed: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Tensors of four dimensions of the same shapes as others."""
    parts, start = [], 0
    for shape in (part.shape for part in like):
        count = shape[0] * shape[1] * shape[2] * shape[3]
        parts.append(packed.narrow(0, start, count).reshape(shape))
        start = start + count
    return parts


def _counts(area: Sequence[int], size: tuple[int, int]) -> tuple[list[int], list[int]]:
    """Rows and columns of tiles of a size that cover an area, and the pixels that they add below and to the right."""
    counts = [(n + length - 1) // length for n, length in zip(area, size, strict=True)]
    return counts, [length * count - n for length, count, n in zip(size, counts, area, strict=True)]


class _Tiles:
    """Tiles of a batch of maps, one for each step of a loop."""

    def __init__(self, batch: int, rows: int, columns: int) -> None:
        self._counts = (batch, rows, columns)
        self._step = steps(batch * rows * columns)
        self._item, self._row, self._column = pixels.places(self._step.reshape(1), rows, columns)

    def window(self, values: Tensor, size: tuple[int, int], margin: int) -> Tensor:
        """The window of a map for one tile of ``size``, with a margin."""
        shape = (1, int(values.shape[1]), size[0] + 2 * margin, size[1] + 2 * margin)
        first = torch.cat([self._item, torch.zeros_like(self._item), self._row * size[0], self._column * size[1]])
        lengths = torch.tensor(shape)
        cut = operator("Slice", [values, first, first + lengths], shape)
        # runtimes do not know the size of a slice, and use fast convolutions only for known sizes
        return operator("Reshape", [cut, lengths], shape)

    def joined(self, tile: Tensor) -> Tensor:
        """All tiles ``[1, C, h, w]`` as maps ``[B, C, rows * h, columns * w]``."""
        batch, rows, columns = self._counts
        channels, height, width = tile.shape[1:]
        tiles = collect(self._step, tile, batch * rows * columns)
        maps = tiles.reshape(batch, rows, columns, channels, height, width).permute(0, 3, 1, 4, 2, 5)
        return maps.reshape(batch, channels, rows * height, columns * width)


def _samples(
    values: Tensor, size: tuple[int, int], step: int, half_px: tuple[Tensor, Tensor]
) -> list[tuple[Tensor, Tensor]]:
    """The four samples around each pixel of a map, each ``[B, C, H, W]``, and their shares of the linear mean.

    The whole map is enlarged and shifted, because runtimes are slow at lists of single pixels. ``values``
    ``[B, C, h, w]`` are samples at every ``step``-th pixel, a power of two, with one more on each side; ``half_px`` is
    the offset of the map's centre from theirs, below and to the right, in half pixels: 0 or 1.
    """
    enlarged = functional.interpolate(values, scale_factor=float(step), mode="nearest")
    first = step // 2  # of the samples before the first pixel
    shares = []
    for n, half in zip(size, half_px, strict=True):
        position = 2 * torch.arange(n, device=values.device) + 2 * first + 1
        share = ((position % (2 * step)).to(values.dtype) + half) / (2 * step)
        shares.append((1.0 - share, share))
    return [
        (
            enlarged.narrow(-2, first + row * step, size[0]).narrow(-1, first + column * step, size[1]),
            shares[0][row].reshape(-1, 1) * shares[1][column],  # not [:, None]: ONNX infers wrong values from it
        )
        for row in (0, 1)
        for column in (0, 1)
    ]


class WholeOps(Ops):
    """Operations of a graph without control flow (``layout="whole"``), which renders all layers of the whole frame.

    Runtimes on GPUs and in browsers compute loops, branches and lists of pixels on the CPU, or not at all. This graph
    has none: it computes every pixel, also where a tiled graph skips work, and it has no rays of highlights.
    """

    channels = 32
    has_rays = False

    def select(self, mask: Tensor) -> Selected:
        """All pixels; only those of the mask are changed."""
        return _Everywhere(mask)


class _Everywhere(Selected):
    """All pixels of a map, P = B H W, as lists of values; :meth:`put` changes only those of the mask."""

    def __init__(self, mask: Tensor) -> None:
        self._mask = mask

    def pick(self, values: Tensor) -> Tensor:
        return values.transpose(0, 1).flatten(1)

    def around(self, values: Tensor) -> Tensor:
        padded = functional.pad(values, (1, 1, 1, 1), mode="replicate").transpose(0, 1).unsqueeze(1)
        kept = [slice(first, first - 2 or None) for first in range(3)]
        return torch.cat([padded[..., rows, columns] for rows in kept for columns in kept], 1).flatten(2)

    def of_item(self, values: Tensor) -> Tensor:
        height, width = self._mask.shape[-2:]
        return values.t()[..., None].expand(-1, -1, height * width).flatten(1)

    def put(self, values: Tensor, new: Tensor) -> Tensor:
        batch, channels, height, width = values.shape
        maps = new.reshape(channels, batch, height, width).transpose(0, 1)
        return torch.where(self._mask, maps, values)
