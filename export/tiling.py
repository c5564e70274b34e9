"""Renders the frame tile by tile in a loop, so that an exported graph does only the work that a scene needs.

A graph cannot choose its work before it runs. In a loop over tiles each step reads a small window; branches skip layers
without pixels in the window, and the whole tile if it is in focus.
"""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.render.disocclusion import BEHIND_PX, search, shown_behind
from torchdof.render.ops import Level, Ops, Seen
from torchdof.render.surfaces import PaddedFrame, PaddedSurface

from .operators import collect, window
from .shifting import samples

__all__ = ["seen", "side", "tile_by_tile"]

_SIDE = 96  # pixels of a tile; its maps fit into the processor's caches


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
    surfaces = [PaddedSurface(*(window(t, tile_px, margin) for t in s if t is not None)) for s in frame.surfaces]
    behind = None if frame.behind is None else window(frame.behind, tile_px, 0)
    inside = (..., slice(margin, margin + tile_px), slice(margin, margin + tile_px))
    size = (tile_px, tile_px)
    tile_frame = PaddedFrame(surfaces, frame.nodes, frame.ramps, behind, margin, size, size, frame.occlusion)
    rendered, sharp = render(tile_frame), surfaces[0].light[inside]
    weights = int(rendered.shape[1]) - frame.colours
    if weights:
        sharp = torch.cat([sharp, torch.ones_like(sharp[:, :weights])], 1)
    tile = ops.choose(lambda: torch.stack([s.x.abs().max() for s in surfaces]).max() > 0, rendered, sharp)
    rows, columns = (n // tile_px for n in frame.area)
    batch = frame.surfaces[0].light.shape[0]
    tiles = collect(tile, batch * rows * columns)
    return _joined(tiles, (batch, rows, columns))[..., : frame.size[0], : frame.size[1]]


def seen(levels: Sequence[Level], coc_px: Tensor, mask: Tensor, ops: Ops) -> Seen:
    """Light and coc behind the pixels of an image, from the levels of :mod:`torchdof.render.disocclusion`.

    They are computed tile by tile, and only in tiles with pixels of the mask ``[B, 1, H, W]`` behind which a surface
    may lie.
    """
    size = (coc_px.shape[-2], coc_px.shape[-1])
    covered = [levels[0].step * n for n in levels[0].values.shape[-2:]]  # px; the levels are centred on the image
    missing = [(n + _SIDE - 1) // _SIDE * _SIDE - n for n in covered]  # below and right, to whole tiles
    top, left = ((w - n) // 2 for w, n in zip(covered, size, strict=True))
    halves = [torch.scalar_tensor((w - n) % 2, dtype=coc_px.dtype) for w, n in zip(covered, size, strict=True)]
    ends = [left, covered[1] + missing[1] - size[1] - left, top, covered[0] + missing[0] - size[0] - top]
    padded = functional.pad(torch.cat([coc_px, mask], 1), ends, mode="replicate")
    coc_px, mask = window(padded, _SIDE, 0).split(1, 1)
    windows, behind = [], []
    for level in levels:
        ends = [1, 1 + missing[1] // level.step, 1, 1 + missing[0] // level.step]
        values = window(functional.pad(level.values, ends, mode="replicate"), _SIDE // level.step, 1)
        windows.append(values)
        behind.append(shown_behind(*samples(values, (_SIDE, _SIDE), level.step, (halves[0], halves[1])), coc_px))
    lights, weights = (torch.stack(parts) for parts in zip(*behind, strict=True))
    surfaces = torch.cat(search(levels, lights, weights, coc_px), 1)

    def hides() -> Tensor:
        nearest = torch.stack([values[:, -2].max() for values in windows]).max()
        return (mask.max() > 0) & (nearest > coc_px.min() + (BEHIND_PX - 0.5))

    tile = ops.choose(hides, surfaces, torch.zeros_like(surfaces))
    rows, columns = ((w + m) // _SIDE for w, m in zip(covered, missing, strict=True))
    batch = padded.shape[0]
    tiles = collect(tile, batch * rows * columns)
    # narrow() instead of slices: tracing then knows the sizes of the result
    maps = _joined(tiles, (batch, rows, columns)).narrow(-2, top, size[0]).narrow(-1, left, size[1])
    return maps[:, :-1], maps[:, -1:]


def _joined(tiles: Tensor, counts: tuple[int, int, int]) -> Tensor:
    """Joins tiles ``[n, C, side, side]`` to maps; counts: items, rows and columns."""
    channels, side = tiles.shape[1:3]
    batch, rows, columns = counts
    maps = tiles.reshape(batch, rows, columns, channels, side, side).permute(0, 3, 1, 4, 2, 5)
    return maps.reshape(batch, channels, rows * side, columns * side)
