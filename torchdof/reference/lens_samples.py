"""Points on the lens, and the shift of the picture for each: with many points, the views sum to the blur kernel."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..optics import psf
from ..optics.blur_table import BlurTable

__all__ = ["LensSamples", "spread_points"]

_RADIAL_STEPS = 4096  # steps of the radius, and of the share of light, in the tables
_COC_NODES = 33  # circles of confusion on each side of 0 at which radii are tabulated; linear in between


def spread_points(count: int) -> tuple[Tensor, Tensor]:
    """Evenly spread points on the unit disc (a sunflower): radius and angle, ``[count]`` each, float64.

    Example:
        >>> radius, angle = spread_points(1000)
        >>> round(float((radius**2).mean()), 3)
        0.5
    """
    index = torch.arange(count, dtype=torch.float64)
    return ((index + 0.5) / count).sqrt(), index * (math.pi * (3.0 - math.sqrt(5.0)))


class LensSamples:
    """A lens seen from ``views`` points, each representing the same share of its light.

    A point at radius ``rho`` shifts a surface by the radius that contains the share ``rho^2`` of the surface's kernel,
    in opposite directions in front of and behind the focus plane.

    Args:
        table: Blur table of the lens.
        channel: Channel of the table.
        views: Number of points.
        cocs: Maps of the circles of confusion that will be used, in pixels.
        width: Width of the image in pixels.
        points_per_view: Mean number of points of a finer set that belong to each view.
    """

    def __init__(
        self, table: BlurTable, channel: int, views: int, cocs: Sequence[Tensor], width: int, points_per_view: int = 16
    ) -> None:
        self.views, self.points_per_view = views, points_per_view
        low = min(0.0, *(float(c.min()) for c in cocs)) - 1e-3
        high = max(0.0, *(float(c.max()) for c in cocs)) + 1e-3
        near, far = (torch.linspace(0.0, end, _COC_NODES, dtype=torch.float64) for end in (low, high))
        self._nodes = torch.cat([near[1:].flip(0), far])
        radii = _radii(table, channel, self._nodes, width)
        self._views, self._points = _Points.of(views, radii), _Points.of(views * points_per_view, radii)
        self._owner = _nearest(self._points.positions, self._views.positions)

    def shift(self, view: int, coc_px: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Shift along x and y of surfaces in this view, in pixels, and the derivatives of both by the coc."""
        shift, slope = self._shift(self._views.radii[view], coc_px)
        x, y = self._views.directions[view].tolist()
        return shift * x, shift * y, slope * x, slope * y

    def points_of(self, view: int, coc_px: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Shifts along x and y for each point of the finer set that belongs to this view, its nearest one."""
        for point in self._owner[view]:
            shift, _ = self._shift(self._points.radii[point], coc_px)
            x, y = self._points.directions[point].tolist()
            yield shift * x, shift * y

    def _shift(self, radii: Tensor, coc_px: Tensor) -> tuple[Tensor, Tensor]:
        nodes, radii = self._nodes.to(coc_px), radii.to(coc_px)
        upper = torch.searchsorted(nodes, coc_px.contiguous()).clamp(1, len(nodes) - 1)
        slope = (torch.diff(radii) / torch.diff(nodes))[upper - 1]
        return radii[upper] + (coc_px - nodes[upper]) * slope, slope


class _Points(NamedTuple):
    """Points of the lens, and the shift of each at the tabulated circles of confusion."""

    positions: Tensor  # [n, 2] on the unit disc
    directions: Tensor  # [n, 2] unit vectors
    radii: Tensor  # [n, nodes] signed shift in pixels at each tabulated coc

    @classmethod
    def of(cls, count: int, radii: Tensor) -> "_Points":
        rho, angle = spread_points(count)
        directions = torch.stack([angle.cos(), angle.sin()], -1)
        # interpolate between the tabulated shares
        position = rho**2 * (radii.shape[0] - 1)
        low = position.floor().long().clamp(max=radii.shape[0] - 2)
        return cls(
            rho[:, None] * directions, directions, torch.lerp(radii[low], radii[low + 1], (position - low)[:, None])
        )


def _radii(table: BlurTable, channel: int, nodes: Tensor, width: int) -> Tensor:
    """Radius that contains each of the evenly spaced shares of the light: ``[shares, nodes]``, signed like the coc."""
    columns = []
    for coc in nodes:
        params = {name: value[channel] for name, value in table.params(coc, width).items()}
        reach = psf.support(table.family, params)
        r = torch.linspace(0.0, reach, _RADIAL_STEPS + 1, dtype=torch.float64)
        ring_centres = 0.5 * (r[1:] + r[:-1])
        # for radii below a thousandth of a pixel the profile does not matter
        ring_light = psf.profile(table.family, ring_centres, params) * ring_centres if reach > 1e-3 else ring_centres
        cumulative = torch.cat([ring_light.new_zeros(1), ring_light.cumsum(0)])
        shares = torch.linspace(0.0, float(cumulative[-1]), _RADIAL_STEPS + 1, dtype=torch.float64)
        upper = torch.searchsorted(cumulative, shares).clamp(1, _RADIAL_STEPS)
        step = (cumulative[upper] - cumulative[upper - 1]).clamp_min(torch.finfo(torch.float64).tiny)
        radius = r[upper - 1] + ((shares - cumulative[upper - 1]) / step).clamp(0.0, 1.0) * (r[upper] - r[upper - 1])
        columns.append(radius * torch.sign(coc))
    return torch.stack(columns, 1)


def _nearest(points: Tensor, views: Tensor) -> list[list[int]]:
    """For each view, the points nearest to it."""
    nearest_view = torch.cat([torch.cdist(part, views).argmin(1) for part in points.split(4096)])
    points_of_view: list[list[int]] = [[] for _ in range(len(views))]
    for point, view in enumerate(nearest_view.tolist()):
        points_of_view[view].append(point)
    return points_of_view
