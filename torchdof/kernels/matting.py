"""Matting on a GPU: the host code of ``matting.cu``, whose comments have the steps.

Tensors are float32, contiguous and on one device. ``B`` items have ``C`` channels.
"""

import ctypes
import functools

import torch
from torch import Tensor

from . import loader

_TAPS = 9  # pixels around one, as in matting.h

module, options = loader.by_channels("matting.cu"), loader.options


@functools.cache
def argument_type() -> type[ctypes.Structure]:
    """The structure that all kernels take, as ``matting.h`` defines it."""
    return loader.structure(loader.text("matting.h"), {})


class Matting:
    """Splits the mixed pixels of images, and computes the gradients of these splits.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is left out; None means all count.
    """

    def __init__(self, light: Tensor, coc_px: Tensor, valid: Tensor | None) -> None:
        self._light, self._coc = light, coc_px
        self._launch = module(light.shape[1], light.device.index or 0)
        self._darkest, self._brightest = light.flatten(2).aminmax(dim=2)  # of each channel
        self._edge, self._clean = torch.empty_like(coc_px), torch.empty_like(light)
        maps = {"light": light, "coc": coc_px, "valid": valid, "edge": self._edge}
        maps |= {"clean": self._clean, "darkest": self._darkest, "brightest": self._brightest}
        self._common = argument_type()(height=light.shape[2], width=light.shape[3])
        self._set(**maps)
        for kernel in ("find_edges", "find_clean"):
            self._run(kernel)

    def surfaces(self) -> Tensor:
        """Own light, other light, coc and weight of the other surface of each pixel, ``[B, 2 C + 2, H, W]``."""
        surfaces = self._planes(2 * self._light.shape[1] + 2)
        self._set(surfaces=surfaces)
        self._run("split")
        return surfaces

    def gradients(self, of_surfaces: Tensor) -> list[Tensor]:
        """The gradients by light and coc from that of :meth:`surfaces`."""
        channels, of_surfaces = self._light.shape[1], of_surfaces.contiguous()
        of_values = self._planes(2 * channels + 2).zero_()
        self._set(of_values=of_values, of_surfaces=of_surfaces)

        # the pixels at edges, numbered from 1, and their parts of the gradients
        slots = (self._edge > 0).flatten().cumsum(0, dtype=torch.int32)
        self._common.count = count = int(slots[-1]) if len(slots) else 0
        parts = self._light.new_empty((2 * channels + 2) * _TAPS + 2 * channels, count)
        of_rows = self._light.new_empty(len(self._light), 4 * channels, self._light.shape[2])
        self._set(slots=slots, parts=parts, of_rows=of_rows)
        self._run("split_back")
        grid = (-(-self._light.shape[2] // loader.TILE_COLUMNS), channels, len(self._light))
        self._launch("sum_rows", grid, (loader.TILE_COLUMNS, 1, 1), self._common)
        of_ends = of_rows.sum(2)
        self._set(of_ends=of_ends)
        self._gather(0, 2 * channels + 2)
        self._run("find_clean_back")
        self._gather(0, channels + 2)
        self._run("find_edges_back")
        self._gather(channels, 1)
        return [of_values[:, :channels], of_values[:, channels : channels + 1]]

    def _gather(self, first: int, planes: int) -> None:
        """Adds the parts of the gradients by some values of each pixel."""
        self._common.first, self._common.planes = first, planes
        self._run("gather")

    def _planes(self, count: int) -> Tensor:
        return self._light.new_empty(len(self._light), count, *self._light.shape[2:])

    def _set(self, **maps: Tensor | None) -> None:
        """Points the argument to tensors."""
        for name, values in maps.items():
            setattr(self._common, name, loader.pointer(values))

    def _run(self, kernel: str) -> None:
        self._launch(kernel, *loader.frame_grid(self._light), self._common)
