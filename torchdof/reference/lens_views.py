"""Depth of field from many views through the lens: slow, plain, and what everything faster is measured against.

Every point of the lens sees its own sharp picture. Each pixel of the image is a small square of surface, which that
view shifts by ``coc_px`` times the place on the lens; what comes to lie in front hides what is behind; the views are
averaged. Nothing is blurred, so nothing has to be composited. What one image does not show, because something stands in
front of it, weighs nothing, unless it is given as a further surface.

References:
    Cook, Porter, Carpenter, "Distributed ray tracing", SIGGRAPH 1984.
    Haeberli, Akeley, "The accumulation buffer", SIGGRAPH 1990.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .. import validation
from ..optics.blur_table import BlurTable
from ..optics.camera import CAMERA_NUMBERS, Camera
from ..render.matting import matte
from .lens_samples import LensSamples

__all__ = ["LensViews", "lens_views", "lens_views_by_coc"]

_SAME_SURFACE_PX = 1.0  # neighbours whose coc differs by less lie on one surface, which does not tear
_SAME_DEPTH_PX = 0.5  # surfaces whose coc differs by less do not hide each other
_BRIGHT = 8.0  # light above this many times the mean is drawn from more points of the lens than there are views


class LensViews(NamedTuple):
    """The average of all views, and how much of it is known.

    Args:
        image: ``[B, C, H, W]``, linear light.
        known: ``[B, 1, H, W]``, share of the views in [0, 1] that saw a surface. Below 1 something hidden, or outside
            the frame, would have to be known.
    """

    image: Tensor
    known: Tensor


@dataclasses.dataclass(frozen=True)
class _Squares:
    """Pixels as squares of surface, one a row: place, light, cover, coc and their slopes along x and y."""

    x: Tensor
    y: Tensor
    light: Tensor  # [n, C]
    light_slope: Tensor  # [2, n, C]
    cover: Tensor
    coc: Tensor
    coc_slope: Tensor  # [2, n]


def lens_views(
    image: Tensor,
    depth: Tensor,
    camera: Camera,
    *,
    table: BlurTable | None = None,
    views: int = 256,
    surfaces: Sequence[tuple[Tensor, Tensor]] = (),
    mixed_edges: bool | None = None,
) -> LensViews:
    """Renders depth of field from many views through the lens.

    Time and not memory grows with ``views``: about 0.05 s a view and megapixel on one core. Not differentiable.

    Args:
        image: ``[B, C, H, W]``, linear light.
        depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres, > 0, ``inf`` allowed.
        camera: The camera.
        table: Blur measured from a lens; None takes the ideal disc. A view at radius ``rho`` of the lens shifts a
            surface by the radius that holds the share ``rho^2`` of its kernel's light: any radial kernel comes out.
        views: Points of the lens, well spread. The picture converges as they grow; a blur of radius ``r`` wants about
            ``r^2`` of them.
        surfaces: Further surfaces, such as what is hidden: pairs of premultiplied colour and cover ``[B, C + 1, H, W]``
            and depth like ``depth``.
        mixed_edges: Whether pixels that hold two surfaces are told apart (:func:`torchdof.render.matting.matte`); None:
            where no surfaces are given, for beside those the matte's guess does more harm than good.

    Returns:
        Image and the known share, in the image's dtype; pixels that no view knows are those of ``image``.

    Raises:
        ValueError: If an argument is not as described.

    Example:
        >>> image, depth = torch.rand(1, 3, 8, 12), torch.full((1, 1, 8, 12), 3.0)
        >>> lens_views(image, depth, Camera(focus_m=3.0), views=4).image.equal(image)
        True
    """
    validation.image_and_depth(image, depth, values=True)
    width = image.shape[-1]
    placed = []
    for rgba, behind in surfaces:
        validation.image_and_depth(rgba, behind, values=True)
        placed.append((rgba, camera.coc_px(behind, width)))
    coc = camera.coc_px(depth, width)
    validation.coc_of_lens(coc, depth, {name: getattr(camera, name) for name in CAMERA_NUMBERS})
    return lens_views_by_coc(image, coc, table=table, views=views, surfaces=placed, mixed_edges=mixed_edges)


def lens_views_by_coc(
    image: Tensor,
    coc_px: Tensor,
    *,
    table: BlurTable | None = None,
    views: int = 256,
    surfaces: Sequence[tuple[Tensor, Tensor]] = (),
    mixed_edges: bool | None = None,
) -> LensViews:
    """The same from a signed circle of confusion.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, signed radius in pixels, negative in front of the focus plane.
        table: As in :func:`lens_views`.
        views: As in :func:`lens_views`.
        surfaces: Pairs of premultiplied colour and cover ``[B, C + 1, H, W]`` and coc like ``coc_px``.
        mixed_edges: As in :func:`lens_views`.

    Returns:
        As :func:`lens_views`.

    Raises:
        ValueError: If an argument is not as described.
    """
    table = BlurTable.disc() if table is None else table
    if table.aperture is not None:
        raise ValueError(f"many views are taken through a round lens, got {table!r}; take with_aperture(None) of it")
    if table.field is not None:
        raise ValueError(f"many views have one spot all over the frame, got {table!r}; take replace(field=None) of it")
    validation.image_and_coc(image, coc_px, table.channels, values=True)
    if isinstance(views, bool) or not isinstance(views, int) or views < 1:
        raise ValueError(f"views must be a whole number of points on the lens, at least 1, got {views!r}")
    batch, channels, height, width = image.shape
    for rgba, coc in surfaces:
        if rgba.shape != (batch, channels + 1, height, width):
            expected = f"[{batch}, {channels + 1}, {height}, {width}], premultiplied colour and cover"
            raise ValueError(f"a surface must be {expected}, got {list(rgba.shape)}")
        validation.image_and_coc(rgba[:, :1], coc, channels=1, values=True)

    images, shares = [], []
    for item in range(batch):
        shown = (image[item : item + 1].float(), coc_px.expand(batch, -1, -1, -1)[item : item + 1].float())
        stack = [(*shown, torch.ones_like(shown[1]))]
        if mixed_edges or (mixed_edges is None and not surfaces):
            stack = _matted(*shown)
        for rgba, coc in surfaces:
            cover = rgba[item : item + 1, -1:].float().clamp(0.0, 1.0)
            colour = rgba[item : item + 1, :-1].float() / cover.clamp_min(1e-6)
            stack.append((colour, coc.expand(batch, -1, -1, -1)[item : item + 1].float(), cover))
        groups = [slice(None)] if table.channels == 1 else [slice(c, c + 1) for c in range(channels)]
        parts = []
        for c, group in enumerate(groups):
            lens = LensSamples(table, c, views, [coc for _, coc, _ in stack], width)
            parts.append(_average([(light[:, group], coc, cover) for light, coc, cover in stack], lens, height, width))
        known = torch.stack([known_share for _, known_share in parts]).amin(0)
        average = torch.cat([light for light, _ in parts], 1)
        images.append(torch.where(known > 0, average, shown[0]))
        shares.append(known)
    return LensViews(torch.cat(images).to(image.dtype), torch.cat(shares).to(image.dtype))


def _matted(image: Tensor, coc: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Light, coc and cover of the surface in front, and of the one behind it where a pixel holds two."""
    own, other, other_coc, other_weight = matte(image, coc)
    mixed = other_weight > 1e-3
    in_front, behind = mixed & (other_coc < coc), mixed & (other_coc >= coc)
    front = torch.where(in_front, other, torch.where(behind, own, image))
    cover = torch.where(in_front, other_weight, torch.where(behind, 1.0 - other_weight, 1.0))
    return [
        (front, torch.where(in_front, other_coc, coc), cover),
        (torch.where(in_front, own, other), torch.where(in_front, coc, other_coc), mixed.to(image.dtype)),
    ]


