"""Rays of highlights on a GPU: the host code of ``rays.cu``. Tensors are on one device; numbers are float32."""

import ctypes
import functools

from torch import Tensor

from . import loader
from .loader import Launch

_BLOCK = 128  # threads of a block, as in rays.cu


@functools.cache
def module(device: int) -> Launch:
    """The kernel, compiled for a CUDA device."""
    return loader.on_device(loader.text("rays.cu"), [], device)


@functools.cache
def argument_type() -> type[ctypes.Structure]:
    """The structure that the kernel takes, as ``rays.cu`` defines it."""
    return loader.structure(loader.text("rays.cu"), {})


def blocked(maps: dict[str, Tensor], side: int) -> Tensor:
    """The part of each ray that is blocked, ``[n, side, side]``, as ``torchdof.render.highlights`` computes it.

    ``maps`` are the members of the argument that are given, by their names; all are contiguous.
    """
    (count, bins), (surfaces, items, height, width) = maps["scale"].shape, maps["place"].shape
    hidden = maps["scale"].new_empty(count, side, side)
    sizes = {"count": count, "bins": bins, "side": side, "surfaces": surfaces}
    sizes |= {"items": items, "height": height, "width": width}
    pointers = {name: loader.pointer(values) for name, values in {**maps, "hidden": hidden}.items()}
    if count:
        launch, grid = module(hidden.device.index or 0), (-(-hidden.numel() // _BLOCK), 1, 1)
        launch("block_rays", grid, (_BLOCK, 1, 1), argument_type()(**sizes, **pointers))
    return hidden
