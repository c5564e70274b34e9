"""Steps of the picture on a CUDA device, by the kernels of :mod:`torchdof.kernels`.

They find and judge the edges of depth, block the rays of highlights, split mixed pixels, and blur and composite the
layers, the last two with their gradients.

Before a device first uses some kernels, they and the plain engine compute a small frame. If the results or the
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
from ...kernels import edges, layers, loader, matting, rays
from ...tensors import is_differentiated, is_in_memory, is_traced, without_autocast
from ..layers.layer_weights import ramps
from ..surfaces import edge_colours, edge_prior, edge_search
from ..surfaces.edge_colours import Looks, Shown
from ..surfaces.edge_search import Edges
from ..surfaces.frame import PaddedFrame, PaddedSurface, maps_of, surfaces_of
from ..surfaces.matting import Matted, with_covered
from ..surfaces.matting import matte as plain_matte
from ..surfaces.windows import mean_around
from .compiled_steps import differentiable
from .ops import EAGER, Ops

DEVICE = "cuda"
"""Type of the devices that have kernels."""

_NEAR = 1e-5  # largest difference between the results of both engines, of the light
_NEAR_GRADIENT = 1e-4  # the same of their gradients, of the norm

_FLAGS_OF_TRIAL = ((True, False), (False, True))  # of judge: the prior, and mixtures

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
    if not takes(maps, channels, len(frame.surfaces), colours):
        return None
    variant = (channels, len(frame.surfaces), frame.stacked, maps[0].device.index or 0)
    return None if _missing(_layers_of_trial, plain, *variant) else _by_kernels(frame, kernels, plain)


def matte(
    light: Tensor, coc_px: Tensor, valid: Tensor | None = None, ops: Ops = EAGER, covered: Tensor | None = None
) -> Matted:
    """:func:`torchdof.render.surfaces.matting.matte`, by kernels of a GPU if they compute it.

    Raises:
        ValueError: If they cannot be used and ``TORCHDOF_ENGINE`` is ``gpu``.
    """
    maps, channels = [t for t in (light, coc_px, valid, covered) if t is not None], light.shape[1]
    if not takes(maps, channels) or _missing(_matte_of_trial, channels, light.device.index or 0):
        return plain_matte(light, coc_px, valid, ops, covered)
    surfaces = Matted(*_matte_by_kernels(light, coc_px, valid).split([channels, channels, 1, 1], 1))
    return surfaces if covered is None else with_covered(light, surfaces, covered)


def find_edges(light: Tensor, nearness: Tensor, valid: Tensor, step: Tensor) -> Edges:
    """:func:`torchdof.render.surfaces.edge_search.find` for the map of an image ``[B, C, H, W]``, by kernels of a GPU.

    Raises:
        ValueError: If they cannot be used and ``TORCHDOF_ENGINE`` is ``gpu``.
    """
    if _has_no_edge_kernels(light.shape[1], nearness, light):
        return edge_search.find(nearness, valid, step)
    return _edges_by_kernels(light, nearness, valid, step)


def judge(
    looks: Looks, like: Tensor, edge_pixels: Tensor, sharpness: Tensor, in_prior: bool, mixtures: bool, ops: Ops
) -> Shown:
    """:func:`torchdof.render.surfaces.edge_colours.judge`, by kernels of a GPU if they compute it.

    Raises:
        ValueError: If they cannot be used and ``TORCHDOF_ENGINE`` is ``gpu``.
    """
    if _has_no_edge_kernels(looks.colour.shape[0], like, looks.maps):
        return edge_colours.judge(looks, like, edge_pixels, sharpness, in_prior, mixtures, ops)
    return _judged_by_kernels(looks, like, edge_pixels, sharpness, in_prior, mixtures)


def calibrate(light: Tensor, kinds: Tensor, score: Tensor) -> Tensor:
    """:func:`torchdof.render.surfaces.edge_prior.calibrate` for images ``[B, C, H, W]``, by kernels of a GPU.

    Raises:
        ValueError: If they cannot be used and ``TORCHDOF_ENGINE`` is ``gpu``.
    """
    if _has_no_edge_kernels(light.shape[1], light, score):
        return edge_prior.calibrate(kinds, score, light.shape[0])
    return _calibrated_by_kernels(light, kinds, score)


def _has_no_edge_kernels(channels: int, *maps: Tensor) -> bool:
    """Whether PyTorch finds and judges edges, for light of some channels and maps ``[B, ...]``."""
    return not takes(maps, channels) or _missing(_edges_of_trial, channels, maps[0].device.index or 0)


def blocked(plain: Callable[..., Tensor], *given: Any) -> Tensor:
    """``plain(scale, fades, wanted, at, step, shown)``, the rays that are blocked, by a kernel without gradients.

    Raises:
        ValueError: If it cannot be used and ``TORCHDOF_ENGINE`` is ``gpu``.
    """
    scale, fades, _, _, _, shown = given
    maps = (scale, fades, *shown)
    is_taken = takes(maps) and not any(map(is_differentiated, maps))
    if not is_taken or _missing(_rays_of_trial, plain, scale.device.index or 0):
        return plain(*given)
    return _blocked_by_kernels(*given)


def takes(maps: Sequence[Tensor], channels: int = 1, surfaces: int = 1, colours: int = 1) -> bool:
    """Whether the kernels are wanted and render maps ``[B, ...]`` of which B ``colours`` items have these channels.

    ``surfaces`` is the number of surfaces in a pixel.
    """
    if is_traced() or native.wanted() == "torch":
        return False
    if channels > loader.MOST_CHANNELS or surfaces > layers.MOST_SURFACES or len(maps[0]) * colours > loader.MOST_ITEMS:
        return False
    return all(t.dtype == torch.float32 and is_in_memory(t, backward=True, device=DEVICE) for t in maps)


def _missing(trial: "Trial", *variant: Any) -> bool:
    """Whether the kernels cannot be used, after a warning or an error that says why."""
    reason = why_missing(trial, *variant)
    if reason and native.wanted() == "gpu":
        raise ValueError(f"TORCHDOF_ENGINE is gpu, but {reason}; leave it out to render with PyTorch")
    if reason:
        _warn(reason)
    return bool(reason)


@functools.cache
def _warn(reason: str) -> None:
    message = f"PyTorch computes what CUDA kernels would, which is slower: {reason}"
    warnings.warn(message, RuntimeWarning, stacklevel=2)


Trial = Callable[..., tuple[Sequence[Tensor], Callable[..., Tensor], Callable[..., Tensor]]]
"""``trial(*variant)``: maps of a small frame, then what the plain engine and the kernels make of them."""


@functools.cache
def why_missing(trial: Trial, *variant: Any) -> str:
    """Why the kernels of a variant, whose last value is the device, cannot be used; empty if they can."""
    try:
        with torch.inference_mode(False), torch.enable_grad(), without_autocast(DEVICE), native.engine_off():
            maps, *engines = trial(*variant)
            maps = [t.to(torch.device(DEVICE, variant[-1])).requires_grad_() for t in maps]
            results = []
            for compute in engines:
                result = compute(*maps)
                has_gradients = result.requires_grad
                gradients = torch.autograd.grad(result.square().sum(), maps) if has_gradients else ()
                results.append((result.detach(), *gradients))
    except Exception as error:  # of any kind: the plain engine needs none of this
        return str(error) or type(error).__name__
    (result, *of_plain), (other, *of_kernels) = results
    is_near = bool((other - result).abs().max() <= _NEAR) and all(
        bool((b - a).norm() <= _NEAR_GRADIENT * a.norm()) for a, b in zip(of_plain, of_kernels, strict=True)
    )
    return "" if is_near else "on this device they render another picture than PyTorch"


def _layers_of_trial(plain: Plain, channels: int, surfaces: int, stacked: bool, device: int) -> Any:
    """A small frame of random light from 0 to 1, places and weights, and layers of two resolutions."""
    dice, nodes, (height, width), margin = torch.Generator().manual_seed(0), (-3.0, -1.0, 0.0, 1.0, 3.0), (20, 36), 8

    def random(*size: int) -> Tensor:
        return torch.rand(size, generator=dice)

    size = (height + 2 * margin, width + 2 * margin)
    maps = [
        t
        for _ in range(surfaces)
        for t in (random(1, channels, *size), 7.0 * random(1, 1, *size) - 3.5, random(1, 1, *size) / surfaces)
    ]
    where, kernels = torch.device(DEVICE, device), []
    for half, scale in ((2, 2), (3, 1), (0, 1), (3, 1), (3, 2)):
        kernel = random(1, 2 * half + 1, 2 * half + 1)
        kernels.append(((kernel / kernel.sum()).to(where), scale))
    behind = None if stacked else random(1, channels, height, width).to(where)
    starts, area = ramps([nodes], maps[0].to(where)), (height, width)

    def with_maps(*maps: Tensor) -> PaddedFrame:
        padded = [PaddedSurface(*maps[i : i + 3]) for i in range(0, len(maps), 3)]
        return PaddedFrame(padded, [nodes], starts, behind, margin, area, area, True, stacked)

    return (
        maps,
        lambda *maps: plain(with_maps(*maps), kernels),
        lambda *maps: _by_kernels(with_maps(*maps), kernels, plain),
    )


def _matte_of_trial(channels: int, device: int) -> Any:
    """A small image of patches, each with a random colour and coc, and noise."""
    dice = torch.Generator().manual_seed(0)
    light, coc_px = (torch.rand(1, n, 5, 7, generator=dice).repeat_interleave(4, 2) for n in (channels, 1))
    light, coc_px = (t.repeat_interleave(4, 3) for t in (light, coc_px))
    light = (light + 0.3 * torch.rand(light.shape, generator=dice)) / 1.3

    def weighted(surfaces: Sequence[Tensor]) -> Tensor:
        own, other, other_coc, weight = surfaces
        return torch.cat([own, weight * other, weight * other_coc, weight], 1)  # the other light is moved / weight

    return (
        [light, 16.0 * coc_px - 8.0],
        lambda *maps: weighted(plain_matte(*maps)),
        lambda *maps: weighted(_matte_by_kernels(*maps).split([channels, channels, 1, 1], 1)),
    )


def _edges_of_trial(channels: int, device: int) -> Any:
    """A small image of patches, each with a random colour and nearness, some of which end in ramps."""
    dice = torch.Generator().manual_seed(0)
    light, nearness = (torch.rand(1, n, 4, 6, generator=dice).repeat_interleave(9, 2) for n in (channels, 1))
    light, nearness = (t.repeat_interleave(9, 3) for t in (light, nearness))
    nearness[..., 18:, :] = mean_around(nearness, 2)[..., 18:, :]
    light = (light + 0.3 * torch.rand(light.shape, generator=dice)) / 1.3

    def shown(find: Any, decide: Any, learn: Any, light: Tensor, nearness: Tensor) -> Tensor:
        valid, every = nearness > -1e6, torch.arange(nearness.numel(), device=nearness.device)
        found = find(light, nearness, valid, torch.full_like(nearness, 1.0))
        found = found._replace(direction=found.direction * found.is_edge)  # elsewhere it has no meaning
        looks = Looks.of(light, nearness, valid, found)
        judged = [decide(looks, nearness, every, nearness.new_tensor([0.5]), *flags) for flags in _FLAGS_OF_TRIAL]
        kinds = edge_search.kinds(found).flatten()
        prior = learn(light, kinds, judged[0].score)[kinds]
        maps = [*found, *(values.view_as(nearness) for values in (*judged[0], *judged[1], prior))]
        return 0.1 * torch.cat([values.detach().to(nearness.dtype) for values in maps], 1)  # 0 to 1, about

    plain = (
        lambda light, *maps: edge_search.find(*maps),
        functools.partial(edge_colours.judge, ops=EAGER),
        lambda light, kinds, score: edge_prior.calibrate(kinds, score, 1),
    )
    by_kernels = (_edges_by_kernels, _judged_by_kernels, _calibrated_by_kernels)
    return [light, 8.0 * nearness], *(functools.partial(shown, *steps) for steps in (plain, by_kernels))


def _edges_by_kernels(light: Tensor, nearness: Tensor, valid: Tensor, step: Tensor) -> Edges:
    maps = (nearness.contiguous(), valid.contiguous(), step.expand_as(nearness).contiguous())
    return Edges(*edges.find(*maps, edge_search.RAMP_REACH, light.shape[1]))


def _rays_of_trial(plain: Callable[..., Tensor], device: int) -> Any:
    """Rays of four highlights past random surfaces in three bins."""
    dice = torch.Generator().manual_seed(0)
    places = [torch.randint(0, most, (4,), generator=dice).to(torch.device(DEVICE, device)) for most in (2, 9, 12)]

    def hidden(compute: Callable[..., Tensor], scale: Tensor, fades: Tensor, place: Tensor, cover: Tensor) -> Tensor:
        maps = [t.detach() for t in (scale, fades, place, cover)]
        step = torch.arange(-3, 4, device=scale.device)
        return compute(*maps[:2], fades > 0.3, places, step, maps[2:])

    maps = [torch.rand(size, generator=dice) for size in ((4, 3), (4, 3), (2, 2, 9, 12), (2, 2, 9, 12))]
    maps[2] = 2.0 * maps[2]
    return maps, functools.partial(hidden, plain), functools.partial(hidden, _blocked_by_kernels)


def _blocked_by_kernels(
    scale: Tensor, fades: Tensor, wanted: Tensor, at: Sequence[Tensor], step: Tensor, shown: Sequence[Tensor]
) -> Tensor:
    names = ("scale", "fades", "wanted", "item", "row", "column", "place", "cover")
    maps = (t.contiguous() for t in (scale, fades, wanted, *at, *shown))
    return rays.blocked(dict(zip(names, maps, strict=True)), len(step))


def _calibrated_by_kernels(light: Tensor, kinds: Tensor, score: Tensor) -> Tensor:
    return edges.calibrate(kinds, score, len(light), edge_search.PLACES, edge_search.DIRECTIONS, light.shape[1])


def _judged_by_kernels(
    looks: Looks, like: Tensor, edge_pixels: Tensor, sharpness: Tensor, in_prior: bool, mixtures: bool
) -> Shown:
    maps = (looks.maps.contiguous(), like, edge_pixels, edge_colours.falloff(like.dtype, like.device))
    return Shown(*edges.judge(*maps, sharpness, in_prior, mixtures))


def _matte_by_kernels(light: Tensor, coc_px: Tensor, valid: Tensor | None = None) -> Tensor:
    """The surfaces of :func:`matte` without a matte, ``[B, 2 C + 2, H, W]``."""
    given = [light, coc_px, *([] if valid is None else [valid])]

    def matting_of(*maps: Tensor) -> matting.Matting:
        light, coc_px, *valid = (t.contiguous() for t in maps)
        return matting.Matting(light, coc_px, valid[0] if valid else None)

    return differentiable(
        lambda *maps: matting_of(*maps).surfaces(),
        lambda gradient, *maps: matting_of(*maps).gradients(gradient),
        lambda *maps: torch.cat(plain_matte(*maps), 1),
        *given,
    )


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
