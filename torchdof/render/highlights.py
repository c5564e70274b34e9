"""Highlights: light far brighter than what is around it, splatted by rays to the crisp discs that a lens makes of it.

Layers know how much of the lens a blurred foreground covers, not which part. For other light that is enough; in the
disc of a highlight everybody sees it, for a post in front of a lamp draws a crisp line through its disc. A ray from a
pixel at ``p`` with coc ``c`` through the point ``u`` of the lens lands at ``p + c u``, and it passes a nearer surface
with coc ``c'`` where the image shows the position ``p + (c - c') u``. So the sharp image itself tells which rays pass.

Highlights are few. What exceeds the threshold of what is around it is extracted from the layers, and splatted as rays.
Without occlusion nothing stands in the way: there rays are for what layers would be too coarse for, and their light is
divided by the same sum of weights as the layers'. Nothing of it sets in at once: what a highlight exceeds, how much it
is blurred, what stands before it and how many there are fade in.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import pixels
from ..optics.blur_table import BlurTable
from ..optics.placed_kernels import Shares, placed_between, ray_shares
from ..tensors import is_traced
from .ops import EAGER, Ops
from .plan import KERNELS_PER_PX, kernels_for
from .surfaces import HIDDEN_WEIGHT, Highlights, Surface, going_on

__all__ = ["COARSE_CELL", "FACTOR", "NEARER_PX", "affordable_taps", "covered_cells", "extract", "splat", "threshold"]

FACTOR = 8.0
"""Light above so many times what is around it is a highlight's."""

COARSE_CELL = 8
"""Pixels in which nearer surfaces are looked for."""

NEARER_PX = 1.0
"""Difference in coc from which on a surface is another one, in front: wholly at 1 px more."""

_STEP = 3  # every so many pixels one tells the threshold; odd, as the next, that a flip of an image flips them
_CELL = 11  # of them over which it is decided
_LEAST_PX = 1.0  # blur from which on there are rays
_WHOLE = 4.0  # times the share of a highlight that is splatted is, up to 1, what counts of its rays
_TAPS_PER_PIXEL = 16  # of the frame: rays beyond this number are left to the layers
_FREE_CHANGE_PX = 1.6  # mean change of the coc between neighbours, in pixels, above which fewer rays are affordable
_TAPS = 2**21  # rays splatted together
_PAIRS = 2**22  # of a source and a bin of nearer surfaces, looked at together
_PAIR_TAPS = 2**19  # of these, rays looked at together


