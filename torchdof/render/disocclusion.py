"""Disocclusion: what lies hidden behind blurred surfaces, filled in from the farther surfaces around them.

Where a foreground blurs, what is behind it shows through, and no pixel of the image holds it. A hidden sample stands in
with a weight so small that it speaks only where nothing visible does.
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import pixels
from .downsampling import downsampled
from .matting import NEVER_PX

__all__ = ["BEHIND_STEP", "HIDDEN_WEIGHT", "behind_pixels", "behind_size", "fill_hidden"]

HIDDEN_WEIGHT = 0.003
"""Weight of a hidden sample against 1 of a visible one."""

_BEHIND_PX = 1.0  # a hidden surface lies about so much farther, in coc: from half a pixel less to half a pixel more
_FALL = 0.35  # weight of a level of the pyramid against the finer one before
_FINE_LEVELS = 2  # of the pyramid that each pixel looks at; the coarser ones are looked at from cells as large as these
_SURE = 0.1  # weight of what a level shows from which on it has a whole vote
_CERTAIN = 0.01  # votes from which on a hidden sample has all of its weight, or a farther one counts alone

BEHIND_STEP = 2**_FINE_LEVELS
"""Light behind both surfaces is known at every so many pixels, counted from the image's centre."""


class _Level:
    """Farthest surfaces at every ``step``-th pixel: light, coc and weight ``[B, C + 2, H, W]``.

    ``vote`` is its weight against other levels, None if that is in the weights; ``least_px`` the blur from which on a
    pixel looks so far, and wholly from twice of it.
    """

    def __init__(self, values: Tensor, size: tuple[int, int], step: int, vote: float | None, least_px: float) -> None:
        self.height, self.width = values.shape[-2:]
        self.size = size  # of the image
        self.flat, self.light = values.movedim(1, -1).flatten(0, 2), values[:, :-2]  # a place's numbers lie together
        self.step, self.vote, self.least_px = step, vote, least_px

    def behind(self, item: Tensor, row: Tensor, column: Tensor, coc_px: Tensor) -> tuple[Tensor, Tensor]:
        """Light and coc ``[P, C + 1]`` behind places ``[P]`` of the image, and their weight, 0 where nothing is.

        Interpolated linearly among those of the four samples around that lie behind; plain interpolation would mix in
        the foreground's own colour.
        """
        row = _place(row, self.size[0], self.height, self.step)
        column = _place(column, self.size[1], self.width, self.step)
        summed, total = torch.zeros_like(coc_px)[:, None], torch.zeros_like(coc_px)
        corners, down, right = pixels.corners(item, row, column, self.height, self.width)
        corner_weights = [vertical * horizontal for vertical in (1 - down, down) for horizontal in (1 - right, right)]
        for corner, corner_weight in zip(corners, corner_weights, strict=True):
            sample = self.flat.index_select(0, corner)
            weight = corner_weight * sample[:, -1] * _is_behind(sample[:, -2] - coc_px)
            summed, total = summed + sample[:, :-1] * weight[:, None], total + weight
        total = torch.where(total > 1e-4, total, 0.0)
        return summed / total.clamp_min(1e-4)[:, None], total


def _is_behind(distance_px: Tensor) -> Tensor:
    """How surely a surface that is so much farther, in coc, is another one."""
    return (distance_px - _BEHIND_PX + 0.5).clamp(0.0, 1.0)


def behind_size(size: int, levels: int) -> int:
    """Length of an axis of the map of what lies behind both surfaces, for an axis of the image."""
    return _continued(size, 2**levels) // BEHIND_STEP


def behind_pixels(behind: Tensor, size: tuple[int, int]) -> Tensor:
    """The map of what lies behind both surfaces at the pixels of an image of that size: ``[B, C, H, W]``."""
    for dim, length in ((-2, size[0]), (-1, size[1])):
        samples = behind.shape[dim]
        place = _place(torch.arange(length, device=behind.device).to(behind.dtype), length, samples, BEHIND_STEP)
        before = place.clamp(0, samples - 2).long()
        part = (place - before).clamp(0.0, 1.0)
        part = part[:, None] if dim == -2 else part
        behind = torch.lerp(behind.index_select(dim, before), behind.index_select(dim, before + 1), part)
    return behind


def _place(pixel: Tensor, size: int, samples: int, step: int) -> Tensor:
    """Where pixels of an axis of the image lie on that of a map at every ``step``-th pixel. Both have one centre."""
    return (pixel - _centre(size, pixel)) / step + _centre(samples, pixel)


def _centre(size: int, like: Tensor) -> Tensor:
    """Place of the middle of an axis; as a tensor, for graphs take no fractions of their sizes."""
    return 0.5 * torch.scalar_tensor(size - 1, dtype=like.dtype, device=like.device)


