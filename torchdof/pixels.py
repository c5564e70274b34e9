"""Single pixels of maps ``[B, C, H, W]`` by their flat index: ``(item * H + row) * W + column``.

Depth edges, hidden surfaces and highlights concern few pixels, which are processed as lists ``[P]``.
"""

import torch
from torch import Tensor


class Selected:
    """Pixels of a mask ``[B, 1, H, W]``, as lists of P values."""

    def __init__(self, mask: Tensor) -> None:
        self._height, self._width = mask.shape[-2:]
        self._pixels = indices(mask)
        self._window: Tensor | None = None

    def pick(self, values: Tensor) -> Tensor:
        """Values ``[B, C, H, W]`` at the pixels: ``[C, P]``."""
        return pick(values, self._pixels)

    def around(self, values: Tensor) -> Tensor:
        """Values at the 3 x 3 pixels around each, row by row, the border's ones repeated: ``[C, 9, P]``."""
        if self._window is None:
            self._window = around(self._pixels, values, 1)
        return pick(values, self._window)

    def of_item(self, values: Tensor) -> Tensor:
        """Values ``[B, C]`` of each pixel's item: ``[C, P]``."""
        item = places(self._pixels, self._height, self._width)[0]
        return values.index_select(0, item).t()  # not values[item], whose gradient PyTorch adds up pixel by pixel

    def put(self, values: Tensor, new: Tensor) -> Tensor:
        """A copy of ``[B, C, H, W]`` with new values ``[C, P]`` (or ``[P]``, for one channel) at the pixels."""
        return put(values, self._pixels, new)


def indices(mask: Tensor) -> Tensor:
    """Indices of the pixels of a mask ``[B, 1, H, W]`` that are set: ``[P]``."""
    return mask.flatten().nonzero()[:, 0]


def places(pixels: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Item, row and column of pixels."""
    line = pixels // width
    return line // height, line % height, pixels % width


def rows(values: Tensor) -> Tensor:
    """Values ``[B, C, H, W]`` by the index of their pixel: ``[C, B * H * W]``."""
    # one channel needs no transpose, which would be a copy in an exported graph
    return values.reshape(1, -1) if values.shape[1] == 1 else values.transpose(0, 1).flatten(1)


def pick(values: Tensor, pixels: Tensor) -> Tensor:
    """Values ``[B, C, H, W]``, or their :func:`rows`, at pixels of any shape ``[...]``: ``[C, ...]``."""
    flat = values if values.dim() == 2 else rows(values)
    return flat.index_select(1, pixels.flatten()).unflatten(1, pixels.shape)


def put(values: Tensor, pixels: Tensor, new: Tensor) -> Tensor:
    """A copy of ``[B, C, H, W]`` with new values ``[C, P]`` (or ``[P]``, for one channel) at pixels ``[P]``."""
    batch, channels, height, width = values.shape
    flat = values.transpose(0, 1).flatten(1).index_copy(1, pixels, new.reshape(channels, -1).to(values.dtype))
    return flat.unflatten(1, (batch, height, width)).transpose(0, 1)


def around(pixels: Tensor, like: Tensor, reach: int) -> Tensor:
    """Pixels of the square up to ``reach`` around each, row by row, clamped to the frame: ``[(2 reach + 1)^2, P]``."""
    height, width = like.shape[-2:]
    line = pixels // width
    row = line % height
    offsets = torch.arange(-reach, reach + 1, device=pixels.device)[:, None]
    lines = ((row + offsets).clamp(0, height - 1) + (line - row)) * width
    columns = (pixels % width + offsets).clamp(0, width - 1)
    return (lines[:, None] + columns).flatten(0, 1)


def corners(item: Tensor, row: Tensor, column: Tensor, height: int, width: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """Indices and weights for bilinear interpolation at places ``[P]``, clamped to the frame.

    Returns:
        The four pixels around each place (top left, top right, bottom left, bottom right), and the weights of the lower
        row and of the right column. On an axis of one pixel both are the same pixel.
    """
    row, column = row.clamp_min(0), column.clamp_min(0)
    top, left = (t.long().clamp(max=n - 2).clamp_min(0) for t, n in ((row, height), (column, width)))
    first = (item * height + top) * width + left
    # index steps; 0 on an axis of one pixel
    down, right = torch.sym_min(1, height - 1) * width, torch.sym_min(1, width - 1)
    weights = (row - top).clamp(max=1), (column - left).clamp(max=1)
    return [first, first + right, first + down, first + (down + right)], *weights
