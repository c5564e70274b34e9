"""Disocclusion: fills in the hidden surfaces behind blurred ones, from the farther surfaces around them.

A blurred foreground is partly transparent, and the image holds no pixel of the surface behind it. A hidden sample takes
the place of this pixel. Its weight is very small, so that it matters only where no visible sample contributes.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.kernel_cache import kept
from ..tensors import recomputed
from .compiled_steps import finest_level, looked_behind
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

# Another surface, or a slope of the pixel's own one; larger values of both: fewer hidden samples
BEHIND_PX = 1.0  # px; difference in coc at which a sample lies on another surface with confidence 1/2; 1 at 1/2 px more
_OWN_SLOPE = 0.25  # part of a pixel's blur by which its own surface may be farther nearby

# Levels of the pyramid
_FALL = 0.35  # weight of a level relative to the next finer one; larger: hidden areas are smoother
_FINE_LEVELS = 2  # levels that each pixel reads; coarser ones are read once per cell of 2**_FINE_LEVELS pixels
_SURE = 0.1  # weight of the samples of a level at which its vote is full
_LEAST_SEEN = 1e-4  # weight of samples up to which they count as empty
_CERTAIN = 0.01  # votes at which a hidden sample has full weight, or a farther surface replaces a nearer one

BEHIND_STEP = 2**_FINE_LEVELS
"""Distance in pixels of the samples of the light behind both surfaces, counted from the image's centre."""


def surfaces_of_image(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: Sequence[int], ops: Ops = EAGER
) -> tuple[list[Surface], Tensor]:
    """Splits an image into each pixel's own surface and a second one, mixed or hidden; and the light behind both.

    Arguments, and the light behind both, are those of :func:`fill_hidden`.
    """
    if is_compiled():
        maps = _operator(light, coc_px, valid, threshold, list(levels))
    else:
        maps = _matted_and_filled(light, coc_px, valid, threshold, levels, ops)
    own_light, own_weight, other_light, other_coc, other_weight, behind = maps
    return [Surface(own_light, coc_px, own_weight), Surface(other_light, other_coc, other_weight)], behind