def _average(
    stack: Sequence[tuple[Tensor, Tensor, Tensor]], lens: LensSamples, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """Mean of all views ``[1, C, H, W]`` and the share of views that saw something ``[1, 1, H, W]``."""
    limit = _BRIGHT * stack[0][0].mean()
    plain = [(light.clamp(max=limit), coc, cover) for light, coc, cover in stack]
    squares = _squares(plain)
    excess = torch.cat(
        [(light.double() - limit).clamp_min(0.0)[0].flatten(1).T[cover.flatten() > 0] for light, _, cover in stack]
    )
    bright = excess.amax(-1).nonzero()[:, 0]
    extra = excess[bright] * squares.cover[bright, None]

    count, channels = height * width, extra.shape[-1]
    device = extra.device
    # In float64 the mean of equal views is exact: what is in focus comes back unchanged.
    total = torch.zeros(count, channels, dtype=torch.float64, device=device)
    glare, seen = torch.zeros_like(total), torch.zeros(count, dtype=torch.float64, device=device)
    dice = torch.rand(squares.cover.shape, generator=torch.Generator().manual_seed(0)).to(device)
    for view in range(lens.views):
        # A square that covers 30 % of its pixel is there in 30 % of the views.
        is_drawn = ((dice + view * 0.7548776662466927) % 1.0) < squares.cover
        source, target, light = _draw(squares, is_drawn, *lens.shift(view, squares.coc), height, width)
        front = torch.full((count,), torch.inf, device=device)
        front.scatter_reduce_(0, target, squares.coc[source], "amin")
        visible = squares.coc[source] <= front[target] + _SAME_DEPTH_PX
        target, light = target[visible], light[visible]
        covered = torch.zeros(count, device=device).index_add_(0, target, torch.ones_like(light[:, 0]))
        drawn = torch.zeros(count, channels, device=device).index_add_(0, target, light)
        total += drawn / covered.clamp_min(1.0)[:, None]
        seen += covered > 0
        if bright.numel():
            _draw_points(glare, front, squares, bright, extra, lens, view, height, width)
    # What is unknown looks like what is known, except for highlights: they are not made up.
    image = (total / seen.clamp_min(1.0)[:, None] + glare / lens.views).clamp_min(0.0).float()
    return image.T.reshape(1, channels, height, width), (seen / lens.views).float().reshape(1, 1, height, width)


def _squares(stack: Sequence[tuple[Tensor, Tensor, Tensor]]) -> _Squares:
    """One row for every pixel of every surface that covers anything."""
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
    """Differences to the neighbour before and to the one after, 0 where that one lies on another surface."""
    step = torch.diff(values, dim=dim)
    step = torch.where(torch.diff(coc, dim=dim).abs() < _SAME_SURFACE_PX, step, 0.0)
    edge = torch.zeros_like(step.narrow(dim, 0, 1))
    return torch.cat([edge, step], dim), torch.cat([step, edge], dim)


def _coc_slope(coc: Tensor) -> Tensor:
    """The steeper of both sides, so that squares of a curved surface overlap, not crack: ``[2, H, W]``."""
    slopes = [torch.where(b.abs() > a.abs(), b, a) for b, a in (_sides(coc, coc, dim) for dim in (-1, -2))]
    return torch.cat(slopes, 1)[0]


def _light_slope(light: Tensor, coc: Tensor) -> Tensor:
    """Slope of the light within a square: ``[2, C, H, W]``.

    A square of constant light, moved to every place within a pixel, blurs by the pixel's width once more than the lens
    does (variance + 1/12 px^2); one that follows the light's full slope sharpens by as much; half of it does neither.
    """
    slopes = []
    for dim in (-1, -2):
        before, after = _sides(light, coc, dim)
        slopes.append((0.25 * (before + after)).clamp(-light, light)[0])
    return torch.stack(slopes)


def _draw(
    squares: _Squares, is_drawn: Tensor, dx: Tensor, dy: Tensor, ddx: Tensor, ddy: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Squares of a view as (row of the square, pixel it covers the centre of, its light there)."""
    x, y = squares.x + dx, squares.y + dy
    slope_x, slope_y = squares.coc_slope
    # The view maps a step (a, b) along the surface to (a, b) + (ddx, ddy) (slope . (a, b)); det is that map's area.
    det = 1.0 + ddx * slope_x + ddy * slope_y
    det = torch.where(det.abs() < 0.05, 0.05, det)
    sources, targets, lights = [], [], []
    for right in (0, 1):
        for down in (0, 1):
            column, row = x.floor() + right, y.floor() + down
            ex, ey = column - x, row - y
            along = (slope_x * ex + slope_y * ey) / det
            qx, qy = ex - ddx * along, ey - ddy * along
            inside = (qx >= -0.5) & (qx < 0.5) & (qy >= -0.5) & (qy < 0.5)
            inside &= is_drawn & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            s = inside.nonzero()[:, 0]
            sources.append(s)
            targets.append((row[s] * width + column[s]).long())
            slope = squares.light_slope
            lights.append(squares.light[s] + slope[0, s] * qx[s, None] + slope[1, s] * qy[s, None])
    return torch.cat(sources), torch.cat(targets), torch.cat(lights)


def _draw_points(
    glare: Tensor,
    front: Tensor,
    squares: _Squares,
    bright: Tensor,
    light: Tensor,
    lens: LensSamples,
    view: int,
    height: int,
    width: int,
) -> None:
    """Adds light far above the mean from all points of the lens that are nearest to this view, as it sees it.

    A highlight of one pixel is one dot in each view; without more points its disc would be a pattern of dots.
    """
    coc = squares.coc[bright]
    for dx, dy in lens.points_of(view, coc):
        column, row = (squares.x[bright] + dx).round(), (squares.y[bright] + dy).round()
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        target = (row * width + column).long()[inside]
        visible = coc[inside] <= front[target] + _SAME_DEPTH_PX
        glare.index_add_(0, target[visible], light[inside][visible] / lens.points_per_view)