def _window(size: int, samples: int, step: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The pixels that each sample of a map at every ``step``-th pixel covers, and how much: ``[samples, step + 1]``.

    On an axis of odd size a sample covers half of its first and last pixel; of even size, none of the last, which is
    named once more.
    """
    twice = (size - 1) + 2 * step * torch.arange(samples, device=device) - step * (samples - 1)  # of the centre
    first, last = (twice - step + 1) // 2, (twice + step) // 2
    pixel = first[:, None] + torch.arange(step + 1, device=device)
    share = ((step + 1) / 2 - (pixel - twice[:, None] / 2).abs()).clamp(0.0, 1.0)
    return torch.minimum(pixel, last[:, None]).clamp(0, size - 1), share


def _largest(values: Tensor, height: int, width: int, step: int) -> Tensor:
    """Largest value of the pixels that each of ``height x width`` samples covers."""
    for dim, samples in ((-2, height), (-1, width)):
        pixel, _ = _window(values.shape[dim], samples, step, values.device)
        taken = values.index_select(dim, pixel.flatten()).unflatten(dim, (-1, step + 1))
        values = taken.amax(-1) if dim == -1 else taken.amax(-2)
    return values


def fill_hidden(
    light: Tensor,
    coc_px: Tensor,
    other_light: Tensor,
    other_coc_px: Tensor,
    other_weight: Tensor,
    valid: Tensor | None,
    threshold: Tensor,
    levels: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Light and coc of what lies behind blurred surfaces, from the farthest surfaces around them.

    A pyramid averages at each step only the farthest of four children. A pixel takes the mean of the levels that show
    something behind it, finer ones first, and of the four samples around it there only those that do; it looks no
    farther than its own blur reaches, for deeper inside nothing of what is hidden can show.

    Where that surface is blurred itself, and nothing else reaches a pixel, something lies behind it again: of all that
    the levels show, the farthest.

    Args:
        light: Each pixel's own, as :func:`torchdof.render.matting.matte` gives it, ``[B, C, H, W]``.
        coc_px: Its signed coc ``[B, 1, H, W]``.
        other_light: Of mixed pixels' second surface, from there as well, as the next two.
        other_coc_px: ``[B, 1, H, W]``.
        other_weight: ``[B, 1, H, W]``, 0 where a pixel is not mixed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is to be left out; None counts all.
        threshold: Largest light that is no highlight's, ``[B, 1, H, W]``; a highlight is nowhere else but in its place.
        levels: Levels of the pyramid, from 2; the widest look is ``2 ** levels`` pixels.

    Returns:
        The second sample, mixed or hidden: light, coc and weight (0 where there is none); and light behind both, at
        every :data:`BEHIND_STEP`-th pixel ``[B, C, h, w]``, for somewhat more than the image.
    """
    height, width = coc_px.shape[-2:]
    whole = tuple(_continued(n, 2**levels) for n in (height, width))  # centred on the image, which goes on to its ends

    # the farther surface of each pixel, dimmed to no highlight
    is_mixed = (other_weight > 0.05) & (other_coc_px > coc_px)
    far_coc, far_light = torch.where(is_mixed, other_coc_px, coc_px), torch.where(is_mixed, other_light, light)
    brightest = far_light.amax(1, keepdim=True)
    is_bright = brightest > threshold
    far_light = far_light * torch.where(is_bright, threshold / torch.where(is_bright, brightest, 1.0), 1.0)
    far_weight = torch.where(is_mixed, other_weight, 1.0 - other_weight)
    if valid is not None:
        far_coc, far_weight = torch.where(valid > 0, far_coc, -NEVER_PX), far_weight * valid
    pyramid = [_first_level(far_light, far_coc, far_weight, whole[0] // 2, whole[1] // 2)]
    for _ in range(1, levels):
        pyramid.append(_farthest(*pyramid[-1]))
    size = (height, width)
    searched = [_Level(torch.cat(level, 1), size, 2**i, _FALL**i, _least_px(i)) for i, level in enumerate(pyramid, 1)]

    # what coarse levels show behind cells is one level of such cells; and the farthest of all is behind both surfaces
    may_hide = _may_hide(coc_px, [far_coc for _, far_coc, _ in pyramid])
    wanted = (coc_px.abs() > 0.5) & (other_weight < HIDDEN_WEIGHT)
    cell_rows, cell_columns = whole[0] // BEHIND_STEP, whole[1] // BEHIND_STEP
    nearest = -_largest(-coc_px, cell_rows, cell_columns, BEHIND_STEP)
    cells = torch.cat([may_hide, wanted], 1).to(coc_px.dtype)
    cells = pixels.indices(_largest(cells, cell_rows, cell_columns, BEHIND_STEP).amin(1, keepdim=True) > 0)
    item, row, column = pixels.places(cells, cell_rows, cell_columns)
    row = (row - _centre(cell_rows, coc_px)) * BEHIND_STEP + _centre(height, coc_px)
    column = (column - _centre(cell_columns, coc_px)) * BEHIND_STEP + _centre(width, coc_px)
    cell_places = (item, row, column, pixels.pick(nearest, cells)[0])
    total, seen = _search(searched, *cell_places, farthest=True)
    shown = pixels.indices(total > 0)
    behind = pixels.put(searched[_FINE_LEVELS - 1].light, cells[shown], seen[:, :-1].index_select(0, shown).t())
    if levels > _FINE_LEVELS:
        total, seen = _search(searched[_FINE_LEVELS:], *cell_places)
        values = nearest.new_zeros(nearest.shape[0], seen.shape[1] + 1, *nearest.shape[-2:])
        values = pixels.put(values, cells, torch.cat([seen, total[:, None]], 1).t())
        searched = [*searched[:_FINE_LEVELS], _Level(values, size, BEHIND_STEP, None, searched[_FINE_LEVELS].least_px)]

    # each pixel behind which these levels show something gets it as its second sample
    hiding = pixels.indices(may_hide & wanted)
    total, seen = _search(searched, *pixels.places(hiding, height, width), pixels.pick(coc_px, hiding)[0])
    shown = pixels.indices(total > 0)
    hiding, seen = hiding[shown], seen.index_select(0, shown).t()
    return (
        pixels.put(other_light, hiding, seen[:-1]),
        pixels.put(other_coc_px, hiding, seen[-1]),
        pixels.put(other_weight, hiding, HIDDEN_WEIGHT * (total[shown] / _CERTAIN).clamp(max=1.0)),
        behind,
    )


def _first_level(
    light: Tensor, coc_px: Tensor, weight: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The first step of the pyramid, from the pixels: at every second pixel from the centre, of those around it."""
    rows, row_share = _window(coc_px.shape[-2], height, 2, coc_px.device)
    columns, column_share = _window(coc_px.shape[-1], width, 2, coc_px.device)

    def around(values: Tensor) -> Tensor:  # [B, C, height, width, 9]
        values = values.index_select(-2, rows.flatten()).index_select(-1, columns.flatten())
        return values.unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3)).transpose(-3, -2).flatten(-2)

    share = (row_share[:, None, :, None] * column_share[:, None]).flatten(-2).to(coc_px.dtype)  # [height, width, 9]
    coc_around = around(coc_px)
    farthest = coc_around.amax(-1, keepdim=True)
    counts = around(weight) * (1.0 - _is_behind(farthest - coc_around)) * (share / 4.0)
    total = counts.sum(-1)
    known = total.clamp_min(1e-9)
    coc_px = torch.where(total > 0, (coc_around * counts).sum(-1) / known, -NEVER_PX)
    return (around(light) * counts).sum(-1) / known, coc_px, total


def _farthest(light: Tensor, coc_px: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One step of the pyramid: of each four children, the mean of those that are farthest."""
    farthest = functional.interpolate(functional.max_pool2d(coc_px, 2), scale_factor=2.0, mode="nearest")
    counts = weight * (1.0 - _is_behind(farthest - coc_px))
    total = downsampled(counts, 2)
    known = total.clamp_min(1e-9)
    coc_px = torch.where(total > 0, downsampled(coc_px * counts, 2) / known, -NEVER_PX)
    return downsampled(light * counts, 2) / known, coc_px, total


def _may_hide(coc_px: Tensor, farthest: list[Tensor]) -> Tensor:
    """Pixels for which the coc of a level of the pyramid that they look at may be farther; none too few."""
    near, (height, width) = coc_px.detach(), coc_px.shape[-2:]
    may_hide = torch.zeros_like(near, dtype=torch.bool)
    for level, coc in enumerate(farthest, 1):
        around = functional.max_pool2d(coc.detach(), 5, stride=1, padding=2)  # a cell's centre lies up to 2 px away
        for dim, size in ((-2, height), (-1, width)):
            samples = around.shape[dim]
            place = _place(torch.arange(size, device=near.device).to(near.dtype), size, samples, 2**level)
            around = around.index_select(dim, place.round().clamp(0, samples - 1).long())
        may_hide = may_hide | ((around > near + (_BEHIND_PX - 0.5)) & (near.abs() > _least_px(level)))
    return may_hide


def _search(
    levels: list[_Level], item: Tensor, row: Tensor, column: Tensor, coc_px: Tensor, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """What levels show behind surfaces at some places: the sum of their votes, and light and coc ``[P, C + 1]``.

    With ``farthest``, of two surfaces only the farther one counts.
    """
    total = torch.zeros_like(coc_px)
    seen = coc_px.new_zeros(1, levels[0].flat.shape[1] - 1)
    for level in levels:
        behind, weight = level.behind(item, row, column, coc_px)
        looked = (coc_px.abs() / level.least_px - 1.0).clamp(0.0, 1.0)
        vote = looked * (weight if level.vote is None else level.vote * (weight / _SURE).clamp(max=1.0))
        if farthest:
            apart = behind[:, -1] - seen[:, -1]
            vote = torch.where(total > 0, vote * (1.0 - _is_behind(-apart)), vote)
            total = total * (1.0 - (looked * weight / _CERTAIN).clamp(max=1.0) * _is_behind(apart))
        total = total + vote
        seen = seen + (behind - seen) * (vote / total.clamp_min(1e-9))[:, None]
    return total, seen


def _least_px(level: int) -> float:
    """Blur above which a pixel begins to look as far as this level."""
    return 2.0 ** (level - 2)


def _continued(size: int, step: int) -> int:
    """Pixels of an image that is continued for a pyramid."""
    # in this form exported code knows that the sizes are multiples, and with one more that none of them is 1
    return (size + 2 * step - 1) // step * step
