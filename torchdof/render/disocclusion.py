"""Disocclusion: what lies hidden behind blurred surfaces, filled in from the farther surfaces around them.

Where a foreground blurs, what is behind it shows through, and no pixel of the image holds it. A hidden sample stands in
with a weight so small that it speaks only where nothing visible does.
"""

import functools
from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import pixels
from .downsampling import downsampled
from .matting import NEVER_PX, attribute_emitters, matte
from .ops import EAGER, Level, Ops, Seen
from .surfaces import HIDDEN_WEIGHT, Surface
from .traced import is_compiled, one_operator

__all__ = [
    "BEHIND_PX",
    "BEHIND_STEP",
    "behind_pixels",
    "behind_size",
    "fill_hidden",
    "search",
    "surfaces_of_image",
]

BEHIND_PX = 1.0  # a hidden surface lies about so much farther, in coc: from half a pixel less to half a pixel more
_FALL = 0.35  # weight of a level of the pyramid against the finer one before
_FINE_LEVELS = 2  # of the pyramid that each pixel looks at; the coarser ones are looked at from cells as large as these
_SURE = 0.1  # weight of what a level shows from which on it has a whole vote
_CERTAIN = 0.01  # votes from which on a hidden sample has all of its weight, or a farther one counts alone

BEHIND_STEP = 2**_FINE_LEVELS
"""Light behind both surfaces is known at every so many pixels, counted from the image's centre."""

Samples = Iterable[tuple[Tensor, Tensor]]
"""Samples around places, ``[P, C + 2]`` or maps ``[B, C + 2, h, w]``, and their shares of the linear mean of them."""


def surfaces_of_image(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: int, ops: Ops = EAGER
) -> tuple[list[Surface], Tensor]:
    """What each pixel shows, and what is mixed into it or hidden behind it; and the light behind both.

    Arguments and what is behind are those of :func:`fill_hidden`.
    """
    if is_compiled():
        maps = _operator(light, coc_px, valid, threshold, levels)
    else:
        maps = _matted_and_filled(light, coc_px, valid, threshold, levels, ops)
    own_light, own_weight, other_light, other_coc, other_weight, behind = maps
    return [Surface(own_light, coc_px, own_weight), Surface(other_light, other_coc, other_weight)], behind