def _matted_and_filled(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: Sequence[int], ops: Ops
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    matted = matte(light, coc_px, valid, ops)
    if ops.has_rays:
        matted = attribute_emitters(light, coc_px, threshold, valid, matted)
    own, other, other_coc, weight = matted
    own_weight = 1.0 - _counted(weight)
    other, other_coc, weight, behind = fill_hidden(own, coc_px, other, other_coc, weight, valid, threshold, levels, ops)
    if valid is not None:
        own_weight, weight = own_weight * valid, weight * valid
    return own, own_weight, other, other_coc, weight, behind


def _empty(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    colour, single = light.new_empty(light.shape), coc_px.new_empty(coc_px.shape)
    behind = light.new_empty(*light.shape[:2], *(behind_size(n, max(levels)) for n in light.shape[-2:]))
    return colour, single, torch.empty_like(colour), torch.empty_like(single), torch.empty_like(single), behind


# The number of pixels to process depends on the data, which compiled graphs do not support.
@one_operator("torchdof::surfaces", _empty, differentiable=2)
def _operator(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, threshold: Tensor, levels: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    maps = (t.contiguous() for t in _matted_and_filled(light, coc_px, valid, threshold, levels, EAGER))
    own, own_weight, other, other_coc, other_weight, behind = maps
    return own, own_weight, other, other_coc, other_weight, behind


def _end_of_surface(coc_px: Tensor) -> Tensor:
    """Largest coc of a pixel's own surface nearby: it may slope by a part of the pixel's blur."""
    return coc_px + (_OWN_SLOPE * coc_px.abs() - BEHIND_PX).clamp_min(0.0)


def _is_behind(distance_px: Tensor) -> Tensor:
    """Confidence, 0 to 1, that a surface farther by ``distance_px`` of coc is another surface."""
    return (distance_px - BEHIND_PX + 0.5).clamp(0.0, 1.0)


def behind_size(size: int, levels: int) -> int:
    """Samples of the light behind both surfaces along an axis of ``size`` pixels."""
    return _continued(size, 2**levels) // BEHIND_STEP


def behind_pixels(behind: Tensor, size: tuple[int, int]) -> Tensor:
    """Interpolates the light behind both surfaces at the pixels of an image of ``size``: ``[B, C, H, W]``."""
    for dim, length in ((-1, size[1]), (-2, size[0])):
        whole = behind.shape[dim] * BEHIND_STEP
        samples, parts = _axis(length, 1, whole, (BEHIND_STEP,), behind.dtype, behind.device)
        part = parts[0, :, None] if dim == -2 else parts[0]
        before, after = (behind.index_select(dim, samples[0, i]) for i in range(2))
        behind = torch.lerp(before, after, part)
    return behind


@kept
def _axis(
    length: int, step: int, whole: int, steps: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Indices and weights of linear interpolation between samples of pyramid levels, at each place of an axis.

    The axis and the levels are centred on each other.

    Args:
        length: Number of places, n.
        step: Distance of two places in pixels.
        whole: Pixels that each level covers.
        steps: Distance of two samples in pixels, for each of the L levels.
        dtype: Type of the weights.
        device: Device of both results.

    Returns:
        Indices of the samples before and after each place, ``[L, 2, n]``, and the weight of the one after, ``[L, n]``.
    """
    place = torch.arange(length, device=device).to(dtype)
    middle = torch.scalar_tensor(whole, dtype=dtype, device=device) / 2.0
    distance = torch.tensor(steps, dtype=dtype, device=device)[:, None]
    last = 2.0 * middle / distance - 1.0
    place = ((place - _centre(length, place)) * step + middle) / distance - 0.5
    place = torch.minimum(place.clamp_min(0.0), last)
    before = torch.minimum(place.floor(), last - 1.0)
    part, before = place - before, before.long()
    return torch.stack([before, before + 1], 1), part


def _centre(size: int, like: Tensor) -> Tensor:
    """Index of the middle of an axis; a tensor, as graphs support no fractions of sizes."""
    return 0.5 * torch.scalar_tensor(size - 1, dtype=like.dtype, device=like.device)


@kept
def _window(size: int, samples: int, step: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Pixels ``[samples (step + 1)]`` that the samples of an axis cover, and the covered fraction of each.

    Samples are ``step`` pixels apart; fractions are ``[samples, step + 1]``. On an axis of odd size a sample covers
    half of its first and last pixel. On one of even size it covers all of its first pixel and nothing of its last one,
    whose index repeats that of the pixel before.
    """
    twice = (size - 1) + 2 * step * torch.arange(samples, device=device) - step * (samples - 1)  # 2 * centres
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
    levels: Sequence[int],
    ops: Ops = EAGER,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fills in light and coc of hidden surfaces, from the farthest surfaces around them.

    1. Take the farther surface of each pixel, with highlights dimmed to the threshold.
    2. Build a pyramid. Each sample is the mean of those of its four children that are farthest.
    3. For each cell of :data:`BEHIND_STEP` pixels, take the farthest surface of all levels: the light behind both
       surfaces. It shows where the hidden surface is blurred itself and nothing else reaches a pixel.
    4. For each pixel, average the levels that have samples behind it, with larger weights for finer ones. Use only the
       samples behind it, as the foreground's colour must not leak in. The search reaches no farther than the pixel's
       blur: deeper inside, hidden surfaces never show. A slightly farther sample counts as part of the same surface if
       that is strongly blurred: the mean coc of a slope and of a surface beyond the focus could be 0, a sharp speck.
    5. Replace second surfaces that are hardly mixed in by the hidden sample.

    Args:
        light: Light of each pixel's own surface (:func:`torchdof.render.matting.matte`), ``[B, C, H, W]``.
        coc_px: Its signed coc, ``[B, 1, H, W]``.
        other_light: Light of mixed pixels' second surface, ``[B, C, H, W]``.
        other_coc_px: Its signed coc, ``[B, 1, H, W]``.
        other_weight: Its weight, ``[B, 1, H, W]``, 0 where a pixel is not mixed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is left out; None means all count.
        threshold: Light above which a pixel is a highlight, ``[B, 1, H, W]``; highlights are not filled in elsewhere.
        levels: Levels of the pyramid, at least 2; one number for all items or one for each. The widest search is
            ``2 ** levels`` pixels.
        ops: Reads the levels.

    Returns:
        The second sample, mixed or hidden: light, coc and weight, 0 without one. And the light behind both at every
        :data:`BEHIND_STEP`-th pixel, ``[B, C, h, w]``, for an area slightly larger than the image.
    """
    (height, width), colours = coc_px.shape[-2:], light.shape[1]
    sizes = [[_continued(n, 2**own) for own in levels] for n in (height, width)]
    whole = [max(of_items) for of_items in sizes]  # pixels of a level, centred on the image

    surfaces, size = (light, coc_px, other_light, other_coc_px, other_weight), (whole[0] // 2, whole[1] // 2)

    def finest(*surfaces: Tensor) -> Tensor:
        return _finest_level(surfaces, threshold, valid, size)

    first = finest_level(surfaces, threshold, valid, size, finest)
    first = finest(*surfaces) if first is None else first
    far_light, far_coc, far_weight = first.split([colours, 1, 1], 1)
    pyramid = [_repeated((far_light, far_coc, far_weight), sizes, 1)]
    for level in range(2, max(levels) + 1):
        pyramid.append(_repeated(_farthest(*pyramid[-1]), sizes, level))
    # cells without valid pixels get the mean light of the others
    light, coc, weight = pyramid[_FINE_LEVELS - 1]
    mean = (light * weight).sum((-2, -1), keepdim=True) / weight.sum((-2, -1), keepdim=True).clamp_min(1e-12)
    pyramid[_FINE_LEVELS - 1] = torch.where(weight > 0, light, mean), coc, weight
    searched = [Level(torch.cat(level, 1), 2**i, _FALL**i, _least_px(i)) for i, level in enumerate(pyramid, 1)]

    # the farthest surface around each cell of 4 x 4 pixels, and one level of cells that replaces all coarse levels
    cell_rows, cell_columns = whole[0] // BEHIND_STEP, whole[1] // BEHIND_STEP
    wanted = ((coc_px.abs() > 0.5) & (2.0 * other_weight < HIDDEN_WEIGHT)).to(coc_px.dtype)
    cells = _largest(torch.cat([-coc_px, wanted], 1), cell_rows, cell_columns, BEHIND_STEP)
    nearest, is_wanted = -cells[:, :1], cells[:, 1:] > 0
    samples, shares = _samples(searched, (cell_rows, cell_columns), BEHIND_STEP)
    shown, known = shown_behind(torch.stack(samples), shares[:, None, None], nearest)
    farthest = search(searched, shown, known, nearest, farthest=True)
    coarse: tuple[Tensor, ...] = ()
    if len(searched) > _FINE_LEVELS:
        coarser = slice(_FINE_LEVELS, None)
        coarse = search(searched[coarser], shown[coarser], known[coarser], nearest)
    looked = torch.cat([*farthest, *coarse], 1)
    looked = ops.choose(lambda: is_wanted.any(), looked * is_wanted, torch.zeros_like(looked))
    behind = torch.where(looked[:, colours + 1 : colours + 2] > 0, looked[:, :colours], pyramid[_FINE_LEVELS - 1][0])
    if coarse:
        of_cells = Level(looked[:, colours + 2 :], BEHIND_STEP, None, searched[_FINE_LEVELS].least_px)
        searched = [*searched[:_FINE_LEVELS], of_cells]
    seen, total = ops.seen(_seen, searched, coc_px, wanted)

    # Up to HIDDEN_WEIGHT / 2 a mixed sample does not count, and the hidden one replaces it. Both weights are 0 at the
    # limit, where light and coc jump from one to the other.
    free_weight = (HIDDEN_WEIGHT - 2.0 * other_weight).clamp_min(0.0)
    hidden = (total / _CERTAIN).clamp(max=1.0) * free_weight
    is_hidden, (seen_light, seen_coc) = hidden > 0, seen.split([colours, 1], 1)
    light = torch.where(is_hidden, seen_light, other_light)
    coc_px = torch.where(is_hidden, seen_coc, other_coc_px)
    weight = hidden + _counted(other_weight)
    return light, coc_px, weight, behind


def _counted(weight: Tensor) -> Tensor:
    """Weight with which a mixed pixel's other surface counts: 0 up to HIDDEN_WEIGHT / 2, unchanged at HIDDEN_WEIGHT."""
    return weight * (weight * (2.0 / HIDDEN_WEIGHT) - 1.0).clamp(0.0, 1.0)


def _repeated(
    values: tuple[Tensor, Tensor, Tensor], sizes: Sequence[Sequence[int]], level: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Repeat the border of each item's own pyramid, so that an item has the same samples in a batch as alone.

    The pyramid of a batch covers its largest item. ``sizes`` are the rows and columns of pixels that the pyramid of
    each item covers, ``[2][B]``; all have one centre.
    """
    if len(sizes[0]) == 1 or all(len({*of_items}) == 1 for of_items in sizes):  # a graph has symbolic sizes of one
        return values
    nearest = []
    for of_items in sizes:
        count = max(of_items) >> level
        own = torch.tensor([[count - (n >> level), count + (n >> level) - 2] for n in of_items]) // 2
        place = torch.arange(count).expand(len(own), -1)
        nearest.append(torch.minimum(torch.maximum(place, own[:, :1]), own[:, 1:]).to(values[0].device))
    rows, columns = nearest
    item = torch.arange(len(rows), device=rows.device)[:, None, None]
    light, coc, weight = (t.movedim(1, -1)[item, rows[:, :, None], columns[:, None]].movedim(-1, 1) for t in values)
    return light, coc, weight


def _finest_level(surfaces: Sequence[Tensor], threshold: Tensor, valid: Tensor | None, size: tuple[int, int]) -> Tensor:
    """The finest level of the pyramid: at every second pixel from the centre, the farthest of the pixels around it.

    Each pixel shows its farther surface, dimmed to the threshold.

    Args:
        surfaces: Light and coc of each pixel's own surface, the same of its other surface, and the weight of that one.
        threshold: As for :func:`fill_hidden`.
        valid: As for :func:`fill_hidden`.
        size: Height and width of the level, h and w.

    Returns:
        Light, coc and weight, ``[B, C + 2, h, w]``.
    """
    light, coc_px, other_light, other_coc_px, other_weight = surfaces
    is_mixed = (other_weight > 0.05) & (other_coc_px > coc_px)
    coc_px, light = torch.where(is_mixed, other_coc_px, coc_px), torch.where(is_mixed, other_light, light)
    brightest = light.amax(1, keepdim=True)
    is_bright = brightest > threshold
    light = light * torch.where(is_bright, threshold / torch.where(is_bright, brightest, 1.0), 1.0)
    weight = torch.where(is_mixed, other_weight, 1.0 - other_weight)
    if valid is not None:
        coc_px, weight = torch.where(valid > 0, coc_px, -NEVER_PX), weight * valid
    shares, ends = [], []
    for dim, samples in ((-1, size[1]), (-2, size[0])):
        pixels = coc_px.shape[dim]
        shares.append(_window(pixels, samples, 2, coc_px.dtype, coc_px.device)[1].t())
        before = (2 * samples - pixels + 1) // 2
        ends += [before, 2 * samples + 2 - pixels - before]
    values = functional.pad(torch.cat([light, coc_px, weight], 1), ends, mode="replicate")
    planes = [values[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]  # [B, C + 2, h + 1, w + 1]
    first, last = slice(0, -1), slice(1, None)
    parts = [(0, first), (1, first), (0, last)]  # of the three pixels around a sample along an axis
    around = [
        planes[2 * odd_row + odd_column][..., rows, columns] for odd_row, rows in parts for odd_column, columns in parts
    ]  # [B, C + 2, h, w] each; one tensor of all nine would take the memory of eleven images
    coc, weight = (torch.cat([values[:, i, None] for values in around], 1) for i in (-2, -1))  # [B, 9, h, w]
    share = (shares[1][:, None, :, None] * shares[0][:, None, :]).flatten(0, 1)
    # on an axis of even size the last of three pixels has no share
    farthest = torch.where(share > 0, coc, -NEVER_PX).amax(1, keepdim=True)
    counts = weight * (1.0 - _is_behind(farthest - coc)) * (share / 4.0)
    total = counts.sum(1, keepdim=True)
    summed = around[0][:, :-1] * counts[:, :1]
    for k in range(1, 9):
        summed = torch.addcmul(summed, around[k][:, :-1], counts[:, k, None])
    mean = summed / total.clamp_min(1e-9)
    return torch.cat([mean[:, :-1], torch.where(total > 0, mean[:, -1:], -NEVER_PX), total], 1)


def _farthest(light: Tensor, coc_px: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The next coarser level of the pyramid: of each four samples, the mean of those on the farthest surface."""
    farthest = functional.interpolate(functional.max_pool2d(coc_px, 2), scale_factor=2.0, mode="nearest")
    counts = weight * (1.0 - _is_behind(farthest - coc_px))
    means = downsampled(torch.cat([light * counts, coc_px * counts, counts], 1), 2)
    total = means[:, -1:]
    means = means[:, :-1] / total.clamp_min(1e-9)
    return means[:, :-1], torch.where(total > 0, means[:, -1:], -NEVER_PX), total


def _seen(levels: Sequence[Level], coc_px: Tensor) -> Seen:
    """Light and coc behind the surfaces of an image, ``[B, C + 1, H, W]``, and the sum of votes ``[B, 1, H, W]``."""

    def plain(values: Sequence[Tensor], coc_px: Tensor) -> Tensor:
        given = [level._replace(values=t) for level, t in zip(levels, values, strict=True)]
        samples = _samples(given, (coc_px.shape[-2], coc_px.shape[-1]), 1)
        shown = [shown_behind(values, share, coc_px) for values, share in zip(*samples, strict=True)]
        lights, weights = (torch.stack(parts) for parts in zip(*shown, strict=True))
        return torch.cat(search(given, lights, weights, coc_px), 1)

    values = [level.values for level in levels]
    found = looked_behind(values, [(level.step, *_rule(level)) for level in levels], coc_px, plain)
    found = recomputed(lambda: plain(values, coc_px)) if found is None else found
    seen, votes = found.split([found.shape[1] - 1, 1], 1)  # not two slices, each of whose gradients is a whole map
    return seen, votes


def _samples(levels: Sequence[Level], size: tuple[int, int], step: int) -> tuple[list[Tensor], Tensor]:
    """The four samples of each level around the pixels of a map at every ``step``-th pixel of the image.

    Args:
        levels: L levels of a pyramid.
        size: Height and width of the map, ``h`` and ``w``. The levels are centred on it.
        step: Distance of two pixels of the map in pixels of the image.

    Returns:
        Samples of each level ``[B, C + 2, 4, h, w]``, and their weights of bilinear interpolation ``[L, 4, h, w]``.
    """
    values = levels[0].values
    steps, whole = tuple(level.step for level in levels), [levels[0].step * n for n in values.shape[-2:]]
    (rows, down), (columns, aside) = (
        _axis(n, step, total, steps, values.dtype, values.device) for n, total in zip(size, whole, strict=True)
    )
    samples = []
    for k, level in enumerate(levels):
        lines = [level.values.index_select(-2, rows[k, i]) for i in range(2)]
        samples.append(torch.stack([line.index_select(-1, columns[k, i]) for line in lines for i in range(2)], 2))
    shares = [y[:, :, None] * x[:, None] for y in (1.0 - down, down) for x in (1.0 - aside, aside)]
    return samples, torch.stack(shares, 1)


def shown_behind(samples: Tensor, shares: Tensor, coc_px: Tensor) -> Seen:
    """Mean of those samples that lie behind a map; a mean of all four would include the foreground's colour.

    Args:
        samples: Light, coc and weight of the four samples around each pixel, ``[..., C + 2, 4, h, w]``.
        shares: Weights of bilinear interpolation, ``[4, h, w]``, or with further axes that broadcast.
        coc_px: Coc of the map, ``[B, 1, h, w]``.

    Returns:
        Light and coc ``[..., C + 1, h, w]``, and their weight ``[..., 1, h, w]``.
    """
    count = samples.shape[-4] - 2
    coc, weight = samples.narrow(-4, count, 1), samples.narrow(-4, count + 1, 1)
    part = shares * weight * _is_behind(coc - _end_of_surface(coc_px).unsqueeze(2))
    total = part.sum(-3)
    total = torch.where(total > _LEAST_SEEN, total, 0.0)
    return (samples.narrow(-4, 0, count + 1) * part).sum(-3) / total.clamp_min(_LEAST_SEEN), total


def search(levels: Sequence[Level], shown: Tensor, weight: Tensor, coc_px: Tensor, farthest: bool = False) -> Seen:
    """Mean over levels of the light and coc behind a map; with ``farthest``, of the farthest surface only.

    Args:
        levels: L levels, fine to coarse.
        shown: Light and coc of each level, ``[L, B, C + 1, h, w]``, from :func:`shown_behind`.
        weight: Their weights, ``[L, B, 1, h, w]``, from :func:`shown_behind`.
        coc_px: Coc of the map, ``[B, 1, h, w]``.
        farthest: Whether, of two levels with different surfaces, only the farther surface counts.

    Returns:
        Light and coc ``[B, C + 1, h, w]``, and the sum of the levels' votes ``[B, 1, h, w]``.
    """
    numbers = _numbers_of(tuple(_rule(level) for level in levels), coc_px.dtype, coc_px.device)
    least, slope, most = (numbers[i, :, None, None, None, None] for i in range(3))
    looked = (coc_px.abs() / least - 1.0).clamp(0.0, 1.0)
    votes = looked * torch.minimum(weight * slope, most)
    if not farthest:
        total = votes.sum(0)
        return (shown * votes).sum(0) / total.clamp_min(1e-9), total
    sure = (looked * weight / _CERTAIN).clamp(max=1.0)
    total, seen = votes[0], shown[0]
    for k in range(1, len(levels)):
        beyond = shown[k] - seen
        apart, vote = beyond[:, -1:], votes[k]
        vote = torch.where(total > 0, vote * (1.0 - _is_behind(-apart)), vote)
        total = total * (1.0 - sure[k] * _is_behind(apart)) + vote
        seen = seen + beyond * (vote / total.clamp_min(1e-9))
    return seen, total


def _rule(level: Level) -> tuple[float, float, float]:
    """Smallest blur in pixels at which a level is read, votes per weight, and largest number of votes."""
    return (level.least_px, 1.0, math.inf) if level.vote is None else (level.least_px, level.vote / _SURE, level.vote)


@kept
def _numbers_of(rules: tuple[tuple[float, float, float], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Rows of ``[3, L]``: the numbers of :func:`_rule`."""
    return torch.tensor(rules, dtype=dtype, device=device).t()


def _least_px(level: int) -> float:
    """Blur in pixels above which a pixel reads this level."""
    return 2.0 ** (level - 2)


def _continued(size: int, step: int) -> int:
    """Pixels of an axis padded for a pyramid: at least half a cell on each side, and an even size on every level."""
    # Even sizes put the image's centre between two samples of each level. An exported graph infers from this form that
    # sizes are multiples.
    return (size + BEHIND_STEP + 2 * step - 1) // (2 * step) * (2 * step)
