"""Moves the edges of a depth map to the edges of the image.

Measured or estimated depth has its edges a few pixels beside those of the image, or ramps instead of steps. Both draw
outlines around blurred objects. This module decides for each pixel near a depth edge which of the two surfaces it
shows. It compares the pixel's colour with pixels that clearly lie on one surface, and combines this with a prior: the
share of wrong pixels that the map has at similar places of the same frame. So systematic errors (a foreground a pixel
too thin, edges displaced to the right, ramps four pixels wide) are learnt from the frame, and a map with exact edges
stays unchanged.

All computations use nearness, a measure linear in 1 / depth: planes are linear in it, and resampling and depth
estimation turn an edge into averages of it.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import native, pixels, validation
from ..options import DepthEdges
from ..tensors import is_differentiated, is_in_memory, is_traced
from ..validation import ends
from .ops import EAGER, Ops
from .traced import is_compiled, one_operator

__all__ = ["STEP_PX", "judged", "mended", "repair", "repair_edges"]

STEP_PX = 1.0
"""Smallest difference in coc, in pixels, between two surfaces whose edge is repaired."""

# Edges: which pixels are compared
_LEAST_STEP_PX = 0.5 * STEP_PX  # smallest range of coc in a map that is repaired; half a step, as for lamps
_STEP = 0.1  # step of :func:`repair_edges`, as a fraction of the largest nearness around; larger: fewer edges
_RINGS = 3  # px on each side of a step that are checked; larger: corrects wider displacements
_ABRUPT = 0.3  # smallest jump between neighbours at a step, as a fraction of the step; larger: fewer steps
_RAMP_REACH = 6  # px; half the width of the widest ramp, anything wider is a slope
_SHALLOW = 0.03  # smallest slope of a ramp per pixel, as a fraction of the range of nearness around
_TIE = 0.017  # steps by which one axis must lead to give an edge its direction; breaks ties of means over 25 pixels

# Noise of a map, below which a step is not an edge
_NOISES = 12.0  # smallest step, in standard deviations of the noise; larger: fewer edges in noisy maps
_LEVELS_OF_A_FILE = 64  # fewest levels of a map with the noise of rounding; larger: more edges in coarse maps
_NOISE_SAMPLED = 2**13  # pixels per frame that are sampled, half along rows and half along columns

# Colour: which of two surfaces a pixel resembles
_REACH = 5  # px; half the width of the window of samples around a pixel
_FALLOFF_PX = 2.5  # standard deviation of the Gaussian weights of these samples
_SURE = (0.0, 0.02, 0.06, 0.2, 1.0)  # weight of a sample, by ring: beside a step its depth may be wrong
_CLEAR = 0.1  # sum of these weights from which samples beside a step count in full; larger: thin strands stay
_CLEAR_IN_PRIOR = 0.25  # the same where the share of wrong pixels is estimated; larger: soft pictures stay
_SHARPNESS = 1.6  # factor on scores, which samples on the wrong side reduce; larger: colour outweighs the map

# Prior: how often each kind of edge pixel shows the near surface
_DIRECTIONS = 5  # directions of an edge: up, left, diagonal, right, down
_LEVELS = 6  # levels of a ramp
_PLACES = 2 * _RINGS + _LEVELS  # kinds of one direction
_SAMPLED = 12_000  # sqrt(_SAMPLED * pixels of the frame) pixels are sampled, in blocks; larger: more exact, slower
_BLOCK = 8  # px; side of a block
_TRUSTED = 0.05  # assumed share of wrong pixels beside steps
_PRIOR_COUNT = 30.0  # weight of assumptions, in pixels; larger: the frame changes them less
_ROUNDS = 10  # iterations of the fit

# Decision, with "auto"
_RELATED = 0.8  # smallest agreement of colours with the clear pixels of a map at which colours are used
_EXACT = 0.025  # largest share of wrong pixels at which the steps of a map count as exact
_DOUBTFUL = 0.05  # share of wrong pixels of a kind above which these pixels are decided again
_LEAN = 2.0  # log-odds by which a far surface must win: foreground left behind is the more visible error

# Soft maps: blurred by resampling, or written by a network. More than _SOFT of the edge pixels of a soft map lie on
# ramps. These are wider than _WIDE, or have more than _MIXED of their pixels in the middle half between both surfaces:
# compression makes narrow ramps too, whose pixels lie close to one of the surfaces.
_SOFT = 0.1  # share of edge pixels
_WIDE = 1.5  # px
_MIXED = 0.5  # share of a ramp's pixels

# Lamps and ringing of soft maps
_BLUR_REACH = 9  # px; half the width of the Gaussian kernel
_CLIMBED = 0.35  # standard deviation of a ramp, as a fraction of (pixels of its middle half) / (steps they climb)
_PIXEL = 0.2  # px^2; variance that the area of a pixel adds to a ramp
_BETTER = 0.5  # fraction of the variance unexplained by a sharp shape that its blur must explain for full confidence
_RINGING_REACH = 3  # px; half the largest width of a rim of ringing; larger: wider details are flattened
_OVERSHOOT = 0.12  # largest height of a rim that is removed in full, in steps; at twice this height it stays

# Numbers
_NEVER = 1e30  # negated, replaces invalid values in maxima
_LARGEST = 1e15  # largest valid nearness, whose square is finite in float32
_BRIGHTEST = 1e30  # upper limit for light; products of a few such values overflow float32


class _Edges(NamedTuple):
    """Edges of a map of nearness; all ``[B, 1, H, W]``."""

    near: Tensor  # nearness of the nearer of the two surfaces around the pixel
    far: Tensor  # nearness of the farther one
    is_ramp: Tensor  # the pixel lies on a ramp between the two
    ring: Tensor  # distance to a step in pixels, from 1; ``_RINGS + 1`` if no step is within ``_RINGS``
    is_edge: Tensor
    direction: Tensor  # towards the near surface: 0 up, 1 left, 2 diagonal, 3 right, 4 down


def repair_edges(image: Tensor, depth: Tensor, edges: DepthEdges = "repair") -> Tensor:
    """Moves and sharpens the edges of a depth map to where the image has them.

    Ramps become steps between their two surfaces. Pixels that show one surface and have the depth of the other are
    corrected. Slopes stay slopes, and an edge between two surfaces of the same colour stays unchanged.

    Args:
        image: ``[B, C, H, W]``, linear light, floating point; its scale does not matter.
        depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres, > 0, ``inf`` allowed; NaN, zero and negative values stay.
        edges: "repair" decides at each edge; "auto" returns a map with exact edges unchanged to the bit; "as
            given" does nothing.

    Returns:
        ``[B, 1, H, W]``, metres. Gradients flow to the depth of unchanged pixels; repaired pixels are constant.

    Raises:
        ValueError: If shapes or types are not as described.

    Example:
        >>> image = torch.zeros(1, 3, 24, 24)
        >>> image[..., 12:] = 1.0
        >>> depth = torch.full((1, 1, 24, 24), 2.0)
        >>> depth[..., 13:] = 1.0  # a pixel too far to the right
        >>> bool((repair_edges(image, depth)[..., 12:] == 1.0).all())
        True
    """
    validation.image_and_depth(image, depth, values=False)
    validation.choice("depth_edges", edges, ("auto", "repair", "as given"))
    if edges == "as given":
        return depth
    depth = depth.expand(image.shape[0], -1, -1, -1)
    nearness = torch.where(depth > 0, 1.0 / depth.detach(), torch.nan)
    high = _highest(torch.where(depth > 0, nearness, 0.0).float(), _REACH)
    repaired = repair(image, nearness, _STEP * high, edges == "auto")
    changed = (repaired != nearness) & (depth > 0)
    return torch.where(changed, 1.0 / repaired.clamp_min(0.0), depth)


def mended(image: Tensor, coc_px: Tensor, edges: DepthEdges, ops: Ops = EAGER) -> Tensor:
    """Repairs the edges of a map of the coc: the first step of the pipeline.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B or 1, 1, H, W]``, signed.
        edges: As for :func:`repair_edges`.
        ops: Skips frames without edges, and processes lists of pixels in parts.

    Returns:
        The map, ``[B, 1, H, W]`` if it is repaired. Gradients flow to unchanged pixels.
    """
    if edges == "as given":
        return coc_px
    if not is_traced():
        low, high = ends(coc_px)
        if high - low < _LEAST_STEP_PX:
            return coc_px
    repaired = repair(image, coc_px.detach(), STEP_PX, auto=edges == "auto", of_coc=True, ops=ops)
    repaired = ops.choose(lambda: _has_steps(coc_px), repaired, coc_px)
    return torch.where(repaired == coc_px, coc_px, repaired) if is_differentiated(coc_px) else repaired


def _has_steps(coc_px: Tensor) -> Tensor:
    """Whether the range of a map reaches :data:`_LEAST_STEP_PX` or contains NaN: a bool ``[]``."""
    low, high = torch.aminmax(coc_px)
    return ~(high - low < _LEAST_STEP_PX)


def repair(
    image: Tensor, nearness: Tensor, step: Tensor | float, auto: bool, of_coc: bool = False, ops: Ops = EAGER
) -> Tensor:
    """Repairs a map of nearness, of any scale and offset.

    Values that are not finite, or above 1e15 in magnitude, stay unchanged and affect no other pixel.

    Args:
        image: ``[B, C, H, W]``, linear light.
        nearness: ``[B or 1, 1, H, W]``, linear in 1 / depth, larger is nearer.
        step: Smallest difference in nearness between two surfaces, ``[B, 1, H, W]`` or a number.
        auto: Whether exact edges stay unchanged.
        of_coc: Whether ``nearness`` is a map of the coc instead, in which a larger value is farther.
        ops: Processes lists of pixels in parts.

    Returns:
        ``[B, 1, H, W]``, constant to autograd; unchanged pixels keep their values to the bit.
    """
    device = image.device.type
    if torch.is_autocast_enabled(device):  # which would compute in half precision
        with torch.autocast(device, enabled=False):
            return repair(image, nearness, step, auto, of_coc, ops)
    image, nearness = image.detach(), nearness.detach()
    compiled = not is_traced() and all(map(is_in_memory, (image, nearness))) and native.chosen()
    if of_coc and not compiled:
        return -repair(image, -nearness, step, auto, ops=ops)
    light, given = image.float(), nearness.float().expand(image.shape[0], -1, -1, -1)
    step = torch.as_tensor(step, dtype=given.dtype, device=given.device)
    if is_compiled():
        repaired = _operator(light, given, step, auto)
    elif compiled:
        steps = step.expand(light.shape[0], 1, *given.shape[-2:]) if step.ndim else step.expand(light.shape[0], 1)
        items = [native.repair_edges(a, b[0], c[0], auto, of_coc) for a, b, c in zip(light, given, steps, strict=True)]
        repaired = (items[0][None] if len(items) == 1 else torch.stack(items))[:, None]
    else:
        repaired = _repair(light, given, step, auto, ops)
    if nearness.dtype == torch.float32:
        return repaired
    return torch.where(repaired == given, nearness, repaired.to(nearness.dtype))


@torch.no_grad()
def judged(image: Tensor, nearness: Tensor, step: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """Finds the pixels at a map's edges, and those that :func:`repair` changes with ``auto``.

    Args:
        image: As for :func:`repair`.
        nearness: As for :func:`repair`.
        step: As for :func:`repair`.

    Returns:
        Whether a pixel is at an edge, whether it is on a ramp there, and whether it changes, ``[B, 1, H, W]`` each.
    """
    given = nearness.float().expand(image.shape[0], -1, -1, -1)
    valid = given.abs() <= _LARGEST
    step = torch.as_tensor(step, dtype=given.dtype, device=given.device)
    edges = _find(torch.where(valid, given, 0.0), valid, torch.maximum(step, _NOISES * _noise(given, valid)))
    repaired = repair(image, nearness, step, auto=True)
    return edges.is_edge, edges.is_edge & edges.is_ramp, (repaired != nearness) & valid


@torch.no_grad()
def _repair(image: Tensor, nearness: Tensor, step: Tensor, auto: bool, ops: Ops = EAGER) -> Tensor:
    """Plain PyTorch version of :func:`repair`.

    1. Find ramps and steps, and the nearness of both surfaces there.
    2. Score sampled edge pixels by colour, fit the prior of each kind of edge pixel, and detect soft maps.
    3. Select the pixels to decide: all edge pixels; with ``auto``, those of kinds that are often wrong.
    4. A selected pixel shows the near surface where ``score + logit(prior) > 0``.
    5. Give selected pixels the nearness of their surface, on ramps in proportion to the evidence.
    6. In soft maps, remove the ringing of interpolation beside steps, and correct lamps of a few pixels.
    """
    valid = nearness.abs() <= _LARGEST
    given = torch.where(valid, nearness, 0.0)
    step = torch.maximum(step, _NOISES * _noise(given, valid))
    light = torch.where(torch.isfinite(image), image, 0.0).clamp(0.0, _BRIGHTEST)
    edges = _find(given, valid, step)
    is_near = 2.0 * given > edges.near + edges.far
    witness = given.new_tensor(_SURE)[edges.ring] * (valid & ~edges.is_ramp)

    # the prior of each kind of edge pixel, from samples
    height, width = given.shape[-2:]
    area = torch.scalar_tensor(height * width, dtype=torch.float64, device=given.device)  # not a constant in graphs
    every = (area / _SAMPLED).sqrt().ceil().long()
    rows, columns = (_from_border(n, given.device) // _BLOCK for n in (height, width))
    sampled = pixels.indices(edges.is_edge & ((rows[:, None] + columns) % every == 0))
    level = ((given - edges.far) / (edges.near - edges.far).clamp_min(1e-12)).clamp(0.0, 1.0)
    kind = _kind(level, edges)
    sampled_score = _judge(light, given, witness, edges, sampled, _CLEAR_IN_PRIOR, ops)[0]
    prior = _calibrate(kind, sampled, sampled_score, given.shape[0])[kind]
    wrong = torch.where(is_near, 1.0 - prior, prior)
    climb = _climb(given, valid, edges)
    is_mixed = edges.is_edge & ((level - 0.5).abs() < 0.25)
    parts = (edges.is_ramp.float(), (edges.is_ramp & is_mixed).float(), climb)
    ramps, mixed, length = (_mean_of(part, edges.is_edge, sampled) for part in parts)
    is_soft = (ramps > _SOFT) & ((ramps > _WIDE * length) | (mixed > _MIXED * ramps))
    if auto:
        is_related = _is_related(level, edges, sampled, sampled_score)
        is_soft = is_soft & is_related
        is_inexact = is_related & (is_soft | (_mean_of(wrong, ~edges.is_ramp, sampled) > _EXACT))

    # which surface the selected pixels show
    doubtful = edges.is_edge
    if auto:
        doubtful = doubtful & is_inexact & torch.where(edges.is_ramp, is_soft, wrong > _DOUBTFUL)
    edge_pixels = pixels.indices(doubtful)
    if auto and not is_traced() and len(edge_pixels) == 0:  # nor lamps: a soft map has ramps, which are selected
        return nearness
    score, evidence, near, far = _judge(light, given, witness, edges, edge_pixels, _CLEAR, ops)
    shows_near = score + torch.logit(pixels.pick(prior, edge_pixels)[0])
    if auto:  # without auto, correct steps are decided too, and the lead would move them
        shows_near = shows_near + _LEAN * (score.abs() - 1.0).clamp(0.0, 1.0)
    shows_near = shows_near > 0

    # the blur of a soft map: its standard deviation in pixels, and the width that it takes from near surfaces
    climbed = (climb * is_mixed).sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
    ramp_px = _CLIMBED * is_mixed.sum((1, 2, 3), keepdim=True) / climbed
    sigma = (ramp_px.square() - _PIXEL).clamp_min(0.0).sqrt().clamp(0.2, 3.0)

    label = pixels.put(is_near.to(given.dtype), edge_pixels, shows_near.to(given.dtype))
    length = climb.sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
    lost_px = torch.where(edges.is_edge, label - level, 0.0).sum((1, 2, 3), keepdim=True) / length

    own = pixels.pick(given, edge_pixels)[0]
    is_ramp = pixels.pick(edges.is_ramp, edge_pixels)[0]
    moved = torch.where(is_ramp, evidence, (shows_near != pixels.pick(is_near, edge_pixels)[0]).to(given.dtype))
    out = pixels.put(given, edge_pixels, torch.lerp(own, torch.where(shows_near, near, far), moved))
    out = torch.where(is_soft, _without_ringing(out, valid, step), out)
    return torch.where(valid, _lift_lamps(light, given, out, step, is_soft, sigma, lost_px, ops), nearness)


def _empty(image: Tensor, nearness: Tensor, step: Tensor, auto: bool) -> Tensor:
    return torch.empty_like(nearness, memory_format=torch.contiguous_format)


# The number of pixels to process depends on the data, which compiled graphs do not support.
@one_operator("torchdof::repair_edges", _empty)
def _operator(image: Tensor, nearness: Tensor, step: Tensor, auto: bool) -> Tensor:
    return _repair(image, nearness, step, auto).clone()


def _from_border(size: int, device: torch.device) -> Tensor:
    """Distance of each pixel to the nearest border: selects the same pixels in a mirrored frame."""
    places = torch.arange(size, device=device)
    return torch.minimum(places, size - 1 - places)


def _noise(nearness: Tensor, valid: Tensor) -> Tensor:
    """Estimates the standard deviation of each item's noise, ``[B, 1, 1, 1]``.

    It is proportional to the median of ``|second difference|``, along rows or columns, whichever is larger. A map that
    holds multiples of a number q, such as one from a file with 8 bits, has at least the noise of rounding to them,
    ``q / sqrt(12)``; q is the smallest difference of two neighbours. This needs a range of more than
    :data:`_LEVELS_OF_A_FILE` times q: a map of a few surfaces has a smallest difference too, which is not rounding.
    """
    every = (2 * nearness.shape[-2] * nearness.shape[-1] + _NOISE_SAMPLED - 1) // _NOISE_SAMPLED
    middles, least, ends = [], [], []
    for values, known in ((nearness, valid), (nearness.transpose(-2, -1), valid.transpose(-2, -1))):
        count, size = values.shape[-2:]
        first = torch.arange(0, (count + 1) // 2, every, device=values.device)
        last = count - 1 - torch.arange(0, count // 2, every, device=values.device)
        lines = torch.cat([first, last])  # from both borders: the same lines in a mirrored frame
        line, has = (functional.pad(t.index_select(-2, lines), (0, 2)) for t in (values, known))
        has = has.narrow(-1, 0, size) & has.narrow(-1, 1, size) & has.narrow(-1, 2, size)
        changes = line.diff()
        bends = torch.where(has, changes.diff().abs(), torch.inf).flatten(1).sort(1).values
        middle = (has.flatten(1).sum(1, keepdim=True) - 1).clamp_min(0) // 2
        middles.append(bends.gather(1, middle))
        line, changes = line.narrow(-1, 0, size), changes.narrow(-1, 0, size).abs()
        least.append(torch.where(has & (changes > 0), changes, torch.inf).amin((-2, -1)))
        ends.append(
            torch.where(has, line, -torch.inf).amax((-2, -1)) + torch.where(has, -line, -torch.inf).amax((-2, -1))
        )
    bend = torch.maximum(*(torch.where(middle < torch.inf, middle, 0.0) for middle in middles))
    quantum, span = torch.minimum(*least), torch.maximum(*ends)
    noise = torch.where(span > _LEVELS_OF_A_FILE * quantum, 0.2887 * quantum, 0.0)  # 1 / sqrt(12)
    return torch.maximum(0.6053 * bend, noise)[..., None, None]  # 1.4826 / sqrt(6), for Gaussian noise


def _find(nearness: Tensor, valid: Tensor, step: Tensor) -> _Edges:
    """Finds ramps and steps, and the nearness of the two surfaces that meet there."""
    high, low = torch.where(valid, nearness, -_NEVER), torch.where(valid, -nearness, -_NEVER)
    slope, jump = _slopes(nearness, valid)
    span = _highest(high, _REACH) + _highest(low, _REACH)
    # a ramp is short and has flat places around it; a slope has none
    flattest = -_highest(-_mean(slope, 2), 8)
    is_ramp = (slope > 0.1 * step) & (slope > _SHALLOW * span) & (span > step) & (flattest < 0.3 * slope) & valid

    # the surfaces at both ends of a ramp: extremes spread along it pixel by pixel
    ends = torch.cat([high, low], 1)  # the nearer surface, and the farther one with the opposite sign
    spread = ends
    for _ in range(_RAMP_REACH):
        spread = torch.where(is_ramp, _highest(spread, 1), spread)
    is_ramp = is_ramp & (spread.sum(1, keepdim=True) > step)
    ends = torch.where(is_ramp, spread, ends)

    # the surfaces on both sides of a step: extremes within k pixels; the smallest k that reaches the step counts
    rings = [torch.cat([ends, jump], 1)]
    for _ in range(_RINGS):
        rings.append(_highest(rings[-1], 1))
    least = torch.maximum(0.6 * rings[-1][:, :2].sum(1, keepdim=True), step)
    ring, sides = torch.full_like(nearness, _RINGS + 1, dtype=torch.long), rings[-1][:, :2]
    for k in range(_RINGS, 0, -1):
        of_ring, largest_jump = rings[k].split([2, 1], 1)
        gap = of_ring.sum(1, keepdim=True)
        is_step = (gap > least) & (largest_jump > _ABRUPT * gap)
        ring, sides = torch.where(is_step, k, ring), torch.where(is_step, of_ring, sides)
    near, far = torch.where(is_ramp, ends, sides).split(1, 1)
    far = -far
    is_edge = (is_ramp | (ring <= _RINGS)) & (near - far > step) & valid

    mean = _mean(functional.pad(nearness, (2,) * 4, mode="replicate"), 2)
    right, down = mean[..., 2:-2, 4:] - mean[..., 2:-2, :-4], mean[..., 4:, 2:-2] - mean[..., :-4, 2:-2]
    tie = _TIE * (near - far)
    across = torch.where(right.abs() > down.abs() + tie, right.sign(), 0.0)
    along = torch.where(down.abs() > right.abs() + tie, down.sign(), 0.0)
    direction = (2.0 * along + across).long() + _DIRECTIONS // 2
    return _Edges(near, far, is_ramp, ring, is_edge, direction)


def _kind(level: Tensor, edges: _Edges) -> Tensor:
    """Index of the kind of each pixel ``[B, 1, H, W]``; pixels of one kind have one prior.

    A kind is an item, a place and a direction. A place is a ring on one side of a step, or one level of a ramp.
    """
    side = (level > 0.5).long() * _RINGS + edges.ring.clamp(max=_RINGS) - 1
    place = torch.where(edges.is_ramp, 2 * _RINGS + (level * _LEVELS).long().clamp(0, _LEVELS - 1), side)
    item = torch.arange(level.shape[0], device=level.device).view(-1, 1, 1, 1)
    return (item * _PLACES + place) * _DIRECTIONS + edges.direction


def _judge(
    light: Tensor, nearness: Tensor, witness: Tensor, edges: _Edges, edge_pixels: Tensor, clear: float, ops: Ops
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Scores by colour which of two surfaces pixels ``[P]`` show.

    1. Take samples of both surfaces from a window around each pixel, weighted by distance and by ``witness``.
    2. Compute mean and spread of both colours, and how well these separate the surfaces, in [0, 1].
    3. Compute the likelihood of each surface: the share of its samples that resemble the pixel. A surface of several
       colours has no useful mean. Beside a step, few samples prove little: in a photograph, whose edges are soft, a
       strand of a pixel has mostly the colour of its background.
    4. Average scores over neighbours of similar colour.

    ``clear`` is the sum of weights from which samples of a surface count in full.

    Returns:
        ``[P]`` each: the log-likelihood ratio, positive for the near surface; the evidence, 0 to 1; and the nearness
        of the near and of the far surface, as means of the samples that resemble the pixel.
    """
    colour = light.sqrt()
    offsets = torch.arange(-_REACH, _REACH + 1, device=light.device, dtype=light.dtype)
    apart = offsets[:, None] ** 2 + offsets**2  # a pixel is not its own sample
    falloff = torch.where(apart > 0, torch.exp(-apart / (2 * _FALLOFF_PX**2)), 0.0).flatten()[:, None]

    def look(part: Tensor) -> Tensor:
        window = pixels.around(part, nearness, _REACH)
        near, far = pixels.pick(edges.near, part)[0], pixels.pick(edges.far, part)[0]
        values, own, others = pixels.pick(nearness, window)[0], pixels.pick(colour, part), pixels.pick(colour, window)
        weight, most_off = falloff * pixels.pick(witness, window)[0], 0.25 * (near - far).clamp_min(1e-12)
        sides = [weight * ((values - end).abs() < most_off) for end in (near, far)]

        # mean colours of both surfaces, and the variance around them
        sums = [side.sum(0) for side in sides]
        known = (sums[0] > 1e-3) & (sums[1] > 1e-3)
        totals = [total + 1e-9 for total in sums]
        means = [(others * side).sum(1) / total for side, total in zip(sides, totals, strict=True)]
        spreads = [
            ((others - mean[:, None]).square() * side).sum((0, 1)) / total
            for mean, side, total in zip(means, sides, totals, strict=True)
        ]
        noise = 2.25e-4 * (means[0] + means[1]).square().sum(0)
        spread = 0.5 * (spreads[0] + spreads[1]) + noise + 1e-12
        contrast = (means[0] - means[1]).square().sum(0)
        separation = (contrast / (contrast + 0.5 * spread) - 0.1).clamp_min(0.0) / 0.9
        separation = torch.where(known, separation, 1.0)  # no samples in the middle of a wide ramp: neighbours decide

        # likelihoods
        alike = (1.0 + (others - own[:, None]).square().sum(0) / (0.3 * spread)).square().reciprocal()
        likelihoods = [(side * alike).sum(0) / total + 1e-9 for side, total in zip(sides, totals, strict=True)]
        score = torch.where(known, torch.log(likelihoods[0] / likelihoods[1]), 0.0).clamp(-8.0, 8.0)
        certainty = (torch.minimum(*sums) / clear).clamp(max=1.0)
        score = torch.where(pixels.pick(edges.is_ramp, part)[0], score, score * certainty)
        surfaces = []
        for side, end in zip(sides, (near, far), strict=True):
            share = side * (alike + 1e-3)
            surfaces.append(torch.where(known, (share * values).sum(0) / share.sum(0).clamp_min(1e-12), end))
        return torch.stack([score, separation, *surfaces, known.to(score.dtype)])

    score, separation, near, far, known = ops.by_parts(look, edge_pixels).unbind(0)

    # neighbours of similar colour decide together
    scores = pixels.put(torch.full_like(nearness, torch.nan), edge_pixels, score)
    window = pixels.around(edge_pixels, nearness, 1)
    own, others = pixels.pick(colour, edge_pixels), pixels.pick(colour, window)
    scores = pixels.pick(scores, window)[0]
    alike = 1.0 / (1.0 + (others - own[:, None]).square().sum(0) / (0.0225 * own.square().sum(0) + 1e-12))
    alike = torch.where(scores.isnan(), 0.0, alike)  # NaN: not an edge pixel
    scores = torch.where(scores.isnan(), 0.0, scores)
    score = (_SHARPNESS * separation * (alike * scores).sum(0) / alike.sum(0).clamp_min(1e-12)).clamp(-6.0, 6.0)
    evidence = (2.0 * separation * scores.abs().amax(0) - 1.0).clamp(0.0, 1.0)
    # at the ends of a wide ramp the window holds only one of the surfaces: use the evidence of its middle
    around = _highest(pixels.put(torch.zeros_like(nearness), edge_pixels, evidence), 3)
    evidence = torch.where(known > 0, evidence, pixels.pick(around, edge_pixels)[0])
    return score, evidence, near, far


