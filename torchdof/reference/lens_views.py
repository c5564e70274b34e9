"""Depth of field from many views through the lens: slow and simple, the reference for all faster methods.

Every point of the lens sees its own sharp picture. Each pixel of the image is a small square of a surface; a view
shifts it by ``coc_px`` times the position on the lens. Nearer squares hide farther ones, and the views are averaged.
Nothing is blurred, so nothing has to be composited. Areas hidden in the image have no weight, unless they are given as
further surfaces.

References:
    Cook, Porter, Carpenter, "Distributed ray tracing", SIGGRAPH 1984.
    Haeberli, Akeley, "The accumulation buffer", SIGGRAPH 1990.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..render.matting import matte
from ..validation import image_and_coc, whole
from .scenes import spread_points

__all__ = ["LensViews", "lens_views"]

_SAME_SURFACE_PX = 1.0  # neighbours whose coc differs by less belong to one surface without gaps
_SAME_DEPTH_PX = 0.5  # surfaces whose coc differs by less do not hide each other
_BRIGHT_RATIO = 8.0  # light above this multiple of the mean is drawn from more points of the lens than there are views
_POINTS_PER_VIEW = 16  # points around that of the view from which such light is drawn; more make its discs smoother


class LensViews(NamedTuple):
    """The average of all views, and the share of views that contributed.

    Args:
        image: ``[B, C, H, W]``, linear light.
        known: ``[B, 1, H, W]``, share of the views in [0, 1] that saw a surface. Below 1, some views saw hidden
            surfaces or the outside of the frame.
    """

    image: Tensor
    known: Tensor


@dataclasses.dataclass(frozen=True)
class _Squares:
    """Pixels as squares of surface, one in each row: position, light, cover, coc, and slopes along x and y."""

    x: Tensor
    y: Tensor
    light: Tensor  # [n, C]
    light_slope: Tensor  # [2, n, C]
    cover: Tensor
    coc: Tensor
    coc_slope: Tensor  # [2, n]


def lens_views(
    image: Tensor,
    coc_px: Tensor,
    *,
    views: int = 256,
    surfaces: Sequence[tuple[Tensor, Tensor]] = (),
    mixed_edges: bool | None = None,
) -> LensViews:
    """Renders the depth of field of an ideal round lens from many views through it.

    The time grows with ``views``, the memory does not: about 0.05 s for each view and megapixel on one core. Not
    differentiable.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, signed radius in pixels, negative in front of the focus plane.
        views: Number of points on the lens. The picture converges as it grows; a blur of radius ``r`` pixels needs
            about ``r^2``.
        surfaces: Further surfaces, such as hidden ones: pairs of premultiplied colour and cover ``[B, C + 1, H, W]``
            and coc like ``coc_px``.
        mixed_edges: Whether to split pixels that show two surfaces (:func:`torchdof.render.matting.matte`). None splits
            them if no surfaces are given; with given surfaces the estimate does more harm than good.

    Returns:
        Image and known share, in the image's dtype; pixels known in no view are copied from ``image``.

    Raises:
        ValueError: If an argument is invalid.

    Example:
        >>> image = torch.rand(1, 3, 8, 12)
        >>> lens_views(image, torch.zeros(1, 1, 8, 12), views=4).image.equal(image)
        True
    """
    image_and_coc(image, coc_px, channels=1, values=True)
    whole("views", views, 1, 2**31)
    batch, channels, height, width = image.shape
    for rgba, coc in surfaces:
        if rgba.shape != (batch, channels + 1, height, width):
            expected = f"[{batch}, {channels + 1}, {height}, {width}], premultiplied colour and cover"
            raise ValueError(f"a surface must be {expected}, got {list(rgba.shape)}")
        image_and_coc(rgba, coc, channels=1, values=True)

    averages = []
    for item in range(batch):
        light, coc = (maps.expand(batch, -1, -1, -1)[item : item + 1].float() for maps in (image, coc_px))
        stack = [(light, coc, torch.ones_like(coc))]
        if mixed_edges or (mixed_edges is None and not surfaces):
            stack = _matted(light, coc)
        for rgba, hidden_coc in surfaces:
            cover = rgba[item : item + 1, -1:].float().clamp(0.0, 1.0)
            colour = rgba[item : item + 1, :-1].float() / cover.clamp_min(1e-6)
            stack.append((colour, hidden_coc.expand(batch, -1, -1, -1)[item : item + 1].float(), cover))
        average, known = _average(stack, views, height, width)
        averages.append((torch.where(known > 0, average, light), known))
    return LensViews(*(torch.cat(maps).to(image.dtype) for maps in zip(*averages, strict=True)))


def _matted(image: Tensor, coc: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Splits mixed pixels: light, coc and cover of the surface in front, and of the one behind it."""
    own_light, other_light, other_coc, other_weight = matte(image, coc)
    mixed = other_weight > 1e-3
    in_front, behind = mixed & (other_coc < coc), mixed & (other_coc >= coc)
    front = torch.where(in_front, other_light, torch.where(behind, own_light, image))
    cover = torch.where(in_front, other_weight, torch.where(behind, 1.0 - other_weight, 1.0))
    return [
        (front, torch.where(in_front, other_coc, coc), cover),
        (torch.where(in_front, own_light, other_light), torch.where(in_front, coc, other_coc), mixed.to(image.dtype)),
    ]


