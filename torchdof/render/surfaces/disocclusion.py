"""Disocclusion: fills in the hidden surfaces behind blurred ones, from the farther surfaces around them.

A blurred foreground is partly transparent, and the image holds no pixel of the surface behind it. A hidden sample takes
the place of this pixel. Its weight is very small, so that it matters only where no visible sample contributes.
"""

import functools
import math
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import native
from ...optics.kernel_cache import kept
from ...tensors import recomputed
from ..engines.compiled_steps import compiled_step
from ..engines.on_gpu import matte
from ..engines.ops import EAGER, Level, Ops, Seen
from ..engines.traced import is_compiled, one_operator
from ..layers.downsampling import downsampled
from ..rules import active
from .emitters import attribute_emitters
from .frame import HIDDEN_WEIGHT, Surface
from .matting import NEVER_PX, Matted

_BEHIND_PX = 1.0
"""Difference in coc at which a sample lies on another surface with confidence 1/2; 1 at 1/2 px more."""
_OWN_SLOPE = 0.25  # part of a pixel's blur by which its own surface may be farther nearby; larger: fewer hidden samples

# Levels of the pyramid
_FALL = 0.35  # weight of a level relative to the next finer one; larger: hidden areas are smoother
_FINE_LEVELS = 2  # levels that each pixel reads; coarser ones are read once per cell of 2**_FINE_LEVELS pixels
_SURE = 0.1  # weight of the samples of a level at which its vote is full, or replaces that of nearer surfaces
_LEAST_SEEN = 1e-4  # weight of samples up to which they count as empty
_LEAST_TOTAL = 1e-9  # smallest divisor of sums of light
_MIXED = 0.05  # share above which the second surface of a pixel counts; larger: fewer mixed pixels
_HIDING_FROM_PX = 0.5  # px: pixels blurred less hide nothing that is seen
_OF_MEAN = 4.0  # mean blur, over the mean coc, from which a hidden sample fades; larger: more sharp specks
_CERTAIN = 0.01  # votes at which a hidden sample has full weight

BEHIND_STEP = 2**_FINE_LEVELS
"""Distance in pixels of the samples of the light behind both surfaces, counted from the image's centre."""

_Maps = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def surfaces_of_image(
    light: Tensor,
    coc_px: Tensor,
    valid: Tensor | None,
    threshold: Tensor,
    levels: Sequence[int],
    ops: Ops = EAGER,
    covered: Tensor | None = None,
) -> tuple[list[Surface], Tensor]:
    """Splits an image into each pixel's own surface and a second one, mixed or hidden; and the light behind both.

    1. Split mixed pixels (:mod:`torchdof.render.surfaces.matting`).
    2. Take the farther surface of each pixel, with highlights dimmed to the threshold.
    3. Build a pyramid. Each sample is the mean of those of its four children that are farthest.
    4. For each cell of :data:`BEHIND_STEP` pixels, take the farthest surface of all levels: the light behind both
       surfaces. It shows where the hidden surface is blurred itself and nothing else reaches a pixel.
    5. For each pixel, average the levels that have samples behind it, with larger weights for finer ones. Use only the
       samples behind it, as the foreground's colour must not leak in. The search reaches no farther than the pixel's
       blur: deeper inside, hidden surfaces never show. A slightly farther sample counts as part of the same surface if
       that is strongly blurred, as a slope is not its own background.
    6. Replace second surfaces that are hardly mixed in by the hidden sample. Beside a larger share of the same surface
       it keeps its weight, so that no share leaves the pixel without a background.
    7. The light of a sharper surface is badly measured where its share of the pixel is small. The smaller the share,
       the more the hidden sample replaces it, if that lies on the same surface. Highlights stay: hidden samples have
       none.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: Signed, ``[B, 1, H, W]``.
        valid: ``[B, 1, H, W]``, 0 where a pixel is left out; None means all count.
        threshold: Light above which a pixel is a highlight, ``[B, 1, H, W]``; highlights are not filled in elsewhere.
        levels: Levels of the pyramid, at least 2, of all items or of each. The widest search is ``2 ** levels`` pixels.
        ops: Operations.
        covered: Surfaces that a matte gives, as from :func:`torchdof.render.surfaces.coverage.covered_by`.

    Returns:
        The surfaces, the second one with weight 0 where the pixel has one surface; and the light behind both at every
        :data:`BEHIND_STEP`-th pixel, ``[B, C, h, w]``, for an area slightly larger than the image.
    """
    if is_compiled():
        given = light.new_empty(0) if covered is None else covered
        maps = _operator(light, coc_px, given, list(levels), threshold, valid)
    else:
        maps = _surfaces_of_image(light, coc_px, covered, levels, threshold, valid, ops)
    own_light, own_weight, other_light, other_coc, other_weight, behind = maps
    return [Surface(own_light, coc_px, own_weight), Surface(other_light, other_coc, other_weight)], behind