def _mean_of(values: Tensor, mask: Tensor, sampled: Tensor) -> Tensor:
    """Mean over an item's sampled pixels inside a mask, ``[B, 1, 1, 1]``; 0 without such pixels."""
    item, weight = sampled // mask[0].numel(), pixels.pick(mask, sampled)[0].to(values.dtype)
    weighted = weight * pixels.pick(values, sampled)[0]
    sums = [weight.new_zeros(mask.shape[0]).index_add(0, item, w) for w in (weight, weighted)]
    return (sums[1] / sums[0].clamp_min(1.0)).view(-1, 1, 1, 1)


def _is_related(level: Tensor, edges: _Edges, sampled: Tensor, score: Tensor) -> Tensor:
    """Whether the colour scores of an item agree with its map at clear pixels, ``[B, 1, 1, 1]``.

    Clear pixels lie in the outermost ring of a step or near the ends of a ramp. An image unrelated to its depth agrees
    at half of them.
    """
    own = pixels.pick(level, sampled)[0]
    is_ramp, ring = pixels.pick(edges.is_ramp, sampled)[0], pixels.pick(edges.ring, sampled)[0]
    clear = torch.where(is_ramp, (own - 0.5).abs() > 0.3, ring == _RINGS)
    weight = (0.5 * score.abs()).clamp(max=1.0) * clear
    agrees = ((score > 0) == (own > 0.5)).to(score.dtype)
    item = sampled // level[0].numel()
    sums = [score.new_zeros(level.shape[0]).index_add(0, item, w) for w in (weight, weight * agrees)]
    return ((sums[1] + 0.5 * _PRIOR_COUNT) / (sums[0] + _PRIOR_COUNT) > _RELATED).view(-1, 1, 1, 1)


