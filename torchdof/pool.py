"""Bands of rows, places of pixels, and maxima and means of neighbours.

These come from shifted views: on a CPU several times faster than PyTorch's pooling.
"""

import functools
from collections.abc import Callable

import torch
from torch import Tensor

__all__ = [
    "any_around",
    "any_of_blocks",
    "bands",
    "between",
    "max_around",
    "max_of_blocks",
    "max_of_four",
    "mean_of_blocks",
    "mean_of_four",
    "min_of_blocks",
    "places",
]

OfTwo = Callable[[Tensor, Tensor], Tensor]
_PIXELS = 2**17  # of a band: what fits the cache


def bands(values: Tensor, multiple: int = 1) -> list[slice]:
    """Rows of ``[..., H, W]`` in bands that fit the cache, a multiple of so many but for the last.

    Traced code, which knows no sizes, takes all rows at once.

    Example:
        >>> bands(torch.zeros(300, 1024), 64)
        [slice(0, 128, None), slice(128, 256, None), slice(256, 300, None)]
    """
    height, width = values.shape[-2:]
    if torch.compiler.is_compiling() or torch.compiler.is_exporting():
        return [slice(0, height)]
    rows = max(1, _PIXELS // (width * multiple)) * multiple
    return [slice(start, min(start + rows, height)) for start in range(0, height, rows)]


def max_around(values: Tensor, reach: int = 1) -> Tensor:
    """Largest of the values around each, so many to each side: ``[..., H, W]``; what is outside counts for nothing.

    Example:
        >>> max_around(torch.tensor([[3.0, 0, 0, 1]])).tolist()
        [[3.0, 3.0, 1.0, 1.0]]
        >>> max_around(torch.tensor([[3.0, 0, 0, 1]]), 2).tolist()
        [[3.0, 3.0, 3.0, 1.0]]
    """
    return _around(torch.maximum, values, reach)


def any_around(bits: Tensor, reach: int = 1) -> Tensor:
    """Bits that any of the integers around each has, so many to each side: ``[..., H, W]``.

    Example:
        >>> any_around(torch.tensor([[1, 0, 4, 2]])).tolist()
        [[1, 5, 6, 6]]
    """
    return _around(torch.bitwise_or, bits, reach)


def _around(of_two: OfTwo, values: Tensor, reach: int) -> Tensor:
    """What is around each, joined: an operation for which it does not matter that a value occurs twice."""
    side = 2 * reach + 1
    for dim in (-2, -1):
        size = values.shape[dim]
        ends = [[values.narrow(dim, at, 1)] * reach for at in (0, size - 1)]
        values = torch.cat([*ends[0], values, *ends[1]], dim)
        length = 1  # of what each value joins
        while 2 * length <= side:
            count = values.shape[dim] - length
            values = of_two(values.narrow(dim, 0, count), values.narrow(dim, length, count))
            length *= 2
        values = of_two(values.narrow(dim, 0, size), values.narrow(dim, side - length, size))
    return values


def max_of_four(values: Tensor) -> Tensor:
    """Largest of each 2 x 2 values: ``[..., H, W]`` with even H and W -> ``[..., H / 2, W / 2]``.

    Example:
        >>> max_of_four(torch.tensor([[1.0, 2, 0, 0], [3, 0, 0, 1]])).tolist()
        [[3.0, 1.0]]
    """
    return _of_four(torch.maximum, values)


def mean_of_four(values: Tensor) -> Tensor:
    """Mean of each 2 x 2 values: ``[..., H, W]`` with even H and W -> ``[..., H / 2, W / 2]``.

    Example:
        >>> mean_of_four(torch.tensor([[1.0, 2, 0, 0], [3, 0, 0, 1]])).tolist()
        [[1.5, 0.25]]
    """
    rows = torch.lerp(values[..., 0::2, :], values[..., 1::2, :], 0.5)  # a sum could overflow
    return torch.lerp(rows[..., 0::2], rows[..., 1::2], 0.5)


def mean_of_blocks(values: Tensor, scale: int) -> Tensor:
    """Mean of each ``scale`` x ``scale`` values, a power of two: ``[..., H, W] -> [..., H / scale, W / scale]``.

    Example:
        >>> mean_of_blocks(torch.arange(16.0).reshape(4, 4), 4).tolist()
        [[7.5]]
    """
    return _of_blocks(mean_of_four, values, scale)


def max_of_blocks(values: Tensor, scale: int) -> Tensor:
    """Largest of each ``scale`` x ``scale`` values, a power of two: ``[..., H, W] -> [..., H / scale, W / scale]``.

    Example:
        >>> max_of_blocks(torch.arange(16.0).reshape(4, 4), 4).tolist()
        [[15.0]]
    """
    return _of_blocks(max_of_four, values, scale)


def min_of_blocks(values: Tensor, scale: int) -> Tensor:
    """Least of each ``scale`` x ``scale`` values, a power of two, as in :func:`max_of_blocks`.

    Example:
        >>> min_of_blocks(torch.tensor([[1.0, 2], [3, 5]]), 2).tolist()
        [[1.0]]
    """
    return _of_blocks(functools.partial(_of_four, torch.minimum), values, scale)


def any_of_blocks(bits: Tensor, scale: int) -> Tensor:
    """Bits that any of each ``scale`` x ``scale`` integers has, a power of two, as in :func:`max_of_blocks`.

    Example:
        >>> any_of_blocks(torch.tensor([[1, 0], [4, 1]]), 2).tolist()
        [[5]]
    """
    return _of_blocks(functools.partial(_of_four, torch.bitwise_or), bits, scale)


def _of_four(of_two: OfTwo, values: Tensor) -> Tensor:
    rows = of_two(values[..., 0::2, :], values[..., 1::2, :])
    return of_two(rows[..., 0::2], rows[..., 1::2])


def _of_blocks(of_four: Callable[[Tensor], Tensor], values: Tensor, scale: int) -> Tensor:
    for _ in range(scale.bit_length() - 1):
        values = of_four(values)
    return values


def places(at: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Item, row and column of flat indices in ``[B, 1, H, W]``.

    Example:
        >>> [part.tolist() for part in places(torch.tensor([5, 7]), 2, 3)]
        [[0, 1], [1, 0], [2, 1]]
    """
    line = at // width
    item = line // height
    return item, line - item * height, at - line * width


def between(at: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The pixel before each place along an axis, and the share of the next one, for linear interpolation.

    Values go on beyond both ends as they are there. An axis of one pixel has no next one, and gives it no share.

    Example:
        >>> [part.tolist() for part in between(torch.tensor([-1.0, 0.25, 2.0]), 3)]
        [[0, 0, 1], [0.0, 0.25, 1.0]]
    """
    at = at.clamp(0, size - 1)
    before = at.floor().clamp(max=max(0, size - 2))
    return before.long(), at - before
