"""The dots of a grid to one table whose blur depends on the place in the frame."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.field import Field

from ..problems import FitError
from ..result import Array
from .captures import Captures
from .table import TableFit

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

    Raises:
        FitError: There are no two dots at different distances from the middle, or they were not fitted alike.
    """
    if len(dots) < 2:
        raise FitError(f"dots must be those of a grid, two at least, got {len(dots)}")
    captures, fitted = dots[0]
    first = fitted.table
    for other, its_fit in dots:
        same = its_fit.table.coc.shape == first.coc.shape and torch.allclose(its_fit.table.coc, first.coc, rtol=1e-6)
        if not same or its_fit.table.channels != first.channels:
            where = other.notes.get("position_px")
            raise FitError(f"the dot at {where} px must be fitted at the distances and colours of the first one")
    centres = [other.pairs[0].position_px for other, _ in dots]
    per_px = float(first.coc[-1]) / fitted.coc_px[-1]
    places = [(x * per_px, y * per_px) for x, y in centres]
    field = field_of_dots([its_fit.table for _, its_fit in dots], places, captures.focus_m / captures.distances_m)
    found = {"dots_px": [list(place) for place in centres]}
    return first.replace(aperture=None, field=field, provenance=first.provenance | found)


def field_of_dots(tables: Sequence[BlurTable], places: Sequence[tuple[float, float]], shrunk: Array) -> Field:
    """Spots over blur and distance from the middle, of tables with the same nodes of single places (x, y).

    Places are those in the sharp picture, from the middle of the frame, in the tables' unit; pictures shrink towards
    the middle by the focus over the distance at each node.
    """
    away = np.hypot(*np.array(places, dtype=np.float64).T)
    order = np.argsort(away)
    groups = np.split(order, np.flatnonzero(np.diff(away[order]) > _SAME * away.max()) + 1)  # at like distances
    rings = groups if away[groups[0]].mean() > _SAME * away.max() else groups[1:]
    if not rings or away.max() == 0:
        raise FitError(f"dots must lie at two distances from the middle of the frame at least, got {len(groups)}")
    rising = np.array([0.0, *(away[ring].mean() for ring in rings)])
    # where dots lie in the picture in which they lie nearest to the middle, and in that where they lie farthest
    both = np.sort(np.concatenate([rising * min(shrunk), rising[1:] * max(shrunk)]))
    radius = both[np.concatenate([[True], np.diff(both) > 1e-3 * both[-1]])]
    boxes, light = [], []
    for k in range(len(tables[0].coc)):
        spots = [_spot(tables, places, groups[0], k, azimuths=32), *(_spot(tables, places, ring, k) for ring in rings)]
        nodes = rising * shrunk[k]
        low = np.clip(np.searchsorted(nodes, radius, side="right") - 1, 0, len(nodes) - 2)
        part = torch.from_numpy(np.clip((radius - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0))
        reach, seen = torch.tensor([spot[0] for spot in spots]).double(), torch.stack([spot[1] for spot in spots])
        boxes.append(torch.lerp(reach[low], reach[low + 1], part))
        light.append(torch.lerp(seen[low], seen[low + 1], part[:, None, None, None]))
    sizes, cells = torch.stack(boxes), torch.stack(light)  # [K, F], [K, F, C, U, V]
    coc, sizes, cells = _both_sides(tables[0].coc, sizes, cells)
    box = torch.stack([torch.zeros_like(sizes), sizes, sizes], -1)
    return Field(coc, torch.from_numpy(radius), box, cells.permute(2, 0, 1, 3, 4))


def _spot(
    tables: Sequence[BlurTable], places: Sequence[tuple[float, float]], group: np.ndarray, node: int, azimuths: int = 0
) -> tuple[float, Tensor]:
    """Half the side of the box and the light ``[C, U, V]`` of dots as far from the middle as each other, at a node.

    As seen towards each dot, or, in the middle of the frame, as the mean over a number of azimuths.
    """
    unit = tables[0].px_per_unit(1.0)
    coc = float(tables[0].coc[node]) * unit
    reach = max(tables[i].reach_px(coc, 1.0) for i in group) / unit
    along, across = (torch.arange(n, dtype=torch.float64) + 0.5 for n in _CELLS)
    u, v = (along * (2.0 / _CELLS[0]) - 1.0)[:, None], across / _CELLS[1]
    total = torch.zeros(tables[0].channels, *_CELLS, dtype=torch.float64)
    width = _FINE / reach / unit
    for i in group:
        kernel = tables[i].kernels(torch.tensor([coc * width], dtype=torch.float64), width)
        x, y = places[i]
        angles = np.linspace(0.0, 2.0 * math.pi, azimuths, endpoint=False) if azimuths else [math.atan2(y, x)]
        for angle in angles:
            sine, cosine = math.sin(angle), math.cos(angle)
            for side in (1.0, -1.0):
                place = torch.stack([u * cosine - side * v * sine, u * sine + side * v * cosine], -1)
                grid = place * (2.0 * _FINE / kernel.shape[-1])
                taken = functional.grid_sample(kernel, grid[None], align_corners=False)[0]
                total += taken / (len(angles) * taken.sum((-2, -1), keepdim=True))
    return reach, total / (2 * len(group))


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
