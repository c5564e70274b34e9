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

import math
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import native, pixels, validation
from ...optics.kernel_cache import kept
from ...options import DepthEdges
from ...tensors import is_differentiated, is_empty, is_in_memory, is_traced
from ...validation import ends
from ..engines.ops import EAGER, Ops
from ..engines.traced import is_compiled, one_operator
from ..layers.convolution import widest_float
from ..rules import active
from .coverage import is_near_edge
from .doubt import LARGEST, NEVER, blurred_in_doubt, doubt_of
from .missed import completed
from .windows import highest, mean_around

__all__ = ["STEP_PX", "judged", "mended", "repair", "repair_edges"]

STEP_PX = 1.0
"""Smallest difference in coc, in pixels, between two surfaces whose edge is repaired."""

# Edges: which pixels are compared. Steps, slopes and means of a map with the levels of a file are simple fractions of
# each other. Rounding would decide where they meet such a limit, so these limits are none: 0.3037 instead of 0.3.
_LEAST_STEP_PX = 0.5 * STEP_PX  # smallest range of coc in a map that is repaired; half a step, as for lamps
_STEP = 0.1  # step of :func:`repair_edges`, as a fraction of the largest nearness around; larger: fewer edges
_RINGS = 3  # px on each side of a step that are checked; larger: corrects wider displacements
_ABRUPT = 0.3037  # smallest jump between neighbours at a step, as a fraction of the step; larger: fewer steps
_FLAT_REACH = 8  # px within which a ramp becomes flat; larger: more slopes count as ramps
_RAMP_REACH = 6  # px; half the width of the widest ramp, anything wider is a slope
_SHALLOW = 0.0303  # smallest slope of a ramp per pixel, as a fraction of the range of nearness around
_FLAT = 0.3037  # slope of the flattest place around a ramp, over the ramp's; larger: more slopes count as ramps
_NEAREST = 0.6037  # a step nearer to the pixel counts from this part of the largest one around; larger: fewer rings
_TIE = 0.0171  # steps by which one axis must lead to give an edge its direction; larger: more diagonal ones

# Noise of a map, below which a step is not an edge
_NOISE_OF_BEND = 0.6053  # 1.4826 / sqrt(6): deviation of Gaussian noise over the median of |second difference|
_NOISE_OF_ROUNDING = 0.2887  # 1 / sqrt(12): deviation of rounding over the distance of two levels
_NOISES = 12.0  # smallest step, in standard deviations of the noise; larger: fewer edges in noisy maps
_LEVELS_OF_A_FILE = 64  # fewest levels of a map with the noise of rounding; larger: more edges in coarse maps
_NOISE_SAMPLED = 2**13  # pixels per frame that are sampled, half along rows and half along columns

# Colour: which of two surfaces a pixel resembles
_REACH = 5  # px; half the width of the window of samples around a pixel
_SAMPLED_GAP = 0.2537  # a sample shows a surface up to this part of the step from it; larger: more samples
_FALLOFF_PX = 2.5  # standard deviation of the Gaussian weights of these samples
_SURE = (0.0, 0.02, 0.06, 0.2, 1.0)  # weight of a sample, by ring: beside a step its depth may be wrong
_CLEAR = 0.1  # sum of these weights from which samples beside a step count in full; larger: thin strands stay
_CLEAR_IN_PRIOR = 0.25  # the same where the share of wrong pixels is estimated; larger: soft pictures stay
_LIKELY = 0.01  # likelihood from which a ramp's pixel shows one of both surfaces; larger: more pixels stay between them
_COLOUR_NOISE = 2.25e-4  # (1.5 %)^2: variance of a colour, over its square, that a surface has at least
_MIXTURE = 0.05  # likelihood of a mixed colour on a more blurred near surface; larger: fewer outlines, less detail
_SPREAD = 0.3  # variance, over that of both surfaces, by which a sample resembles a pixel; larger: more do
_SIMILAR = 0.0225  # (15 %)^2: squared difference, over the square, at which a neighbour counts by half
_SHARPNESS = 1.6  # factor on scores, which samples on the wrong side reduce; larger: colour outweighs the map
_SOFT_SHARPNESS = 0.7  # the same in soft maps, where samples near the edge are rarely wrong

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
_CLEAR_LEVEL = 0.3  # distance from the middle of a ramp, in steps, from which its pixels are clear
_RELATED = 0.8  # smallest agreement of colours with the clear pixels of one side of edges at which colours are used
_EXACT = 0.025  # largest share of wrong pixels at which the steps of a map count as exact
_DOUBTFUL = 0.05  # share of wrong pixels of a kind above which these pixels are decided again
_LEAN = 2.0  # log-odds by which a far surface must win: foreground left behind is the more visible error
_TO_BLURRED = 4.5  # log-odds for a soft map's near surface that is more blurred; larger: fewer specks, less detail
_MORE_BLURRED_PX = 2.0  # difference in blur of two surfaces from which these log-odds count in full
_BESIDE, _DIAGONAL = 1.3, 0.8  # log-odds of a neighbour's surface in soft maps; larger: smoother edges, less detail
_DECIDED_ROUNDS = 4  # times that neighbours decide again; more: smoother edges

