"""Edges of a depth map where the image has them.

Depth that is measured or estimated has its edges beside those of the image, or ramps where they should be steps. Both
draw outlines around everything that is blurred. Here each pixel near an edge is asked which of the two surfaces that
meet there it shows: by its colour, against the colours that surely belong to one of them; and by the map, trusted as
far as it has proved right in the rest of the frame. So the map's own habits (a foreground a pixel too thin, edges
displaced to the right, ramps four pixels wide) are learnt from the frame, and a map whose edges are exact proves so and
stays as it is.

Everything is computed in a measure of nearness that is linear in 1 / depth: there planes are straight, and what
resampling and estimators do to an edge is an average.
"""

import math
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import native, pixels, validation

__all__ = ["STEP_PX", "DepthEdges", "judged", "repair", "repair_edges"]

DepthEdges = Literal["auto", "repair", "as given"]
"""What is done to depth edges before rendering: repaired where the map proves inexact, or all of them, or nothing."""

STEP_PX = 1.0
"""Difference in the circle of confusion from which on the edge between two surfaces is worth repair."""

_STEP = 0.1  # part of its nearness by which a surface stands before another one, for :func:`repair_edges`
_RINGS = 3  # pixels beside a step that may be on its wrong side
_REACH = 5  # pixels around one that tell what the two surfaces look like
_FALLOFF_PX = 2.5
_ABRUPT = 0.3  # part of a step that lies between two neighbours
_SURE = (0.0, 0.02, 0.06, 0.2, 1.0)  # weight of a pixel as witness, by ring; beside an edge it may be wrong itself
_RAMP_REACH = 6  # half the width of the widest ramp that is one, not a slope
_SHALLOW = 0.03  # slope, of what lies between the surfaces around, from which on it belongs to a ramp
_LEVELS = 6  # places on a ramp that are calibrated apart
_PLACES = 2 * _RINGS + _LEVELS
_TRUSTED = 0.05  # share of wrong pixels that a map is assumed to have
_ROUNDS = 10
_SHARPNESS = 1.6  # how much surer colours are than their likelihoods say, which count witnesses on the wrong side
_UNSEEN = 0.05  # likelihood of a colour on a surface that is not in sight
_MOST = 4.0  # times its own step, a thin structure stands out at most
_BLUR_REACH = 9
_MIDDLE = (0.3, 0.2)  # part of a step by which a level lies off the middle, up to which it is in the middle half
_MIDDLE_HALF = 1.22  # standard deviations that the middle half of a ramp is taken to be wide
_WHOLE = 1.1  # times the blur of steps, shapes are blurred that are known to whole pixels only
_PIXELS = 0.25  # variance that differences between pixels add to a blur, in pixels squared
_BETTER = 0.5  # part of what a shape leaves unexplained that its blur explains, where it is blurred
_LEAN = 2.0  # by how much likelier the far surface must be, as a logarithm: foreground left behind is seen more
_PRIOR_COUNT = 30.0  # pixels for which the assumption that a map is exact stands
_FADE = 0.03  # of a logarithm of likelihoods: a pixel that is not surer of its surface lies between both
_SUREST = 13.0  # no pixel is surer than this
# what decides fades in between these
_EXACT = (0.02, 0.03)  # share of wrong pixels up to which a map's steps count as exact
_DOUBTFUL = (0.04, 0.06)  # share of wrong pixels of a kind up to which they are taken to be right
_SOFT = (0.1, 0.15)  # share of ramps among the pixels of edges up to which a map counts as sharp
_RELATED = (0.78, 0.82)  # share of clear cases in which colours must agree with a map to be heard on it
_CLEAR = (0.28, 0.32)  # part of a step by which a level lies off the middle, where a ramp is clear
_OF_SIDE = (0.3, 0.2)  # the same by which a witness of a surface is off it
_STANDS = (1.0, 1.2)  # times the least step
_ENDS = (0.3, 0.24)  # part of its own slope that a ramp has left where it ends
_KNOWN = (1e-3, 2e-3)  # weight of witnesses
_LAMP, _GLOW = (4.0, 5.0), (2.0, 2.5)  # times the usual brightness around
_SAMPLED = 2**17  # pixels of a frame among which a map is calibrated
_BLOCK = 32
_CHUNK = 40_000
_NEVER = 1e30
_LARGEST = 1e15  # nearness, and light, whose squares are numbers too: beyond it the one is none, the other no brighter
_BRIGHTEST = 1e30


