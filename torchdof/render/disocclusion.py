"""Disocclusion: what lies hidden behind blurred surfaces, filled in from the farther surfaces around them.

Where a foreground blurs, what is behind it shows through, and no pixel of the image holds it. A hidden sample stands in
with a weight so small that it speaks only where nothing visible does.
"""

import math
from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.kernel_cache import kept
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
    "shown_behind",
    "surfaces_of_image",
]

BEHIND_PX = 1.0  # a hidden surface lies about so much farther, in coc: from half a pixel less to half a pixel more
_FALL = 0.35  # weight of a level of the pyramid against the finer one before
_FINE_LEVELS = 2  # of the pyramid that each pixel looks at; the coarser ones are looked at from cells as large as these
_SURE = 0.1  # weight of what a level shows from which on it has a whole vote
_CERTAIN = 0.01  # votes from which on a hidden sample has all of its weight, or a farther one counts alone

BEHIND_STEP = 2**_FINE_LEVELS
"""Light behind both surfaces is known at every so many pixels, counted from the image's centre."""


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
    """Interpolates the light behind both surfaces at the pixels of an image of ``size``: ``[B, C, H, W]``."""
    for dim, length in ((-1, size[1]), (-2, size[0])):
        whole = behind.shape[dim] * BEHIND_STEP
        samples, shares = _axis(length, 1, whole, (BEHIND_STEP,), behind.dtype, behind.device)
        part = shares[0, 1, :, None] if dim == -2 else shares[0, 1]
        before, after = behind.index_select(dim, samples[0]).chunk(2, dim)
        behind = torch.lerp(before, after, part)
    return behind