# Soft maps: blurred by resampling, or written by a network. More than _SOFT of the edge pixels of a soft map lie on
# ramps. These are wider than _WIDE, or have more than _MIXED of their pixels in the middle half between both surfaces:
# compression makes narrow ramps too, whose pixels lie close to one of the surfaces.
_SOFT = 0.1  # share of edge pixels
_WIDE = 1.5  # px
_MIXED = 0.5  # share of a ramp's pixels

# Lamps and ringing of soft maps
_BLUR_REACH = 9  # px; half the width of the Gaussian kernel
_CLIMBED = 0.35  # standard deviation of a ramp, as a fraction of (pixels of its middle half) / (steps they climb)
_USUAL_REACH = _REACH + 2  # px; half the width of the window of the usual light around a lamp
_LAMP_REACH = 2  # px; half the width of the largest lamp
_PIXEL = 0.2  # px^2; variance that the area of a pixel adds to a ramp
_LEAST_BLUR_PX, _MOST_BLUR_PX = 0.2, 3.0  # range of the standard deviation
_EXPLAINED, _EXPLAINED_MORE = 0.5, 0.3  # fraction of the variance from which a fit counts; the part above, for full
_BETTER = 0.5  # fraction of the variance unexplained by a sharp shape that its blur must explain for full confidence
_RINGING_REACH = 3  # px; half the largest width of a rim of ringing; larger: wider details are flattened
_OVERSHOOT = 0.12  # largest height of a rim that is removed in full, in steps; at twice this height it stays

# With a matte
_MATTE_REACH = 30  # px; distance from its edge up to which foregrounds neither grow nor blur their surroundings

# Numbers
_BRIGHTEST = 1e30  # upper limit for light; products of a few such values overflow float32


class _Edges(NamedTuple):
    """Edges of a map of nearness; all ``[B, 1, H, W]``."""

    near: Tensor  # nearness of the nearer of the two surfaces around the pixel
    far: Tensor  # nearness of the farther one
    is_ramp: Tensor  # the pixel lies on a ramp between the two
    ring: Tensor  # distance to a step in pixels, from 1; ``_RINGS + 1`` if no step is within ``_RINGS``
    is_edge: Tensor
    direction: Tensor  # towards the near surface: 0 up, 1 left, 2 diagonal, 3 right, 4 down
    level: Tensor  # place of the pixel between the two surfaces, 0 (far) to 1 (near)
    climb: Tensor  # steepness in steps per pixel, 0 away from edges; the sum is the length of all edges in pixels


