"""Pixels without depth: count, refuse or fill them."""

import itertools
from typing import Literal

import torch
from torch import Tensor

from ..validation import number, one_channel, show

__all__ = ["Fill", "fill_holes", "resolve_holes"]

Fill = Literal["nearest", "far"] | float
"""The rule by which :func:`fill_holes` fills a hole, or a depth in metres."""


def fill_holes(depth: Tensor, fill: Fill) -> Tensor:
    """Fills every pixel without depth (NaN).

    Args:
        depth: ``[1, 1, H, W]``.
        fill: "nearest" takes the nearest pixel with depth (by jump flooding, which occasionally picks one that is a
            fraction of a pixel farther). "far" takes the farthest of the first pixels with depth to the left, right,
            above and below, because stereo misses the background beside a foreground. A number is the depth in metres,
            for example inf for a sky.

    Returns:
        ``[1, 1, H, W]`` without NaN; known depths are unchanged.

    Raises:
        ValueError: If no pixel has a depth to fill from, or the fill is unknown.

    Example:
        >>> fill_holes(torch.tensor([[[[1.0, torch.nan, torch.nan, 4.0]]]]), "far")
        tensor([[[[1., 4., 4., 4.]]]])
    """
    one_channel("depth", depth, "in metres")
    if not isinstance(fill, str):
        metres = number("fill (the depth in holes)", fill, 0, unit="metres", infinite=True)
        return torch.where(depth.isnan(), torch.tensor(metres, dtype=torch.float64, device="cpu").to(depth), depth)
    if fill not in ("nearest", "far"):
        raise ValueError(f"fill must be 'nearest', 'far' or metres, got {show(fill)}")
    if len(depth) != 1:
        raise ValueError(f"depth must be [1, 1, H, W], got {list(depth.shape)}")
    if not bool(depth.isnan().any()):
        return depth
    if bool(depth.isnan().all()):
        raise ValueError("no pixel has a depth; check the kind, scale and offset of the depth map")
    if fill == "nearest":
        return _nearest(depth[0, 0])[None, None]
    farthest = torch.full_like(depth, -torch.inf)
    for turns in range(4):  # to the left of each hole, then above it, to the right and below
        line = depth.rot90(turns, (-2, -1))
        places = torch.arange(line.shape[-1], device=line.device)
        last = torch.where(line.isnan(), -1, places).cummax(-1).values
        values = torch.where(last >= 0, line.gather(-1, last.clamp(min=0)), -torch.inf)
        farthest = torch.maximum(farthest, values.rot90(-turns, (-2, -1)))
    filled = torch.where(depth.isnan() & (farthest > -torch.inf), farthest, depth)
    return fill_holes(filled, "nearest")  # holes without any depth in their row and column


def resolve_holes(depth: Tensor, name: str, fill: Fill | None, zero_is_known: bool = False) -> tuple[Tensor, int]:
    """The depth without holes (NaN), filled as by :func:`fill_holes` or, with None, refused; and how many there were.

    For the message: ``name`` is that of the file, ``zero_is_known`` whether zero and negative numbers are known depths,
    as in relative depth.
    """
    holes = int(depth.isnan().sum())
    if holes == 0:
        return depth, 0
    if fill is None and holes < depth.numel():
        causes, hint = "NaN or marked unknown", ""
        if not zero_is_known:
            causes = "NaN, zero, negative or marked unknown"
            hint = "; if zero is the far end of relative depth, say that (--depth-kind relative)"
        share = f"{holes} pixels ({100 * holes / depth.numel():.1f} %) have no depth ({causes})"
        raise ValueError(f"{name}: {share}; say how to fill them: fill 'nearest' or 'far' (--fill-depth){hint}")
    try:
        return fill_holes(depth, "far" if fill is None else fill), holes
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _nearest(depth: Tensor) -> Tensor:
    """Fills NaN in ``[H, W]`` with the nearest depth, by jump flooding (Rong and Tan 2006) on the holes alone."""
    height, width = depth.shape
    y, x = torch.nonzero(depth.isnan(), as_tuple=True)
    places = torch.arange(depth.numel(), device=depth.device).reshape(depth.shape)
    seed = torch.where(depth.isnan(), -1, places)
    for step in [*(1 << k for k in range(max(height, width).bit_length(), -1, -1)), 2, 1]:
        best, best_distance = seed[y, x], torch.full_like(y, torch.iinfo(torch.int64).max)
        for dy, dx in [(0, 0), *itertools.product((-step, 0, step), repeat=2)]:
            inside = (y + dy >= 0) & (y + dy < height) & (x + dx >= 0) & (x + dx < width)
            candidate = seed[(y + dy).clamp(0, height - 1), (x + dx).clamp(0, width - 1)]
            distance = (candidate // width - y) ** 2 + (candidate % width - x) ** 2
            is_nearer = inside & (candidate >= 0) & (distance < best_distance)
            best = torch.where(is_nearer, candidate, best)
            best_distance = torch.where(is_nearer, distance, best_distance)
        seed[y, x] = best
    return depth.flatten()[seed]