class _Edges(NamedTuple):
    """What a map of nearness shows; all ``[B, 1, H, W]``."""

    near: Tensor  # of the two surfaces that meet around the pixel
    far: Tensor
    is_ramp: Tensor  # the map passes from one to the other here
    ring: Tensor  # how many pixels from a step: 1 is beside it; one more than there are: none is near
    is_edge: Tensor
    strength: Tensor  # how clearly it is one, 0 to 1
    towards: (
        Tensor  # where the near surface lies, ``[B, 5, H, W]``: left, right, up, down, or not to be told; sums to 1
    )


class _Habits(NamedTuple):
    """What a frame teaches of its map; ``[B, 1, 1, 1]`` each but the first."""

    shares: Tensor  # of pixels that show the near surface, ``[B * places, 5]``, by direction
    wrong: Tensor  # share of pixels beside steps that are on the wrong side
    ramps: Tensor  # share of ramps among the pixels of edges
    agreement: Tensor  # share of clear cases in which the image agrees with the map
    softness: Tensor  # how far ramps are to become steps, 0 to 1
    inexactness: Tensor  # how far pixels beside steps are asked, 0 to 1


def repair_edges(image: Tensor, depth: Tensor, edges: DepthEdges = "repair") -> Tensor:
    """Moves and sharpens the edges of a depth map to where the image has them.

    Ramps become steps between their two surfaces; pixels that show one surface and have the depth of the other get
    theirs; structures so thin that a ramp has swallowed part of their depth get it back. Slopes stay slopes, and where
    the image shows no difference between two surfaces the map is left as it is.

    Args:
        image: ``[B, C, H, W]``, linear light, floating point; its scale does not matter.
        depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres, > 0, ``inf`` allowed; NaN, zero and negative values stay.
        edges: "repair" asks each edge; "auto" leaves a map alone whose edges prove exact, bit for bit; "as given" does
            nothing.

    Returns:
        ``[B, 1, H, W]``, metres. Gradients flow to the depth where it is unchanged; what was repaired is constant.

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
    validation.depth_edges(edges)
    if edges == "as given":
        return depth
    depth = depth.expand(image.shape[0], -1, -1, -1)
    nearness = torch.where(depth > 0, 1.0 / depth.detach(), torch.nan)
    high = _highest(torch.where(depth > 0, nearness, 0.0).float(), _REACH)
    mended = repair(image, nearness, _STEP * high, edges == "auto")
    changed = (mended != nearness) & (depth > 0)
    return torch.where(changed, 1.0 / mended.clamp_min(0.0), depth)


def repair(image: Tensor, nearness: Tensor, step: Tensor | float, auto: bool) -> Tensor:
    """Repairs a map of nearness, of any scale and offset; what is not finite, or above 1e15, stays and touches nothing.

    Args:
        image: ``[B, C, H, W]``, linear light.
        nearness: ``[B or 1, 1, H, W]``, linear in 1 / depth, larger is nearer; the negative coc is one.
        step: Difference in nearness from which on neighbours are two surfaces, ``[B, 1, H, W]`` or a number.
        auto: Whether edges that prove exact are left alone.

    Returns:
        ``[B, 1, H, W]``, constant to autograd; where nothing is repaired, the given values themselves.
    """
    device = image.device.type
    if torch.is_autocast_enabled(device):  # it would convolve in half precision
        with torch.autocast(device, enabled=False):
            return repair(image, nearness, step, auto)
    light, given = image.detach().float(), nearness.detach().float().expand(len(image), -1, -1, -1)
    step = torch.as_tensor(step, dtype=given.dtype, device=given.device)
    if torch.compiler.is_compiling() and not torch.compiler.is_exporting():
        mended = _operator(light, given, step, auto)
    elif not validation.is_traced() and all(map(native.can_read, (image, nearness))) and native.chosen():
        steps = step.expand(len(light), 1, *given.shape[-2:]) if step.ndim else step.expand(len(light), 1)
        items = zip(light, given, steps, strict=True)
        mended = torch.stack([native.repair_edges(a, b[0], c[0], auto)[None] for a, b, c in items])
    else:
        mended = _repair(light, given, step, auto)
    if nearness.dtype == torch.float32:
        return mended
    return torch.where(mended == given, nearness.detach(), mended.to(nearness.dtype))


@torch.no_grad()
def judged(image: Tensor, nearness: Tensor, step: Tensor | float) -> tuple[Tensor, Tensor]:
    """The pixels at a map's edges, and those whose nearness :func:`repair` changes with ``auto``.

    Args:
        image: As there.
        nearness: As there.
        step: As there.

    Returns:
        ``[B, 1, H, W]``, uint8: 0 where there is no edge, 1 beside a step, 2 on a ramp; and bool.
    """
    given = nearness.float().expand(len(image), -1, -1, -1)
    valid = given.abs() <= _LARGEST
    edges = _find(torch.where(valid, given, 0.0), valid, torch.as_tensor(step, dtype=given.dtype, device=given.device))
    mended = repair(image, nearness, step, auto=True)
    return edges.is_edge * (1 + edges.is_ramp.byte()), (mended != nearness) & valid


@torch.no_grad()
def _repair(image: Tensor, nearness: Tensor, step: Tensor, auto: bool) -> Tensor:
    valid = nearness.abs() <= _LARGEST
    given = torch.where(valid, nearness, 0.0)
    light = torch.where(torch.isfinite(image), image, 0.0).clamp(0.0, _BRIGHTEST)
    edges = _find(given, valid, step)
    habits = _learn(light, given, valid, edges, auto)

    # which edges are asked, and how firmly
    edge_pixels = pixels.indices(edges.is_edge)
    level, is_ramp, strength = (
        pixels.pick(v, edge_pixels)[0] for v in (_level(given, edges), edges.is_ramp, edges.strength)
    )
    item, prior = edge_pixels // given[0].numel(), _prior(given, edges, habits, edge_pixels)
    if auto:
        wrong = torch.where(level > 0.5, 1.0 - prior, prior)
        doubt = habits.inexactness.flatten()[item] * _fade(wrong, _DOUBTFUL)
        strength = strength * torch.where(is_ramp, habits.softness.flatten()[item], doubt)
        asked = (strength > 0).nonzero()[:, 0]
        edge_pixels, level, is_ramp, strength, prior = (
            v[asked] for v in (edge_pixels, level, is_ramp, strength, prior)
        )

    # which surface they show
    firmness = pixels.put(torch.zeros_like(given), edge_pixels, strength)
    score, evidence, near, far = _judge(light, given, valid, edges, firmness, edge_pixels, one_counts=True)
    shows_near = score + torch.logit(prior)
    if auto:  # else steps that prove right are asked as well, and would be moved
        shows_near = shows_near + _LEAN * (score.abs() - 1.0).clamp(0.0, 1.0)
    is_near = level > 0.5
    stays = torch.where(is_ramp, 0.0, _SUREST * (1.0 - strength))
    shows_near = (0.5 + (shows_near + torch.where(is_near, stays, -stays)) / _FADE).clamp(0.0, 1.0)

    # and what is so thin that a ramp swallowed part of its depth
    sigma, length = _blur_of(given, valid, edges)
    label = torch.where(
        edges.is_edge, _level(given, edges) > 0.5, 2.0 * given > _highest(given, 6) - _highest(-given, 6)
    )
    label = pixels.put(label.to(given.dtype), edge_pixels, shows_near)
    lost_px = torch.where(edges.is_edge, label - _level(given, edges).clamp(0.0, 1.0), 0.0).sum((1, 2, 3), keepdim=True)
    lost_px = lost_px / length
    near, far = _unmix(given, edges, label, sigma, lost_px, edge_pixels, near, far)

    own = pixels.pick(given, edge_pixels)[0]
    shown = torch.where(is_ramp, torch.lerp(far, near, shows_near), torch.where(is_near, far, near))
    moved = torch.where(is_ramp, evidence * strength, torch.where(is_near, 1.0 - shows_near, shows_near))
    out = pixels.put(given, edge_pixels, torch.lerp(own, shown, moved))
    return torch.where(valid, _lift_lamps(light, given, out, step, habits.softness, sigma, lost_px), nearness)


# How many pixels need work depends on the data, which compiled graphs do not allow for: to them it is one operator.
@torch.library.custom_op("torchdof::repair_edges", mutates_args=())
def _operator(image: Tensor, nearness: Tensor, step: Tensor, auto: bool) -> Tensor:
    return _repair(image, nearness, step, auto).clone()


@_operator.register_fake
def _(image: Tensor, nearness: Tensor, step: Tensor, auto: bool) -> Tensor:
    return torch.empty_like(nearness, memory_format=torch.contiguous_format)


def _find(nearness: Tensor, valid: Tensor, step: Tensor) -> _Edges:
    """Ramps and steps, and the two surfaces that meet there."""
    high, low = torch.where(valid, nearness, -_NEVER), torch.where(valid, -nearness, -_NEVER)
    slope, jump = _slopes(nearness, valid)
    span = _highest(high, _REACH) + _highest(low, _REACH)
    # a ramp ends, a slope goes on
    flattest = -_highest(-_mean(slope, 2), 8)
    is_ramp = (slope > 0.1 * step) & (slope > _SHALLOW * span) & (span > step) & (flattest < 0.3 * slope) & valid

    # the surfaces at both ends of a ramp
    near, far = high, low
    for _ in range(_RAMP_REACH):
        near, far = (torch.where(is_ramp, _highest(end, 1), end) for end in (near, far))
    is_ramp = is_ramp & (near + far > step)
    near, far = torch.where(is_ramp, near, high), torch.where(is_ramp, far, low)

    # those at both sides of a step
    nears, fars = ([_highest(end, ring) for ring in range(1, _RINGS + 1)] for end in (near, far))
    least = torch.maximum(0.6 * (nears[-1] + fars[-1]), step)
    ring = torch.full_like(nearness, _RINGS + 1, dtype=torch.long)
    beside, behind = nears[-1], fars[-1]
    for k in reversed(range(_RINGS)):
        gap = nears[k] + fars[k]
        is_step = (gap > least) & (_highest(jump, k + 1) > _ABRUPT * gap)
        ring = torch.where(is_step, k + 1, ring)
        beside, behind = torch.where(is_step, nears[k], beside), torch.where(is_step, fars[k], behind)
    near, far = torch.where(is_ramp, near, beside), -torch.where(is_ramp, far, behind)
    is_edge = (is_ramp | (ring <= _RINGS)) & (near - far > step) & valid
    steepness = torch.minimum(slope / (0.1 * step), slope / (_SHALLOW * span).clamp_min(1e-12))
    ramp_strength = _fade(steepness, (1.0, 1.2)) * _fade(flattest / slope.clamp_min(1e-12), _ENDS)
    strength = _fade((near - far) / step, _STANDS) * torch.where(is_ramp, ramp_strength, 1.0) * is_edge

    mean = _mean(functional.pad(nearness, (2,) * 4, mode="replicate"), 2)
    right, down = mean[..., 2:-2, 4:] - mean[..., 2:-2, :-4], mean[..., 4:, 2:-2] - mean[..., :-4, 2:-2]
    parts = torch.cat([-right, right, -down, down], 1).clamp_min(0.0) ** 2
    none = (0.05 * (near - far)) ** 2
    towards = torch.cat([parts, none], 1) / (parts.sum(1, keepdim=True) + none).clamp_min(1e-30)
    return _Edges(near, far, is_ramp, ring, is_edge, strength, towards)


def _level(nearness: Tensor, edges: _Edges) -> Tensor:
    """Where between the far surface, 0, and the near one, 1, the map lies."""
    return (nearness - edges.far) / (edges.near - edges.far).clamp_min(1e-12)


def _fade(values: Tensor, bounds: tuple[float, float]) -> Tensor:
    """0 up to the first bound, 1 from the second on."""
    return ((values - bounds[0]) / (bounds[1] - bounds[0])).clamp(0.0, 1.0)


def _place(nearness: Tensor, edges: _Edges, edge_pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Which pixels ``[P]`` are calibrated together: those of one ring and side of a step, or of a level of a ramp.

    The number, of items and then of places, of the one before, and what part of the way to the next a pixel is.
    """
    level, ring, is_ramp = (
        pixels.pick(v, edge_pixels)[0] for v in (_level(nearness, edges), edges.ring, edges.is_ramp)
    )
    on_ramp = (level * _LEVELS - 0.5).clamp(0.0, _LEVELS - 1.0)
    below = on_ramp.long().clamp(max=_LEVELS - 2)
    place = torch.where(is_ramp, 2 * _RINGS + below, (level > 0.5).long() * _RINGS + ring.clamp(max=_RINGS) - 1)
    return edge_pixels // nearness[0].numel() * _PLACES + place, torch.where(is_ramp, on_ramp - below, 0.0)


