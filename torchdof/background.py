"""What one image hides: the second surface of mixed pixels, and the background behind blurred foregrounds.

A sharp image is anti-aliased, its depth is not. Along every depth edge pixels carry the light of two surfaces and the
depth of one; blurred with that depth alone, a bright emitter draws a wrong ring and a foreground a fringe. Such pixels
are split between their surfaces (:func:`split_mixed`), without touching texture within a surface.

Where a foreground blurs, what is behind it shows through, and no pixel of the image holds it. A hidden sample, filled
from the farther surfaces around (:func:`fill_hidden`), stands in with a weight so small that it speaks only where
nothing visible does.

Both give the second sample of a pixel: its light, coc and weight. Work is done at the pixels that need it. Their number
depends on the data, which compiled graphs do not allow for, so these call :func:`surfaces` as one opaque operator.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from .pool import bands, between, max_around, max_of_blocks, max_of_four, mean_of_four, min_of_blocks, places

__all__ = ["fill_hidden", "split_mixed", "surfaces"]

HIDDEN_WEIGHT = 0.003
"""Weight of a hidden sample against 1 of a visible one."""

_NEVER_PX = 1e9  # a coc that no pixel has
_EDGE_PX = 1.0  # difference in coc of neighbours from which on they may be two surfaces
_BEHIND_PX = 2.0  # a hidden surface lies at least so much farther, in coc
_REACH = 2  # pixels around a mixed pixel that tell what its two surfaces look like
_FALL = 0.7  # weight of a level of the pyramid against the finer one before
_UNCLEAN = 1e-3  # weight of a pixel that may be mixed itself
_TRUST = 4.0  # how much local contrast discredits a split
_DOUBT = 4.0 / 3.0  # times the variance of the own surface's light, all colours, is what its texture may explain
_CELL_LEVEL = 3  # of the pyramid, whose pixels are told apart when looking for those that may hide something
_FINE_LEVELS = 2  # that each pixel looks at; the coarser ones are looked at from cells as large as these
BEHIND_STEP = 2**_FINE_LEVELS
"""Light behind both surfaces is known at every so many pixels."""
_AT_ONCE = 2**16  # positions looked at together
_SPLIT_AT_ONCE = 2**13
_LEAST_SHARE = 0.1  # a smaller share is more likely texture than a second surface


def surfaces(light: Tensor, coc_px: Tensor, valid: Tensor | None, ordinary: Tensor, levels: int) -> tuple[Tensor, ...]:
    """What each pixel shows and hides.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is to be left out; None counts all.
        ordinary: As in :func:`fill_hidden`.
        levels: As in :func:`fill_hidden`.

    Returns:
        Light ``[B, C, H, W]`` and weight ``[B, 1, H, W]`` of each pixel's own surface; light, coc and weight of its
        second one, which is mixed into the pixel or hidden behind it; and light of what lies behind both, at every
        :data:`BEHIND_STEP`-th pixel ``[B, C, h, w]``, for somewhat more than the image.
    """
    if torch.compiler.is_compiling() and not torch.compiler.is_exporting():
        own, seen, other, other_coc, share, behind = _surfaces_operator(light, coc_px, valid, ordinary, levels)
        return own, seen, other, other_coc, share, behind
    return _surfaces(light, coc_px, valid, ordinary, levels)


def split_mixed(light: Tensor, coc_px: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Split pixels at depth edges between the surface they are attributed to and the one across the edge.

    With F and B the light of the two surfaces near the pixel, the share of F in a pixel is the least-squares solution
    of ``I = a F + (1 - a) B``, kept on the side of 1/2 that the pixel's own depth states (its centre lies on that
    surface) and drawn towards no split at all where the contrast of the two is small against the texture of each, or
    where the texture of the pixel's own surface explains it and moves little light. The light of the two parts sums to
    the pixel's.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        valid: ``[B, 1, H, W]``, 0 where a pixel is to be left out; None counts all.

    Returns:
        ``(own, other, other_coc_px, share)``: light of the pixel's own surface and of the other ``[B, C, H, W]``, the
        other's coc and the share of the pixel that it covers, in [0, 1/2], ``[B, 1, H, W]``; 0 away from edges.
    """
    edge = torch.cat([_edge(coc_px, valid, rows) for rows in bands(coc_px)], -2)
    at = _positions(edge > 0)
    parts = [_split(light, coc_px, valid, edge, some) for some in _in_parts(at, _SPLIT_AT_ONCE)]
    own_light, other_light, other_coc, share = (torch.cat(part, -1) for part in zip(*parts, strict=True))
    return (
        _put(light, at, own_light),
        _place(other_light, at, light),
        _put(coc_px, at, other_coc),
        _place(share, at, coc_px),
    )