def _empty(light: Tensor, coc_px: Tensor, _: Tensor, levels: Sequence[int], *others: Tensor | None) -> _Maps:
    colour, single = light.new_empty(light.shape), coc_px.new_empty(coc_px.shape)
    cells = (_continued(n, 2 ** max(levels)) // BEHIND_STEP for n in light.shape[-2:])
    behind = light.new_empty(*light.shape[:2], *cells)
    return colour, single, torch.empty_like(colour), torch.empty_like(single), torch.empty_like(single), behind


# The number of pixels to process depends on the data, which compiled graphs do not support.
@one_operator("torchdof::surfaces", _empty, differentiable=3)
def _operator(
    light: Tensor,
    coc_px: Tensor,
    covered: Tensor,
    levels: Sequence[int],
    threshold: Tensor,
    valid: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    given = covered if covered.numel() else None  # each argument with a gradient is a tensor
    maps = _surfaces_of_image(light, coc_px, given, levels, threshold, valid, EAGER)
    own, own_weight, other, other_coc, other_weight, behind = (t.contiguous() for t in maps)
    return own, own_weight, other, other_coc, other_weight, behind


def is_another_surface(distance_px: Tensor) -> Tensor:
    """Confidence, 0 to 1, that a surface farther by ``distance_px`` of coc is another surface."""
    return (distance_px - _BEHIND_PX + 0.5).clamp(0.0, 1.0)


def own_end(coc_px: Tensor) -> Tensor:
    """Largest coc of a pixel's own surface nearby, which may slope, of the coc of the pixel."""
    slope = _OWN_SLOPE if active().own_slope else 0.0
    return coc_px + (slope * coc_px.abs() - _BEHIND_PX).clamp_min(0.0)


def is_read(coc_px: Tensor, least_px: float | Tensor) -> Tensor:
    """How much a pixel reads a level of the pyramid, 0 to 1: in full from a blur of twice its ``least_px`` on."""
    return (coc_px.abs() / least_px - 1.0).clamp(0.0, 1.0)


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
    """Indices and weights of linear interpolation between samples of L pyramid levels, at each place of an axis.

    The axis, of ``length`` places that are ``step`` pixels apart, and the levels, which cover ``whole`` pixels with
    samples ``steps`` pixels apart, are centred on each other. Returns the indices of the samples before and after each
    place, ``[L, 2, n]``, and the weight of the one after, ``[L, n]``.
    """
    place = torch.arange(length, device=device).to(dtype)
    # tensors, as graphs support no fractions of sizes
    middle = torch.scalar_tensor(whole, dtype=dtype, device=device) / 2.0
    distance = torch.tensor(steps, dtype=dtype, device=device)[:, None]
    last = 2.0 * middle / distance - 1.0
    centre = torch.scalar_tensor(length - 1, dtype=dtype, device=device) / 2.0
    place = ((place - centre) * step + middle) / distance - 0.5
    place = torch.minimum(place.clamp_min(0.0), last)
    before = torch.minimum(place.floor(), last - 1.0)
    part, before = place - before, before.long()
    return torch.stack([before, before + 1], 1), part


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
        values = taken.amax(dim)
    return values


def _surfaces_of_image(
    light: Tensor,
    coc_px: Tensor,
    covered: Tensor | None,
    levels: Sequence[int],
    threshold: Tensor,
    valid: Tensor | None,
    ops: Ops,
) -> _Maps:
    """Light and weight of each pixel's own surface; light, coc and weight of the other one; light behind both."""
    matted = matte(light, coc_px, valid, ops, covered)
    if ops.has_rays and active().emitters:
        matted = attribute_emitters(light, coc_px, threshold, valid, matted)
    own, other, other_coc, other_weight = matted
    # a mixed pixel's other surface does not count up to a weight of HIDDEN_WEIGHT / 2, 0 here; fully from twice that, 1
    mixed = other_weight * (2.0 / HIDDEN_WEIGHT) - 1.0
    counted = other_weight * mixed.clamp(0.0, 1.0)

    # how far a hidden sample may take the place of the mixed one: of a small part of the pixel that is no highlight
    small = torch.zeros_like(mixed)
    if active().small_shares:
        peak = other.amax(1, keepdim=True) / threshold.clamp_min(torch.finfo(threshold.dtype).tiny)
        small = (2.0 - 2.0 * peak).clamp(0.0, 1.0) * (1.0 - 2.0 * other_weight).clamp_min(0.0)

    pyramid = _pyramid(matted, coc_px, threshold, valid, levels)
    wanted = (coc_px.abs() > _HIDING_FROM_PX).to(coc_px.dtype)
    behind, searched = _light_behind(pyramid, coc_px, wanted, ops)
    seen, total = ops.seen(_seen, searched, coc_px, wanted)
    seen_light, blur, seen_coc = seen.split([light.shape[1], 1, 1], 1)
    certain = (total / _CERTAIN).clamp(max=1.0)
    if active().one_side:
        certain = certain * _on_one_side(seen_coc, blur)
    if not active().filling:
        certain = torch.zeros_like(certain)

    # Up to HIDDEN_WEIGHT / 2 a mixed sample does not count, and the hidden one replaces it. If both are unlike, their
    # weights are 0 at the limit, where light and coc jump from one to the other.
    alike = small * (1.0 - is_another_surface((seen_coc - other_coc).abs()))
    hidden = HIDDEN_WEIGHT * certain * (1.0 - (1.0 - alike) * (1.0 + mixed).clamp(0.0, 1.0))
    sharper = (coc_px.abs() - other_coc.abs()).clamp(0.0, 1.0)
    kept = (1.0 - sharper * certain * alike) * (counted / (hidden + counted).clamp_min(1e-12))
    kept = torch.where(hidden > 0, kept, 1.0)
    taken = 1.0 - kept
    other, other_coc = other * kept + seen_light * taken, other_coc * kept + seen_coc * taken
    own_weight, other_weight = 1.0 - counted, hidden + counted
    if valid is not None:
        own_weight, other_weight = own_weight * valid, other_weight * valid
    return own, own_weight, other, other_coc, other_weight, behind


def _pyramid(
    matted: Matted, coc_px: Tensor, threshold: Tensor, valid: Tensor | None, levels: Sequence[int]
) -> list[Level]:
    """Step 3 of :func:`surfaces_of_image`: the farthest surfaces of an image, fine to coarse, centred on it.

    Their blur, the magnitude of the coc, is one more channel of the light, ``[B, C + 3, h, w]``.
    """
    own, other, other_coc, other_weight = matted
    sizes = [[_continued(n, 2**level) for level in levels] for n in coc_px.shape[-2:]]
    rows, columns = (max(of_items) // 2 for of_items in sizes)
    maps = [own, coc_px, other, other_coc, other_weight, threshold, *([] if valid is None else [valid])]
    light, coc_px, weight = finest_level((rows, columns), *maps).split([own.shape[1], 1, 1], 1)
    pyramid = [_repeated(torch.cat([light, coc_px.abs(), coc_px, weight], 1), sizes, 1)]
    for level in range(2, max(levels) + 1):
        pyramid.append(_repeated(coarser_level(pyramid[-1]), sizes, level))
    # a pixel reads a level from a blur of a quarter of its step on
    return [Level(t, 2**i, 2.0 ** (i - 2), _FALL**i / _SURE, _FALL**i) for i, t in enumerate(pyramid, 1)]


def _light_behind(pyramid: Sequence[Level], coc_px: Tensor, wanted: Tensor, ops: Ops) -> tuple[Tensor, Sequence[Level]]:
    """Step 4 of :func:`surfaces_of_image`: the light behind both surfaces, ``[B, C, h, w]``.

    Also returns the levels that each pixel reads: the fine ones, and one of cells instead of all coarse ones.
    ``wanted`` is 1 for pixels that may have a hidden surface, else 0.
    """
    coarse, of_cells = pyramid[_FINE_LEVELS:], pyramid[_FINE_LEVELS - 1].values
    parts = [of_cells.shape[1] - 2, 1, 1]
    looked = behind_cells(pyramid, (of_cells.shape[-2], of_cells.shape[-1]), coc_px, wanted, ops)
    behind, _, votes, *of_coarse = looked.split([*parts, *([sum(parts)] if coarse else [])], 1)
    # where nothing lies behind, the farthest surface of the cell; in a cell without valid pixels, the mean of all cells
    far_light, _, far_weight = of_cells.split(parts, 1)
    mean = (far_light * far_weight).sum((-2, -1), keepdim=True)
    mean = mean / far_weight.sum((-2, -1), keepdim=True).clamp_min(1e-12)
    behind = torch.where(votes > 0, behind, torch.where(far_weight > 0, far_light, mean))[:, :-1]
    if not coarse:
        return behind, pyramid
    cells = Level(of_coarse[0], BEHIND_STEP, coarse[0].least_px, 1.0, math.inf)
    return behind, [*pyramid[:_FINE_LEVELS], cells]


def _on_one_side(coc_px: Tensor, blur_px: Tensor) -> Tensor:
    """Confidence, 0 to 1, that samples lie on one side of the focus, of their mean coc and their mean blur.

    Both are equal in magnitude then. The mean of samples on both sides could be 0, a sharp speck.
    """
    return (1.0 + _OF_MEAN * coc_px.abs() - blur_px).clamp(0.0, 1.0)


def _repeated(values: Tensor, sizes: Sequence[Sequence[int]], level: int) -> Tensor:
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
        nearest.append(torch.minimum(torch.maximum(place, own[:, :1]), own[:, 1:]).to(values.device))
    rows, columns = nearest
    item = torch.arange(len(rows), device=rows.device)[:, None, None]
    return values.movedim(1, -1)[item, rows[:, :, None], columns[:, None]].movedim(-1, 1)


def finest_level(size: tuple[int, int], *maps: Tensor) -> Tensor:
    """:func:`_finest_level`, by the compiled engine if it can compute it."""
    found = None
    if maps[0].shape[1] <= native.MOST_PLANES:
        found = compiled_step(
            lambda *maps: native.farthest(maps, size),
            lambda gradient, *maps: native.farthest_gradient(maps, size, gradient),
            functools.partial(_finest_level, size),
            *maps,
        )
    return _finest_level(size, *maps) if found is None else found


def _finest_level(
    size: tuple[int, int],
    light: Tensor,
    coc_px: Tensor,
    other_light: Tensor,
    other_coc_px: Tensor,
    other_weight: Tensor,
    threshold: Tensor,
    valid: Tensor | None = None,
) -> Tensor:
    """The finest level of the pyramid, of ``size``: light, coc and weight, ``[B, C + 2, h, w]``.

    It is, at every second pixel from the centre, the farthest of the pixels around it. Each pixel shows its farther
    surface, dimmed to the threshold. Maps are those of its own and its other surface.
    """
    is_mixed = (other_weight > _MIXED) & (other_coc_px > coc_px)
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
    colours = light.shape[1]
    coc, weight = (torch.cat([t[:, i, None] for t in around], 1) for i in (colours, colours + 1))  # [B, 9, h, w]
    share = (shares[1][:, None, :, None] * shares[0][:, None, :]).flatten(0, 1)
    # on an axis of even size the last of three pixels has no share
    farthest = torch.where(share > 0, coc, -NEVER_PX).amax(1, keepdim=True)
    counts = weight * (1.0 - is_another_surface(farthest - coc)) * (share / 4.0)
    total = counts.sum(1, keepdim=True)
    summed = around[0][:, : colours + 1] * counts[:, :1]
    for k in range(1, 9):
        summed = torch.addcmul(summed, around[k][:, : colours + 1], counts[:, k, None])
    return _level_of(summed, total)


def coarser_level(values: Tensor) -> Tensor:
    """:func:`_farthest`, by the compiled engine if it can compute it."""
    found, parts = None, (values.shape[1] - 2, 1, 1)
    if parts[0] <= native.MOST_PLANES:
        size = (values.shape[-2] // 2, values.shape[-1] // 2)
        found = compiled_step(
            lambda values: native.farthest(values.split(parts), size),
            lambda gradient, values: [torch.cat(native.farthest_gradient(values.split(parts), size, gradient))],
            _farthest,
            values,
        )
    return _farthest(values) if found is None else found


def _farthest(values: Tensor) -> Tensor:
    """The next coarser level of the pyramid: of each four samples, the mean of those on the farthest surface."""
    light, coc_px, weight = values.split([values.shape[1] - 2, 1, 1], 1)
    farthest = functional.interpolate(functional.max_pool2d(coc_px, 2), scale_factor=2.0, mode="nearest")
    counts = weight * (1.0 - is_another_surface(farthest - coc_px))
    means = downsampled(torch.cat([light * counts, coc_px * counts, counts], 1), 2)
    return _level_of(*means.split([light.shape[1] + 1, 1], 1))


def _level_of(summed: Tensor, total: Tensor) -> Tensor:
    """Light, coc and weight of a level, of the weighted sums of light and coc, ``[B, C + 1, h, w]``, and the weight."""
    light, coc_px = (summed / total.clamp_min(_LEAST_TOTAL)).split([summed.shape[1] - 1, 1], 1)
    return torch.cat([light, torch.where(total > 0, coc_px, -NEVER_PX), total], 1)


def _seen(levels: Sequence[Level], coc_px: Tensor) -> Seen:
    """Light and coc behind the surfaces of an image, ``[B, C + 1, H, W]``, and the sum of votes ``[B, 1, H, W]``."""
    values = [level.values for level in levels]

    def plain(coc_px: Tensor, *values: Tensor) -> Tensor:
        given = [level._replace(values=t) for level, t in zip(levels, values, strict=True)]
        samples = _samples(given, (coc_px.shape[-2], coc_px.shape[-1]), 1)
        shown = [shown_behind(values, share, coc_px) for values, share in zip(*samples, strict=True)]
        lights, weights = (torch.stack(parts) for parts in zip(*shown, strict=True))
        return torch.cat(search(given, lights, weights, coc_px), 1)

    found = _looked(plain, levels, coc_px)
    found = recomputed(functools.partial(plain, coc_px, *values)) if found is None else found
    seen, votes = found.split([found.shape[1] - 1, 1], 1)  # not two slices, each of whose gradients is a whole map
    return seen, votes


def behind_cells(levels: Sequence[Level], size: tuple[int, int], coc_px: Tensor, wanted: Tensor, ops: Ops) -> Tensor:
    """Light, coc and votes behind cells of :data:`BEHIND_STEP` pixels, zeros without ``wanted`` pixels.

    Args:
        levels: All levels of the pyramid.
        size: Rows and columns of cells, which are centred on the image.
        coc_px: ``[B, 1, H, W]``; a cell has the smallest one of its pixels.
        wanted: 1 for pixels that may have a hidden surface, else 0, ``[B, 1, H, W]``.
        ops: Operations.

    Returns:
        The farthest surface of all levels, ``[B, C + 2, h, w]``; if there are coarse levels, with the mean of these,
        ``[B, 2 C + 4, h, w]``.
    """

    def plain(coc_px: Tensor, *maps: Tensor) -> Tensor:
        given = [level._replace(values=t) for level, t in zip(levels, maps[:-1], strict=True)]
        cells = _largest(torch.cat([-coc_px, maps[-1]], 1), *size, BEHIND_STEP)
        nearest, is_wanted = -cells[:, :1], cells[:, 1:] > 0
        samples, shares = _samples(given, size, BEHIND_STEP)
        shown, known = shown_behind(torch.stack(samples), shares[:, None, None], nearest)
        found = [*search(given, shown, known, nearest, farthest=True)]
        if len(levels) > _FINE_LEVELS:
            found += search(given[_FINE_LEVELS:], shown[_FINE_LEVELS:], known[_FINE_LEVELS:], nearest)
        looked = torch.cat(found, 1)
        return ops.equal_unless(lambda: is_wanted.any(), looked * is_wanted, torch.zeros_like(looked))

    found = _looked(plain, levels, coc_px, wanted)
    return plain(coc_px, *(level.values for level in levels), wanted) if found is None else found


def _looked(plain: Callable[..., Tensor], levels: Sequence[Level], coc_px: Tensor, *wanted: Tensor) -> Tensor | None:
    """``plain(coc_px, *values of the levels, *wanted)``, by the compiled engine if it can compute it."""
    values, rules, count = [level.values for level in levels], [level[1:] for level in levels], len(levels)
    if count > native.MOST_LEVELS or values[0].shape[1] - 2 > native.MOST_PLANES:
        return None
    return compiled_step(
        lambda coc, *maps: native.look_behind(maps[:count], rules, coc, *maps[count:]),
        lambda gradient, coc, *maps: native.look_behind_gradient(maps[:count], rules, coc, gradient, *maps[count:]),
        plain,
        coc_px,
        *values,
        *wanted,
    )


def _samples(levels: Sequence[Level], size: tuple[int, int], step: int) -> tuple[list[Tensor], Tensor]:
    """The four samples of each level around the pixels of a map at every ``step``-th pixel of the image.

    The map, of ``size``, is centred on the levels. Returns samples of each level, ``[B, C + 2, 4, h, w]``, and their
    weights of bilinear interpolation, ``[L, 4, h, w]``.
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
    counted, weights = counted_behind(samples, shares, coc_px.unsqueeze(2), -4)
    return mean_behind(counted.sum(-3), weights.sum(-3))


def counted_behind(samples: Tensor, share: Tensor, coc_px: Tensor, channels: int = -3) -> Seen:
    """Samples times the weights with which they count behind a map, ``[..., C + 1, h, w]``, and these weights.

    ``channels`` is the axis of light, coc and weight of the samples, of which each has a share of the mean.
    """
    count = samples.shape[channels] - 2
    coc, weight = samples.narrow(channels, count, 1), samples.narrow(channels, count + 1, 1)
    part = share * weight * is_another_surface(coc - own_end(coc_px))
    return samples.narrow(channels, 0, count + 1) * part, part


def mean_behind(summed: Tensor, total: Tensor) -> Seen:
    """The mean of the samples of which :func:`counted_behind` gives the terms; 0 if hardly any counts."""
    total = torch.where(total > _LEAST_SEEN, total, 0.0)
    return summed / total.clamp_min(_LEAST_SEEN), total


def search(levels: Sequence[Level], shown: Tensor, weight: Tensor, coc_px: Tensor, farthest: bool = False) -> Seen:
    """Mean over levels of the light and coc behind a map; with ``farthest``, of the farthest surface only.

    Args:
        levels: L levels, fine to coarse.
        shown: Light and coc of each level, ``[L, B, C + 1, h, w]``, from :func:`shown_behind`, as the next.
        weight: Their weights, ``[L, B, 1, h, w]``.
        coc_px: Coc of the map, ``[B, 1, h, w]``.
        farthest: Whether, of two levels with different surfaces, only the farther surface counts.

    Returns:
        Light and coc ``[B, C + 1, h, w]``, and the sum of the levels' votes ``[B, 1, h, w]``.
    """
    numbers = _numbers_of(tuple(level[2:] for level in levels), coc_px.dtype, coc_px.device)
    least, slope, most = (numbers[i, :, None, None, None, None] for i in range(3))
    looked = is_read(coc_px, least)
    votes = looked * torch.minimum(weight * slope, most)
    if not farthest:
        total = votes.sum(0)
        return (shown * votes).sum(0) / total.clamp_min(_LEAST_TOTAL), total
    sure = (looked * weight / _SURE).clamp(max=1.0)
    total, seen = votes[0], shown[0]
    for k in range(1, len(levels)):
        beyond = shown[k] - seen
        apart, vote = beyond[:, -1:], votes[k]
        vote = torch.where(total > 0, vote * (1.0 - is_another_surface(-apart)), vote)
        total = total * (1.0 - sure[k] * is_another_surface(apart)) + vote
        seen = seen + beyond * (vote / total.clamp_min(_LEAST_TOTAL))
    return seen, total


@kept
def _numbers_of(rules: tuple[tuple[float, float, float], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Rows of ``[3, L]``: ``least_px``, ``slope`` and ``most`` of each level."""
    return torch.tensor(rules, dtype=dtype, device=device).t()


def _continued(size: int, step: int) -> int:
    """Pixels of an axis padded for a pyramid: at least half a cell on each side, and an even size on every level."""
    # Even sizes put the image's centre between two samples of each level. An exported graph infers from this form that
    # sizes are multiples.
    return (size + BEHIND_STEP + 2 * step - 1) // (2 * step) * (2 * step)
