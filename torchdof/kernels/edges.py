"""Edges of maps of depth on a GPU: the host code of ``edges.cu``, whose comments have the steps.

Tensors are float32, contiguous and on one device. ``B`` items have ``C`` channels.
"""

import ctypes
import functools

import torch
from torch import Tensor

from . import loader

_BLOCK = 128  # threads of a block for a list of pixels, as in edges.cu
_WORK = 9  # planes of the work, as in edges.cu

module, options = loader.by_channels("edges.cu"), loader.options


@functools.cache
def argument_type() -> type[ctypes.Structure]:
    """The structure that all kernels take, as ``edges.cu`` defines it."""
    return loader.structure(loader.text("edges.cu"), {})


def _argument(like: Tensor, maps: dict[str, Tensor], **numbers: int) -> ctypes.Structure:
    """The argument for maps that are like ``like``, ``[B, 1, H, W]``."""
    items, _, height, width = like.shape
    pointers = {name: loader.pointer(values) for name, values in maps.items()}
    return argument_type()(items=items, height=height, width=width, **pointers, **numbers)


def find(nearness: Tensor, valid: Tensor, step: Tensor, ramp_reach: int, channels: int) -> tuple[Tensor, ...]:
    """Finds edges, as :func:`torchdof.render.surfaces.edge_search.find`.

    Args:
        nearness: ``[B, 1, H, W]``, finite.
        valid: Whether a pixel counts, like ``nearness``.
        step: Smallest difference of two surfaces, like ``nearness``.
        ramp_reach: Half the width of the widest ramp in pixels.
        channels: That of the kernels, which also judge the pixels.

    Returns:
        Near and far surface, whether a pixel is on a ramp, ring, whether it is at an edge, direction, level, and climb,
        like ``nearness``.
    """
    items, _, height, width = nearness.shape
    launch, device = module(channels, nearness.device.index or 0), nearness.device
    is_ramp, is_edge = (torch.empty(nearness.shape, dtype=torch.bool, device=device) for _ in range(2))
    # indices, so valid ones even if the kernels fail on a device
    ring, direction = (torch.zeros(nearness.shape, dtype=torch.long, device=device) for _ in range(2))
    edges, work = (nearness.new_empty(items, planes, height, width) for planes in (4, _WORK))
    given = {"nearness": nearness, "valid": valid, "step": step, "work": work}
    found = {"edges": edges, "is_ramp": is_ramp, "is_edge": is_edge, "ring": ring, "direction": direction}
    argument = _argument(nearness, {**given, **found})
    for kernel in ("find_slopes", "smooth_slopes", "find_ramps", *["climb_ramps"] * ramp_reach, "find_surfaces"):
        launch(kernel, *loader.frame_grid(nearness), argument)
        argument.turn ^= kernel == "climb_ramps"
    near, far, level, climb = edges.split(1, 1)
    return near, far, is_ramp, ring, is_edge, direction, level, climb


def calibrate(kinds: Tensor, score: Tensor, items: int, places: int, directions: int, channels: int) -> Tensor:
    """The prior, as :func:`torchdof.render.surfaces.edge_prior.calibrate`.

    Args:
        kinds: Kinds of samples ``[P]``: ``(item * places + place) * directions + direction``.
        score: Scores of the samples.
        items: Number of items.
        places: Number of places of an edge pixel.
        directions: Number of directions of an edge.
        channels: That of the kernels.

    Returns:
        The share of each kind, ``[B * places * directions]``.
    """
    launch = module(channels, score.device.index or 0)
    shares, prior = (score.new_empty(items * places * n) for n in (1, directions))
    kinds, order = kinds.sort(stable=True)
    starts = torch.searchsorted(kinds, torch.arange(len(prior) + 1, device=kinds.device))
    maps = {"sampled": score[order], "starts": starts, "shares": shares, "prior": prior}
    argument = argument_type()(**{name: loader.pointer(values) for name, values in maps.items()})
    for turn, of_turn in enumerate((shares, prior)):
        argument.turn, argument.count = turn, len(of_turn)
        launch("fit", (-(-len(of_turn) // _BLOCK), 1, 1), (_BLOCK, 1, 1), argument)
    return prior


def judge(
    looks: Tensor, like: Tensor, chosen: Tensor, falloff: Tensor, sharpness: Tensor, is_prior: bool, mixtures: bool
) -> Tensor:
    """Scores pixels ``[P]`` by colour, as :func:`torchdof.render.surfaces.edge_colours.judge`.

    Args:
        looks: What the pixels look like, ``[C + 5, B * H * W]``.
        like: A map of the frame, ``[B, 1, H, W]``.
        chosen: Indices of the pixels.
        falloff: Weights of a window of samples.
        sharpness: The factor on the scores of each item, ``[B]``.
        is_prior: Whether more samples are needed, for the shares of wrong pixels.
        mixtures: Whether mixed colours count as a more blurred near surface.

    Returns:
        Score, evidence, near and far surface of each pixel, ``[4, P]``.
    """
    count, launch = chosen.shape[0], module(looks.shape[0] - 5, like.device.index or 0)
    shown, scores = looks.new_empty(5, count), torch.full_like(like, torch.nan)
    given = {"looks": looks, "chosen": chosen, "falloff": falloff, "sharpness": sharpness}
    flags = {"is_prior": is_prior, "mixtures": mixtures}
    argument = _argument(like, {**given, "scores": scores, "shown": shown}, count=count, **flags)
    for kernel in ("judge", "decide") if count else ():
        launch(kernel, (-(-count // _BLOCK), 1, 1), (_BLOCK, 1, 1), argument)
    return shown[:4]