def repair_edges(image: Tensor, depth: Tensor, edges: DepthEdges = "repair") -> Tensor:
    """Moves and sharpens the edges of a depth map to where the image has them.

    Ramps become steps between their two surfaces. Pixels that show one surface and have the depth of the other are
    corrected. Slopes stay slopes, and a step between two surfaces of the same colour stays unchanged.

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
    high = highest(torch.where(depth > 0, nearness, 0.0).float(), _REACH)
    repaired, _ = repair(image, nearness, _STEP * high, edges == "auto")
    changed = (repaired != nearness) & (depth > 0)
    return torch.where(changed, 1.0 / repaired.clamp_min(0.0), depth)


def mended(image: Tensor, coc_px: Tensor, edges: DepthEdges, ops: Ops = EAGER, matte: Tensor | None = None) -> Tensor:
    """Repairs the edges of a map of the coc: the first step of the pipeline.

    Pixels at edges get the surface that they show, blurred foregrounds get what the map misses of them, and edges that
    are still in doubt are blurred. Near edges of a matte only the first step is done: a matte states coverage.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B or 1, 1, H, W]``, signed.
        edges: As for :func:`repair_edges`.
        ops: Skips frames without edges, and processes lists of pixels in parts.
        matte: Coverage by the subject ``[B or 1, 1, H, W]``, in [0, 1].

    Returns:
        The map, ``[B, 1, H, W]`` if it is repaired. Gradients flow to unchanged pixels.
    """
    if edges == "as given" or not active().edges:
        return coc_px
    if not is_traced():
        low, high = ends(coc_px)
        if high - low < _LEAST_STEP_PX:
            return coc_px
    given = coc_px.detach()
    repaired, contradicted = repair(image, given, STEP_PX, auto=edges == "auto", of_coc=True, ops=ops)
    if repaired is given:
        return coc_px
    grown, missed = completed(image, repaired, given, ops)
    blurred = blurred_in_doubt(given, grown, torch.maximum(contradicted, missed), ops)
    if matte is None:
        repaired = blurred
    else:
        repaired = torch.where(is_near_edge(matte.detach(), _MATTE_REACH), repaired, blurred)
    repaired = ops.equal_unless(lambda: _has_steps(coc_px), repaired, coc_px)
    return torch.where(repaired == coc_px, coc_px, repaired) if is_differentiated(coc_px) else repaired


def _has_steps(coc_px: Tensor) -> Tensor:
    """Whether the range of a map reaches :data:`_LEAST_STEP_PX` or contains NaN: a bool ``[]``."""
    low, high = torch.aminmax(coc_px)
    return ~(high - low < _LEAST_STEP_PX)


def repair(
    image: Tensor, nearness: Tensor, step: Tensor | float, auto: bool, of_coc: bool = False, ops: Ops = EAGER
) -> tuple[Tensor, Tensor]:
    """Repairs a map of nearness, of any scale and offset.

    Values that are not finite, or above 1e15 in magnitude, stay unchanged and affect no other pixel.

    Args:
        image: ``[B, C, H, W]``, linear light.
        nearness: ``[B or 1, 1, H, W]``, linear in 1 / depth, larger is nearer; constant to autograd.
        step: Smallest difference in nearness between two surfaces, ``[B, 1, H, W]`` or a number.
        auto: Whether exact edges stay unchanged.
        of_coc: Whether ``nearness`` is a map of the coc instead, in which a larger value is farther. With
            ``auto``, undecided pixels of a soft map then go to a near surface that is more blurred.
        ops: Processes lists of pixels in parts.

    Returns:
        ``[B, 1, H, W]``, constant to autograd; unchanged pixels keep their values to the bit. ``nearness`` itself if
        the compiled engine leaves all of it unchanged. And how much the map is in doubt, 0 to 1, ``[B, 1, 1, 1]``.
    """
    device = image.device.type
    if torch.is_autocast_enabled(device):  # which would compute in half precision
        with torch.autocast(device, enabled=False):
            return repair(image, nearness, step, auto, of_coc, ops)
    image = image.detach()
    compiled = not is_traced() and all(map(is_in_memory, (image, nearness))) and native.chosen()
    light, given = image.float(), nearness.float().expand(image.shape[0], -1, -1, -1)
    step = torch.as_tensor(step, dtype=given.dtype, device=given.device)
    if is_compiled():
        repaired, doubt = _operator(light, given, step, auto, of_coc)
    elif compiled:
        steps = step.expand(light.shape[0], 1, *given.shape[-2:]) if step.ndim else step.expand(light.shape[0], 1)
        maps = [of_item[0] for of_item in given]
        of_items = [native.repair_edges(a, b, c[0], auto, of_coc) for a, b, c in zip(light, maps, steps, strict=True)]
        items, doubts = zip(*of_items, strict=True)
        doubt = given.new_tensor(doubts).view(-1, 1, 1, 1)
        if all(new is old for new, old in zip(items, maps, strict=True)):
            return nearness, doubt
        repaired = (items[0][None] if len(items) == 1 else torch.stack(items))[:, None]
    else:
        repaired, doubt = _repair(light, given, step, auto, of_coc, ops)
    if nearness.dtype == torch.float32:
        return repaired, doubt
    return torch.where(repaired == given, nearness, repaired.to(nearness.dtype)), doubt


@torch.no_grad()
def judged(image: Tensor, coc_px: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Finds the pixels at the edges of a map of the coc, and what :func:`mended` makes of them with "auto".

    Args:
        image: As for :func:`mended`.
        coc_px: As for :func:`mended`.

    Returns:
        Whether a pixel is at an edge, whether it is on a ramp there, and the repaired map, ``[B, 1, H, W]`` each.
    """
    nearness = -coc_px.float().expand(image.shape[0], -1, -1, -1)
    valid = nearness.abs() <= LARGEST
    step = (_NOISES * _noise(nearness, valid)).clamp_min(STEP_PX)
    edges = _find(torch.where(valid, nearness, 0.0), valid, step)
    return edges.is_edge, edges.is_edge & edges.is_ramp, mended(image, coc_px, "auto")


