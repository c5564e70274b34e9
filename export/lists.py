"""Processes lists of single pixels in a graph (:mod:`torchdof.pixels`) in parts, because each has many neighbours.

Each part is a window of a narrow map, so that the loop over tiles (:mod:`.structure`) can be used.
"""

from collections.abc import Callable

from torch import Tensor

from .operators import collect, operator, window
from .scripting import Floats, Ints, op, script

__all__ = ["FUNCTIONS", "by_parts"]

_PART_SIDE = 32  # side of the map that holds a part; larger: fewer steps of the loop, more memory
_PART_SIZE = _PART_SIDE * _PART_SIDE


def by_parts(look: Callable[[Tensor], Tensor], pixels: Tensor) -> Tensor:
    """Applies ``look`` to the pixels ``[P]`` in parts; returns ``[n, P]``."""
    count = pixels.shape[0]
    parts = (count + _PART_SIZE - 1) // _PART_SIZE
    rows = operator("parts_of", [pixels], (1, 1, _PART_SIDE * parts, _PART_SIDE))
    results = look(window(rows, _PART_SIDE, margin=0).flatten())
    tile = results.reshape(1, results.shape[0], _PART_SIDE, _PART_SIDE)
    return operator("joined_parts", [pixels, collect(tile, parts)], (results.shape[0], count))


@script
def parts_of(pixels: Ints) -> Ints:
    """A list as rows of a map ``[1, 1, n, side]``, padded with zeros to whole parts."""
    count = op.Shape(pixels)
    parts = op.Max((count + _PART_SIZE - 1) / _PART_SIZE, 1)  # at least 1: an empty result has no shape in runtimes
    ends = op.Concat(op.Constant(value_ints=[0]), parts * _PART_SIZE - count, axis=0)
    return op.Reshape(op.Pad(pixels, ends), op.Constant(value_ints=[1, 1, -1, _PART_SIDE]))


@script
def joined_parts(pixels: Ints, tiles: Floats) -> Floats:
    """Joins the results of the parts ``[n, C, side, side]`` to lists ``[C, P]``."""
    lists = op.Transpose(tiles, perm=[1, 0, 2, 3])
    lists = op.Reshape(lists, op.Concat(op.Shape(lists, start=0, end=1), op.Constant(value_ints=[-1]), axis=0))
    return op.Slice(lists, op.Constant(value_ints=[0]), op.Shape(pixels), op.Constant(value_ints=[1]))


FUNCTIONS = (parts_of, joined_parts)
"""The functions called in the graph."""
