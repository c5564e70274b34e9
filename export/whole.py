"""The operations of a graph without control flow (``layout="whole"``), which renders all layers of the whole frame.

Runtimes on GPUs and in browsers compute loops, branches and lists of pixels on the CPU, or not at all. This graph has
none: it computes every pixel, also where a tiled graph skips work, and it has no rays of highlights.
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.pixels import Selected
from torchdof.render.ops import Ops

__all__ = ["WholeOps"]


class WholeOps(Ops):
    """Operations on whole maps; the number of computed pixels does not depend on the values."""

    channels = 32
    has_rays = False

    def select(self, mask: Tensor) -> Selected:
        """All pixels; only those of the mask are changed."""
        return _Everywhere(mask)


class _Everywhere(Selected):
    """All pixels of a map, P = B H W, as lists of values; :meth:`put` changes only those of the mask."""

    def __init__(self, mask: Tensor) -> None:
        self._mask = mask

    def pick(self, values: Tensor) -> Tensor:
        return values.transpose(0, 1).flatten(1)

    def around(self, values: Tensor) -> Tensor:
        height, width = values.shape[-2:]
        padded = functional.pad(values, (1, 1, 1, 1), mode="replicate")
        shifted = [padded[..., row : row + height, column : column + width] for row in range(3) for column in range(3)]
        return torch.stack(shifted).permute(2, 0, 1, 3, 4).flatten(2)

    def of_item(self, values: Tensor) -> Tensor:
        height, width = self._mask.shape[-2:]
        return values.t()[..., None].expand(-1, -1, height * width).flatten(1)

    def put(self, values: Tensor, new: Tensor) -> Tensor:
        batch, channels, height, width = values.shape
        maps = new.reshape(channels, batch, height, width).transpose(0, 1)
        return torch.where(self._mask, maps, values)