@torch.no_grad()
def _repair(
    image: Tensor, nearness: Tensor, step: Tensor, auto: bool, of_coc: bool = False, ops: Ops = EAGER
) -> tuple[Tensor, Tensor]:
    """Plain PyTorch version of :func:`repair`.

    1. Find ramps and steps, and the nearness of both surfaces there.
    2. Detect soft maps from sampled edge pixels, score these by colour, and fit the prior of each kind of edge pixel.
    3. Select the pixels to decide: all edge pixels; with ``auto``, those of kinds that are often wrong.
    4. A selected pixel shows the near surface where ``score + logit(prior) > 0``. In soft maps the sum also has a term
       for a more blurred near surface, for a map of the coc, and the chances of its neighbours to show it, which
       depend on theirs in turn: a mean field of a few rounds, so that edges are smooth lines without single pixels
       beside them.
    5. Give selected pixels the nearness of their surface, on ramps in proportion to the evidence.
    6. In soft maps, remove the ringing of interpolation beside steps, and correct lamps of a few pixels.
    """
    rules = active()
    if of_coc:
        nearness = -nearness
    valid = nearness.abs() <= LARGEST
    given = torch.where(valid, nearness, 0.0)
    step = torch.maximum(step, _NOISES * _noise(given, valid))
    light = torch.where(torch.isfinite(image), image, 0.0).clamp(0.0, _BRIGHTEST)
    edges = _find(given, valid, step)
    is_near = 2.0 * given > edges.near + edges.far
    witness = given.new_tensor(_SURE)[edges.ring] * (valid & ~edges.is_ramp)

    maps = [light.sqrt(), given, witness, edges.near, edges.far, edges.is_ramp.to(given.dtype)]
    looks = pixels.rows(torch.cat(maps, 1))  # what _judge looks at

    # a sample of the edge pixels
    batch, _, height, width = given.shape
    area = torch.scalar_tensor(height * width, dtype=torch.float64, device="cpu")  # not a constant in graphs
    every = (area / _SAMPLED).sqrt().ceil().long()
    rows, columns = (_from_border(n, given.device) // _BLOCK for n in (height, width))
    sampled = pixels.indices(edges.is_edge & ((rows[:, None] + columns) % every == 0))

    def sums(*parts: Tensor) -> tuple[Tensor, ...]:  # over the samples of each item
        items = given.new_zeros(len(parts), batch, dtype=widest_float(given.device))
        found = items.index_add(1, sampled // (height * width), torch.stack(parts).to(items.dtype))
        return found[..., None, None, None].unbind(0)

    # whether the map is soft
    is_mixed = edges.is_edge & ((edges.level - 0.5).abs() < 0.25)
    maps = [edges.level, edges.climb, edges.is_ramp, is_mixed, edges.ring]
    level, climb, is_ramp, mixed, ring = pixels.pick(torch.cat([t.to(given.dtype) for t in maps], 1), sampled)
    ramps, mixed, length, steps = sums(is_ramp, is_ramp * mixed, climb, 1.0 - is_ramp)
    is_soft = (ramps > _SOFT * (ramps + steps)) & ((ramps > _WIDE * length) | (mixed > _MIXED * ramps))
    sharpness = torch.where(is_soft, _SOFT_SHARPNESS, _SHARPNESS).flatten().to(given.dtype)

    kind = _kind(edges)
    score = _judge(looks, given, sampled, sharpness, _CLEAR_IN_PRIOR, False, ops)[0]
    weight = (0.5 * score.abs()).clamp(max=1.0)
    prior = _calibrate(pixels.pick(kind, sampled)[0], score, weight, batch)[kind]
    wrong = torch.where(is_near, 1.0 - prior, prior)

    # which surface the selected pixels show
    doubtful = edges.is_edge
    if auto:
        # colour agrees with the map at clear pixels: in the outermost ring of a step, or near a ramp's ends; on one
        # side of the edges only where the map's foreground is too thin, and at half of them where it has no relation
        weight = weight * torch.where(is_ramp > 0, (level - 0.5).abs() > _CLEAR_LEVEL, ring == _RINGS)
        is_clear = weight * torch.stack([level > 0.5, level <= 0.5])  # of the near and of the far surface
        agrees = is_clear * ((score > 0) == (level > 0.5))
        doubts, *sides = sums((1.0 - is_ramp) * pixels.pick(wrong, sampled)[0], *is_clear, *agrees)
        clear, agreed = torch.stack(sides).chunk(2)
        is_related = (agreed + 0.25 * _PRIOR_COUNT > _RELATED * (clear + 0.5 * _PRIOR_COUNT)).any(0)
        is_soft = is_soft & is_related
        is_inexact = is_related & (is_soft | (doubts > _EXACT * steps))
        doubtful = doubtful & is_inexact & torch.where(edges.is_ramp, is_soft, wrong > _DOUBTFUL)
    edge_pixels = pixels.indices(doubtful)
    if auto and is_empty(edge_pixels):  # nor lamps: a soft map has ramps, which are selected
        return -nearness if of_coc else nearness, given.new_zeros(batch, 1, 1, 1)
    score, evidence, near, far = _judge(looks, given, edge_pixels, sharpness, _CLEAR, of_coc, ops)
    shows_near = score + torch.logit(pixels.pick(prior, edge_pixels)[0])
    if auto:  # without auto, correct steps are decided too, and the lead would move them
        shows_near = shows_near + (_LEAN if rules.far_lead else 0.0) * (score.abs() - 1.0).clamp(0.0, 1.0)
    of_soft = is_soft.flatten().index_select(0, edge_pixels // (height * width))
    if auto and of_coc and rules.more_blurred:
        more_blurred = _TO_BLURRED * _more_blurred(pixels.pick(looks[-3:-1], edge_pixels))
        shows_near = torch.where(of_soft, shows_near + more_blurred, shows_near)
    # pixels of a soft map that stick out of an edge are mostly background of a similar colour
    window = pixels.around(edge_pixels, given, 1)
    middle = pixels.pick(looks[-3:-1], edge_pixels).mean(0)  # of both surfaces
    by_map = (pixels.pick(given, window)[0] > middle).to(given.dtype)
    odds = shows_near
    for _ in range(_DECIDED_ROUNDS if rules.neighbours else 0):
        chance = pixels.put(torch.full_like(given, -1.0), edge_pixels, torch.sigmoid(odds))
        chance = pixels.pick(chance, window)[0]
        chance = torch.where(chance < 0, by_map, chance)
        odds = shows_near + (_neighbours(given.dtype, given.device) * (2.0 * chance - 1.0)).sum(0)
    shows_near = torch.where(of_soft, odds, shows_near) > 0

    # the blur of a soft map: its standard deviation in pixels, and the width that it takes from near surfaces
    climbed = (edges.climb * is_mixed).sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
    ramp_px = _CLIMBED * is_mixed.sum((1, 2, 3), keepdim=True) / climbed
    sigma = (ramp_px.square() - _PIXEL).clamp_min(0.0).sqrt().clamp(_LEAST_BLUR_PX, _MOST_BLUR_PX)

    label = pixels.put(is_near.to(given.dtype), edge_pixels, shows_near.to(given.dtype))
    length = edges.climb.sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
    lost_px = torch.where(edges.is_edge, label - edges.level, 0.0).sum((1, 2, 3), keepdim=True) / length

    own = pixels.pick(given, edge_pixels)[0]
    is_ramp = pixels.pick(edges.is_ramp, edge_pixels)[0]
    if not rules.third_surfaces:
        evidence = torch.ones_like(evidence)
    doubt = given.new_zeros(batch, 1, 1, 1)
    if auto and rules.in_doubt:
        doubt = torch.where(is_soft, doubt_of(clear, agreed).to(given.dtype), doubt)
    evidence = torch.maximum(evidence, doubt.flatten().index_select(0, edge_pixels // (height * width)))
    moved = torch.where(is_ramp, evidence, (shows_near != pixels.pick(is_near, edge_pixels)[0]).to(given.dtype))
    out = pixels.put(given, edge_pixels, torch.lerp(own, torch.where(shows_near, near, far), moved))
    if rules.ringing:
        out = torch.where(is_soft, _without_ringing(out, valid, step), out)
    if rules.soft_lamps:
        out = _lift_lamps(light, given, out, step, is_soft, sigma, lost_px, doubt, ops)
    out = torch.where(valid, out, nearness)
    return -out if of_coc else out, doubt


def _empty(image: Tensor, nearness: Tensor, step: Tensor, auto: bool, of_coc: bool) -> tuple[Tensor, Tensor]:
    out = torch.empty_like(nearness, memory_format=torch.contiguous_format)
    return out, nearness.new_empty(nearness.shape[0], 1, 1, 1)


# The number of pixels to process depends on the data, which compiled graphs do not support.
@one_operator("torchdof::repair_edges", _empty)
def _operator(image: Tensor, nearness: Tensor, step: Tensor, auto: bool, of_coc: bool) -> tuple[Tensor, Tensor]:
    repaired, doubt = _repair(image, nearness, step, auto, of_coc)
    return repaired.clone(), doubt


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
    rounding = (_NOISE_OF_ROUNDING if active().rounding else 0.0) * quantum
    noise = torch.where(span > _LEVELS_OF_A_FILE * quantum, rounding, 0.0)
    return torch.maximum(_NOISE_OF_BEND * bend, noise)[..., None, None]


def _find(nearness: Tensor, valid: Tensor, step: Tensor) -> _Edges:
    """Finds ramps and steps, and the nearness of the two surfaces that meet there."""
    ends = _ends(nearness, valid)
    slope, jump, steepness = _slopes(nearness, valid)
    span = highest(ends, _REACH).sum(1, keepdim=True)
    # a ramp is short and has flat places around it; a slope has none
    flattest = -highest(-mean_around(slope, 2), _FLAT_REACH)
    is_ramp = (slope > 0.1 * step) & (slope > _SHALLOW * span) & (span > step) & (flattest < _FLAT * slope) & valid

    # the surfaces at both ends of a ramp: extremes spread along it pixel by pixel
    spread = ends
    for _ in range(_RAMP_REACH):
        spread = torch.where(is_ramp, highest(spread, 1), spread)
    is_ramp = is_ramp & (spread.sum(1, keepdim=True) > step)
    ends = torch.where(is_ramp, spread, ends)

    # the surfaces on both sides of a step: extremes within k pixels; the smallest k that reaches the step counts
    rings = [torch.cat([ends, jump], 1)]
    for _ in range(_RINGS):
        rings.append(highest(rings[-1], 1))
    least = torch.maximum(_NEAREST * rings[-1][:, :2].sum(1, keepdim=True), step)
    ring, sides = torch.full_like(nearness, _RINGS + 1, dtype=torch.long), rings[-1][:, :2]
    for k in range(_RINGS, 0, -1):
        of_ring, largest_jump = rings[k].split([2, 1], 1)
        gap = of_ring.sum(1, keepdim=True)
        is_step = (gap > least) & (largest_jump > _ABRUPT * gap)
        ring, sides = torch.where(is_step, k, ring), torch.where(is_step, of_ring, sides)
    near, far = torch.where(is_ramp, ends, sides).split(1, 1)
    far = -far
    gap = near - far
    is_edge = (is_ramp | (ring <= _RINGS)) & (gap > step) & valid

    mean = mean_around(functional.pad(nearness, (2,) * 4, mode="replicate"), 2)
    right, down = mean[..., 2:-2, 4:] - mean[..., 2:-2, :-4], mean[..., 4:, 2:-2] - mean[..., :-4, 2:-2]
    lead, tie = right.abs() - down.abs(), _TIE * gap
    across = torch.where(lead > tie, right.sign(), 0.0)
    along = torch.where(-lead > tie, down.sign(), 0.0)
    direction = (2.0 * along + across).long() * active().directions + _DIRECTIONS // 2
    gap = gap.clamp_min(1e-12)
    level, climb = ((nearness - far) / gap).clamp(0.0, 1.0), torch.where(is_edge, steepness / gap, 0.0)
    return _Edges(near, far, is_ramp, ring, is_edge, direction, level, climb)


def _ends(nearness: Tensor, valid: Tensor) -> Tensor:
    """A map and its negative, ``[B, 2, H, W]``, so that maxima of both are the ends of its range."""
    return torch.where(valid, torch.cat([nearness, -nearness], 1), -NEVER)


def _kind(edges: _Edges) -> Tensor:
    """Index of the kind of each pixel ``[B, 1, H, W]``; pixels of one kind have one prior.

    A kind is an item, a place and a direction. A place is a ring on one side of a step, or one level of a ramp.
    """
    level = edges.level
    side = (level > 0.5).long() * _RINGS + edges.ring.clamp(max=_RINGS) - 1
    place = torch.where(edges.is_ramp, 2 * _RINGS + (level * _LEVELS).long().clamp(0, _LEVELS - 1), side)
    item = torch.arange(level.shape[0], device=level.device).view(-1, 1, 1, 1)
    return (item * _PLACES + place) * _DIRECTIONS + edges.direction


def _judge(
    looks: Tensor, like: Tensor, edge_pixels: Tensor, sharpness: Tensor, clear: float, mixtures: bool, ops: Ops
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Scores by colour which of two surfaces pixels ``[P]`` show.

    1. Take samples of both surfaces from a window around each pixel, weighted by distance and by how sure they are.
    2. Compute mean and spread of both colours, and how well these separate the surfaces, in [0, 1].
    3. Compute the likelihood of each surface: the share of its samples that resemble the pixel. A surface of several
       colours has no useful mean. Beside a step, few samples prove little: in a photograph, whose edges are soft, a
       strand of a pixel has mostly the colour of its background.
    4. With ``mixtures``, which needs maps of the coc, add the likelihood of a mixture of both colours to a more blurred
       near surface. Such a pixel resembles neither surface; left in the sharper far one it would be a sharp outline.
    5. Average scores over neighbours of similar colour.

    ``looks`` are :func:`torchdof.pixels.rows` of the colour, the nearness, the weight of samples, the nearness of both
    surfaces, and whether the pixel is on a ramp; ``like`` is a map of the frame. ``sharpness`` is the factor on the
    scores of each item. ``clear`` is the sum of weights from which samples of a surface count in full.

    Returns:
        ``[P]`` each: the log-likelihood ratio, positive for the near surface; the evidence, 0 to 1, that the pixel
        shows one of both surfaces and not a third one between them, such as a lamp; and the nearness of the near and
        of the far surface, as means of the samples that resemble the pixel.
    """
    colour = looks[:-5]
    falloff = _gaussian(_REACH, _FALLOFF_PX, like.dtype, like.device)
    falloff = torch.where(falloff < 1.0, falloff, 0.0)  # a pixel is not its own sample

    def look(part: Tensor) -> Tensor:
        samples = pixels.pick(looks[:-3], pixels.around(part, like, _REACH))
        others, values, trusted = samples[:-2], samples[-2], samples[-1]  # [C, n, P], [n, P]
        own = pixels.pick(looks, part)
        ends, is_ramp = own[-3:-1], own[-1]  # near and far, [2, P]
        most_off = _SAMPLED_GAP * (ends[0] - ends[1]).clamp_min(1e-12)
        side = falloff * trusted * ((values - ends[:, None]).abs() < most_off)  # [2, n, P]

        # mean colours of both surfaces, and the variance around them
        seen = side.sum(1)
        least, total = seen.amin(0), seen + 1e-9
        known = least > 1e-3
        mean = (others[:, None] * side).sum(2) / total  # [C, 2, P]
        spread = ((others[:, None] - mean[:, :, None]).square() * side).sum((0, 2)) / total
        noise = _COLOUR_NOISE * mean.sum(1).square().sum(0)
        spread = 0.5 * spread.sum(0) + noise + 1e-12
        contrast = (mean[:, 0] - mean[:, 1]).square().sum(0)
        separation = (contrast / (contrast + 0.5 * spread) - 0.1).clamp_min(0.0) / 0.9
        separation = torch.where(known, separation, 1.0)  # no samples in the middle of a wide ramp: neighbours decide

        # likelihoods
        apart = (others - own[:-5, None]).square().sum(0)
        alike = (1.0 + apart / (_SPREAD * spread)).square().reciprocal()
        likelihood = (side * alike).sum(1) / total + 1e-9
        if mixtures and active().mixtures:
            off, along = own[:-5] - mean[:, 1], mean[:, 0] - mean[:, 1]
            share = ((off * along).sum(0) / contrast.clamp_min(1e-12)).clamp(0.0, 1.0)
            mixed = (1.0 + (off - share * along).square().sum(0) / spread).square().reciprocal()
            mixed = _MIXTURE * mixed * _more_blurred(ends)
            likelihood = torch.stack([likelihood[0] + mixed, likelihood[1]])
        score = torch.where(known, torch.log(likelihood[0] / likelihood[1]), 0.0).clamp(-8.0, 8.0)
        if active().few_samples:
            score = torch.where(is_ramp > 0, score, score * (least / clear).clamp(max=1.0))
        share = side * (alike + 1e-3)
        surfaces = torch.where(known, (share * values).sum(1) / share.sum(1).clamp_min(1e-12), ends)
        likeliest = torch.where(known, likelihood.amax(0), 1.0)
        return torch.cat([torch.stack([score, separation, likeliest]), surfaces])

    score, separation, likeliest, near, far = ops.by_parts(look, edge_pixels).unbind(0)

    # neighbours of similar colour decide together
    scores = pixels.put(torch.full_like(like, torch.nan), edge_pixels, score)
    window = pixels.around(edge_pixels, like, 1)
    own, others = pixels.pick(colour, edge_pixels), pixels.pick(colour, window)
    scores = pixels.pick(scores, window)[0]
    alike = 1.0 / (1.0 + (others - own[:, None]).square().sum(0) / (_SIMILAR * own.square().sum(0) + 1e-12))
    if not active().like_scores:
        alike = (torch.arange(len(alike), device=alike.device) == len(alike) // 2).to(alike.dtype)[:, None]
    is_edge = ~scores.isnan()
    alike, scores = torch.where(is_edge, alike, 0.0), torch.where(is_edge, scores, 0.0)
    score = separation * (alike * scores).sum(0) / alike.sum(0).clamp_min(1e-12)
    score = (sharpness.index_select(0, edge_pixels // like[0].numel()) * score).clamp(-6.0, 6.0)
    evidence = torch.maximum(2.0 * separation * scores.abs().amax(0) - 1.0, likeliest / _LIKELY).clamp(0.0, 1.0)
    return score, evidence, near, far


def _more_blurred(surfaces: Tensor) -> Tensor:
    """How clearly the near one of two surfaces, of cocs ``[2, P]``, is the more blurred one, 0 to 1."""
    blur = surfaces.abs()
    return ((blur[0] - blur[1]) / _MORE_BLURRED_PX).clamp(0.0, 1.0)


def _calibrate(kinds: Tensor, score: Tensor, weight: Tensor, items: int) -> Tensor:
    """Share of pixels that show the near surface, for each kind: the prior, fitted to colour scores of samples ``[P]``.

    Expectation maximisation with an assumed share, which counts as :data:`_PRIOR_COUNT` pixels. The first fit joins all
    directions; its shares are the assumption of the second fit, one direction at a time.
    """
    device, dtype = score.device, score.dtype
    steps = torch.tensor([_TRUSTED] * _RINGS + [1.0 - _TRUSTED] * _RINGS, device=device, dtype=dtype)
    ramps = (torch.arange(_LEVELS, device=device, dtype=dtype) + 0.5) / _LEVELS
    assumed = torch.cat([steps, ramps]).repeat(items)
    odds = torch.exp(-score)

    def fit(groups: Tensor, start: Tensor, assumed: Tensor) -> Tensor:
        total = torch.full_like(assumed, _PRIOR_COUNT).index_add(0, groups, weight)
        prior, share = _PRIOR_COUNT * assumed / total, start
        # of a pixel that counts w of all, w sigmoid(score + logit(share)) = share / (share / w + (1 - share) odds / w)
        near = total[groups] / weight.clamp_min(1e-20)
        far = near * odds
        change = near - far
        for _ in range(_ROUNDS):
            own = share[groups]
            share = prior.index_add(0, groups, own / torch.addcmul(far, own, change)).clamp(0.005, 0.995)
        return share

    is_step = (torch.arange(_PLACES, device=device) < 2 * _RINGS).repeat(items)
    places = kinds // _DIRECTIONS
    together = fit(places, torch.where(is_step, 0.5, assumed), assumed).repeat_interleave(_DIRECTIONS)
    return fit(kinds, torch.full_like(together, 0.5), together)


def _without_ringing(nearness: Tensor, valid: Tensor, step: Tensor) -> Tensor:
    """Removes rims beside steps that are a little nearer, or farther, than the surface to which they belong.

    Maps enlarged by bicubic or Lanczos interpolation overshoot a step by up to a tenth of it on both sides. The rim of
    a surface near the focus would be blurred differently from the surface. Opening removes rims of at most twice
    :data:`_RINGING_REACH` pixels that are nearer, closing those that are farther. Pixels move into the range between
    the closed opening and the opened closing (the morphological centre), which leaves noise unchanged too.

    Reference:
        Serra, "Image Analysis and Mathematical Morphology, volume 2", 1988, chapter 8 (the centre).
    """
    ends = _spread(_ends(nearness, valid))
    opened_closing, closed_opening = _spread(-_spread(_spread(-ends))).split(1, 1)
    closed_opening = -closed_opening
    ends_of_both = torch.minimum(closed_opening, opened_closing), torch.maximum(closed_opening, opened_closing)
    moved = torch.minimum(torch.maximum(nearness, ends_of_both[0]), ends_of_both[1]) - nearness
    span = ends.sum(1, keepdim=True)
    return nearness + moved * torch.where(span > step, 2.0 - moved.abs() / (_OVERSHOOT * span), 0.0).clamp(0.0, 1.0)


def _spread(values: Tensor) -> Tensor:
    return highest(values, _RINGING_REACH)


def _lift_lamps(
    light: Tensor,
    nearness: Tensor,
    repaired: Tensor,
    step: Tensor,
    is_soft: Tensor,
    sigma: Tensor,
    lost_px: Tensor,
    doubt: Tensor,
    ops: Ops,
) -> Tensor:
    """Raises the nearness of lamps of a few pixels, which a soft map averages with their surroundings.

    A map in doubt stays: what looks like a lamp may be a bright spot of its surroundings, which would become sharp.

    The fit ``nearness = a + b blurred(cover)`` gives the lamp ``a + b``; its cover is its light over its brightest.
    """
    brightest = light.amax(1, keepdim=True)
    usual = mean_around(brightest.sqrt(), _USUAL_REACH) ** 2
    span = highest(torch.cat([nearness, -nearness], 1), _REACH).sum(1, keepdim=True)
    around = highest(brightest, _LAMP_REACH)
    is_lamp = (brightest > 4.0 * usual) & (brightest > 0.1 * around) & (span > 0.5 * step) & is_soft
    cover = torch.where(brightest > 2.0 * usual, brightest / around.clamp_min(1e-30), 0.0)
    lamp_pixels = pixels.indices(is_lamp)
    behind, difference, fit = _regress(nearness, cover, _blurred(cover, sigma), lamp_pixels, ops)
    # all pixels of a lamp lie on one surface: average their fits
    weight = fit * pixels.pick(cover, lamp_pixels)[0]
    values = torch.stack([weight, weight * (behind + difference.clamp_min(0.0)), weight * fit])
    of_lamps = pixels.put(torch.zeros_like(nearness).repeat(1, 3, 1, 1), lamp_pixels, values)
    total, level, fit = pixels.pick(of_lamps, pixels.around(lamp_pixels, nearness, _LAMP_REACH)).sum(1).unbind(0)
    level, fit = (values / total.clamp_min(1e-9) for values in (level, fit))
    # a map whose near surfaces are not too thin has lost no lamps: 0 where they are 1 px too wide
    is_lost = ((2.4 + 2.5 * lost_px).clamp(0.0, 1.0) * (1.0 - doubt)).flatten()
    fit = fit * is_lost[lamp_pixels // nearness[0].numel()]
    own = pixels.pick(repaired, lamp_pixels)[0]
    return pixels.put(repaired, lamp_pixels, own + fit * (level - own).clamp_min(0.0))


def _regress(
    nearness: Tensor, shape: Tensor, blurred: Tensor, chosen: Tensor, ops: Ops
) -> tuple[Tensor, Tensor, Tensor]:
    """Fits ``nearness = a + b blurred`` in windows around pixels ``[P]``: a, b and the quality of the fit, 0 to 1.

    The quality is 0 where the sharp ``shape`` explains as much of the variance: there the map is not blurred.
    """
    weight = _gaussian(_REACH, 3.0, nearness.dtype, nearness.device)
    weight = weight / weight.sum()
    maps = pixels.rows(torch.cat([nearness, blurred, shape], 1))

    def look(part: Tensor) -> Tensor:
        samples = pixels.pick(maps, pixels.around(part, nearness, _REACH))  # [3, n, P]
        means = (weight * samples).sum(1)
        off = samples - means[:, None]
        yy, *xx = (weight * off.square()).sum(1).unbind(0)
        xy = (weight * off[0] * off[1:]).sum(1).clamp_min(0.0)
        explained, unblurred = (c.square() / (v * yy).clamp_min(1e-12) for c, v in zip(xy.unbind(0), xx, strict=True))
        better = ((explained - unblurred) / (_BETTER * (1.0 - unblurred)).clamp_min(1e-6)).clamp(0.0, 1.0)
        fit = torch.where(xx[0] > 0.004, ((explained - _EXPLAINED) / _EXPLAINED_MORE).clamp(0.0, 1.0) * better, 0.0)
        b = xy[0] / xx[0].clamp_min(1e-9)
        return torch.stack([means[0] - b * means[1], b, fit])

    a, b, fit = ops.by_parts(look, chosen).unbind(0)
    return a, b, fit


@kept
def _neighbours(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Log-odds ``[9, 1]`` that a pixel takes from its neighbours, in the order of :func:`torchdof.pixels.around`."""
    odds = [_DIAGONAL, _BESIDE, _DIAGONAL, _BESIDE, 0.0, _BESIDE, _DIAGONAL, _BESIDE, _DIAGONAL]
    return torch.tensor(odds, dtype=dtype, device=device)[:, None]


@kept
def _gaussian(reach: int, sigma: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Gaussian weights ``[(2 reach + 1)^2, 1]`` of a square, in the order of :func:`torchdof.pixels.around`."""
    steps = range(-reach, reach + 1)
    weights = [math.exp(-(dy * dy + dx * dx) / (2.0 * sigma**2)) for dy in steps for dx in steps]
    return torch.tensor(weights, dtype=dtype, device=device)[:, None]


def _slopes(nearness: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slope, jump and steepness of each pixel, ``[B, 1, H, W]`` each; slope and jump are the maximum over both axes.

    The slope is the smaller of the changes on both sides if these have one sign, else 0. The jump is the larger change
    minus the slope. The steepness is the mean length of the gradient. Changes from or to an invalid pixel are 0.
    """
    least, jump, sides = [], [], []
    for dim in (-1, -2):
        size = nearness.shape[dim]
        known = valid.narrow(dim, 1, size - 1) & valid.narrow(dim, 0, size - 1)
        change = torch.where(known, nearness.diff(dim=dim), 0.0)
        padded = functional.pad(change, (1, 1) if dim == -1 else (0, 0, 1, 1))
        before, after = padded.narrow(dim, 0, size), padded.narrow(dim, 1, size)
        has_one_sign = before * after > 0
        sides.append([before, after])
        before, after = before.abs(), after.abs()
        least.append(torch.where(has_one_sign, torch.minimum(before, after), 0.0))
        jump.append(torch.maximum(before, after) - least[-1])
    steepness = torch.stack([torch.hypot(a, b) for a in sides[0] for b in sides[1]]).mean(0)
    return torch.maximum(*least), torch.maximum(*jump), steepness


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
            values = torch.addcmul(values, half[..., k : k + 1], both)
    return values