def _split(light: Tensor, coc_px: Tensor, valid: Tensor | None, edge: Tensor, at: Tensor) -> tuple[Tensor, ...]:
    """Own light and other light ``[C, P]``, coc of the other and its share ``[P]`` of pixels at edges."""
    here, colour = _pick(coc_px, at)[0], _pick(light, at)
    near, far = _ends(coc_px, valid, at)
    gap = (far - near).clamp_min(1e-6)
    around = _around(at, coc_px, _REACH)
    seen, place, between = (_pick_all(t, around) for t in (light, coc_px, edge))
    weight = (1.0 - between[0] + _UNCLEAN) * _falloff(light)[:, None]
    if valid is not None:
        weight = weight * _pick_all(valid, around)[0]
    nearness = (far - place[0]) / gap
    nearer, farther = weight * (4 * nearness - 2.8).clamp(0, 1), weight * (1.2 - 4 * nearness).clamp(0, 1)

    behind, behind_spread = _mean(seen, farther)
    # a thin foreground has no clean pixel: trust the one that differs most from what is behind
    differs = nearer * ((seen - behind[:, None]) ** 2).sum(0) + 1e-12
    front, front_spread = _mean(seen, torch.where(nearer.sum(0) > 20 * _UNCLEAN, nearer, differs))

    contrast = front - behind
    strength = (contrast**2).sum(0)
    share = ((colour - behind) * contrast).sum(0) / strength.clamp_min(1e-12)
    is_near = here - near < far - here
    fitted = share.clamp(0.0, 1.0)
    misfit = ((colour - behind - fitted * contrast) ** 2).sum(0)
    trust = strength / (strength + 4e-4 + _TRUST * (behind_spread + front_spread + misfit))
    raw = torch.where(is_near, 1.0 - fitted, fitted)
    own_spread = torch.where(is_near, front_spread, behind_spread)
    # what lies behind is seen sharp where it is nearer to focus, and so is every error of its split
    doubt = torch.where(
        far.abs() < near.abs(), (_DOUBT * own_spread / strength.clamp_min(1e-12)).clamp_min(1e-12).sqrt(), 0.0
    )
    sure = raw - doubt
    sure = sure * (2.0 * sure / _LEAST_SHARE - 1.0).clamp(0.0, 1.0)
    # the light of a highlight counts even where its share is small
    moved = raw * (strength / (colour**2).sum(0).clamp_min(1e-18)).clamp_min(1e-12).sqrt()
    sure = torch.lerp(sure, raw, (4.0 * moved - 1.0).clamp(0.0, 1.0))
    # its depth must be that of one of the two: in between, a steep surface goes on
    sided = ((here - near) - (far - here)).abs() / gap
    other = sure.clamp(0.0, 0.5) * trust * (4.0 * sided - 2.0).clamp(0.0, 1.0) * _pick(edge, at)[0]
    own_pure, other_pure = torch.where(is_near, front, behind), torch.where(is_near, behind, front)
    rest = colour - (1.0 - other) * own_pure - other * other_pure
    norm = other**2 + (1.0 - other) ** 2
    other_light = (other_pure + rest * other / norm).clamp_min(0.0)
    # the own part takes what the other leaves, so that no light is lost
    own_light = (colour - other * other_light) / (1.0 - other)
    return own_light, other_light, torch.where(is_near, far, near), other