def _calibrate(kind: Tensor, sampled: Tensor, score: Tensor, items: int) -> Tensor:
    """Share of pixels that show the near surface, for each kind: the prior, fitted to colour scores.

    Expectation maximisation with an assumed share, which counts as :data:`_PRIOR_COUNT` pixels. The first fit joins all
    directions; its shares are the assumption of the second fit, one direction at a time.
    """
    device, dtype = score.device, score.dtype
    steps = torch.tensor([_TRUSTED] * _RINGS + [1.0 - _TRUSTED] * _RINGS, device=device, dtype=dtype)
    ramps = (torch.arange(_LEVELS, device=device, dtype=dtype) + 0.5) / _LEVELS
    assumed = torch.cat([steps, ramps]).repeat(items)
    kinds = pixels.pick(kind, sampled)[0]
    places = kinds // _DIRECTIONS
    weight = (0.5 * score.abs()).clamp(max=1.0)

    def fit(groups: Tensor, start: Tensor, assumed: Tensor) -> Tensor:
        prior = _PRIOR_COUNT * assumed
        share, total = start, torch.full_like(prior, _PRIOR_COUNT).index_add(0, groups, weight)
        for _ in range(_ROUNDS):
            near = torch.sigmoid(score + torch.logit(share)[groups])
            share = (prior.index_add(0, groups, weight * near) / total).clamp(0.005, 0.995)
        return share

    is_step = (torch.arange(_PLACES, device=device) < 2 * _RINGS).repeat(items)
    together = fit(places, torch.where(is_step, 0.5, assumed), assumed).repeat_interleave(_DIRECTIONS)
    return fit(kinds, torch.full_like(together, 0.5), together)