@kept
def _axis(
    length: int, step: int, whole: int, steps: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """For each place of an axis the samples before it and after it on levels of a pyramid, and the share of each.

    The axis and those of the levels have one centre.

    Args:
        length: Number of places, n.
        step: Distance of two places in pixels.
        whole: Pixels that each level covers.
        steps: Distance of two samples of each of the L levels in pixels.
        dtype: Of the shares.
        device: Of both results.

    Returns:
        Samples ``[L, 2 n]``, all those before first; shares of linear interpolation ``[L, 2, n]``.
    """
    place = torch.arange(length, device=device).to(dtype)
    middle = torch.scalar_tensor(whole, dtype=dtype, device=device) / 2.0
    distance = torch.tensor(steps, dtype=dtype, device=device)[:, None]
    last = 2.0 * middle / distance - 1.0
    place = ((place - _centre(length, place)) * step + middle) / distance - 0.5
    place = torch.minimum(place.clamp_min(0.0), last)
    before = torch.minimum(place.floor(), last - 1.0)
    part, before = place - before, before.long()
    return torch.cat([before, before + 1], 1), torch.stack([1.0 - part, part], 1)


def _centre(size: int, like: Tensor) -> Tensor:
    """Place of the middle of an axis; as a tensor, for graphs take no fractions of their sizes."""
    return 0.5 * torch.scalar_tensor(size - 1, dtype=like.dtype, device=like.device)


@kept
def _window(size: int, samples: int, step: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The pixels that each sample of a map at every ``step``-th pixel covers, ``[samples (step + 1)]``, and how much.

    The shares are ``[samples, step + 1]``. On an axis of odd size a sample covers half of its first and last pixel; of
    even size, all of its first and none of its last one, in whose place the one before it is named again.
    """
    twice = (size - 1) + 2 * step * torch.arange(samples, device=device) - step * (samples - 1)  # of the centre
    first, last = (twice - step + 1) // 2, (twice + step) // 2
    pixel = first[:, None] + torch.arange(step + 1, device=device)
    share = ((step + 1) / 2 - (pixel - twice[:, None] / 2).abs()).clamp(0.0, 1.0)
    return torch.minimum(pixel, last[:, None]).clamp(0, size - 1).flatten(), share.to(dtype)


def _largest(values: Tensor, height: int, width: int, step: int) -> Tensor:
    """Largest value of the pixels that each of ``height x width`` samples covers."""
    for dim, samples in ((-2, height), (-1, width)):
        pixel, _ = _window(values.shape[dim], samples, step, values.dtype, values.device)
        taken = values.index_select(dim, pixel).unflatten(dim, (-1, step + 1))
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
    (height, width), colours = coc_px.shape[-2:], light.shape[1]
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

    # the farthest surface around each cell of 4 x 4 pixels is behind both surfaces; what the coarse levels show around
    # the cells becomes one level, of the cells
    cell_rows, cell_columns = whole[0] // BEHIND_STEP, whole[1] // BEHIND_STEP
    wanted = ((coc_px.abs() > 0.5) & (other_weight < HIDDEN_WEIGHT)).to(coc_px.dtype)
    cells = _largest(torch.cat([-coc_px, wanted], 1), cell_rows, cell_columns, BEHIND_STEP)
    nearest, is_wanted = -cells[:, :1], cells[:, 1:] > 0
    samples, shares = zip(*_samples(searched, (cell_rows, cell_columns), BEHIND_STEP), strict=True)
    shown, known = shown_behind(_in_pairs(torch.stack(samples, 1)), torch.stack(shares), nearest[:, None])
    farthest = search(searched, shown, known, nearest, farthest=True)
    coarse: tuple[Tensor, ...] = ()
    if len(searched) > _FINE_LEVELS:
        rest = slice(_FINE_LEVELS, None)
        coarse = search(searched[rest], shown[:, rest], known[:, rest], nearest)
    looked = torch.cat([*farthest, *coarse], 1)
    looked = ops.choose(lambda: is_wanted.any(), looked * is_wanted, torch.zeros_like(looked))
    behind = torch.where(looked[:, colours + 1 : colours + 2] > 0, looked[:, :colours], pyramid[_FINE_LEVELS - 1][0])
    if coarse:
        of_cells = Level(looked[:, colours + 2 :], BEHIND_STEP, None, searched[_FINE_LEVELS].least_px)
        searched = [*searched[:_FINE_LEVELS], of_cells]
    seen, total = ops.seen(_seen, searched, coc_px, wanted)

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
        shares.append(_window(size, samples, 2, coc_px.dtype, coc_px.device)[1].t())
        before = (2 * samples - size + 1) // 2
        ends += [before, 2 * samples + 2 - size - before]
    values = functional.pad(torch.cat([light, coc_px, weight], 1), ends, mode="replicate")
    planes = [values[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]  # [B, C + 2, h + 1, w + 1]
    around = torch.stack(
        [
            planes[row % 2 * 2 + column % 2].narrow(-2, row // 2, height).narrow(-1, column // 2, width)
            for row in range(3)
            for column in range(3)
        ],
        2,
    )  # [B, C + 2, 9, h, w]
    share = (shares[1][:, None, :, None] * shares[0][:, None, :]).flatten(0, 1)
    coc = around[:, -2:-1]
    # on an axis of even size the last of three pixels has no share
    farthest = torch.where(share > 0, coc, -NEVER_PX).amax(2, keepdim=True)
    counts = around[:, -1:] * (1.0 - _is_behind(farthest - coc)) * (share / 4.0)
    summed, total = (around[:, :-1] * counts).sum(2), counts.sum(2)
    mean = summed / total.clamp_min(1e-9)
    return mean[:, :-1], torch.where(total > 0, mean[:, -1:], -NEVER_PX), total


def _farthest(light: Tensor, coc_px: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One step of the pyramid: of each four children, the mean of those that are farthest."""
    farthest = functional.interpolate(functional.max_pool2d(coc_px, 2), scale_factor=2.0, mode="nearest")
    counts = weight * (1.0 - _is_behind(farthest - coc_px))
    means = downsampled(torch.cat([light * counts, coc_px * counts, counts], 1), 2)
    total = means[:, -1:]
    means = means[:, :-1] / total.clamp_min(1e-9)
    return means[:, :-1], torch.where(total > 0, means[:, -1:], -NEVER_PX), total


def _seen(levels: Sequence[Level], coc_px: Tensor) -> Seen:
    """What levels show behind the surfaces of an image: light and coc ``[B, C + 1, H, W]``, and the sum of votes."""
    size = (coc_px.shape[-2], coc_px.shape[-1])
    shown = [shown_behind(_in_pairs(values), share, coc_px) for values, share in _samples(levels, size, 1)]
    lights, weights = zip(*shown, strict=True)
    return search(levels, torch.stack(lights, 1), torch.stack(weights, 1), coc_px)


def _samples(levels: Sequence[Level], size: tuple[int, int], step: int) -> Iterator[tuple[Tensor, Tensor]]:
    """The samples of each level around the pixels of a map at every ``step``-th pixel of the image.

    Args:
        levels: Of a pyramid.
        size: Height and width of the map, ``h`` and ``w``. It has one centre with the levels.
        step: Distance of two pixels of the map in pixels of the image.

    Yields:
        Samples ``[B, C + 2, 2 h, 2 w]``, those above and at the left first, and their shares ``[2, 2, h, w]``.
    """
    values = levels[0].values
    steps, whole = tuple(level.step for level in levels), [levels[0].step * n for n in values.shape[-2:]]
    rows, columns = (
        _axis(n, step, total, steps, values.dtype, values.device) for n, total in zip(size, whole, strict=True)
    )
    for k, level in enumerate(levels):
        samples = level.values.index_select(-2, rows[0][k]).index_select(-1, columns[0][k])
        yield samples, rows[1][k][:, None, :, None] * columns[1][k][:, None, :]


def _in_pairs(samples: Tensor) -> Tensor:
    """Samples ``[..., 2 h, 2 w]`` as ``[..., 2, 2, h, w]``."""
    return samples.unflatten(-1, (2, -1)).unflatten(-3, (2, -1)).transpose(-3, -2)


def shown_behind(samples: Tensor, shares: Tensor, coc_px: Tensor) -> Seen:
    """Mean of the samples that lie behind a map. The foreground's own colour would be in a mean of all four.

    Args:
        samples: Two rows and two columns of them around each pixel, ``[..., C + 2, 2, 2, h, w]``: light, coc, weight.
        shares: Of each in linear interpolation, ``[2, 2, h, w]``, or with more axes that fit.
        coc_px: Of the map, ``[..., 1, h, w]``.

    Returns:
        Light and coc ``[..., C + 1, h, w]``, and their weight ``[..., 1, h, w]``.
    """
    count = samples.shape[-5] - 2
    values, (_, coc, weight) = samples.narrow(-5, 0, count + 1), samples.split([count, 1, 1], -5)
    part = (shares if shares.ndim == 4 else shares[:, None]) * weight * _is_behind(coc - coc_px[..., None, None, :, :])
    total = part.sum((-4, -3))
    total = torch.where(total > 1e-4, total, 0.0)
    return (values * part).sum((-4, -3)) / total.clamp_min(1e-4), total


def search(levels: Sequence[Level], shown: Tensor, weight: Tensor, coc_px: Tensor, farthest: bool = False) -> Seen:
    """The mean of what levels show behind a map; with ``farthest``, the farthest of it.

    Args:
        levels: L of them, fine to coarse.
        shown: Light and coc that they show, ``[B, L, C + 1, h, w]``.
        weight: Of these, ``[B, L, 1, h, w]``, as :func:`shown_behind` gives it.
        coc_px: Of the map, ``[B, 1, h, w]``.
        farthest: Of two levels that show different surfaces only the farther surface counts.

    Returns:
        Light and coc ``[B, C + 1, h, w]``, and the sum of the levels' votes ``[B, 1, h, w]``.
    """
    rules = tuple((level.least_px, level.vote) for level in levels)
    (numbers,) = _numbers_of(rules, coc_px.dtype, coc_px.device)
    least, slope, most = (numbers[i, :, None, None, None] for i in range(3))
    looked = (coc_px.abs()[:, None] / least - 1.0).clamp(0.0, 1.0)
    votes = looked * torch.minimum(weight * slope, most)
    if not farthest:
        total = votes.sum(1)
        return (shown * votes).sum(1) / total.clamp_min(1e-9), total
    sure = (looked * weight / _CERTAIN).clamp(max=1.0)
    total, seen = votes[:, 0], shown[:, 0]
    for k in range(1, len(levels)):
        beyond = shown[:, k] - seen
        apart, vote = beyond[:, -1:], votes[:, k]
        vote = torch.where(total > 0, vote * (1.0 - _is_behind(-apart)), vote)
        total = total * (1.0 - sure[:, k] * _is_behind(apart)) + vote
        seen = seen + beyond * (vote / total.clamp_min(1e-9))
    return seen, total


@kept
def _numbers_of(
    rules: tuple[tuple[float, float | None], ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, ...]:
    """Of levels: blur from which they are looked at, in pixels; votes for a weight; most votes. ``[3, L]``."""
    numbers = [
        (least_px, 1.0, math.inf) if vote is None else (least_px, vote / _SURE, vote) for least_px, vote in rules
    ]
    return (torch.tensor(numbers, dtype=dtype, device=device).t(),)


def _least_px(level: int) -> float:
    """Blur above which a pixel begins to look as far as this level."""
    return 2.0 ** (level - 2)


def _continued(size: int, step: int) -> int:
    """Pixels of an image that is continued for a pyramid: half a cell to each side, and whole pairs on every level."""
    # so that the image's centre lies between two samples however many levels there are; exported code knows from this
    # form that the sizes are multiples
    return (size + BEHIND_STEP + 2 * step - 1) // (2 * step) * (2 * step)
