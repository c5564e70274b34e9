"""Depth of field from many views through the lens: slow and simple, the reference for all faster methods.

Every point of the lens sees its own sharp picture. Each pixel of the image is a small square of a surface; a view
shifts it by ``coc_px`` times the position on the lens. Nearer squares hide farther ones, and the views are averaged.
Nothing is blurred, so nothing has to be composited. A pixel that shows two surfaces is split into both
(:func:`torchdof.render.surfaces.matting.matte`); areas hidden in the image have no weight.

References:
    Cook, Porter, Carpenter, "Distributed ray tracing", SIGGRAPH 1984.
    Haeberli, Akeley, "The accumulation buffer", SIGGRAPH 1990.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ..render.surfaces.matting import matte
from ..validation import scene, whole
from .scenes import spread_points

__all__ = ["LensViews", "lens_views"]

_SAME_SURFACE_PX = 1.0  # neighbours whose coc differs by less belong to one surface without gaps
_SAME_DEPTH_PX = 0.5  # surfaces whose coc differs by less do not hide each other
_BRIGHT_RATIO = 8.0  # light above this multiple of the mean is drawn from more points of the lens than there are views
_POINTS_PER_VIEW = 16  # points around that of the view from which such light is drawn; more make its discs smoother


class LensViews(NamedTuple):
    """The average of all views, and the share of views that contributed."""

    image: Tensor  # [B, C, H, W], linear light
    known: Tensor  # [B, 1, H, W], share of the views that saw a surface; the others saw hidden ones or past the frame


class _Squares(NamedTuple):
    """Pixels as squares of surface, one in each row; slopes are those along x and along y."""

    x: Tensor  # [n]
    y: Tensor
    light: Tensor  # [n, C]
    light_slopes: tuple[Tensor, Tensor]
    coc: Tensor  # [n]
    coc_slopes: tuple[Tensor, Tensor]


def lens_views(image: Tensor, coc_px: Tensor, *, views: int = 256) -> LensViews:
    """Renders the depth of field of an ideal round lens from many views through it.

    The time grows with ``views``, the memory does not: about 0.05 s for each view and megapixel on one core. Not
    differentiable.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, signed radius in pixels, negative in front of the focus plane.
        views: Number of points on the lens. The picture converges as it grows; a blur of radius ``r`` pixels needs
            about ``r^2``.

    Returns:
        Image and known share, in the image's dtype; pixels known in no view are copied from ``image``.

    Raises:
        ValueError: If an argument is invalid.

    Example:
        >>> image = torch.rand(1, 3, 8, 12)
        >>> lens_views(image, torch.zeros(1, 1, 8, 12), views=4).image.equal(image)
        True
    """
    scene(image, "coc_px", coc_px)
    whole("views", views, 1, 2**31)
    cocs = coc_px.float().expand(image.shape[0], -1, -1, -1)
    averages = [_average(*maps, views) for maps in zip(image.float().split(1), cocs.split(1), strict=True)]
    return LensViews(*(torch.cat(maps).to(image.dtype) for maps in zip(*averages, strict=True)))


def _average(image: Tensor, coc: Tensor, views: int) -> tuple[Tensor, Tensor]:
    """Mean of all views of one image ``[1, C, H, W]``, and the share of views that saw a surface ``[1, 1, H, W]``."""
    light, coc, cover = _surfaces(image, coc)
    size, device = (image.shape[-2], image.shape[-1]), image.device
    limit = _BRIGHT_RATIO * light[0].mean()
    clipped = light.clamp(max=limit)
    surface, y, x = (cover[:, 0] > 0).nonzero(as_tuple=True)

    def covered(maps: Tensor) -> Tensor:  # [2, C, H, W] to [n, C]
        return maps.movedim(1, -1)[surface, y, x]

    light_slopes = tuple(map(covered, _light_slopes(clipped, coc)))
    coc_slopes = tuple(covered(slope)[:, 0] for slope in _coc_slopes(coc))
    squares = _Squares(x.to(coc), y.to(coc), covered(clipped), light_slopes, covered(coc)[:, 0], coc_slopes)  # type: ignore[arg-type]
    cover = covered(cover)[:, 0]
    excess = (covered(light).double() - limit).clamp_min(0.0) * cover[:, None]
    bright = excess.amax(-1).nonzero()[:, 0]

    # In float64 the mean of equal views is exact: pixels in focus are returned unchanged.
    total = torch.zeros(size[0] * size[1], image.shape[1], dtype=torch.float64, device=device)
    highlights, known_views = torch.zeros_like(total), torch.zeros_like(total[:, 0])
    thresholds = torch.rand(cover.shape, generator=torch.Generator().manual_seed(0)).to(device)
    lens, offsets = spread_points(views), spread_points(_POINTS_PER_VIEW) / views**0.5
    for view, (ux, uy) in enumerate(lens.tolist()):
        # A square that covers 30 % of its pixel is drawn in 30 % of the views.
        is_drawn = ((thresholds + view * 0.7548776662466927) % 1.0) < cover
        source, target, drawn_light = _draw(squares, is_drawn, ux, uy, size)
        front = torch.full((len(total),), torch.inf, device=device)
        front.scatter_reduce_(0, target, squares.coc[source], "amin")
        visible = squares.coc[source] <= front[target] + _SAME_DEPTH_PX
        target, drawn_light = target[visible], drawn_light[visible]
        count = torch.zeros(len(total), device=device).index_add_(0, target, torch.ones_like(drawn_light[:, 0]))
        total += (
            torch.zeros_like(total, dtype=torch.float32).index_add_(0, target, drawn_light)
            / count.clamp_min(1.0)[:, None]
        )
        known_views += count > 0
        # A highlight of one pixel is one dot in each view; from more points around that of the view its disc is even.
        for point_x, point_y in (lens[view] + offsets).tolist() if bright.numel() else ():
            target, inside = _pixels(
                (squares.x[bright] + point_x * squares.coc[bright]).round(),
                (squares.y[bright] + point_y * squares.coc[bright]).round(),
                size,
            )
            inside = inside & (squares.coc[bright] <= front[target] + _SAME_DEPTH_PX)
            highlights.index_add_(0, target[inside], excess[bright][inside] / _POINTS_PER_VIEW)
    # Unknown views get the mean of the known ones, but no highlights.
    mean = (total / known_views.clamp_min(1.0)[:, None] + highlights / views).clamp_min(0.0).float()
    known = (known_views / views).float().reshape(1, 1, *size)
    return torch.where(known > 0, mean.T.reshape(image.shape), image), known


def _surfaces(image: Tensor, coc: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Light ``[2, C, H, W]``, coc and cover of the surface in front, and of the one behind it in mixed pixels."""
    own_light, other_light, other_coc, other_weight = matte(image, coc)
    mixed = other_weight > 1e-3
    in_front, behind = mixed & (other_coc < coc), mixed & (other_coc >= coc)
    front = torch.where(in_front, other_light, torch.where(behind, own_light, image))
    cover = torch.where(in_front, other_weight, torch.where(behind, 1.0 - other_weight, 1.0))
    cocs = torch.where(in_front, other_coc, coc), torch.where(in_front, coc, other_coc)
    back = torch.where(in_front, own_light, other_light)
    return torch.cat([front, back]), torch.cat(cocs), torch.cat([cover, mixed.to(cover)])


