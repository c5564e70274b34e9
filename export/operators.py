"""Placeholder operators for structure in a traced graph, from which :mod:`.structure` makes loops and branches.

A traced graph is flat. One operator cuts a window for each tile, another collects the tiles, and a third chooses
between two results.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

__all__ = ["CHOICE", "COLLECT", "DOMAIN", "WINDOW", "choose", "collect", "operator", "window"]

DOMAIN = "torchdof"
"""Domain of these operators; a finished file contains none."""

CHOICE, WINDOW, COLLECT = "Choice", "Window", "Collect"
"""``Choice(needed, result, given)``; ``Window(map)``, cut for each tile; ``Collect(tile)``, all tiles.

All windows before one ``Collect`` belong to the same tile."""


def choose(needed: Tensor, result: Tensor, given: Tensor) -> Tensor:
    """A branch in the graph: ``result`` if ``needed`` (bool ``[]``) is true, else ``given``."""
    return operator(CHOICE, [needed, result, given], result.shape)


def window(values: Tensor, length: int, margin: int) -> Tensor:
    """The window of a map for one tile of ``length`` pixels, with a margin."""
    across = length + 2 * margin
    return operator(WINDOW, [values], (1, int(values.shape[1]), across, across), side=length, margin=margin)


def collect(tile: Tensor, count: int | torch.SymInt) -> Tensor:
    """Collects the results of ``count`` tiles, given the computation of one: ``[count, C, side, side]``."""
    return operator(COLLECT, [tile], (count, *tile.shape[1:]))


def operator(name: str, inputs: Sequence[Tensor], shape: Sequence[int | torch.SymInt], **attributes: int) -> Tensor:
    """An operator of :data:`DOMAIN` in a graph; its result has the dtype of its last input."""
    values: dict[str, Any] = {**attributes}
    return torch.onnx.ops.symbolic(
        f"{DOMAIN}::{name}", inputs, values, dtype=inputs[-1].dtype, shape=list(shape), version=1
    )
