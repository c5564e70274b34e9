"""Makes one table whose blur varies over the frame, from the dots of a grid."""

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

_CELLS = (96, 48)  # of half a spot, along and across the radial direction
_FINE = 64  # pixels on each side of the centre when a dot's kernel is drawn
_SAME = 0.05  # share of the largest distance from the centre within which dots are averaged


def table_of_dots(dots: Sequence[tuple[Captures, TableFit]]) -> BlurTable:
    """One table from all dots of a grid, with a blur that depends on the distance from the centre of the frame.

    Each dot gives the size of the blur at its position (field curvature), its profile and, if pictures were fitted, its
    shape (cat's eyes). Lenses are round, so the blur rotates with the azimuth, and dots at equal distances from the
    centre are averaged. Details that do not rotate, such as blades, average out if the dots surround the centre. The
    blur's offset from the sharp picture (coma) cannot be measured this way.

    Args:
        dots: captures and fit of each dot, the most central first, all with the same scale.

    Raises:
        FitError: there are no two dots at different distances from the centre, or their fits differ in kind.
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
    """Spots over blur and distance from the centre, from tables with the same nodes at single positions (x, y).

    Positions are those in the sharp picture, relative to the centre of the frame, in the tables' unit. At each node the
    picture is smaller by the factor `shrunk`, the focus distance over the object distance.
    """
    away = np.hypot(*np.array(places, dtype=np.float64).T)
    order = np.argsort(away)
    groups = np.split(order, np.flatnonzero(np.diff(away[order]) > _SAME * away.max()) + 1)  # dots at similar distances
    rings = groups if away[groups[0]].mean() > _SAME * away.max() else groups[1:]
    if not rings or away.max() == 0:
        raise FitError(f"dots must lie at two distances from the middle of the frame at least, got {len(groups)}")
    rising = np.array([0.0, *(away[ring].mean() for ring in rings)])
    # distances that dots reach in any picture: from the smallest picture's to the largest picture's
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
    coc, sizes, cells = tables[0].coc, torch.stack(boxes), torch.stack(light)  # [K], [K, F], [K, F, C, U, V]
    if not bool((coc < 0).any() and (coc > 0).any()):  # the other side of focus has these spots rotated by half a turn
        coc, sizes, cells = torch.cat([coc, -coc]), torch.cat([sizes, sizes]), torch.cat([cells, cells.flip(-2)])
        rising_coc = coc.argsort()
        coc, sizes, cells = coc[rising_coc], sizes[rising_coc], cells[rising_coc]
    upper = int((coc > 0).nonzero()[0])
    # in focus, interpolate the signed size: if it is not 0, that position has its focus at another depth
    part = coc[upper - 1] / (coc[upper - 1] - coc[upper])
    size = torch.lerp(-sizes[upper - 1], sizes[upper], part).abs()
    between = torch.lerp(cells[upper - 1], cells[upper], part)
    parts = ((coc, coc.new_zeros(1)), (sizes, size[None]), (cells, between[None]))
    coc, sizes, cells = (torch.cat([of[:upper], new, of[upper:]]) for of, new in parts)
    box = torch.stack([torch.zeros_like(sizes), sizes, sizes], -1)
    return Field(coc, torch.from_numpy(radius), box, cells.permute(2, 0, 1, 3, 4))


def _spot(
    tables: Sequence[BlurTable], places: Sequence[tuple[float, float]], group: np.ndarray, node: int, azimuths: int = 0
) -> tuple[float, Tensor]:
    """Half side of the box, and the light ``[C, U, V]``, of dots at one distance from the centre, at a node.

    Seen in the radial direction of each dot or, in the centre of the frame, averaged over `azimuths` directions.
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