def _climb(nearness: Tensor, valid: Tensor, edges: _Edges) -> Tensor:
    """Steepness of edge pixels in steps per pixel, ``[B, 1, H, W]``: its sum is the length of all edges in pixels."""
    across, along = _changes(nearness, valid, -1), _changes(nearness, valid, -2)
    beside = [functional.pad(across, ends) for ends in ((1, 0), (0, 1))]
    below = [functional.pad(along, (0, 0, *ends)) for ends in ((1, 0), (0, 1))]
    steepness = 0.25 * sum(torch.hypot(a, b) for a in beside for b in below)
    return torch.where(edges.is_edge, steepness / (edges.near - edges.far).clamp_min(1e-12), 0.0)


def _without_ringing(nearness: Tensor, valid: Tensor, step: Tensor) -> Tensor:
    """Removes rims beside steps that are a little nearer, or farther, than the surface to which they belong.

    Maps enlarged by bicubic or Lanczos interpolation overshoot a step by up to a tenth of it on both sides. The rim of
    a surface near the focus would be blurred differently from the surface. Opening removes rims of at most twice
    :data:`_RINGING_REACH` pixels that are nearer, closing those that are farther. Pixels move into the range between
    the closed opening and the opened closing (the morphological centre), which leaves noise unchanged too.

    Reference:
        Serra, "Image Analysis and Mathematical Morphology, volume 2", 1988, chapter 8 (the centre).
    """
    high, low = (_spread(torch.where(valid, t, -_NEVER)) for t in (nearness, -nearness))
    closed_opening, of_negated = (-_spread(-_spread(_spread(-t))) for t in (low, high))
    opened_closing = -of_negated
    ends = torch.minimum(closed_opening, opened_closing), torch.maximum(closed_opening, opened_closing)
    moved = torch.minimum(torch.maximum(nearness, ends[0]), ends[1]) - nearness
    span = high + low
    return nearness + moved * torch.where(span > step, 2.0 - moved.abs() / (_OVERSHOOT * span), 0.0).clamp(0.0, 1.0)


