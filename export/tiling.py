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

from torchdof.render.exporting import Graph, graph_context, where_needed
from torchdof.render.plan import Blur
from torchdof.render.surfaces import Frame, Placed

from .shifting import samples

__all__ = ["CHOICE", "COLLECT", "DOMAIN", "WINDOW", "choose", "in_tiles", "side", "tile_by_tile"]

DOMAIN = "torchdof"
"""Of the operators that stand for structure in a flat graph; none is left in a file."""

CHOICE, WINDOW, COLLECT = "Choice", "Window", "Collect"
"""``Choice(needed, result, given)``; ``Window(frame)``, one for each tile; ``Collect(tile)``, all of them."""

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
    window = (1, sum(channels), length + 2 * margin, length + 2 * margin)
    fields = list(_operator(WINDOW, [torch.cat(parts, 1)], window, side=length, margin=margin).split(channels, 1))
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
    image = pieces.reshape(batch, rows, columns, colours, length, length).permute(0, 3, 1, 4, 2, 5)
    return image.reshape(batch, colours, *frame.area)[..., : frame.size[0], : frame.size[1]]


@contextlib.contextmanager
def in_tiles() -> Iterator[None]:
    """Within this context graphs that are exported render their frames tile by tile, and choose their work."""
    token = graph_context.set(Graph(side, tile_by_tile, samples, choose))
    try:
        yield
    finally:
        graph_context.reset(token)


def _operator(name: str, inputs: Sequence[Tensor], shape: Sequence[int | torch.SymInt], **attributes: int) -> Tensor:
    stated: dict[str, Any] = {**attributes}
    return torch.onnx.ops.symbolic(
        f"{DOMAIN}::{name}", inputs, stated, dtype=inputs[-1].dtype, shape=list(shape), version=1
    )