def fill_hidden(
    light: Tensor,
    coc_px: Tensor,
    other_light: Tensor,
    other_coc_px: Tensor,
    share: Tensor,
    valid: Tensor | None,
    ordinary: Tensor,
    levels: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Light and coc of what lies behind blurred surfaces, from the farthest surfaces around them.

    A pyramid averages at each step only the farthest of four children. A pixel takes the mean of the levels that show
    something behind it, finer ones first, and of the four samples around it there only those that do; it looks no
    farther than its own blur reaches, for deeper inside nothing of what is hidden can show.

    Where that surface is blurred itself, and nothing else reaches a pixel, something lies behind it again: of all that
    the levels show, the farthest.

    Args:
        light: Own light of each pixel ``[B, C, H, W]``.
        coc_px: Its signed coc ``[B, 1, H, W]``.
        other_light: Light of the second surface of mixed pixels, as :func:`split_mixed` made it: it is overwritten.
        other_coc_px: Its coc; overwritten.
        share: Its share, 0 where a pixel is not mixed; overwritten.
        valid: ``[B, 1, H, W]``, 0 where a pixel is to be left out; None counts all.
        ordinary: Largest light that is no highlight's ``[B, 1, H, W]``: a highlight is in one place, so what is hidden
            beside it is none.
        levels: Levels of the pyramid, from 2; the widest look is ``2 ** levels`` pixels.

    Returns:
        The second sample, mixed or hidden: light, coc and weight (0 where there is none); and light behind it.
    """
    height, width = coc_px.shape[-2:]
    step = 2**levels
    right, below = _continued(width, step) - width, _continued(height, step) - height
    maps = [light, coc_px, other_light, other_coc_px, share, ordinary, *([] if valid is None else [valid])]
    parts = []
    for rows in bands(coc_px, step):
        extra = (0, right, 0, below if rows.stop == height else 0)
        parts.append(_finest(*(t[..., rows, :] for t in maps), extra=extra, cell=min(step, 2**_CELL_LEVEL)))
    *finest, near, blur = (torch.cat(part, -2) for part in zip(*parts, strict=True))
    pyramid = [tuple(finest)]
    for _ in range(levels - 1):
        pyramid.append(_farthest(*pyramid[-1]))
    may_hide, near_by = (t[..., :height, :width] for t in _may_hide(near, blur, [depth for _, depth, _ in pyramid]))
    wanted = may_hide & (coc_px.abs() > 0.5) & (share < HIDDEN_WEIGHT)
    looks = [_Level(torch.cat(level, 1), 2**i, _FALL**i, _least_px(i)) for i, level in enumerate(pyramid, 1)]
    cells = _cells(wanted, coc_px, (right, below))
    behind = _behind_all(looks, cells)
    if levels > _FINE_LEVELS:
        looks[_FINE_LEVELS:] = [_together(looks[_FINE_LEVELS:], cells)]
    found = [_hidden(looks, light, coc_px, some) for some in _in_parts(_positions(wanted & near_by), _AT_ONCE)]
    if levels > _FINE_LEVELS:
        far = _positions(wanted & ~near_by)
        found += [_hidden(looks[_FINE_LEVELS:], light, coc_px, some) for some in _in_parts(far, _AT_ONCE)]
    at, seen = torch.cat([some for some, _ in found]), torch.cat([seen for _, seen in found], 1)
    hidden = torch.full_like(seen[0], HIDDEN_WEIGHT)
    return _fill(other_light, at, seen[:-1]), _fill(other_coc_px, at, seen[-1]), _fill(share, at, hidden), behind


class _Level:
    """Farthest surfaces, at every ``step``-th pixel.

    Args:
        values: Light, coc and weight ``[B, C + 2, H, W]``.
        step: A power of two.
        vote: Weight against other levels; None if it is in the weights.
        least_px: Blur from which on a pixel looks so far.
    """

    def __init__(self, values: Tensor, step: int, vote: float | None, least_px: float) -> None:
        self.size = (values.shape[-2], values.shape[-1])
        self.flat, self.light = values.transpose(0, 1).flatten(1), values[:, :-2]
        self.step, self.vote, self.least_px = step, vote, least_px


class _Cells:
    """Cells of :data:`BEHIND_STEP` pixels a side that may hide something, each with its nearest surface."""

    def __init__(self, near: Tensor, at: Tensor) -> None:
        self.near, self.at = near, at

    def look(self, levels: Sequence[_Level], farthest: bool = False) -> tuple[Tensor, Tensor]:
        """What levels show behind them; see :func:`_look`."""
        item, row, column = places(self.at, self.near.shape[-2], self.near.shape[-1])
        centre = (BEHIND_STEP - 1) / 2
        here = _pick(self.near, self.at)[0]
        return _look(levels, item, row * BEHIND_STEP + centre, column * BEHIND_STEP + centre, here, farthest)


def _cells(wanted: Tensor, coc_px: Tensor, extra: tuple[int, int]) -> _Cells:
    """Cells of maps that are continued by so many pixels to the right and below."""
    right, below = extra
    ends = (0, right, 0, below)
    near = min_of_blocks(functional.pad(coc_px, ends, value=_NEVER_PX), BEHIND_STEP)
    any_wanted = max_of_blocks(functional.pad(wanted.to(coc_px.dtype), ends), BEHIND_STEP)
    return _Cells(near, _positions(any_wanted > 0))


def _together(levels: Sequence[_Level], cells: _Cells) -> _Level:
    """What coarse levels show behind cells, as one level of such cells."""
    total, seen = cells.look(levels)
    batch, _, height, width = cells.near.shape
    values = seen.new_zeros(batch, len(seen) + 1, height, width)
    return _Level(_put(values, cells.at, torch.cat([seen, total[None]])), BEHIND_STEP, None, levels[0].least_px)


def _behind_all(levels: Sequence[_Level], cells: _Cells) -> Tensor:
    """Light of the farthest surfaces in reach of each cell, of those that reach none the farthest of their own."""
    total, seen = cells.look(levels, farthest=True)
    some = _positions(total > 0)
    return _put(levels[_FINE_LEVELS - 1].light, cells.at[some], seen[:-1].index_select(1, some))


def _look(
    levels: Sequence[_Level], item: Tensor, row: Tensor, column: Tensor, here: Tensor, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """What levels show behind surfaces at some places: the sum of their votes, and light and coc ``[C + 1, P]``.

    With ``farthest``, of two surfaces only the farther one counts.
    """
    total = torch.zeros_like(here)
    seen = here.new_zeros(levels[0].flat.shape[0] - 1, 1)
    for level in levels:
        behind, any_behind = _behind(level, item, row, column, here)
        vote = any_behind if level.vote is None else torch.where(any_behind > 0, level.vote, 0.0)
        vote = torch.where(level.least_px <= here.abs(), vote, 0.0)
        if farthest:
            apart = behind[-1] - seen[-1]
            vote = torch.where((total > 0) & (apart < -_BEHIND_PX), 0.0, vote)
            total = torch.where((vote > 0) & (apart > _BEHIND_PX), 0.0, total)
        total = total + vote
        seen = seen + (behind - seen) * (vote / total.clamp_min(1e-9))
    return total, seen


def _hidden(levels: Sequence[_Level], light: Tensor, coc_px: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """The pixels behind which there is something, and its light and coc ``[C + 1, P]``."""
    total, seen = _look(levels, *places(at, coc_px.shape[-2], coc_px.shape[-1]), _pick(coc_px, at)[0])
    some = _positions(total > 0)
    return at[some], seen.index_select(1, some)


def _surfaces(light: Tensor, coc_px: Tensor, valid: Tensor | None, ordinary: Tensor, levels: int) -> tuple[Tensor, ...]:
    own, other, other_coc, share = split_mixed(light, coc_px, valid)
    seen = 1.0 - share
    other, other_coc, share, behind = fill_hidden(own, coc_px, other, other_coc, share, valid, ordinary, levels)
    if valid is not None:
        seen, share = seen * valid, share * valid
    return own, seen, other, other_coc, share, behind


@torch.library.custom_op("torchdof::surfaces", mutates_args=())
def _surfaces_operator(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, ordinary: Tensor, levels: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    maps = (t.contiguous() for t in _surfaces(light, coc_px, valid, ordinary, levels))
    own, seen, other, other_coc, share, behind = maps
    return own, seen, other, other_coc, share, behind


@_surfaces_operator.register_fake
def _(light: Tensor, coc_px: Tensor, valid: Tensor | None, ordinary: Tensor, levels: int) -> tuple[Tensor, ...]:
    colour, single = light.new_empty(light.shape), coc_px.new_empty(coc_px.shape)
    cells = [_continued(n, 2**levels) // BEHIND_STEP for n in light.shape[-2:]]
    behind = light.new_empty(*light.shape[:2], *cells)
    return colour, single, *(torch.empty_like(t) for t in (colour, single, single)), behind


def _remember(context: Any, inputs: tuple[Any, ...], output: Any) -> None:
    *maps, context.levels = inputs
    context.save_for_backward(*maps)


def _backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
    light, coc_px, valid, ordinary = context.saved_tensors
    with torch.enable_grad():
        light, coc_px = light.detach().requires_grad_(), coc_px.detach().requires_grad_()
        outputs = _surfaces(light, coc_px, valid, ordinary, context.levels)
        wanted = [(o, g) for o, g in zip(outputs, gradients, strict=True) if o.requires_grad]
        back = torch.autograd.grad([o for o, _ in wanted], [light, coc_px], [g for _, g in wanted], allow_unused=True)
    return (*back, None, None, None)


_surfaces_operator.register_autograd(_backward, setup_context=_remember)


def _continued(size: int, step: int) -> int:
    """Pixels of an image that is continued for a pyramid."""
    # in this form exported code knows that the sizes are multiples, and with one more that none of them is 1
    return (size + 2 * step - 1) // step * step


def _least_px(level: int) -> float:
    """Blur from which on a pixel looks as far as this level."""
    return 2.0 ** (level - 2)


def _may_hide(near: Tensor, blur: Tensor, depths: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Pixels, in cells, for which a level of the pyramid that they look at shows something farther; and a fine one."""
    coarsest = min(len(depths), _CELL_LEVEL)
    found = fine = torch.zeros_like(near, dtype=torch.bool)
    for level, depth in enumerate(depths, 1):
        around = max_around(depth)
        if level < coarsest:
            around = max_of_blocks(around, 2 ** (coarsest - level))
        elif level > coarsest:
            around = functional.interpolate(around, scale_factor=float(2 ** (level - coarsest)), mode="nearest")
        found = found | ((around > near + _BEHIND_PX) & (blur >= _least_px(level)))
        fine = found if level <= _FINE_LEVELS else fine
    both = torch.cat([found, fine], 1).to(near.dtype)
    both = functional.interpolate(both, scale_factor=float(2**coarsest), mode="nearest") > 0
    return both[:, :1], both[:, 1:]


def _finest(
    light: Tensor,
    coc_px: Tensor,
    other_light: Tensor,
    other_coc_px: Tensor,
    share: Tensor,
    most: Tensor,
    valid: Tensor | None = None,
    *,
    extra: tuple[int, int, int, int],
    cell: int,
) -> tuple[Tensor, ...]:
    """First level of the pyramid; and in cells the nearest coc and the largest blur; of maps continued by so much."""
    mixed = (share > 0.05) & (other_coc_px > coc_px)
    depth = torch.where(mixed, other_coc_px, coc_px)
    colour = torch.where(mixed, other_light, light)
    brightest = colour.amax(1, keepdim=True)
    bright = brightest > most
    if torch.compiler.is_exporting() or bool(bright.any()):
        colour = colour * torch.where(bright, most / torch.where(bright, brightest, 1.0), 1.0)
    weight = torch.where(mixed, share, 1.0 - share)
    if valid is not None:
        depth, weight = torch.where(valid > 0, depth, -_NEVER_PX), weight * valid
    colour, depth, weight, coc_px = (
        functional.pad(t, extra, mode="replicate") for t in (colour, depth, weight, coc_px)
    )
    near, blur = min_of_blocks(coc_px, cell), max_of_blocks(coc_px.abs(), cell)
    return *_farthest(colour, depth, weight), near, blur


def _farthest(colour: Tensor, depth: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One step of the pyramid: of each four children, the mean of those that are farthest."""
    most = functional.interpolate(max_of_four(depth), scale_factor=2.0, mode="nearest")
    counts = weight * (depth > most - _BEHIND_PX)
    total = mean_of_four(counts)
    some = total.clamp_min(1e-9)
    colour = mean_of_four(colour * counts) / some
    depth = torch.where(total > 0, mean_of_four(depth * counts) / some, -_NEVER_PX)
    return colour, depth, total


def _behind(level: _Level, item: Tensor, row: Tensor, column: Tensor, here: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear sample of a level at fine positions, of the samples behind each position only.

    Light and coc ``[C + 1, P]`` and their weight, 0 where nothing is behind.
    """
    height, width = level.size
    top, down = between((row + 0.5) / level.step - 0.5, height)
    left, right = between((column + 0.5) / level.step - 0.5, width)
    first = (item * height + top) * width + left
    seen = total = torch.zeros_like(here)
    for i, vertical in enumerate((1 - down, down)):
        for j, horizontal in enumerate((1 - right, right)):
            its = level.flat.index_select(1, first + (min(i, height - 1) * width + min(j, width - 1)))
            share = vertical * horizontal * its[-1] * (its[-2] > here + _BEHIND_PX)
            seen, total = seen + its[:-1] * share, total + share
    total = torch.where(total > 1e-4, total, 0.0)
    return seen / total.clamp_min(1e-4), total


def _mean(colour: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean over n of colours ``[C, n, P]`` and their variance, summed over colours, ``[P]``."""
    total = weight.sum(0).clamp_min(1e-12)
    mean = (colour * weight).sum(1) / total
    second = (colour**2 * weight).sum(1) / total
    return mean, (second - mean**2).clamp_min(0.0).sum(0)


def _positions(wanted: Tensor) -> Tensor:
    """Flat indices of the wanted pixels of ``[B, 1, H, W]``."""
    return wanted.flatten().nonzero()[:, 0]


def _in_parts(at: Tensor, count: int) -> Sequence[Tensor]:
    """Positions, as many at once as fit the cache. A graph does not know how many there are."""
    return [at] if torch.compiler.is_exporting() else at.split(count)


def _pick(values: Tensor, at: Tensor) -> Tensor:
    """``[B, C, H, W]`` -> ``[C, P]``."""
    return values.transpose(0, 1).flatten(1).index_select(1, at)


def _place(new: Tensor, at: Tensor, like: Tensor) -> Tensor:
    """Zeros like ``[B, C, H, W]``, but for what :func:`_pick` would take."""
    batch, channels, *size = like.shape
    return _fill(like.new_zeros(channels, batch, *size).transpose(0, 1), at, new)


def _put(values: Tensor, at: Tensor, new: Tensor) -> Tensor:
    """A copy of ``values`` with what :func:`_pick` would take replaced."""
    batch, channels, *size = values.shape
    flat = values.transpose(0, 1).flatten(1).index_copy(1, at, new.reshape(channels, -1).to(values.dtype))
    return flat.unflatten(1, (batch, *size)).transpose(0, 1)


def _fill(values: Tensor, at: Tensor, new: Tensor) -> Tensor:
    """As :func:`_put`, into the result of it or of :func:`_place` itself."""
    channels = values.shape[1]
    values.transpose(0, 1).view(channels, -1).index_copy_(1, at, new.reshape(channels, -1).to(values.dtype))
    return values


def _falloff(like: Tensor) -> Tensor:
    """Weights of the pixels around one by their distance, in the order of :func:`_around`."""
    reach = range(-_REACH, _REACH + 1)
    return like.new_tensor([math.exp(-(dy * dy + dx * dx) / 4.5) for dy in reach for dx in reach])


def _around(at: Tensor, like: Tensor, reach: int) -> Tensor:
    """Flat indices of the pixels around each position, row by row: ``[n, P]``."""
    height, width = like.shape[-2:]
    item, row, column = places(at, height, width)
    offsets = torch.arange(-reach, reach + 1, device=at.device)[:, None]
    lines = ((row + offsets).clamp(0, height - 1) + item * height) * width
    columns = (column + offsets).clamp(0, width - 1)
    return (lines[:, None] + columns).flatten(0, 1)


def _pick_all(values: Tensor, around: Tensor) -> Tensor:
    """``[B, C, H, W]`` -> ``[C, n, P]``."""
    return _pick(values, around.flatten()).unflatten(1, (around.shape[0], -1))


def _edge(coc_px: Tensor, valid: Tensor | None, rows: slice) -> Tensor:
    """How surely pixels of some rows lie beside another surface, from 0 to 1."""
    around = slice(max(0, rows.start - 1), rows.stop + 1)
    coc, there = coc_px[..., around, :], None if valid is None else valid[..., around, :]
    low, high = (max_around(c if there is None else torch.where(there > 0, c, -_NEVER_PX)) for c in (-coc, coc))
    inner = slice(rows.start - around.start, rows.stop - around.start)
    edge = ((high + low)[..., inner, :] / _EDGE_PX - 1.0).clamp(0.0, 1.0)
    return edge if there is None else edge * there[..., inner, :]


def _ends(coc_px: Tensor, valid: Tensor | None, at: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest coc around positions."""
    around = _around(at, coc_px, 1)
    low = high = _pick_all(coc_px, around)[0]
    if valid is not None:
        there = _pick_all(valid, around)[0] > 0
        low, high = torch.where(there, low, _NEVER_PX), torch.where(there, high, -_NEVER_PX)
    return low.amin(0), high.amax(0)