def _matted_and_filled(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: int, ops: Ops
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    matted = matte(light, coc_px, valid)
    own, other, other_coc, weight = attribute_emitters(light, coc_px, threshold, valid, matted)
    own_weight = 1.0 - weight
    other, other_coc, weight, behind = fill_hidden(own, coc_px, other, other_coc, weight, valid, threshold, levels, ops)
    if valid is not None:
        own_weight, weight = own_weight * valid, weight * valid
    return own, own_weight, other, other_coc, weight, behind


def _empty(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    colour, single = light.new_empty(light.shape), coc_px.new_empty(coc_px.shape)
    behind = light.new_empty(*light.shape[:2], *(behind_size(n, levels) for n in light.shape[-2:]))
    return colour, single, torch.empty_like(colour), torch.empty_like(single), torch.empty_like(single), behind


# How many pixels need work depends on the data, which compiled graphs do not allow for.
@one_operator("torchdof::surfaces", _empty, differentiable=2)
def _operator(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    maps = (t.contiguous() for t in _matted_and_filled(light, coc_px, valid, threshold, levels, EAGER))
    own, own_weight, other, other_coc, other_weight, behind = maps
    return own, own_weight, other, other_coc, other_weight, behind


def _is_behind(distance_px: Tensor) -> Tensor:
    """How surely a surface that is so much farther, in coc, is another one."""
    return (distance_px - BEHIND_PX + 0.5).clamp(0.0, 1.0)


def behind_size(size: int, levels: int) -> int:
    """Length of an axis of the map of what lies behind both surfaces, for an axis of the image."""
    return _continued(size, 2**levels) // BEHIND_STEP


def behind_pixels(behind: Tensor, size: tuple[int, int]) -> Tensor:
    """The map of what lies behind both surfaces at the pixels of an image of that size: ``[B, C, H, W]``."""
    for dim, length in ((-1, size[1]), (-2, size[0])):
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
    ops: Ops = EAGER,
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
        ops: How the levels are looked at.

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
    # a cell that holds no pixel with light has the mean of those that do
    light, coc, weight = pyramid[_FINE_LEVELS - 1]
    mean = (light * weight).sum((-2, -1), keepdim=True) / weight.sum((-2, -1), keepdim=True).clamp_min(1e-12)
    pyramid[_FINE_LEVELS - 1] = torch.where(weight > 0, light, mean), coc, weight
    searched = [Level(torch.cat(level, 1), 2**i, _FALL**i, _least_px(i)) for i, level in enumerate(pyramid, 1)]

    # what coarse levels show behind cells is one level of such cells; and the farthest of all is behind both surfaces
    size = (height, width)
    wanted = (coc_px.abs() > 0.5) & (other_weight < HIDDEN_WEIGHT)
    may_hide = wanted if ops.looks_everywhere else _may_hide(coc_px, [far_coc for _, far_coc, _ in pyramid])
    cell_rows, cell_columns = whole[0] // BEHIND_STEP, whole[1] // BEHIND_STEP
    nearest = -_largest(-coc_px, cell_rows, cell_columns, BEHIND_STEP)
    cells = torch.cat([may_hide, wanted], 1).to(coc_px.dtype)
    cells = _largest(cells, cell_rows, cell_columns, BEHIND_STEP).amin(1, keepdim=True) > 0
    look = functools.partial(ops.seen, functools.partial(_seen, size))
    shown, total = look(searched, nearest, cells, step=BEHIND_STEP, farthest=True)
    behind = torch.where(total > 0, shown[:, :-1], pyramid[_FINE_LEVELS - 1][0])
    if len(searched) > _FINE_LEVELS:
        coarse = torch.cat(look(searched[_FINE_LEVELS:], nearest, cells, step=BEHIND_STEP), 1)
        searched = [*searched[:_FINE_LEVELS], Level(coarse, BEHIND_STEP, None, searched[_FINE_LEVELS].least_px)]
    seen, total = look(searched, coc_px, may_hide & wanted)

    # each pixel behind which these levels show something gets it as its second sample, together with a surface that is
    # hardly mixed in: the more of that, the less of what is hidden
    hidden = (total / _CERTAIN).clamp(max=1.0) * (HIDDEN_WEIGHT - other_weight).clamp_min(0.0)
    weight = hidden + (1.0 - hidden / HIDDEN_WEIGHT) * other_weight
    part = hidden / weight.clamp_min(1e-12)
    light, coc_px = torch.lerp(other_light, seen[:, :-1], part), torch.lerp(other_coc_px, seen[:, -1:], part)
    return light, coc_px, weight, behind


def _first_level(
    light: Tensor, coc_px: Tensor, weight: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The first step of the pyramid, from the pixels: at every second pixel from the centre, of those around it."""
    shares, ends = [], []
    for dim, samples in ((-1, width), (-2, height)):
        size = coc_px.shape[dim]
        shares.append(_window(size, samples, 2, coc_px.device)[1].to(coc_px.dtype))
        before = (2 * samples - size + 1) // 2
        ends += [before, 2 * samples + 2 - size - before]
    values = functional.pad(torch.cat([light, coc_px, weight], 1), ends, mode="replicate")
    planes = [values[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]  # [B, C + 2, h + 1, w + 1]
    around = []
    for row in range(3):
        for column in range(3):
            plane = planes[row % 2 * 2 + column % 2]
            plane = plane.narrow(-2, row // 2, height).narrow(-1, column // 2, width)
            share = shares[1][:, row, None] * shares[0][:, column]
            around.append((plane, share / 4.0))
    # on an axis of even size the last of three has no share
    farthest = torch.stack([torch.where(share > 0, v[:, -2:-1], -NEVER_PX) for v, share in around]).amax(0)
    summed = values.new_zeros(())
    for pixel, share in around:
        counts = pixel[:, -1:] * (1.0 - _is_behind(farthest - pixel[:, -2:-1])) * share
        summed = summed + torch.cat([pixel[:, :-1] * counts, counts], 1)
    total = summed[:, -1:]
    known = total.clamp_min(1e-9)
    return summed[:, :-2] / known, torch.where(total > 0, summed[:, -2:-1] / known, -NEVER_PX), total


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
        may_hide = may_hide | ((around > near + (BEHIND_PX - 0.5)) & (near.abs() > _least_px(level)))
    return may_hide


def _seen(
    size: tuple[int, int], levels: Sequence[Level], coc_px: Tensor, mask: Tensor, step: int, farthest: bool
) -> Seen:
    """What levels show behind the surfaces of a map: light and coc ``[B, C + 1, h, w]``, and the sum of their votes.

    The map, signed coc ``[B, 1, h, w]``, is that of an image of a size at every ``step``-th pixel; there is nothing
    outside of a mask. With ``farthest``, of two surfaces only the farther one counts.
    """
    height, width = coc_px.shape[-2:]
    places = pixels.indices(mask)
    item, row, column = pixels.places(places, height, width)
    row = (row - _centre(height, coc_px)) * step + _centre(size[0], coc_px)
    column = (column - _centre(width, coc_px)) * step + _centre(size[1], coc_px)
    lists = [_samples(level, item, row, column, size) for level in levels]
    seen, total = search(levels, lists, pixels.pick(coc_px, places).t(), farthest)
    batch, channels = coc_px.shape[0], levels[0].values.shape[1]
    values = pixels.put(coc_px.new_zeros(batch, channels, height, width), places, torch.cat([seen, total], 1).t())
    return values[:, :-1], values[:, -1:]


def search(
    levels: Sequence[Level], samples: Sequence[Samples], coc_px: Tensor, farthest: bool
) -> tuple[Tensor, Tensor]:
    """What levels show behind places ``[P, 1]`` or whole maps, given the samples of each level around each of them."""
    total, seen = torch.zeros_like(coc_px), coc_px.new_zeros(levels[0].values.shape[1] - 1, *(1,) * (coc_px.ndim - 2))
    for level, around in zip(levels, samples, strict=True):
        # of the samples only those that lie behind: plain interpolation would mix in the foreground's own colour
        behind, weight = torch.zeros_like(coc_px), torch.zeros_like(coc_px)
        for sample, share in around:
            part = share * sample[:, -1:] * _is_behind(sample[:, -2:-1] - coc_px)
            behind, weight = behind + sample[:, :-1] * part, weight + part
        weight = torch.where(weight > 1e-4, weight, 0.0)
        behind = behind / weight.clamp_min(1e-4)
        looked = (coc_px.abs() / level.least_px - 1.0).clamp(0.0, 1.0)
        vote = looked * (weight if level.vote is None else level.vote * (weight / _SURE).clamp(max=1.0))
        if farthest:
            apart = (behind - seen)[:, -1:]
            vote = torch.where(total > 0, vote * (1.0 - _is_behind(-apart)), vote)
            total = total * (1.0 - (looked * weight / _CERTAIN).clamp(max=1.0) * _is_behind(apart))
        total = total + vote
        seen = seen + (behind - seen) * (vote / total.clamp_min(1e-9))
    return seen, total


def _samples(level: Level, item: Tensor, row: Tensor, column: Tensor, size: tuple[int, int]) -> Samples:
    """The four samples of a level around places ``[P]`` of an image of a size, and their shares of the linear mean."""
    height, width = level.values.shape[-2:]
    row, column = _place(row, size[0], height, level.step), _place(column, size[1], width, level.step)
    flat = level.values.movedim(1, -1).flatten(0, 2)  # a place's numbers lie together
    corners, down, right = pixels.corners(item, row, column, height, width)
    shares = [vertical * horizontal for vertical in (1 - down, down) for horizontal in (1 - right, right)]
    return ((flat.index_select(0, corner), share[:, None]) for corner, share in zip(corners, shares, strict=True))


def _least_px(level: int) -> float:
    """Blur above which a pixel begins to look as far as this level."""
    return 2.0 ** (level - 2)


def _continued(size: int, step: int) -> int:
    """Pixels of an image that is continued for a pyramid: half a cell to each side, and whole pairs on every level."""
    # so that the image's centre lies between two samples however many levels there are; exported code knows from this
    # form that the sizes are multiples
    return (size + BEHIND_STEP + 2 * step - 1) // (2 * step) * (2 * step)