def _spread(values: Tensor) -> Tensor:
    return _highest(values, _RINGING_REACH)


def _lift_lamps(
    light: Tensor,
    nearness: Tensor,
    repaired: Tensor,
    step: Tensor,
    is_soft: Tensor,
    sigma: Tensor,
    lost_px: Tensor,
    ops: Ops,
) -> Tensor:
    """Raises the nearness of lamps of a few pixels, which a soft map averages with their surroundings.

    The fit ``nearness = a + b blurred(cover)`` gives the lamp ``a + b``; its cover is its light over its brightest.
    """
    brightest = light.amax(1, keepdim=True)
    usual = _mean(brightest.sqrt(), _REACH + 2) ** 2
    span = _highest(nearness, _REACH) + _highest(-nearness, _REACH)
    around = _highest(brightest, 2)
    is_lamp = (brightest > 4.0 * usual) & (brightest > 0.1 * around) & (span > 0.5 * step) & is_soft
    cover = torch.where(brightest > 2.0 * usual, brightest / around.clamp_min(1e-30), 0.0)
    lamp_pixels = pixels.indices(is_lamp)
    behind, difference, fit = _regress(nearness, cover, _blurred(cover, sigma), lamp_pixels, ops)
    # all pixels of a lamp lie on one surface: average their fits
    weight = fit * pixels.pick(cover, lamp_pixels)[0]
    window, none = pixels.around(lamp_pixels, nearness, 2), torch.zeros_like(nearness)
    values = (weight, weight * (behind + difference.clamp_min(0.0)), weight * fit)
    total, level, fit = (pixels.pick(pixels.put(none, lamp_pixels, v), window)[0].sum(0) for v in values)
    level, fit = (values / total.clamp_min(1e-9) for values in (level, fit))
    # a map whose near surfaces are not too thin has lost no lamps: 0 where they are 1 px too wide
    is_lost = (2.4 + 2.5 * lost_px).clamp(0.0, 1.0).flatten()
    fit = fit * is_lost[lamp_pixels // nearness[0].numel()]
    own = pixels.pick(repaired, lamp_pixels)[0]
    return pixels.put(repaired, lamp_pixels, own + fit * (level - own).clamp_min(0.0))


def _regress(
    nearness: Tensor, shape: Tensor, blurred: Tensor, chosen: Tensor, ops: Ops
) -> tuple[Tensor, Tensor, Tensor]:
    """Fits ``nearness = a + b blurred`` in windows around pixels ``[P]``: a, b and the quality of the fit, 0 to 1.

    The quality is 0 where the sharp ``shape`` explains as much of the variance: there the map is not blurred.
    """
    offsets = torch.arange(-_REACH, _REACH + 1, device=nearness.device, dtype=nearness.dtype)
    weight = torch.exp(-(offsets[:, None].square() + offsets.square()) / 18.0).flatten()[:, None]
    weight = weight / weight.sum()

    def look(part: Tensor) -> Tensor:
        window = pixels.around(part, nearness, _REACH)
        y = pixels.pick(nearness, window)[0]
        mean_y = (weight * y).sum(0)
        yy = (weight * (y - mean_y).square()).sum(0)
        results = []
        for cover in (blurred, shape):
            x = pixels.pick(cover, window)[0]
            mean_x = (weight * x).sum(0)
            xx = (weight * (x - mean_x).square()).sum(0)
            xy = (weight * (x - mean_x) * (y - mean_y)).sum(0).clamp_min(0.0)
            results.append((xx, xy / xx.clamp_min(1e-9), mean_x, xy.square() / (xx * yy).clamp_min(1e-12)))
        (xx, b, mean_x, explained), (*_, unblurred) = results
        better = ((explained - unblurred) / (_BETTER * (1.0 - unblurred)).clamp_min(1e-6)).clamp(0.0, 1.0)
        fit = torch.where(xx > 0.004, ((explained - 0.5) / 0.3).clamp(0.0, 1.0) * better, 0.0)
        return torch.stack([mean_y - b * mean_x, b, fit])

    a, b, fit = ops.by_parts(look, chosen).unbind(0)
    return a, b, fit


def _slopes(nearness: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Slope and jump of each pixel, ``[B, 1, H, W]`` each; the maximum over both axes.

    The slope is the smaller of the changes on both sides if these have one sign, else 0. The jump is the larger change
    minus the slope. Changes from or to an invalid pixel are 0.
    """
    least, jump = [], []
    for dim in (-1, -2):
        change = _changes(nearness, valid, dim)
        none = torch.zeros_like(nearness.narrow(dim, 0, 1))
        before, after = torch.cat([none, change], dim), torch.cat([change, none], dim)
        has_one_sign = before * after > 0
        least.append(torch.where(has_one_sign, torch.minimum(before.abs(), after.abs()), 0.0))
        jump.append(torch.maximum(before.abs(), after.abs()) - least[-1])
    return torch.maximum(*least), torch.maximum(*jump)


def _changes(nearness: Tensor, valid: Tensor, dim: int) -> Tensor:
    """Difference from each pixel to the next along ``dim``; 0 if one of them is invalid."""
    known = valid.narrow(dim, 1, valid.shape[dim] - 1) & valid.narrow(dim, 0, valid.shape[dim] - 1)
    return torch.where(known, nearness.diff(dim=dim), 0.0)


def _highest(values: Tensor, reach: int) -> Tensor:
    side = 2 * reach + 1
    if reach == 1:
        return functional.max_pool2d(values, side, stride=1, padding=reach)
    rows = functional.max_pool2d(values, (1, side), stride=1, padding=(0, reach))
    return functional.max_pool2d(rows, (side, 1), stride=1, padding=(reach, 0))


def _mean(values: Tensor, reach: int) -> Tensor:
    side = 2 * reach + 1
    rows = functional.avg_pool2d(functional.pad(values, (reach,) * 4, mode="replicate"), (1, side), stride=1)
    return functional.avg_pool2d(rows, (side, 1), stride=1)


def _blurred(values: Tensor, sigma: Tensor) -> Tensor:
    """Blurs each item ``[B, 1, H, W]`` with a Gaussian of its own sigma ``[B, 1, 1, 1]`` in pixels."""
    offsets = torch.arange(_BLUR_REACH + 1, device=values.device, dtype=values.dtype)
    half = torch.exp(-offsets.square() / (2.0 * sigma.square()))  # [B, 1, 1, k], k = 0 is the centre
    half = half / (2.0 * half.sum(-1, keepdim=True) - 1.0)
    for dim in (-1, -2):
        across = _BLUR_REACH if dim == -1 else 0
        ends = (across, across, _BLUR_REACH - across, _BLUR_REACH - across)
        size, padded = values.shape[dim], functional.pad(values, ends, mode="replicate")
        values = half[..., :1] * values
        for k in range(1, _BLUR_REACH + 1):  # runtimes of graphs cannot convolve with a computed kernel
            both = padded.narrow(dim, _BLUR_REACH - k, size) + padded.narrow(dim, _BLUR_REACH + k, size)
            values = values + half[..., k : k + 1] * both
    return values
