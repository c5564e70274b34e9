"""Operators of our own that stand for structure in what is traced; :mod:`.structure` makes loops and branches of them.

A traced graph is flat: one operator cuts a window of each tile, another collects the tiles, a third chooses between two
results.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

__all__ = ["CHOICE", "COLLECT", "DOMAIN", "WINDOW", "choose", "collect", "operator", "window"]

DOMAIN = "torchdof"
"""Of the operators; none is left in a file."""

CHOICE, WINDOW, COLLECT = "Choice", "Window", "Collect"
"""``Choice(needed, result, given)``; ``Window(map)``, one for each tile; ``Collect(tile)``, all of them.

Windows of several maps, before one ``Collect``, are those of the same tile."""


def choose(needed: Tensor, result: Tensor, given: Tensor) -> Tensor:
    """A result if it is needed, a bool ``[]``, else what is given: a branch of the graph."""
    return operator(CHOICE, [needed, result, given], result.shape)


def window(values: Tensor, length: int, margin: int) -> Tensor:
    """What a tile of so many pixels of a map sees of it, with a margin."""
    across = length + 2 * margin
    return operator(WINDOW, [values], (1, int(values.shape[1]), across, across), side=length, margin=margin)


def collect(tile: Tensor, count: int | torch.SymInt) -> Tensor:
    """All of so many tiles, from what is computed of one: ``[count, C, side, side]``."""
    return operator(COLLECT, [tile], (count, *tile.shape[1:]))


def operator(name: str, inputs: Sequence[Tensor], shape: Sequence[int | torch.SymInt], **attributes: int) -> Tensor:
    """An operator of :data:`DOMAIN` in a graph; what it gives has the type of its last input."""
    stated: dict[str, Any] = {**attributes}
    return torch.onnx.ops.symbolic(
        f"{DOMAIN}::{name}", inputs, stated, dtype=inputs[-1].dtype, shape=list(shape), version=1
    )
