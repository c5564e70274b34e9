"""The frame tile by tile, in a loop: how an exported graph does only the work that a scene needs.

A graph cannot choose its work before it runs. In a loop over tiles each step sees a small window, and the branches
inside skip every layer that the window does not hold, and everything where it is in focus.

What is traced is flat: an operator of our own cuts a window, another collects the tiles, a third chooses between two
results. :mod:`torchdof.export.structure` makes a loop and branches of these.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.render.disocclusion import BEHIND_PX, BEHIND_STEP, Level, Looking, Seen, search
from torchdof.render.exporting import Graph, graph_context, where_needed
from torchdof.render.plan import Blur
from torchdof.render.surfaces import Frame, Placed

from .shifting import samples

__all__ = ["CHOICE", "COLLECT", "DOMAIN", "WINDOW", "choose", "in_tiles", "look_tile_by_tile", "side", "tile_by_tile"]

DOMAIN = "torchdof"
"""Of the operators that stand for structure in a flat graph; none is left in a file."""

CHOICE, WINDOW, COLLECT = "Choice", "Window", "Collect"
"""``Choice(needed, result, given)``; ``Window(frame)``, one for each tile; ``Collect(tile)``, all of them.

Windows of several maps, before one ``Collect``, are those of the same tile."""

_SIDE = 128


def side(margin: int) -> int:
    """Pixels of a tile along each axis, given those that the widest kernel reaches beyond it."""
    return _SIDE if margin <= _SIDE // 2 else 2 * _SIDE


def choose(needed: Tensor, result: Tensor, given: Tensor) -> Tensor:
    """A result if it is needed, a bool ``[]``, else what is given: a branch of the graph."""
    return _operator(CHOICE, [needed, result, given], result.shape)


def tile_by_tile(frame: Frame, blurs: Sequence[Blur], render: Callable[[Frame, Sequence[Blur]], Tensor]) -> Tensor:
    """Render each tile of a frame as a frame of its own.

    Args:
        frame: Surfaces and their border; its area is a multiple of :func:`side`.
        blurs: Kernel and resolution of each layer.
        render: Renders one tile with them: ``[1, C, side, side]``.

    Returns:
        ``[B, C, H, W]``.
    """
    length, margin = side(frame.margin), frame.margin
    parts = [t for s in frame.surfaces for t in s if t is not None]
    if frame.behind is not None:
        parts.append(functional.pad(frame.behind, (margin,) * 4))
    channels = [int(t.shape[1]) for t in parts]
    fields = list(_window(torch.cat(parts, 1), length, margin).split(channels, 1))
    inner = (..., slice(margin, margin + length), slice(margin, margin + length))
    behind = None if frame.behind is None else fields.pop()[inner]
    each = 2 if frame.surfaces[0].weight is None else 3
    surfaces = [Placed(*fields[i : i + each]) for i in range(0, len(fields), each)]
    size = (length, length)
    piece = Frame(surfaces, frame.nodes, frame.ramps, behind, margin, size, size, frame.occlusion)
    tile = where_needed(
        lambda: torch.stack([s.x.abs().max() for s in surfaces]).max() > 0,
        render(piece, blurs),
        surfaces[0].light[inner],
    )
    rows, columns = (n // length for n in frame.area)
    batch, colours = parts[0].shape[0], frame.colours
    pieces = _operator(COLLECT, [tile], (batch * rows * columns, colours, length, length))
    return _joined(pieces, (batch, rows, columns))[..., : frame.size[0], : frame.size[1]]


def look_tile_by_tile(
    levels: Sequence[Level],
    maps: Looking,
    look: Callable[[Sequence[Level], Looking, Seen], tuple[Tensor, Tensor, Tensor]],
) -> tuple[Tensor, Tensor, Tensor]:
    """Look behind the pixels of a frame, each tile by itself, and only behind those where there may be something.

    Args:
        levels: Of a pyramid, for the whole frame.
        maps: Who looks.
        look: Looks at one tile.

    Returns:
        What is seen and its votes, for the frame, and the light behind all, for its cells.
    """
    size = maps.coc_px.shape[-2:]
    whole = [BEHIND_STEP * n for n in maps.nearest.shape[-2:]]  # both have one centre
    more = [(n + _SIDE - 1) // _SIDE * _SIDE - n for n in whole]  # below and right, to whole tiles
    before = [(w - n) // 2 for w, n in zip(whole, size, strict=True)]
    like = maps.coc_px
    halves = [torch.scalar_tensor((w - n) % 2, dtype=like.dtype) for w, n in zip(whole, size, strict=True)]

    def windows(values: Tensor, step: int, margin: int) -> Tensor:
        ends = [margin, margin + more[1] // step, margin, margin + more[0] // step]
        return _window(functional.pad(values, ends, mode="replicate"), _SIDE // step, margin)

    top, left = before
    ends = [left, whole[1] + more[1] - size[1] - left, top, whole[0] + more[0] - size[0] - top]
    looking = torch.cat([maps.coc_px, maps.mask.to(like.dtype)], 1)
    coc_px, mask = _window(functional.pad(looking, ends, mode="replicate"), _SIDE, 0).split(1, 1)
    looking = torch.cat([maps.nearest, maps.cells.to(like.dtype)], 1)
    nearest, cells = windows(looking, BEHIND_STEP, 1).split(1, 1)
    # cells are looked at with a margin of one, so finer levels with one of as many pixels
    around = [lv._replace(values=windows(lv.values, lv.step, max(1, BEHIND_STEP // lv.step))) for lv in levels]

    def seen(
        levels: Sequence[Level], coc_px: Tensor, mask: Tensor, step: int = 1, farthest: bool = False
    ) -> tuple[Tensor, Tensor]:
        length, half_px = int(coc_px.shape[-1]), (halves[0], halves[1])
        if step > 1:  # cells and coarser ones lie on one grid
            half_px = (like.new_zeros(()),) * 2
        lists = [samples(level.values, length, level.step / step, half_px) for level in levels]
        shown, total = search(levels, lists, coc_px, farthest)
        return shown, total * mask

    shown, total, behind = look(around, Looking(coc_px, mask, nearest, cells), seen)
    own = next(level.values[:, :-2] for level in around if level.step == BEHIND_STEP)
    found, given = torch.cat([shown, total], 1), torch.zeros_like(torch.cat([shown, total], 1))
    inner = (..., slice(1, -1), slice(1, -1))

    def hides() -> Tensor:
        farthest = torch.stack([level.values[:, -2].max() for level in around]).max()
        return (mask.max() > 0) & (farthest > torch.minimum(coc_px.min(), nearest.min()) + (BEHIND_PX - 0.5))

    # both maps of a tile as one line of numbers, for a loop collects one thing
    lines = (torch.cat([a.flatten(1), b[inner].flatten(1)], 1) for a, b in ((found, behind), (given, own)))
    tile = where_needed(hides, *lines)
    sides, channels = (_SIDE, _SIDE // BEHIND_STEP), (int(found.shape[1]), int(behind.shape[1]))
    lengths = [n * across**2 for n, across in zip(channels, sides, strict=True)]
    rows, columns = ((w + m) // _SIDE for w, m in zip(whole, more, strict=True))
    tiles = _operator(COLLECT, [tile], (like.shape[0] * rows * columns, sum(lengths)))
    pixel_maps, cell_maps = (
        _joined(part.unflatten(1, (n, across, across)), (like.shape[0], rows, columns))
        for part, n, across in zip(tiles.split(lengths, 1), channels, sides, strict=True)
    )
    # narrowed, not sliced: so tracing knows the sizes of what is left
    pixel_maps = pixel_maps.narrow(-2, top, size[0]).narrow(-1, left, size[1])
    cell_maps = cell_maps.narrow(-2, 0, maps.nearest.shape[-2]).narrow(-1, 0, maps.nearest.shape[-1])
    return pixel_maps[:, :-1], pixel_maps[:, -1:], cell_maps


@contextlib.contextmanager
def in_tiles() -> Iterator[None]:
    """Within this context graphs that are exported render their frames tile by tile, and choose their work."""
    token = graph_context.set(Graph(side, tile_by_tile, look_tile_by_tile, choose))
    try:
        yield
    finally:
        graph_context.reset(token)


def _joined(tiles: Tensor, counts: tuple[int, int, int]) -> Tensor:
    """Tiles ``[n, C, side, side]`` of so many items, rows and columns as maps."""
    channels, side = tiles.shape[1:3]
    batch, rows, columns = counts
    maps = tiles.reshape(batch, rows, columns, channels, side, side).permute(0, 3, 1, 4, 2, 5)
    return maps.reshape(batch, channels, rows * side, columns * side)


def _window(values: Tensor, length: int, margin: int) -> Tensor:
    """What a tile of so many pixels of a map sees of it, with a margin."""
    across = length + 2 * margin
    return _operator(WINDOW, [values], (1, int(values.shape[1]), across, across), side=length, margin=margin)


def _operator(name: str, inputs: Sequence[Tensor], shape: Sequence[int | torch.SymInt], **attributes: int) -> Tensor:
    stated: dict[str, Any] = {**attributes}
    return torch.onnx.ops.symbolic(
        f"{DOMAIN}::{name}", inputs, stated, dtype=inputs[-1].dtype, shape=list(shape), version=1
    )
