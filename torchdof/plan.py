"""What a scene needs: the layers to render it with, for a tolerance."""

import dataclasses
import functools
import math

import torch
from torch import Tensor

from .layers import blur_axis, from_blur_axis
from .table import BlurTable

__all__ = ["Plan"]

_FINEST_SPACING = 0.5
_SPACING = 5.0


@dataclasses.dataclass(frozen=True)
class Plan:
    """Layers of a rendering, near to far.

    Args:
        nodes: Places of the layers on the blur axis (see :mod:`torchdof.layers`), strictly increasing.
        tolerance: What the plan was made for.
    """

    nodes: tuple[float, ...]
    tolerance: float

    @classmethod
    def of_scene(cls, coc_px: Tensor, tolerance: float) -> "Plan":
        """Layers for this scene: they span the coc that occur, with one on each end.

        A scene of one plane gets one layer, and its kernel is exact.

        Args:
            coc_px: ``[B, 1, H, W]``; NaN is left out.
            tolerance: As in :class:`torchdof.DepthOfField`.
        """
        low, high = _span(coc_px)
        if high <= low:
            return cls((low,), tolerance)
        nodes = [low]
        for x in _law(low, high, tolerance):
            gap = 0.3 * spacing(x, tolerance)
            if low < x < high and (x == 0.0 or (x - nodes[-1] > gap and high - x > gap)):
                nodes.append(x)
        return cls((*nodes, high), tolerance)

    @classmethod
    def still(cls, coc_px: Tensor, tolerance: float) -> "Plan":
        """Layers that reach as far as this scene does but do not move with it: for gradients."""
        low, high = _span(coc_px)
        return cls(_law(low, high, tolerance), tolerance)

    @classmethod
    def all(cls, max_coc_px: float, tolerance: float) -> "Plan":
        """Layers for every scene up to a radius: the plan of a compiled or exported module."""
        reach = max_coc_px - 0.5
        inner = [x for x in _law(-reach, reach, tolerance) if abs(x) < reach - 0.3 * spacing(reach, tolerance)]
        return cls((-reach, *inner, reach), tolerance)

    @property
    def coc_px(self) -> tuple[float, ...]:
        """Signed coc of the layers, near to far."""
        return tuple(from_blur_axis(x) for x in self.nodes)

    def kernels(
        self, table: BlurTable, size: tuple[int, int], dtype: torch.dtype, device: torch.device
    ) -> list[Tensor]:
        """Kernel of each layer, ``[channels, k, k]``, for a frame of ``size`` (height, width) and no larger than it needs.

        Traced code holds the kernels as constants, so a table that is tied to the width of the image ties it as well.
        """
        width = 1 if table.unit == "relative" else int(size[1])
        if torch.compiler.is_compiling():
            sizes = _constant_sizes(table, self.coc_px, width)
            flat = (
                _constant_bank(table, self.coc_px, width).to(device, dtype).split([s[0] * s[1] * s[2] for s in sizes])
            )
            return [kernel.reshape(shape) for kernel, shape in zip(flat, sizes, strict=True)]
        largest = 2 * max(size) - 1
        return [_cut(_kernel(table, coc, width), largest).to(device, dtype) for coc in self.coc_px]


def spacing(x: float, tolerance: float) -> float:
    """Distance on the blur axis from a node at ``x`` to the next one outwards."""
    finest = max(_FINEST_SPACING, abs(x) / 40.0)
    return max(finest, _SPACING * math.sqrt(tolerance) * max(abs(x) + 0.5, 1.0) ** 0.75)


def _law(low: float, high: float, tolerance: float) -> tuple[float, ...]:
    """Nodes outwards from focus, the last on each side at or beyond the given end."""
    nodes = [0.0]
    for sign, limit in ((-1, -low), (1, high)):
        x = 0.0
        while x < limit:
            x += spacing(x, tolerance)
            nodes.append(sign * x)
    return tuple(sorted(nodes))


def _span(coc_px: Tensor) -> tuple[float, float]:
    coc = coc_px.detach()
    # a kernel far larger than the frame is the same everywhere in it
    reach = 4.0 * max(coc.shape[-2:]) + 4.0
    x = blur_axis(torch.where(torch.isnan(coc), 0.0, coc).clamp(-reach, reach))
    low, high = torch.aminmax(x)
    return float(low), float(high)


@functools.lru_cache(maxsize=512)
def _kernel(table: BlurTable, coc_px: float, width: int) -> Tensor:
    return table.kernels(torch.tensor([coc_px], dtype=torch.float64), width)[0]


# one constant each: a compiled graph cannot hold several results of one such function
@torch.compiler.assume_constant_result
def _constant_sizes(table: BlurTable, coc_px: tuple[float, ...], width: int) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(_kernel(table, coc, width).shape) for coc in coc_px)


@torch.compiler.assume_constant_result
def _constant_bank(table: BlurTable, coc_px: tuple[float, ...], width: int) -> Tensor:
    return torch.cat([_kernel(table, coc, width).flatten() for coc in coc_px])


def _cut(kernel: Tensor, largest: int) -> Tensor:
    spare = max(0, kernel.shape[-1] - largest) // 2
    return kernel[..., spare : kernel.shape[-1] - spare, spare : kernel.shape[-1] - spare]
