"""What a scene needs: the layers to render it with, for a tolerance."""

import dataclasses
import functools
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from . import placement
from .layers import from_blur_axis
from .optics.blur_table import BlurTable
from .resolution import shrink

if TYPE_CHECKING:
    from .survey import Survey

__all__ = ["Blur", "Plan"]

_SPACING = 0.25  # px near focus at a tolerance of 1/255; measured, as the next two: errors stay below the tolerance
_SPACING_POWER = 0.8  # of the tolerance
_LOOSE = 4.0  # of 255: from there on by its square root, lest a picture consists of two layers
_COARSE_FROM_PX = (7.2, 18.0, 36.0, 72.0)  # blurs from which each next half of the resolution will do at 1/255
_SHARED_FROM_PX = 32.0  # blur from which on pixels of a highlight share looks for what hides it, at 1/255


@dataclasses.dataclass(frozen=True)
class Plan:
    """Layers of a rendering, near to far.

    Args:
        nodes: Places of the layers on the blur axis (see :mod:`torchdof.layers`), strictly increasing.
        tolerance: What the plan was made for.
        rays: Highlights are traced (:mod:`torchdof.highlights`) where layers would not do; False spreads them with
            their layers, as plans for every scene do.
        survey: What the plan means for the scene it was made for; ``print`` shows it.
    """

    nodes: tuple[float, ...]
    tolerance: float
    rays: bool = True
    survey: "Survey | None" = dataclasses.field(default=None, compare=False, repr=False)

    def __str__(self) -> str:
        return repr(self) if self.survey is None else str(self.survey)

    @classmethod
    def of_scene(cls, coc_px: Tensor, tolerance: float) -> "Plan":
        """Layers for this scene: they span the coc that occur, with one on each end, and lie close at those of borders.

        A scene of one plane gets one layer, and its kernel is exact.

        Args:
            coc_px: ``[B, 1, H, W]``; NaN is left out.
            tolerance: As in :class:`torchdof.DepthOfField`.
        """
        x = placement.on_axis(coc_px)
        low, high = placement.ends(x)
        if high <= low:
            return cls((low,), tolerance)
        nodes = [low, high]

        def around(x: float) -> float:
            return spacing(x, tolerance)

        def lay(y: float, gap: float) -> None:
            if low < y < high and min(abs(y - other) for other in nodes) > gap:
                nodes.append(y)

        for plane in placement.planes(x, around):
            lay(plane, 0.2 * placement.finest(plane))
        for border in placement.at_borders(x):
            finest = placement.finest(border)
            if around(border) > 2.5 * finest:
                for y in (border, border - finest, border + finest):
                    lay(y, 0.6 * finest)
        for y in _law(low, high, tolerance):
            lay(y, 0.0 if y == 0.0 else 0.3 * around(y))
        return cls(tuple(sorted(nodes)), tolerance)

    @classmethod
    def still(cls, coc_px: Tensor, tolerance: float) -> "Plan":
        """Layers that reach as far as this scene does but do not move with it: for gradients."""
        return cls(_law(*placement.ends(placement.on_axis(coc_px)), tolerance), tolerance)

    @classmethod
    def all(cls, max_coc_px: float, tolerance: float) -> "Plan":
        """Layers for every scene up to a radius: the plan of a compiled or exported module."""
        reach = max_coc_px - 0.5
        inner = [x for x in _law(-reach, reach, tolerance) if abs(x) < reach - 0.3 * spacing(reach, tolerance)]
        return cls((-reach, *inner, reach), tolerance, rays=False)

    @property
    def coc_px(self) -> tuple[float, ...]:
        """Signed coc of the layers, near to far."""
        return tuple(from_blur_axis(x) for x in self.nodes)

    def blurs(
        self, table: BlurTable, size: tuple[int, int], dtype: torch.dtype, device: torch.device, coarse: bool
    ) -> "list[Blur]":
        """Kernel and resolution of each layer, for a frame of ``size`` (height, width).

        Traced code holds the kernels as constants, so a table that is tied to the width of the image ties it as well.
        """
        width = 1 if table.unit == "relative" else int(size[1])
        coarse = coarse and len(self.nodes) > 1  # a plane is exact
        scales = [self._scale(coc) if coarse else 1 for coc in self.coc_px]
        if torch.compiler.is_compiling():
            shapes = _constant_shapes(table, self.coc_px, width, tuple(scales))
            flat = _constant_bank(table, self.coc_px, width, tuple(scales)).to(device, dtype)
            parts = flat.split([shape[0] * shape[1] * shape[2] for shape in shapes])
            longest = [(torch.sym_max(*size) + s - 1) // s for s in scales]
            bank = [_masked(k.reshape(shape), n) for k, shape, n in zip(parts, shapes, longest, strict=True)]
        else:
            bank = [_cut(table, c, width, s, -(-max(size) // s)) for c, s in zip(self.coc_px, scales, strict=True)]
            bank = [kernel.to(device, dtype) for kernel in bank]
        return [Blur(kernel, scale) for kernel, scale in zip(bank, scales, strict=True)]

    @property
    def crisp_px(self) -> float:
        """Radius from which on light is blurred at a coarser resolution, all or in part; that softens highlights."""
        coarse = [abs(coc) for coc in self.coc_px if self._scale(coc) > 1]
        finer = [abs(coc) for coc in self.coc_px if abs(coc) < min(coarse, default=0.0)]
        return math.inf if not coarse else max(finer, default=0.0)

    @property
    def shared_px(self) -> float:
        """Radius from which on neighbouring pixels of a highlight share looks for what hides it."""
        return _SHARED_FROM_PX / (self.tolerance * 255.0) if self.tolerance else math.inf

    def _scale(self, coc_px: float) -> int:
        """Resolution a layer is blurred at: every ``scale``-th pixel, a power of two."""
        reached = abs(coc_px) * math.sqrt(self.tolerance * 255.0)
        return 2 ** sum(reached >= start for start in _COARSE_FROM_PX)


@dataclasses.dataclass(frozen=True)
class Blur:
    """How one layer is scattered.

    Args:
        kernel: ``[1 or C, k, k]``, in pixels of the layer's resolution.
        scale: The layer is spread at every ``scale``-th pixel.
    """

    kernel: Tensor
    scale: int

    @property
    def half(self) -> int:
        """Pixels of the layer's resolution that the kernel reaches to each side."""
        return self.kernel.shape[-1] // 2

    @property
    def halo(self) -> int:
        """Pixels of the image around a window that the layer needs."""
        return self.half if self.scale == 1 else self.scale * (self.half + 1)


def spacing(x: float, tolerance: float) -> float:
    """Distance on the blur axis from a node at ``x`` to the next one outwards."""
    times = tolerance * 255.0
    loose = times**_SPACING_POWER if times <= _LOOSE else max(_LOOSE**_SPACING_POWER, math.sqrt(times))
    return max(placement.finest(x), _SPACING * loose * max(abs(x) + 0.5, 1.0) ** 0.75)


def _law(low: float, high: float, tolerance: float) -> tuple[float, ...]:
    """Nodes outwards from focus, the last on each side at or beyond the given end."""
    nodes = [0.0]
    for sign, limit in ((-1, -low), (1, high)):
        x = 0.0
        while x < limit:
            x += spacing(x, tolerance)
            nodes.append(sign * x)
    return tuple(sorted(nodes))


@functools.lru_cache(maxsize=512)
@torch.inference_mode(False)  # what is kept must serve autograd as well
def _kernel(table: BlurTable, coc_px: float, width: int, scale: int, window: int | None) -> Tensor:
    coc = coc_px / scale
    if scale > 1:  # averaging and interpolation blur as well
        coc *= shrink(table, coc, width / scale, scale)
    return table.kernels(torch.tensor([coc], dtype=torch.float64), width / scale, window=window)[0]


# one constant each: a compiled graph cannot hold several results of one such function
@torch.compiler.assume_constant_result
def _constant_shapes(
    table: BlurTable, coc_px: tuple[float, ...], width: int, scales: tuple[int, ...]
) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(_kernel(table, c, width, s, None).shape) for c, s in zip(coc_px, scales, strict=True))


@torch.compiler.assume_constant_result
def _constant_bank(table: BlurTable, coc_px: tuple[float, ...], width: int, scales: tuple[int, ...]) -> Tensor:
    return torch.cat([_kernel(table, c, width, s, None).flatten() for c, s in zip(coc_px, scales, strict=True)])


def _cut(table: BlurTable, coc_px: float, width: int, scale: int, longest: int) -> Tensor:
    """A kernel without the taps that no pixel of a frame, ``longest`` pixels long, reaches another one with."""
    wide = _reach(table, coc_px, width, scale) > longest - 0.5
    return _kernel(table, coc_px, width, scale, 2 * longest - 1 if wide else None)


@functools.lru_cache(maxsize=4096)
def _reach(table: BlurTable, coc_px: float, width: int, scale: int) -> float:
    return table.reach_px(coc_px / scale, width / scale)


def _masked(kernel: Tensor, longest: int) -> Tensor:
    """The same for traced code, whose kernels keep their size: these taps are 0."""
    half = kernel.shape[-1] // 2
    within = (torch.arange(-half, half + 1, device=kernel.device).abs() < longest).to(kernel.dtype)
    return kernel * within * within[:, None]