def _average(
    stack: Sequence[tuple[Tensor, Tensor, Tensor]], views: int, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """Mean of all views ``[1, C, H, W]`` and the share of views that saw a surface ``[1, 1, H, W]``."""
    limit = _BRIGHT_RATIO * stack[0][0].mean()
    clipped = [(light.clamp(max=limit), coc, cover) for light, coc, cover in stack]
    squares = _squares(clipped)
    excess = torch.cat(
        [(light.double() - limit).clamp_min(0.0)[0].flatten(1).T[cover.flatten() > 0] for light, _, cover in stack]
    )
    bright_rows = excess.amax(-1).nonzero()[:, 0]
    bright_light = excess[bright_rows] * squares.cover[bright_rows, None]

    count, channels = height * width, bright_light.shape[-1]
    device = bright_light.device
    # In float64 the mean of equal views is exact: pixels in focus are returned unchanged.
    total = torch.zeros(count, channels, dtype=torch.float64, device=device)
    highlights, known_views = torch.zeros_like(total), torch.zeros(count, dtype=torch.float64, device=device)
    thresholds = torch.rand(squares.cover.shape, generator=torch.Generator().manual_seed(0)).to(device)
    lens, offsets = spread_points(views), spread_points(_POINTS_PER_VIEW) / views**0.5
    for view, (ux, uy) in enumerate(lens.tolist()):
        # A square that covers 30 % of its pixel is drawn in 30 % of the views.
        is_drawn = ((thresholds + view * 0.7548776662466927) % 1.0) < squares.cover
        source, target, light = _draw(squares, is_drawn, ux, uy, height, width)
        front = torch.full((count,), torch.inf, device=device)
        front.scatter_reduce_(0, target, squares.coc[source], "amin")
        visible = squares.coc[source] <= front[target] + _SAME_DEPTH_PX
        target, light = target[visible], light[visible]
        covered = torch.zeros(count, device=device).index_add_(0, target, torch.ones_like(light[:, 0]))
        drawn = torch.zeros(count, channels, device=device).index_add_(0, target, light)
        total += drawn / covered.clamp_min(1.0)[:, None]
        known_views += covered > 0
        if bright_rows.numel():
            points = (lens[view] + offsets).tolist()
            _draw_points(highlights, front, squares, bright_rows, bright_light, points, height, width)
    # Unknown views get the mean of the known ones, but no highlights.
    image = (total / known_views.clamp_min(1.0)[:, None] + highlights / views).clamp_min(0.0).float()
    return image.T.reshape(1, channels, height, width), (known_views / views).float().reshape(1, 1, height, width)


def _squares(stack: Sequence[tuple[Tensor, Tensor, Tensor]]) -> _Squares:
    """One row for every pixel of every surface with cover."""
    parts = []
    for light, coc, cover in stack:
        height, width = coc.shape[-2:]
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        is_covered = cover.flatten() > 0
        fields = [x.to(coc), y.to(coc), light[0], _light_slope(light, coc), cover[0, 0], coc[0, 0], _coc_slope(coc)]
        sizes = [1, 1, light.shape[1], 2 * light.shape[1], 1, 1, 2]
        parts.append([f.reshape(n, -1)[:, is_covered] for f, n in zip(fields, sizes, strict=True)])
    x, y, light, light_slope, cover, coc, coc_slope = (torch.cat(p, 1) for p in zip(*parts, strict=True))
    light_slope = light_slope.unflatten(0, (2, -1)).transpose(1, 2)
    return _Squares(x[0], y[0], light.T.contiguous(), light_slope.contiguous(), cover[0], coc[0], coc_slope)


def _sides(values: Tensor, coc: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Differences to the previous and the next neighbour; 0 if it belongs to another surface."""
    step = torch.diff(values, dim=dim)
    step = torch.where(torch.diff(coc, dim=dim).abs() < _SAME_SURFACE_PX, step, 0.0)
    edge = torch.zeros_like(step.narrow(dim, 0, 1))
    return torch.cat([edge, step], dim), torch.cat([step, edge], dim)


def _coc_slope(coc: Tensor) -> Tensor:
    """The steeper slope of both sides, so that squares of a curved surface overlap without gaps: ``[2, H, W]``."""
    slopes = [torch.where(b.abs() > a.abs(), b, a) for b, a in (_sides(coc, coc, dim) for dim in (-1, -2))]
    return torch.cat(slopes, 1)[0]


def _light_slope(light: Tensor, coc: Tensor) -> Tensor:
    """Slope of the light used within a square: ``[2, C, H, W]``.

    Squares of constant light would blur by the pixel's width in addition to the lens (variance + 1/12 px^2); squares
    with the light's full slope would sharpen by the same amount. Half the slope does neither.
    """
    slopes = []
    for dim in (-1, -2):
        before, after = _sides(light, coc, dim)
        slopes.append((0.25 * (before + after)).clamp(-light, light)[0])
    return torch.stack(slopes)


def _draw(
    squares: _Squares, is_drawn: Tensor, ux: float, uy: float, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Draws the squares of a view: row of the square, pixel whose centre it covers, and its light there."""
    x, y = squares.x + ux * squares.coc, squares.y + uy * squares.coc
    slope_x, slope_y = squares.coc_slope
    # With slope s the view maps a step v on the surface to v + (ux, uy) (s . v); det is the determinant of that map.
    det = 1.0 + ux * slope_x + uy * slope_y
    det = torch.where(det.abs() < 0.05, 0.05, det)
    sources, targets, lights = [], [], []
    for right in (0, 1):
        for down in (0, 1):
            column, row = x.floor() + right, y.floor() + down
            ex, ey = column - x, row - y
            along = (slope_x * ex + slope_y * ey) / det
            qx, qy = ex - ux * along, ey - uy * along
            inside = (qx >= -0.5) & (qx < 0.5) & (qy >= -0.5) & (qy < 0.5)
            inside &= is_drawn & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            s = inside.nonzero()[:, 0]
            sources.append(s)
            targets.append((row[s] * width + column[s]).long())
            slope = squares.light_slope
            lights.append(squares.light[s] + slope[0, s] * qx[s, None] + slope[1, s] * qy[s, None])
    return torch.cat(sources), torch.cat(targets), torch.cat(lights)


def _draw_points(
    highlights: Tensor,
    front: Tensor,
    squares: _Squares,
    bright_rows: Tensor,
    light: Tensor,
    points: Sequence[Sequence[float]],
    height: int,
    width: int,
) -> None:
    """Adds light far above the mean, seen from points of the lens around that of this view, where it is visible.

    A highlight of one pixel is one dot in each view; with these additional points its disc is even.
    """
    coc = squares.coc[bright_rows]
    for ux, uy in points:
        column, row = (squares.x[bright_rows] + ux * coc).round(), (squares.y[bright_rows] + uy * coc).round()
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        target = (row * width + column).long()[inside]
        visible = coc[inside] <= front[target] + _SAME_DEPTH_PX
        highlights.index_add_(0, target[visible], light[inside][visible] / len(points))
