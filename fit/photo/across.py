"""The dots of a grid to one table whose blur depends on the place in the frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.field import Field

from ..problems import FitError
from .manifest import Captures
from .table import TableFit

__all__ = ["field_of_dots", "table_of_dots"]

_CELLS = (96, 48)  # of half a spot, along and across
_FINE = 64  # pixels of the picture of a dot's kernel on each side of its middle
_SAME = 0.05  # of the farthest dot's distance from the middle; dots as far from it as that are taken together


def table_of_dots(dots: Sequence[tuple[Captures, TableFit]]) -> BlurTable:
    """One table of all dots of a grid, whose blur depends on the distance from the middle of the frame.

    Each dot tells of its place how large the blur is there (field curvature), of what profile, and what it looks like
    where pictures of it were fitted (cat's eyes). Lenses are round, so the blur turns with the azimuth, and dots as far
    from the middle as others are averaged: what does not turn, such as blades, is averaged away as dots surround the
    middle. Where the blur lies against the sharp picture (coma) photographs do not tell.

    Args:
        dots: What was photographed and fitted of each, the most central first, all with the scale of its fit.

    Returns:
        The first dot's table with a field.

    Raises:
        FitError: There are no two dots at different distances from the middle, or they were not fitted alike.
    """
    if len(dots) < 2:
        raise FitError(f"dots must be those of a grid, two at least, got {len(dots)}")
    first = dots[0][1].table
    per_px = float(first.coc[-1]) / dots[0][1].coc_px[-1]
    for captures, fitted in dots:
        same = fitted.table.coc.shape == first.coc.shape and torch.allclose(fitted.table.coc, first.coc, rtol=1e-6)
        if not same or fitted.table.channels != first.channels:
            where = captures.notes.get("position_px")
            raise FitError(f"the dot at {where} px must be fitted at the distances and colours of the first one")
    places = [tuple(v * per_px for v in captures.pairs[0].position_px) for captures, _ in dots]
    shrunk = [dots[0][0].focus_m / pair.distance_m for pair in dots[0][0]]
    field = field_of_dots([fitted.table for _, fitted in dots], places, shrunk)
    found = {"dots_px": [list(captures.pairs[0].position_px) for captures, _ in dots]}
    return first.replace(aperture=None, field=field, provenance=first.provenance | found)


def field_of_dots(tables: Sequence[BlurTable], places: Sequence[tuple[float, float]], shrunk: Sequence[float]) -> Field:
    """Spots over blur and distance from the middle, of tables of single places.

    Args:
        tables: With the same nodes.
        places: Of each in the sharp picture, (x, y) from the middle of the frame, in the tables' unit.
        shrunk: By how much pictures shrink towards the middle at each node: the focus over the distance.

    Raises:
        FitError: There are no two distances from the middle.
    """
    away = np.hypot(*np.array(places, dtype=np.float64).T)
    groups = _groups(away)
    rings = groups if away[groups[0]].mean() > _SAME * away.max() else groups[1:]
    if not rings or away.max() == 0:
        raise FitError(f"dots must lie at two distances from the middle of the frame at least, got {len(groups)}")
    rising = np.array([0.0, *(away[ring].mean() for ring in rings)])
    # where dots lie in the picture in which they lie nearest to the middle, and in that where they lie farthest
    both = np.sort(np.concatenate([rising * min(shrunk), rising[1:] * max(shrunk)]))
    radius = both[np.concatenate([[True], np.diff(both) > 1e-3 * both[-1]])]
    coc = tables[0].coc
    boxes, light = [], []
    for k in range(len(coc)):
        middle = _spot(tables, places, groups[0], k, everywhere=True)
        spots = [middle, *(_spot(tables, places, ring, k) for ring in rings)]
        low, part = _between(rising * shrunk[k], radius)
        reach, seen = torch.tensor([spot[0] for spot in spots]).double(), torch.stack([spot[1] for spot in spots])
        part = torch.from_numpy(part)
        boxes.append(torch.lerp(reach[low], reach[low + 1], part))
        light.append(torch.lerp(seen[low], seen[low + 1], part[:, None, None, None]))
    sizes, cells = torch.stack(boxes), torch.stack(light)  # [K, F], [K, F, C, U, V]
    coc, sizes, cells = _both_sides(coc, sizes, cells)
    box = torch.stack([torch.zeros_like(sizes), sizes, sizes], -1)
    return Field(coc, torch.from_numpy(radius), box, cells.permute(2, 0, 1, 3, 4))


def _groups(away: np.ndarray) -> list[np.ndarray]:
    """Dots at like distances from the middle, by growing distance."""
    order = np.argsort(away)
    ends = np.flatnonzero(np.diff(away[order]) > _SAME * away.max()) + 1
    return np.split(order, ends)


def _spot(
    tables: Sequence[BlurTable],
    places: Sequence[tuple[float, float]],
    group: np.ndarray,
    node: int,
    everywhere: bool = False,
) -> tuple[float, Tensor]:
    """Half the side of the box and the light ``[C, U, V]`` of dots as far from the middle as each other, at a node.

    That of ``everywhere`` is the mean over all azimuths, as in the middle of the frame.
    """
    coc = float(tables[0].coc[node])
    reach = max(tables[i].reach_px(coc * tables[i].px_per_unit(1.0), 1.0) / tables[i].px_per_unit(1.0) for i in group)
    along, across = (torch.arange(n, dtype=torch.float64) + 0.5 for n in _CELLS)
    u, v = (along * (2.0 / _CELLS[0]) - 1.0)[:, None], across / _CELLS[1]
    total = torch.zeros(tables[0].channels, *_CELLS, dtype=torch.float64)
    for i in group:
        width = _FINE / reach / tables[i].px_per_unit(1.0)
        kernel = tables[i].kernels(torch.tensor([coc * tables[i].px_per_unit(width)], dtype=torch.float64), width)
        x, y = places[i]
        azimuths = np.linspace(0.0, 2.0 * math.pi, 32, endpoint=False) if everywhere else [math.atan2(y, x)]
        for azimuth in azimuths:
            sine, cosine = math.sin(azimuth), math.cos(azimuth)
            for side in (1.0, -1.0):
                place = torch.stack([u * cosine - side * v * sine, u * sine + side * v * cosine], -1)
                grid = place * (2.0 * _FINE / kernel.shape[-1])
                taken = functional.grid_sample(kernel, grid[None], align_corners=False)[0]
                total += taken / (len(azimuths) * taken.sum((-2, -1), keepdim=True))
    return reach, total / (2 * len(group))


def _between(nodes: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Node before each place and how far on the way to the next one it lies, 0 to 1."""
    low = np.clip(np.searchsorted(nodes, place, side="right") - 1, 0, len(nodes) - 2)
    return low, np.clip((place - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)


def _both_sides(coc: Tensor, sizes: Tensor, light: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Nodes on both sides of focus and in it: a side without any shows the other's spots turned by half."""
    if not bool((coc < 0).any() and (coc > 0).any()):
        coc, sizes, light = (
            torch.cat(pair) for pair in ((coc, -coc.flip(0)), (sizes, sizes.flip(0)), (light, light.flip(0, -2)))
        )
        order = coc.argsort()
        coc, sizes, light = coc[order], sizes[order], light[order]
    upper = int((coc > 0).nonzero()[0])
    # the signed size is a line: where it does not cross 0 in focus, the focus of that place lies elsewhere
    part = coc[upper - 1] / (coc[upper - 1] - coc[upper])
    size = torch.lerp(-sizes[upper - 1], sizes[upper], part).abs()
    between = torch.lerp(light[upper - 1], light[upper], part)
    parts = ((coc, coc.new_zeros(1)), (sizes, size[None]), (light, between[None]))
    coc, sizes, light = (torch.cat([of[:upper], new, of[upper:]]) for of, new in parts)
    return coc, sizes, light