def threshold(light: Tensor, valid: Tensor | None = None) -> Tensor:
    """Largest light ``[B, 1, H, W]`` that is no highlight's, where light ``[B, C, H, W]`` is valid.

    It is :data:`FACTOR` times what four fifths of the pixels of a cell stay below, interpolated between cells.
    """
    height, width = light.shape[-2:]
    brightest = light.detach().amax(1, keepdim=True)
    if valid is not None:
        brightest = torch.where(valid > 0, brightest, torch.inf)
    side = _STEP * _CELL
    (top, rows), (left, columns) = (_cells(n, side, light.device) for n in (height, width))
    cells = functional.pixel_unshuffle(brightest[..., rows, :][..., columns], _CELL)
    level = torch.topk(cells, cells.shape[1] // 5, dim=1)[0][:, -1:]
    level = FACTOR * level.clamp(0.0, torch.finfo(light.dtype).max / FACTOR)
    level = functional.interpolate(level, scale_factor=float(side), mode="bilinear", align_corners=False)
    return level.narrow(-2, top, height).narrow(-1, left, width)


def _cells(size: int, side: int, device: torch.device) -> tuple[int, Tensor]:
    """Pixels by which cells along an axis begin before it, as they end after it, and the pixels that tell of them.

    Two cells at least. Beyond its ends the axis is mirrored.
    """
    count = (size + 2 * side - 1) // side
    count = count + (count + size) % 2
    before = (count * side - size) // 2
    place = (torch.arange(count * _CELL, device=device) * _STEP + (_STEP // 2 - before)) % (2 * size)
    return before, torch.minimum(place, 2 * size - 1 - place)


def extract(
    surface: Surface,
    limit: Tensor,
    from_px: float = _LEAST_PX,
    beside: Surface | None = None,
    image_coc_px: Tensor | None = None,
    most_taps: Tensor | float | None = None,
    ops: Ops = EAGER,
) -> tuple[Surface, Highlights | None]:
    """Take the light above a limit out of a surface of an image, to be splatted ray by ray.

    A highlight behind part of a nearer surface sends the light of its whole pixel: that surface stands in the way of
    these rays, and what it takes would be taken twice. Beside a highlight what is behind keeps its share, for it is
    bright only by what the two mean colours of a mixed pixel do not explain. Nor where depth around has values
    between the two: it is not exact then, and the farther one may be nearer than the lamp.

    Args:
        surface: Of an image.
        limit: As :func:`threshold` gives it, ``[B, 1, H, W]``.
        from_px: Blur from which on there are rays; all of the light above the limit is theirs at 1 px more.
        beside: The other surface of each pixel.
        image_coc_px: Coc of the image, ``[B, 1, H, W]``; without it a highlight sends what its surface has.
        most_taps: Number of rays that are affordable, as :func:`affordable_taps` gives it; None: 16 a pixel.
        ops: How a frame without highlights stays as it is.

    Returns:
        The surface with what is left of its light, and the highlights if there are any.
    """
    light, coc_px, weight = surface
    from_px = max(from_px, _LEAST_PX)
    brightest = light.amax(1, keepdim=True)
    is_bright = (brightest > limit) & (coc_px.detach().abs() > from_px)
    bright = pixels.indices(is_bright if weight is None else is_bright & (weight > 0))
    peak, coc, most = (pixels.pick(t, bright)[0] for t in (brightest, coc_px, limit))
    fades = (coc.abs() - from_px).clamp(max=1.0)
    # where they are too many, the brightest of them, and only what they are brighter by
    most_taps = _TAPS_PER_PIXEL * math.prod(coc_px.shape) if most_taps is None else most_taps
    least = _least_peak(peak.detach(), coc.detach(), ((1.0 - most / peak) * fades).detach(), most_taps)
    kept = (peak.detach() > least).nonzero()[:, 0]
    if not is_traced() and len(kept) == 0:
        return surface, None
    bright, peak, fades, coc, most = (t.index_select(0, kept) for t in (bright, peak, fades, coc, most))
    taken_from, ordinary = pixels.pick(light, bright), torch.maximum(most, least) / peak
    excess = taken_from * ((1.0 - ordinary) * fades)
    # not what the excess leaves: its rounding is brighter than a dark scene
    left = pixels.put(light, bright, taken_from * ((1.0 - fades) + fades * ordinary))
    left = ops.choose(lambda: is_bright.any(), left, light)
    if weight is not None:
        cover = pixels.pick(weight, bright)
        if beside is not None and image_coc_px is not None:
            gap = coc - pixels.pick(beside.coc_px, bright)[0]
            stopped = (gap - NEARER_PX).clamp(0.0, 1.0)
            beside_peak = pixels.pick(beside.light, bright).amax(0)
            is_dark = (2.0 - beside_peak / most.clamp_min(torch.finfo(most.dtype).tiny)).clamp(0.0, 1.0)
            around = pixels.pick(image_coc_px, pixels.around(bright, image_coc_px, 2))[0]
            off_middle = (around - (coc - 0.5 * gap)).abs() / gap.clamp_min(NEARER_PX)  # 1/2 on either surface
            is_step = (1.5 - 10.0 * (3.5 - 8.0 * off_middle).clamp(0.0, 1.0).mean(0)).clamp(0.0, 1.0)
            cover = cover + going_on(cover) * (stopped * is_dark * is_step)
        excess = excess * cover
    highlights = Highlights(bright, excess, coc)
    return surface._replace(light=left), highlights


def affordable_taps(coc_px: Tensor) -> Tensor:
    """Number of rays ``[]`` that are splatted in a frame ``[B, 1, H, W]`` with occlusion: 16 a pixel.

    A ray looks at each surface that may stand in its way. In a depth map of noise these are many: the number falls in
    proportion to the mean change of the coc from one pixel to the next.
    """
    coc, area = coc_px.detach(), math.prod(coc_px.shape)
    change = (coc.diff(dim=-1).abs().sum() + coc.diff(dim=-2).abs().sum()) / area
    return _TAPS_PER_PIXEL * area / (change / _FREE_CHANGE_PX).clamp_min(1.0)


def _least_peak(peak: Tensor, coc: Tensor, share: Tensor, most_taps: Tensor | float) -> Tensor:
    """Light ``[1]`` up to which highlights ``[n]`` are left to the layers of a frame, lest there be too many rays.

    It is the ``L`` at which the rays of those with a peak ``p`` above it, weighted by ``1 - L / (2 p)``, are as many as
    there may be; 0 where all fit. So it grows smoothly with their number, for equal ones too, and at most twice as many
    are splatted.
    """
    taps = (2.0 * coc.abs() + 1.0) ** 2 * (_WHOLE * share).clamp(max=1.0)
    values, order = functional.pad(peak.double(), (0, 1)).sort(descending=True)  # and one of no light, the last
    count = functional.pad(taps.double(), (0, 1)).index_select(0, order)
    slope = torch.where(values > 0, 0.5 * count / values, 0.0).cumsum(0)
    budget = torch.as_tensor(most_taps, dtype=count.dtype, device=count.device)
    count = count.cumsum(0) - budget  # how many of them are beyond what there may be
    at_next = count - functional.pad(values[1:], (0, 1)) * slope  # how many there are at the next peak
    last = (at_next[:-1] < 0).sum(0, keepdim=True)
    count, slope, value = (t.index_select(0, last) for t in (count, slope, values))
    level = count / torch.where(slope > 0, slope, 1.0)
    return torch.minimum(level.clamp_min(0.0), value).to(peak.dtype)


def splat(
    rays: Sequence[Highlights],
    shown: Sequence[Surface],
    table: BlurTable,
    occlusion: bool = True,
    kernels_per_px: int = KERNELS_PER_PX,
    ops: Ops = EAGER,
) -> Tensor:
    """Scatter highlights to ``[B, C, H, W]``, each ray to where it lands but for what nearer surfaces take of it.

    These are the surfaces that an image shows, each pixel's own first; without occlusion all rays pass. Differentiable
    in the light and coc of the rays and in what is in their way.
    """
    together = Highlights(*(torch.cat(parts, -1) for parts in zip(*rays, strict=True)))
    coc_px, in_the_way = shown[0].coc_px, _obstacles(shown) if occlusion else []

    def splatted() -> Tensor:
        return _splatted(together, coc_px, in_the_way, table, kernels_per_px, ops.lens_width)

    return ops.splat(splatted, together, coc_px, in_the_way)


def _splatted(
    rays: Highlights,
    coc_px: Tensor,
    obstacles: Sequence[tuple[Tensor, Tensor]],
    table: BlurTable,
    kernels_per_px: int,
    lens_width: int | None,
) -> Tensor:
    """Highlights to ``[B, C, H, W]``, so many together that their rays stay within bounds."""
    batch, _, height, width = coc_px.shape
    longest, lens_width = max(height, width), lens_width or int(width)
    source, light, coc = rays
    order = torch.argsort(coc.detach().abs())
    item, row, column = pixels.places(source[order], height, width)
    light, coc = light[:, order], coc[order]
    shares: list[Shares] = []
    if table.depends_on_place:
        shares = [s.to(light) for s in ray_shares(table, coc.detach().tolist(), (height, width))]
    radii = coc.detach().tolist()

    def half_of(radius: float) -> int:
        return min(math.ceil(table.reach_px(radius, lens_width) + 0.5), longest - 1)

    margin = max([half_of(radii[-1]), *(half_of(each.coc_px) for each in shares)])  # the widest need not be the last
    across = width + 2 * margin
    area = (height + 2 * margin) * across
    splats = light.new_zeros(len(light), batch * area)
    hiding = _Occluders(obstacles) if obstacles else None
    most = len(radii) if hiding is None else max(1, _PAIRS // hiding.bins)
    start = 0
    while start < len(radii):  # sources of increasing blur, as many as make a bounded number of taps
        stop = min(len(radii), start + most, start + max(1, _TAPS // (2 * half_of(radii[start]) + 1) ** 2))
        stop = min(stop, start + max(1, _TAPS // (2 * half_of(radii[stop - 1]) + 1) ** 2))
        part = slice(start, stop)
        kernels = kernels_for(table, coc[part], lens_width, longest, kernels_per_px)  # [n, 1 or C, k, k]
        kernels = kernels.to(light.dtype)
        if shares:
            half_diagonal = 0.5 * math.hypot(height, width)
            y, x = ((row[part] + 0.5 - height / 2) / half_diagonal, (column[part] + 0.5 - width / 2) / half_diagonal)
            kernels = placed_between(kernels, shares, coc[part], y, x)
        half = kernels.shape[-1] // 2
        step = torch.arange(-half, half + 1, device=light.device)
        landing = kernels * light[:, part].t()[:, :, None, None]
        if hiding is not None:
            hidden = hiding.hidden(item[part], row[part], column[part], coc[part], step)
            landing = landing * (1.0 - hidden).unsqueeze(1)
        lines = item[part, None] * area + (row[part, None] + margin + step) * across
        lands = lines[:, :, None] + (column[part, None] + margin + step)[:, None, :]  # [n, k, k]
        splats.index_add_(1, lands.flatten(), landing.transpose(0, 1).flatten(1))
        start = stop
    frame = splats.unflatten(1, (batch, height + 2 * margin, across)).transpose(0, 1)
    return frame[..., margin : margin + height, margin : margin + width]


def _obstacles(surfaces: Sequence[Surface]) -> list[tuple[Tensor, Tensor]]:
    """Coc of surfaces and the part of each pixel that they cover, ``[B, 1, H, W]``: none where they are hidden."""
    covers = [torch.ones_like(s.coc_px) if s.weight is None else s.weight for s in surfaces]
    covers = [covers[0], *((c - HIDDEN_WEIGHT).clamp_min(0.0) for c in covers[1:])]
    return [(s.coc_px, cover) for s, cover in zip(surfaces, covers, strict=True)]


class _Occluders:
    """Surfaces that may stand in the way of rays: their coc and cover, in bins of 1 px of coc."""

    def __init__(self, obstacles: Sequence[tuple[Tensor, Tensor]]) -> None:
        coc_px = obstacles[0][0].detach()
        self.height, self.width = int(coc_px.shape[-2]), int(coc_px.shape[-1])
        self.low = coc_px.amin()
        shown = [(coc - self.low, cover) for coc, cover in obstacles]  # a place in bins
        self.bins = int(torch.stack([place.detach().amax() for place, _ in shown]).amax()) + 2
        self.counts = covered_cells([(place.detach(), cover.detach()) for place, cover in shown], self.bins)
        self.places, self.covers = (torch.stack([t.flatten() for t in maps]) for maps in zip(*shown, strict=True))

    def hidden(self, item: Tensor, row: Tensor, column: Tensor, coc: Tensor, step: Tensor) -> Tensor:
        """Share of each ray ``[n, k, k]`` that nearer surfaces take.

        A ray passes the surfaces of a bin at a share of its way; between four pixels their cover is interpolated.

        Args:
            item: Of each source in the batch, ``[n]``.
            row: Of each source, ``[n]``.
            column: Of each source, ``[n]``.
            coc: Signed coc of each source in pixels, ``[n]``.
            step: Pixels from the source to where its rays land, along each axis, ``[k]``.
        """
        bins = torch.arange(self.bins, device=coc.device)
        nearer = self.low + bins
        scale = 1.0 - nearer / coc[:, None]  # [n, bins]
        fades = (coc[:, None] - NEARER_PX - nearer).clamp(0.0, 1.0)
        # pairs of a source and a bin of which some cell within reach shows something
        reach = scale.detach().abs() * step[-1]
        (top, bottom), (left, right) = (
            [(place[:, None] + end).clamp(0, size - 1).long() // COARSE_CELL for end in (-reach, reach + 1.0)]
            for place, size in ((row, self.height), (column, self.width))
        )
        lower, upper = bottom + 1, top
        corners = ((lower, right + 1, 1), (upper, right + 1, -1), (lower, left, -1), (upper, left, 1))
        count = sum(sign * self.counts[bins, item[:, None], y, x] for y, x, sign in corners)
        pairs = ((count > 0) & (fades.detach() > 0)).nonzero()
        hidden = coc.new_zeros(len(coc), len(step), len(step))
        for part in pairs.split(max(1, _PAIR_TAPS // len(step) ** 2)):
            source, bin_of = part.unbind(1)
            way = scale[source, bin_of][:, None] * step
            rows, columns = (row[source, None] + way)[:, :, None], (column[source, None] + way)[:, None, :]
            around, down, aside = pixels.corners(item[source, None, None], rows, columns, self.height, self.width)
            pixel = torch.stack(around)  # [4, pairs, k, k]
            near = (1.0 - (self.places[:, pixel] - bin_of[:, None, None]).abs()).clamp_min(0.0)
            covered = (self.covers[:, pixel] * near).sum(0)
            above, below = torch.lerp(covered[0::2], covered[1::2], aside)
            hidden = hidden.index_add(0, source, torch.lerp(above, below, down) * fades[source, bin_of][:, None, None])
        return hidden.clamp(max=1.0)


def covered_cells(places: Sequence[tuple[Tensor, Tensor]], bins: int) -> Tensor:
    """Counts the cells above and left of each cell that show something in a bin: ``[bins, B, rows + 1, columns + 1]``.

    Args:
        places: Place of each pixel among the bins and its cover, ``[B, 1, H, W]``, of each surface. A pixel lies in the
            bin before its place and in the one after it.
        bins: Number of bins.
    """
    batch, _, height, width = places[0][0].shape
    rows, columns = ((n + COARSE_CELL - 1) // COARSE_CELL for n in (height, width))
    item, row, column = (torch.arange(n, device=places[0][0].device) for n in (batch, height, width))
    cell = (item[:, None, None] * rows + row[:, None] // COARSE_CELL) * columns + column // COARSE_CELL
    shown = places[0][0].new_zeros((bins + 2) * batch * rows * columns)
    for place, cover in places:  # a pixel without cover is put beyond all bins
        before = torch.where(cover > 0, place, float(bins)).long()[:, 0]
        for bin_of in (before, before + 1):
            index = (bin_of * (batch * rows * columns) + cell).flatten()
            shown = shown.scatter(0, index, torch.ones_like(place).flatten())
    shown = shown.unflatten(0, (bins + 2, batch, rows, columns))[:bins]
    return functional.pad(shown.cumsum(-1).cumsum(-2), (1, 0, 1, 0))
