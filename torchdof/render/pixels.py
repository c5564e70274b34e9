"""Single pixels of maps ``[B, C, H, W]`` by their flat index: ``(item * H + row) * W + column``.

Depth edges, hidden surfaces and highlights concern few pixels; these are looked at as lists ``[P]``.
"""

import torch
from torch import Tensor

__all__ = ["around", "between", "pick", "places", "put", "where"]


def where(mask: Tensor) -> Tensor:
    """Indices of the pixels of a mask ``[B, 1, H, W]`` that are set: ``[P]``."""
    return mask.flatten().nonzero()[:, 0]


def places(pixels: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Item, row and column of pixels.

    Example:
        >>> [part.tolist() for part in places(torch.tensor([5, 7]), 2, 3)]
        [[0, 1], [1, 0], [2, 1]]
    """
    line = pixels // width
    item = line // height
    return item, line - item * height, pixels - line * width


def pick(values: Tensor, pixels: Tensor) -> Tensor:
    """Values ``[B, C, H, W]`` at pixels of any shape ``[...]``: ``[C, ...]``."""
    picked = values.transpose(0, 1).flatten(1).index_select(1, pixels.flatten())
    return picked.unflatten(1, pixels.shape)


def put(values: Tensor, pixels: Tensor, new: Tensor) -> Tensor:
    """A copy of ``[B, C, H, W]`` with new values ``[C, P]`` (or ``[P]``, for one channel) at pixels ``[P]``."""
    batch, channels, height, width = values.shape
    flat = values.transpose(0, 1).flatten(1).index_copy(1, pixels, new.reshape(channels, -1).to(values.dtype))
    return flat.unflatten(1, (batch, height, width)).transpose(0, 1)


def around(pixels: Tensor, like: Tensor, reach: int) -> Tensor:
    """The pixels around each, row by row, those beyond the frame's border on it: ``[(2 reach + 1)^2, P]``.

    Args:
        pixels: ``[P]``.
        like: A map of the frame, ``[..., H, W]``.
        reach: Pixels to each side.
    """
    height, width = like.shape[-2:]
    item, row, column = places(pixels, height, width)
    offsets = torch.arange(-reach, reach + 1, device=pixels.device)[:, None]
    lines = ((row + offsets).clamp(0, height - 1) + item * height) * width
    columns = (column + offsets).clamp(0, width - 1)
    return (lines[:, None] + columns).flatten(0, 1)


def between(coordinate: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The pixel before each coordinate along an axis, and the share of the next one, for linear interpolation.

    Values go on beyond both ends as they are there. An axis of one pixel has no next one, and gives it no share.

    Example:
        >>> [part.tolist() for part in between(torch.tensor([-1.0, 0.25, 2.0]), 3)]
        [[0, 0, 1], [0.0, 0.25, 1.0]]
    """
    coordinate = coordinate.clamp(0, size - 1)
    before = coordinate.floor().clamp(max=max(0, size - 2))
    return before.long(), coordinate - before