def _prior(nearness: Tensor, edges: _Edges, habits: _Habits, edge_pixels: Tensor) -> Tensor:
    """Share of the pixels like each ``[P]`` that show the near surface."""
    place, between = _place(nearness, edges, edge_pixels)
    shares = torch.lerp(habits.shares[place], habits.shares[place + 1], between[:, None])
    return (pixels.pick(edges.towards, edge_pixels).T * shares).sum(1)


def _learn(light: Tensor, nearness: Tensor, valid: Tensor, edges: _Edges, auto: bool) -> _Habits:
    """How far the map can be trusted, at each kind of place on an edge: from part of the frame."""
    height, width = nearness.shape[-2:]
    every = -(-height * width // _SAMPLED)
    rows, columns = (torch.arange(n, device=nearness.device) // _BLOCK for n in (height, width))
    sampled = pixels.indices(edges.is_edge & ((rows[:, None] + 3 * columns) % every == 0))
    strength = pixels.pick(edges.strength, sampled)[0]
    score = _judge(light, nearness, valid, edges, edges.strength, sampled, one_counts=False)[0]
    shares = _calibrate(nearness, edges, sampled, score)
    habits = _Habits(shares, *[shares.new_zeros(len(nearness), 1, 1, 1)] * 5)

    item, level = sampled // nearness[0].numel(), pixels.pick(_level(nearness, edges), sampled)[0]
    is_ramp, ring = pixels.pick(edges.is_ramp, sampled)[0], pixels.pick(edges.ring, sampled)[0]

    def share(weight: Tensor, part: Tensor, count: float = 0.0, assumed: float = 0.0) -> Tensor:
        total, found = (score.new_zeros(len(nearness)).index_add(0, item, w) for w in (weight, weight * part))
        return ((found + count * assumed) / (total + count).clamp_min(1e-12)).view(-1, 1, 1, 1)

    prior = _prior(nearness, edges, habits, sampled)
    wrong = share(strength * ~is_ramp, torch.where(level > 0.5, 1.0 - prior, prior))
    ramps = share(strength, is_ramp.to(score.dtype))
    # as far from steps and as high on ramps as is looked at; an image that knows nothing of the depth agrees by half
    clear = torch.where(is_ramp, _fade((level - 0.5).abs(), _CLEAR), (ring == _RINGS).to(score.dtype))
    agreement = share(
        strength * clear * (0.5 * score.abs()).clamp(max=1.0),
        ((score > 0) == (level > 0.5)).to(score.dtype),
        _PRIOR_COUNT,
        0.5,
    )
    heard = _fade(agreement, _RELATED) if auto else 1.0
    softness = heard * _fade(ramps, _SOFT)
    return _Habits(shares, wrong, ramps, agreement, softness, heard * torch.maximum(_fade(wrong, _EXACT), softness))


def _judge(
    light: Tensor,
    nearness: Tensor,
    valid: Tensor,
    edges: _Edges,
    firmness: Tensor,
    edge_pixels: Tensor,
    one_counts: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Which of two surfaces pixels ``[P]`` show, by their colour; neighbours are heard as far as they are firm.

    Where only one of the surfaces is in sight, as in the middle of wide ramps, whether it is that one counts if asked.

    Returns:
        ``[P]`` each: the logarithm of how much likelier the near one is; how surely the colours of the two tell, 0 to
        1; and the nearness of the near and of the far surface there.
    """
    colour = light.sqrt()
    witness = nearness.new_tensor(_SURE)[edges.ring] * (valid & ~edges.is_ramp)
    offsets = torch.arange(-_REACH, _REACH + 1, device=light.device, dtype=light.dtype)
    apart = offsets[:, None] ** 2 + offsets**2  # a pixel is no witness of its own
    falloff = torch.where(apart > 0, torch.exp(-apart / (2 * _FALLOFF_PX**2)), 0.0).flatten()[:, None]
    parts = [edge_pixels] if validation.is_traced() else edge_pixels.split(_CHUNK)
    judged = []
    for part in parts:
        window = pixels.around(part, nearness, _REACH)
        near, far = pixels.pick(edges.near, part)[0], pixels.pick(edges.far, part)[0]
        values, own, others = pixels.pick(nearness, window)[0], pixels.pick(colour, part), pixels.pick(colour, window)
        level = (values - far) / (near - far).clamp_min(1e-12)
        weight = falloff * pixels.pick(witness, window)[0]
        sides = [weight * _fade((level - end).abs(), _OF_SIDE) for end in (1.0, 0.0)]

        # what the surfaces look like: mean colours, and how far colours stray from these
        sums = [side.sum(0) for side in sides]
        known = _fade(torch.minimum(*sums), _KNOWN)
        totals = [total + 1e-9 for total in sums]
        means = [(others * side).sum(1) / total for side, total in zip(sides, totals, strict=True)]
        spreads = [
            ((others - mean[:, None]) ** 2 * side).sum((0, 1)) / total
            for mean, side, total in zip(means, sides, totals, strict=True)
        ]
        noise = 2.25e-4 * (means[0] + means[1]).square().sum(0)
        spread = 0.5 * (spreads[0] + spreads[1]) + noise + 1e-30
        contrast = (means[0] - means[1]).square().sum(0)
        tells = (contrast / (contrast + 0.5 * spread) - 0.1).clamp_min(0.0) / 0.9
        tells = torch.lerp(torch.ones_like(tells), tells, known)  # in the middle of a wide ramp the neighbours do

        # likelihood: how many witnesses look alike, and a little how close their mean is
        alike = (1.0 + (others - own[:, None]).square().sum(0) / (0.3 * spread)).pow(-2)
        likelihoods = [
            (side * alike).sum(0) / total + 0.02 * (1.0 + (own - mean).square().sum(0) / (0.3 * spread)).pow(-2) + 1e-9
            for side, total, mean in zip(sides, totals, means, strict=True)
        ]
        score = known * torch.log(likelihoods[0] / likelihoods[1]).clamp(-8.0, 8.0)
        alone = (1.0 - known) * one_counts
        for sign, side, total, spread, mean in zip((1.0, -1.0), sides, totals, spreads, means, strict=True):
            spread = spread + 9e-4 * mean.square().sum(0) + 1e-30
            alike_one = (1.0 + (others - own[:, None]).square().sum(0) / (0.3 * spread)).pow(-2)
            vote = torch.log(((side * alike_one).sum(0) / total + 0.02) / _UNSEEN).clamp(-3.0, 3.0)
            score = score + sign * alone * _fade(total, _KNOWN) * vote
        surfaces = []
        for side, end in zip(sides, (near, far), strict=True):
            share = side * (alike + 1e-3)
            surface = (share * (values - end)).sum(0) / share.sum(0).clamp_min(1e-12)
            surfaces.append(end + known * surface)
        judged.append(torch.stack([score, tells, *surfaces]))
    score, tells, near, far = torch.cat(judged, 1) if judged else light.new_zeros(4, 0)

    # neighbours of like colour decide together
    scores = pixels.put(torch.full_like(nearness, torch.nan), edge_pixels, score)
    window = pixels.around(edge_pixels, nearness, 1)
    own, others, said = pixels.pick(colour, edge_pixels), pixels.pick(colour, window), pixels.pick(scores, window)[0]
    alike = 1.0 / (1.0 + (others - own[:, None]).square().sum(0) / (0.0225 * own.square().sum(0) + 1e-30))
    alike = torch.where(said.isnan(), 0.0, alike * pixels.pick(firmness, window)[0])
    said = torch.where(said.isnan(), 0.0, said)
    score = (_SHARPNESS * tells * (alike * said).sum(0) / alike.sum(0).clamp_min(1e-12)).clamp(-6.0, 6.0)
    evidence = (2.0 * tells * (pixels.pick(firmness, window)[0] * said.abs()).amax(0) - 1.0).clamp(0.0, 1.0)
    # from the ends of a wide ramp only one of the surfaces is in sight
    known = _highest(pixels.put(torch.zeros_like(nearness), edge_pixels, evidence), 3)
    evidence = pixels.pick(known, edge_pixels)[0]
    return score, evidence, near, far


def _calibrate(nearness: Tensor, edges: _Edges, sampled: Tensor, score: Tensor) -> Tensor:
    """Shares of pixels that show the near surface: those which explain the scores best, from a wary start."""
    device, dtype, items = score.device, score.dtype, len(nearness)
    steps = torch.tensor([_TRUSTED] * _RINGS + [1.0 - _TRUSTED] * _RINGS, device=device, dtype=dtype)
    ramps = (torch.arange(_LEVELS, device=device, dtype=dtype) + 0.5) / _LEVELS
    assumed = torch.cat([steps, ramps]).repeat(items)
    before, between = _place(nearness, edges, sampled)
    places = torch.cat([before, before + 1])
    weight = (0.5 * score.abs()).clamp(max=1.0) * pixels.pick(edges.strength, sampled)[0]
    weights = torch.cat([weight * (1.0 - between), weight * between])
    towards = pixels.pick(edges.towards[:, :4], sampled).repeat(1, 2)  # [4, 2 P]
    scores = score.repeat(2)

    def fit(groups: Tensor, scores: Tensor, weights: Tensor, start: Tensor, assumed: Tensor) -> Tensor:
        share, total = start, torch.zeros_like(start).index_add(0, groups, weights)
        for _ in range(_ROUNDS):
            near = torch.sigmoid(scores + torch.logit(share)[groups])
            found = torch.zeros_like(start).index_add(0, groups, weights * near)
            share = ((found + _PRIOR_COUNT * assumed) / (total + _PRIOR_COUNT)).clamp(0.005, 0.995)
        return share

    is_step = (torch.arange(_PLACES, device=device) < 2 * _RINGS).repeat(items)
    together = fit(places, scores, weights, torch.where(is_step, 0.5, assumed), assumed)  # all directions first
    each = together.repeat_interleave(4)
    groups = places * 4 + torch.arange(4, device=device)[:, None]  # [4, 2 P]
    shares = fit(groups.flatten(), scores.repeat(4), (towards * weights).flatten(), torch.full_like(each, 0.5), each)
    shares = torch.cat([shares.view(-1, 4), together[:, None]], 1).view(items, _PLACES, 5)
    # where the pixels beside a step are right those farther away are too
    far, near, ramp = shares.split([_RINGS, _RINGS, _LEVELS], 1)
    return torch.cat([far.cummin(1).values, near.cummax(1).values, ramp], 1).flatten(0, 1)


def _blur_of(nearness: Tensor, valid: Tensor, edges: _Edges) -> tuple[Tensor, Tensor]:
    """Standard deviation in pixels of the blur that made ramps of an item's steps, and the steps' length in pixels.

    Both ``[B, 1, 1, 1]``. The length is the sum of gradients. Where it is L and the standard deviation s, the squares
    of gradients sum to L / (2 sqrt(pi) s), and 1.35 s L pixels lie in the middle half of a ramp. Thin structures raise
    the first, straight ramps the second: the variance is told from the first, or from the product of both.
    """
    beside, below = (functional.pad(_changes(nearness, valid, d), p) for d, p in ((-1, (1, 1)), (-2, (0, 0, 1, 1))))
    left, right, above, under = beside[..., :-1], beside[..., 1:], below[..., :-1, :], below[..., 1:, :]
    gap = (edges.near - edges.far).clamp_min(1e-12)
    climb = 0.25 * sum(torch.hypot(x, y) for x in (left, right) for y in (above, under)) / gap
    square = 0.25 * ((left + right) ** 2 + (above + under) ** 2) / gap**2
    middle = _fade((_level(nearness, edges) - 0.5).abs(), _MIDDLE)
    length, squares, middles = (
        (edges.strength * v).sum((1, 2, 3), keepdim=True).clamp_min(1e-12) for v in (climb, square, middle)
    )
    by_squares = length / squares / (2.0 * math.sqrt(math.pi))
    by_middles = middles / (_MIDDLE_HALF * length)
    variance = torch.maximum(by_squares**2 - _PIXELS, by_squares * by_middles - 1.2 * _PIXELS)
    return variance.clamp(0.04, 9.0).sqrt(), length


def _unmix(
    nearness: Tensor,
    edges: _Edges,
    label: Tensor,
    sigma: Tensor,
    lost_px: Tensor,
    edge_pixels: Tensor,
    near: Tensor,
    far: Tensor,
) -> tuple[Tensor, Tensor]:
    """The surfaces at edge pixels where one is thin: as near and far as their blurred shape explains the map best."""
    blurred = _blurred(label, _WHOLE * sigma)
    gap = near - far
    item = edge_pixels // label[0].numel()
    for is_near in (True, False):
        shape = label if is_near else 1.0 - label
        whole = torch.where(edges.is_edge, shape, 1.0)
        thin = 1.0 - _highest(-_highest(-whole, 2), 2)
        thin = pixels.pick(thin * (shape > 0), edge_pixels)[0]
        chosen = thin.nonzero()[:, 0]
        at = edge_pixels[chosen]
        least, difference, fit = _regress(nearness, label, blurred, at)
        fit = fit * thin[chosen] * _is_lost(lost_px if is_near else -lost_px)[item[chosen]]
        if is_near:
            most = far[chosen] + _MOST * gap[chosen]
            gain = fit * (torch.minimum(least + difference, most) - near[chosen]).clamp_min(0.0)
            near = near.index_add(0, chosen, gain)
        else:
            lowest = pixels.pick(-_highest(-nearness, 12), at)[0]
            bound = torch.maximum(near[chosen] - _MOST * gap[chosen], lowest)
            gain = fit * (torch.maximum(least, bound) - far[chosen]).clamp_max(0.0)
            far = far.index_add(0, chosen, gain)
    return near, far


def _lift_lamps(
    light: Tensor,
    nearness: Tensor,
    repaired: Tensor,
    step: Tensor,
    softness: Tensor,
    sigma: Tensor,
    lost_px: Tensor,
) -> Tensor:
    """Lamps of a few pixels, whose nearness a soft map spreads around them, as near as what is spread amounts to."""
    brightest = light.amax(1, keepdim=True)
    usual = _mean(brightest.sqrt(), _REACH + 2) ** 2
    span = _highest(nearness, _REACH) + _highest(-nearness, _REACH)
    around = _highest(brightest, 2)
    stands_out, of_peak = (brightest / other.clamp_min(1e-30) for other in (usual, around))
    strength = softness * _fade(stands_out, _LAMP) * _fade(of_peak, (0.1, 0.12)) * _fade(span / step, (0.5, 0.6))
    cover = of_peak * _fade(stands_out, _GLOW)
    lamp_pixels = pixels.indices(strength > 0)
    behind, difference, fit = _regress(nearness, cover, _blurred(cover, sigma), lamp_pixels)
    fit = fit * pixels.pick(strength, lamp_pixels)[0] * _is_lost(lost_px)[lamp_pixels // nearness[0].numel()]
    own = pixels.pick(repaired, lamp_pixels)[0]
    gain = fit * (behind + difference.clamp_min(0.0) - own).clamp_min(0.0)
    return pixels.put(repaired, lamp_pixels, own + gain)


def _is_lost(lost_px: Tensor) -> Tensor:
    """How far thin structures can have lost nearness, 0 to 1, ``[B]``: none where the map's surfaces are too large."""
    return (2.4 + 2.5 * lost_px).clamp(0.0, 1.0).flatten()


def _regress(nearness: Tensor, shape: Tensor, blurred: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Nearness around pixels ``[P]`` as ``a + b blurred``: a, b, and how well that fits, 0 to 1.

    It must explain what the shape does not that is not blurred.
    """
    window = pixels.around(chosen, nearness, _REACH)
    offsets = torch.arange(-_REACH, _REACH + 1, device=nearness.device, dtype=nearness.dtype)
    weight = torch.exp(-(offsets[:, None] ** 2 + offsets**2) / 18.0).flatten()[:, None]
    weight = weight / weight.sum()
    y = pixels.pick(nearness, window)[0]
    mean_y = (weight * y).sum(0)
    yy = (weight * (y - mean_y) ** 2).sum(0)
    results = []
    for cover in (blurred, shape):
        x = pixels.pick(cover, window)[0]
        mean_x = (weight * x).sum(0)
        xx = (weight * (x - mean_x) ** 2).sum(0)
        xy = (weight * (x - mean_x) * (y - mean_y)).sum(0).clamp_min(0.0)
        results.append((xx, xy / xx.clamp_min(1e-9), mean_x, xy**2 / (xx * yy).clamp_min(1e-12)))
    (xx, b, mean_x, explained), (*_, unblurred) = results
    better = ((explained - unblurred) / (_BETTER * (1.0 - unblurred)).clamp_min(1e-6)).clamp(0.0, 1.0)
    fit = _fade(xx, (0.004, 0.005)) * ((explained - 0.5) / 0.3).clamp(0.0, 1.0) * better
    return mean_y - b * mean_x, b, fit


def _slopes(nearness: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Steepness by pixel where it goes on from one side to the other, 0 elsewhere and beside what is unknown.

    The lesser of both sides, in the steeper of the two axes; and by how much the change on one side exceeds that.
    """
    least, jump = [], []
    for dim in (-1, -2):
        change = _changes(nearness, valid, dim)
        none = torch.zeros_like(nearness.narrow(dim, 0, 1))
        before, after = torch.cat([none, change], dim), torch.cat([change, none], dim)
        goes_on = before * after > 0
        least.append(torch.where(goes_on, torch.minimum(before.abs(), after.abs()), 0.0))
        jump.append(torch.maximum(before.abs(), after.abs()) - least[-1])
    return torch.maximum(*least), torch.maximum(*jump)


def _changes(nearness: Tensor, valid: Tensor, dim: int) -> Tensor:
    """From each pixel to the next one, 0 where one of them is unknown."""
    known = valid.narrow(dim, 1, valid.shape[dim] - 1) & valid.narrow(dim, 0, valid.shape[dim] - 1)
    return torch.where(known, nearness.diff(dim=dim), 0.0)


def _highest(values: Tensor, reach: int) -> Tensor:
    side = 2 * reach + 1
    rows = functional.max_pool2d(values, (1, side), stride=1, padding=(0, reach))
    return functional.max_pool2d(rows, (side, 1), stride=1, padding=(reach, 0))


def _mean(values: Tensor, reach: int) -> Tensor:
    side = 2 * reach + 1
    rows = functional.avg_pool2d(functional.pad(values, (reach,) * 4, mode="replicate"), (1, side), stride=1)
    return functional.avg_pool2d(rows, (side, 1), stride=1)


def _blurred(values: Tensor, sigma: Tensor) -> Tensor:
    """Items ``[B, 1, H, W]``, each under a Gaussian of its own sigma ``[B, 1, 1, 1]``."""
    offsets = torch.arange(-_BLUR_REACH, _BLUR_REACH + 1, device=values.device, dtype=values.dtype)
    kernel = torch.exp(-(offsets**2) / (2.0 * sigma**2))  # [B, 1, 1, k]
    kernel = kernel / kernel.sum(-1, keepdim=True)
    padded = functional.pad(values, (_BLUR_REACH,) * 4, mode="replicate").transpose(0, 1)
    rows = functional.conv2d(padded, kernel, groups=len(sigma))
    return functional.conv2d(rows, kernel.transpose(-1, -2), groups=len(sigma)).transpose(0, 1)
