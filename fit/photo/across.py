"""Makes one table whose blur varies over the frame, from the dots of a grid."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.field import Field, bracket
from torchdof.validation import show

from ..problems import FitError
from ..result import Array
from .captures import Captures
from .table import TableFit

_CELLS = (96, 48)  # of half a spot, along and across the radial direction
_KERNEL_HALF = 64  # pixels on each side of the centre when a dot's kernel is drawn
_RING_WIDTH = 0.05  # share of the largest distance from the centre within which dots are averaged


def table_of_dots(dots: Sequence[tuple[Captures, TableFit]]) -> BlurTable:
    """One table from all dots of a grid, with a blur that depends on the distance from the centre of the frame.

    Each dot gives the size of the blur at its position (field curvature), its profile and, if pictures were fitted, its
    shape (cat's eyes). Lenses are round, so dots at equal distances from the centre are averaged, each rotated to one
    azimuth. The blur's offset from the sharp picture (coma) cannot be measured this way.

    Args:
        dots: captures and fit of each dot, the most central first, all with the same scale.

    Raises:
        FitError: there are no two dots at different distances from the centre, or their fits differ in kind.
    """
    if not isinstance(dots, Sequence) or len(dots) < 2:
        raise FitError(f"dots must be a sequence of two dots of a grid at least, got {show(dots)}")
    (captures, first_fit), tables = dots[0], [fit.table for _, fit in dots]
    first, centres = first_fit.table, [list(other.pairs[0].position_px) for other, _ in dots]
    for table, centre in zip(tables, centres, strict=True):
        is_like_first = table.coc.shape == first.coc.shape and torch.allclose(table.coc, first.coc, rtol=1e-6)
        if not is_like_first or table.channels != first.channels:
            raise FitError(f"the dot at {centre} px must be fitted at the distances and colours of the first one")
    unit_per_px = float(first.coc[-1]) / first_fit.coc_px[-1]
    positions = [(x * unit_per_px, y * unit_per_px) for x, y in centres]
    field = field_of_dots(tables, positions, captures.focus_m / captures.distances_m)
    return first.replace(aperture=None, field=field, provenance=first.provenance | {"dots_px": centres})


def field_of_dots(tables: Sequence[BlurTable], points: Sequence[tuple[float, float]], scales: Array) -> Field:
    """Spots over blur and distance from the centre, from tables with the same nodes at single positions (x, y).

    Positions are in the sharp picture, from the centre, in the tables' unit; at each node they shrink by `scales`.
    """
    radii = np.hypot(*np.array(points, dtype=np.float64).T)
    order = np.argsort(radii)
    groups = np.split(order, np.flatnonzero(np.diff(radii[order]) > _RING_WIDTH * radii.max()) + 1)  # by distance
    rings = groups if radii[groups[0]].mean() > _RING_WIDTH * radii.max() else groups[1:]
    if not rings or radii.max() == 0:
        raise FitError(f"dots must lie at two distances from the middle of the frame at least, got {len(groups)}")
    ring_radii = np.array([0.0, *(radii[ring].mean() for ring in rings)])
    # distances that dots reach in any picture: from the smallest picture's to the largest picture's
    all_radii = np.sort(np.concatenate([ring_radii * min(scales), ring_radii[1:] * max(scales)]))
    radius = torch.from_numpy(all_radii[np.diff(all_radii, prepend=-np.inf) > 1e-3 * all_radii[-1]])
    boxes, light = [], []
    for k in range(len(tables[0].coc)):
        spots = [_spot(tables, points, groups[0], k, azimuths=32), *(_spot(tables, points, ring, k) for ring in rings)]
        low, weight = bracket(torch.from_numpy(ring_radii * scales[k]), radius)
        half_sides, cells = torch.tensor([spot[0] for spot in spots]).double(), torch.stack([spot[1] for spot in spots])
        boxes.append(torch.lerp(half_sides[low], half_sides[low + 1], weight))
        light.append(torch.lerp(cells[low], cells[low + 1], weight[:, None, None, None]))
    coc, sizes, cells = tables[0].coc, torch.stack(boxes), torch.stack(light)  # [K], [K, F], [K, F, C, U, V]
    if not bool((coc < 0).any() and (coc > 0).any()):  # the other side of focus has these spots rotated by half a turn
        coc, sizes, cells = torch.cat([coc, -coc]), torch.cat([sizes, sizes]), torch.cat([cells, cells.flip(-2)])
    # in focus, interpolate the signed size: if it is not 0, that position has its focus at another depth
    near, far = torch.where(coc < 0, coc, -math.inf).argmax(), torch.where(coc > 0, coc, math.inf).argmin()
    weight = coc[near] / (coc[near] - coc[far])
    size, focus_cells = torch.lerp(-sizes[near], sizes[far], weight).abs(), torch.lerp(cells[near], cells[far], weight)
    parts = ((coc, coc.new_zeros(())), (sizes, size), (cells, focus_cells))
    coc, sizes, cells = (torch.cat([values, new[None]]) for values, new in parts)
    rising = coc.argsort()
    box = torch.stack([torch.zeros_like(sizes), sizes, sizes], -1)[rising]
    return Field(coc[rising], radius, box, cells[rising].permute(2, 0, 1, 3, 4))


def _spot(
    tables: Sequence[BlurTable], points: Sequence[tuple[float, float]], group: np.ndarray, node: int, azimuths: int = 0
) -> tuple[float, Tensor]:
    """Half side of the box, and the light ``[C, U, V]``, of dots seen in their radial, or in `azimuths` directions."""
    unit = tables[0].px_per_unit(1.0)
    coc = float(tables[0].coc[node]) * unit
    reach = max(tables[i].reach_px(coc, 1.0) for i in group) / unit
    along, across = (torch.arange(n, dtype=torch.float64) + 0.5 for n in _CELLS)
    u, v = (along * (2.0 / _CELLS[0]) - 1.0)[:, None], across / _CELLS[1]
    total, width = torch.zeros(tables[0].channels, *_CELLS, dtype=torch.float64), _KERNEL_HALF / reach / unit
    for i in group:
        kernel = tables[i].kernels(torch.tensor([coc * width], dtype=torch.float64), width)
        x, y = points[i]
        angles = np.linspace(0.0, 2.0 * math.pi, azimuths, endpoint=False) if azimuths else [math.atan2(y, x)]
        for angle in angles:
            sine, cosine = math.sin(angle), math.cos(angle)
            for half in (v, -v):
                grid = torch.stack([u * cosine - half * sine, u * sine + half * cosine], -1)[None]
                grid = grid * (2.0 * _KERNEL_HALF / kernel.shape[-1])
                light = functional.grid_sample(kernel, grid, align_corners=False)[0]
                total += light / (len(angles) * light.sum((-2, -1), keepdim=True))
    return reach, total / (2 * len(group))