def _sides(values: Tensor, coc: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Differences to the previous and the next neighbour; 0 if it belongs to another surface."""
    step = torch.diff(values, dim=dim)
    step = torch.where(torch.diff(coc, dim=dim).abs() < _SAME_SURFACE_PX, step, 0.0)
    edge = torch.zeros_like(values.narrow(dim, 0, 1))
    return torch.cat([edge, step], dim), torch.cat([step, edge], dim)


def _coc_slopes(coc: Tensor) -> list[Tensor]:
    """The steeper slope of both sides, so that squares of a curved surface overlap without gaps."""
    return [torch.where(b.abs() > a.abs(), b, a) for b, a in (_sides(coc, coc, dim) for dim in (-1, -2))]


def _light_slopes(light: Tensor, coc: Tensor) -> list[Tensor]:
    """Slopes of the light used within a square.

    Squares of constant light would blur by the pixel's width in addition to the lens (variance + 1/12 px^2); squares
    with the light's full slope would sharpen by the same amount. Half the slope does neither.
    """
    return [(0.25 * (b + a)).clamp(-light, light) for b, a in (_sides(light, coc, dim) for dim in (-1, -2))]


def _pixels(column: Tensor, row: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Index of each pixel, 0 for those outside of the frame, and whether it lies in the frame."""
    inside = (column >= 0) & (column < size[1]) & (row >= 0) & (row < size[0])
    return torch.where(inside, row * size[1] + column, 0.0).long(), inside


def _draw(
    squares: _Squares, is_drawn: Tensor, ux: float, uy: float, size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Draws the squares of a view: row of the square, pixel whose centre it covers, and its light there."""
    x, y = squares.x + ux * squares.coc, squares.y + uy * squares.coc
    slope_x, slope_y = squares.coc_slopes
    # With slope s the view maps a step v on the surface to v + (ux, uy) (s . v); det is the determinant of that map.
    det = 1.0 + ux * slope_x + uy * slope_y
    det = torch.where(det.abs() < 0.05, 0.05, det)
    drawn = []
    for right, down in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = x.floor() + right, y.floor() + down
        ex, ey = column - x, row - y
        along = (slope_x * ex + slope_y * ey) / det
        qx, qy = ex - ux * along, ey - uy * along
        target, inside = _pixels(column, row, size)
        s = (inside & is_drawn & (qx >= -0.5) & (qx < 0.5) & (qy >= -0.5) & (qy < 0.5)).nonzero()[:, 0]
        along_x, along_y = squares.light_slopes
        drawn.append((s, target[s], squares.light[s] + along_x[s] * qx[s, None] + along_y[s] * qy[s, None]))
    source, target, light = (torch.cat(part) for part in zip(*drawn, strict=True))
    return source, target, light
