"""Renders a frame, or a list of pixels, part by part in a loop, so that a graph does only the work that a scene needs.

A graph cannot choose its work before it runs. In a loop over tiles each step reads a small window; branches skip layers
without pixels in the window, and the whole tile if it is in focus.
"""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import pixels
from torchdof.render.disocclusion import BEHIND_PX, search, shown_behind
from torchdof.render.ops import Level, Ops, Seen
from torchdof.render.surfaces import PaddedFrame, PaddedSurface

from .structure import collect, operator, steps

__all__ = ["by_parts", "samples", "seen", "side", "tile_by_tile"]

_SIDE = 96  # pixels of a tile; its maps fit into the processor's caches
_PART = 1024  # pixels of a list in one step; larger: fewer steps, more memory


def side(margin: int) -> int:
    """Side of a tile in pixels, given the reach of the widest kernel."""
    return next((n for n in (_SIDE, 128) if margin <= n // 2), 256)


def tile_by_tile(frame: PaddedFrame, render: Callable[[PaddedFrame], Tensor], ops: Ops) -> Tensor:
    """Renders each tile of a frame as a frame of its own.

    Args:
        frame: Surfaces and their border; its area is a multiple of :func:`side`.
        render: Renders one tile: ``[1, C, side, side]``, or with weights of its light in further channels, which are 1
            where it is sharp.
        ops: Operations; they skip sharp tiles.

    Returns:
        The rendered frame, ``[B, C, H, W]``.
    """
    tile_px, margin = side(frame.margin), frame.margin
    tiles = _Tiles(frame.surfaces[0].light.shape[0], *(n // tile_px for n in frame.area))
    surfaces = [PaddedSurface(*(tiles.window(t, tile_px, margin) for t in s if t is not None)) for s in frame.surfaces]
    behind = None if frame.behind is None else tiles.window(frame.behind, tile_px, 0)
    inside = (..., slice(margin, margin + tile_px), slice(margin, margin + tile_px))
    size = (tile_px, tile_px)
    tile_frame = PaddedFrame(surfaces, frame.nodes, frame.ramps, behind, margin, size, size, frame.occlusion)
    rendered, sharp = render(tile_frame), surfaces[0].light[inside]
    weights = int(rendered.shape[1]) - frame.colours
    if weights:
        sharp = torch.cat([sharp, torch.ones_like(sharp[:, :weights])], 1)
    tile = ops.choose(lambda: torch.stack([s.x.abs().max() for s in surfaces]).max() > 0, rendered, sharp)
    return tiles.joined(tile)[..., : frame.size[0], : frame.size[1]]


def seen(levels: Sequence[Level], coc_px: Tensor, mask: Tensor, ops: Ops) -> Seen:
    """Light and coc behind the pixels of an image, from the levels of :mod:`torchdof.render.disocclusion`.

    They are computed tile by tile, and only in tiles with pixels of the mask ``[B, 1, H, W]`` behind which a surface
    may lie.
    """
    size = (coc_px.shape[-2], coc_px.shape[-1])
    covered = [levels[0].step * n for n in levels[0].values.shape[-2:]]  # px; the levels are centred on the image
    counts = [(n + _SIDE - 1) // _SIDE for n in covered]
    missing = [_SIDE * count - n for count, n in zip(counts, covered, strict=True)]  # below and right, to whole tiles
    top, left = ((w - n) // 2 for w, n in zip(covered, size, strict=True))
    halves = [torch.scalar_tensor((w - n) % 2, dtype=coc_px.dtype) for w, n in zip(covered, size, strict=True)]
    ends = [left, covered[1] + missing[1] - size[1] - left, top, covered[0] + missing[0] - size[0] - top]
    padded = functional.pad(torch.cat([coc_px, mask], 1), ends, mode="replicate")
    tiles = _Tiles(padded.shape[0], *counts)
    coc_px, mask = tiles.window(padded, _SIDE, 0).split(1, 1)
    windows, behind = [], []
    for level in levels:
        ends = [1, 1 + missing[1] // level.step, 1, 1 + missing[0] // level.step]
        values = tiles.window(functional.pad(level.values, ends, mode="replicate"), _SIDE // level.step, 1)
        windows.append(values)
        behind.append(shown_behind(*samples(values, (_SIDE, _SIDE), level.step, (halves[0], halves[1])), coc_px))
    lights, weights = (torch.stack(parts) for parts in zip(*behind, strict=True))
    surfaces = torch.cat(search(levels, lights, weights, coc_px), 1)

    def hides() -> Tensor:
        nearest = torch.stack([values[:, -2].max() for values in windows]).max()
        return (mask.max() > 0) & (nearest > coc_px.min() + (BEHIND_PX - 0.5))

    tile = ops.choose(hides, surfaces, torch.zeros_like(surfaces))
    # narrow() instead of slices: tracing then knows the sizes of the result
    maps = tiles.joined(tile).narrow(-2, top, size[0]).narrow(-1, left, size[1])
    return maps[:, :-1], maps[:, -1:]


class _Tiles:
    """Tiles of a batch of maps, one for each step of a loop."""

    def __init__(self, batch: int, rows: int, columns: int) -> None:
        self._counts = (batch, rows, columns)
        self._step = steps(batch * rows * columns)
        self._item, self._row, self._column = pixels.places(self._step.reshape(1), rows, columns)

    def window(self, values: Tensor, length: int, margin: int) -> Tensor:
        """The window of a map for one tile of ``length`` pixels, with a margin."""
        across = length + 2 * margin
        shape = (1, int(values.shape[1]), across, across)
        first = torch.cat([self._item, torch.zeros_like(self._item), self._row * length, self._column * length])
        size = torch.tensor(shape)
        cut = operator("Slice", [values, first, first + size], shape)
        # runtimes do not know the size of a slice, and use fast convolutions only for known sizes
        return operator("Reshape", [cut, size], shape)

    def joined(self, tile: Tensor) -> Tensor:
        """All tiles ``[1, C, side, side]`` as maps ``[B, C, rows * side, columns * side]``."""
        batch, rows, columns = self._counts
        channels, side = tile.shape[1:3]
        tiles = collect(self._step, tile, batch * rows * columns)
        maps = tiles.reshape(batch, rows, columns, channels, side, side).permute(0, 3, 1, 4, 2, 5)
        return maps.reshape(batch, channels, rows * side, columns * side)


def by_parts(look: Callable[[Tensor], Tensor], pixels: Tensor) -> Tensor:
    """Applies ``look`` to the pixels ``[P]`` in parts, because each has many neighbours; returns ``[n, P]``."""
    count = pixels.shape[0]
    parts = count // _PART + 1  # at least 1: an empty result has no shape in runtimes
    step = steps(parts)
    padded = torch.cat([pixels, pixels.new_zeros(1)])
    index = torch.minimum(step * _PART + torch.arange(_PART), torch.scalar_tensor(count, dtype=torch.int64))
    results = look(padded.index_select(0, index))
    lists = collect(step, results[None], parts).transpose(0, 1).flatten(1)
    ends = [torch.tensor([0]), torch.scalar_tensor(count, dtype=torch.int64).reshape(1), torch.tensor([1])]
    return operator("Slice", [lists, *ends], (results.shape[0], count))


def samples(values: Tensor, size: tuple[int, int], step: int, half_px: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The four samples around each pixel of a map, and their shares of the linear mean.

    The whole map is enlarged and shifted, because runtimes are slow at lists of single pixels.

    Args:
        values: Samples ``[B, C, h, w]`` at every ``step``-th pixel of the map, with one more on each side.
        size: Height and width of the map.
        step: A power of two, 2 or more.
        half_px: Offset of the map's centre from the samples' centre, below and to the right, in half pixels: 0 or 1.

    Returns:
        Samples ``[B, C, 4, H, W]`` and shares ``[4, H, W]``.
    """
    enlarged = functional.interpolate(values, scale_factor=float(step), mode="nearest")
    first = step // 2  # of the samples before the first pixel
    shares = []
    for n, half in zip(size, half_px, strict=True):
        position = 2 * torch.arange(n, device=values.device) + 2 * first + 1
        share = ((position % (2 * step)).to(values.dtype) + half) / (2 * step)
        shares.append((1.0 - share, share))
    shifted = [
        enlarged.narrow(-2, first + row * step, size[0]).narrow(-1, first + column * step, size[1])
        for row in (0, 1)
        for column in (0, 1)
    ]
    return torch.stack(shifted, 2), torch.stack([y[:, None] * x for y in shares[0] for x in shares[1]])
