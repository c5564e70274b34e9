"""The layers of a picture on a CUDA device, by the kernels of :mod:`torchdof.kernels`, forward and backward.

Before a device first renders with some kernels, they and the plain engine render a small frame. If the pictures or the
gradients differ, or if the kernels cannot be compiled, the plain engine is used from then on, with one warning that
says why; ``TORCHDOF_ENGINE=gpu`` makes it an error.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ... import native
from ...kernels import layers
from ...tensors import is_differentiated, is_in_memory, is_traced, without_autocast
from ..layers.layer_weights import ramps
from ..surfaces.frame import PaddedFrame, PaddedSurface, maps_of, surfaces_of
from .compiled_steps import differentiable

DEVICE = "cuda"
"""Type of the devices that have kernels."""

_NEAR = 1e-5  # largest difference between the pictures of both engines, of the light
_NEAR_GRADIENT = 1e-4  # the same of their gradients, of the norm

Kernels = Sequence[tuple[Tensor, int]]
"""Kernel ``[1 or C, k, k]`` or ``[B, 1 or C, k, k]`` of each layer, near to far, and the size of its pixels."""

Plain = Callable[[PaddedFrame, Kernels], Tensor]
"""The plain engine: light ``[B, C, h, w]``, then its weight of each of the kernels' colours."""


def composited(frame: PaddedFrame, kernels: Kernels, plain: Plain) -> Tensor | None:
    """The result of ``plain(frame, kernels)`` by kernels of a GPU; None if they do not render it or cannot be used.

    Raises:
        ValueError: If they cannot be used and ``TORCHDOF_ENGINE`` is ``gpu``.
    """
    if not frame.occlusion or any(kernel.requires_grad for kernel, _ in kernels):
        return None
    maps, colours = maps_of(frame.surfaces), kernels[0][0].shape[-3]
    channels = frame.colours // colours
    # the number of items last: a traced graph, which `takes` refuses, leaves it open
    if not takes(maps, channels, len(frame.surfaces)) or len(maps[0]) * colours > layers.MOST_ITEMS:
        return None
    variant = (channels, len(frame.surfaces), frame.stacked, maps[0].device.index or 0)
    return None if _missing(plain, *variant) else _by_kernels(frame, kernels, plain)


def takes(maps: Sequence[Tensor], channels: int, surfaces: int) -> bool:
    """Whether the kernels are wanted, and render maps with these numbers of channels and of surfaces in a pixel."""
    if is_traced() or native.wanted() == "torch":
        return False
    if channels > layers.MOST_CHANNELS or surfaces > layers.MOST_SURFACES:
        return False
    return all(t.dtype == torch.float32 and is_in_memory(t, backward=True, device=DEVICE) for t in maps)


def _missing(plain: Plain, *variant: Any) -> bool:
    """Whether the kernels cannot be used, after a warning or an error that says why."""
    reason = why_missing(plain, *variant)
    if reason and native.wanted() == "gpu":
        raise ValueError(f"TORCHDOF_ENGINE is gpu, but {reason}; leave it out to render with PyTorch")
    if reason:
        _warn(reason)
    return bool(reason)


@functools.cache
def _warn(reason: str) -> None:
    message = f"layers are rendered by PyTorch instead of CUDA kernels, which is slower: {reason}"
    warnings.warn(message, RuntimeWarning, stacklevel=2)


@functools.cache
def why_missing(plain: Plain, channels: int, surfaces: int, stacked: bool, device: int) -> str:
    """Why the kernels for these numbers of channels and surfaces cannot be used on a device; empty if they can."""
    where = torch.device(DEVICE, device)
    try:
        with torch.inference_mode(False), torch.enable_grad(), without_autocast(DEVICE):
            frame, kernels = _trial(channels, surfaces, stacked, where)
            results = []
            for render in (plain, functools.partial(_by_kernels, plain=plain)):
                picture = render(frame, kernels)
                gradients = torch.autograd.grad(picture.square().sum(), maps_of(frame.surfaces))
                results.append((picture.detach(), *gradients))
    except Exception as error:  # of any kind: the plain engine needs none of this
        return str(error) or type(error).__name__
    (picture, *of_plain), (other, *of_kernels) = results
    is_near = bool((other - picture).abs().max() <= _NEAR) and all(
        bool((b - a).norm() <= _NEAR_GRADIENT * a.norm()) for a, b in zip(of_plain, of_kernels, strict=True)
    )
    return "" if is_near else "on this device they render another picture than PyTorch"


def _trial(channels: int, surfaces: int, stacked: bool, device: torch.device) -> tuple[PaddedFrame, Kernels]:
    """A small frame of random light from 0 to 1, places and weights, and layers of two resolutions."""
    dice, nodes, (height, width), margin = torch.Generator().manual_seed(0), (-3.0, -1.0, 0.0, 1.0, 3.0), (20, 36), 8

    def random(*size: int) -> Tensor:
        return torch.rand(size, generator=dice)

    size = (height + 2 * margin, width + 2 * margin)
    maps = [
        (random(1, channels, *size), 7.0 * random(1, 1, *size) - 3.5, random(1, 1, *size) / surfaces)
        for _ in range(surfaces)
    ]
    kernels = []
    for half, scale in ((2, 2), (3, 1), (0, 1), (3, 1), (3, 2)):
        kernel = random(1, 2 * half + 1, 2 * half + 1)
        kernels.append(((kernel / kernel.sum()).to(device), scale))
    padded = [PaddedSurface(*(t.to(device).requires_grad_() for t in of_surface)) for of_surface in maps]
    behind = None if stacked else random(1, channels, height, width).to(device)
    starts, area = ramps([nodes], padded[0].x.detach()), (height, width)
    return PaddedFrame(padded, [nodes], starts, behind, margin, area, area, True, stacked), kernels


def _by_kernels(frame: PaddedFrame, kernels: Kernels, plain: Plain) -> Tensor:
    maps, count = maps_of(frame.surfaces), len(frame.surfaces)
    kept: list[layers.Kept] | None = [] if any(map(is_differentiated, maps)) else None
    frame = dataclasses.replace(frame, surfaces=[])  # autograd keeps the maps

    def with_maps(maps: Sequence[Tensor]) -> PaddedFrame:
        return dataclasses.replace(frame, surfaces=surfaces_of(maps, count))

    def picture(*maps: Tensor) -> Tensor:
        return _composite(with_maps(maps), kernels).picture(kept)

    def gradients(gradient: Tensor, *maps: Tensor) -> list[Tensor]:
        found = _composite(with_maps(maps), kernels).gradients(gradient, kept or [])
        return [t for t in found if t is not None]

    return differentiable(picture, gradients, lambda *maps: plain(with_maps(maps), kernels), *maps)


def _composite(frame: PaddedFrame, kernels: Kernels) -> layers.Composite:
    """The layers of a frame for the kernels."""
    given = layers.Frame(
        frame.ramps.contiguous(),
        [kernel.detach() for kernel, _ in kernels],
        [scale for _, scale in kernels],
        [min(places) < 0 for places in zip(*frame.nodes, strict=True)],
        frame.margin,
        frame.area,
        frame.stacked,
        frame.behind is not None,
    )
    surfaces = [
        (light.contiguous(), x.contiguous(), None if weight is None else weight.contiguous())
        for light, x, weight in frame.surfaces
    ]
    return layers.Composite(given, surfaces)
