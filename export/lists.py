"""Lists of single pixels in a graph (:mod:`torchdof.pixels`), some of them at a time, for each has many neighbours.

A part of a list is a window of a narrow map, so that it has the loop that tiles have (:mod:`.structure`).
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import onnxscript
from torch import Tensor

from torchdof.pixels import graph_parts

from .tiling import COLLECT, DOMAIN, operator, window

if TYPE_CHECKING:  # what stands below is read, and not by Python's rules
    from typing import Any
    from typing import Any as Floats
    from typing import Any as Ints

    op: Any
else:
    from onnxscript import opset20 as op

    Floats, Ints = onnxscript.FLOAT[...], onnxscript.INT64[...]

__all__ = ["FUNCTIONS", "in_parts"]

_SIDE = 32
_PART = _SIDE * _SIDE

_script = onnxscript.script(onnxscript.values.Opset(DOMAIN, 1), default_opset=op)


@contextlib.contextmanager
def in_parts() -> Iterator[None]:
    """Within this context graphs that are exported go over lists of pixels in a loop over their parts."""
    token = graph_parts.set(_by_parts)
    try:
        yield
    finally:
        graph_parts.reset(token)


def _by_parts(look: Callable[[Tensor], Tensor], pixels: Tensor) -> Tensor:
    """What a function finds at pixels ``[P]``: ``[n, P]``."""
    count = pixels.shape[0]
    parts = (count + _PART - 1) // _PART
    rows = operator("parts_of", [pixels], (1, 1, _SIDE * parts, _SIDE))
    found = look(window(rows, _SIDE, margin=0).flatten())
    tile = found.reshape(1, found.shape[0], _SIDE, _SIDE)
    tiles = operator(COLLECT, [tile], (parts, *tile.shape[1:]))
    return operator("whole_of", [pixels, tiles], (found.shape[0], count))


@_script
def parts_of(pixels: Ints) -> Ints:
    """A list as rows of a map ``[1, 1, n, side]``, ended by zeros where it ends within a part."""
    count = op.Shape(pixels)
    parts = op.Max((count + _PART - 1) / _PART, 1)  # runtimes do not tell the shape of what no step gave
    ends = op.Concat(op.Constant(value_ints=[0]), parts * _PART - count, axis=0)
    return op.Reshape(op.Pad(pixels, ends), op.Constant(value_ints=[1, 1, -1, _SIDE]))


@_script
def whole_of(pixels: Ints, tiles: Floats) -> Floats:
    """What was found in parts ``[n, C, side, side]``, as lists ``[C, P]``."""
    lists = op.Transpose(tiles, perm=[1, 0, 2, 3])
    lists = op.Reshape(lists, op.Concat(op.Shape(lists, start=0, end=1), op.Constant(value_ints=[-1]), axis=0))
    return op.Slice(lists, op.Constant(value_ints=[0]), op.Shape(pixels), op.Constant(value_ints=[1]))


FUNCTIONS = (parts_of, whole_of)
"""Both, by their names in the graph."""
