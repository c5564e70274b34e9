"""Finds the edges of a depth map: the places where two surfaces meet, by a step or by a ramp.

All computations use nearness, a measure linear in 1 / depth.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..rules import active
from .windows import NEVER, highest, mean_around

__all__ = [
    *("DIRECTIONS", "LEVELS", "PLACES", "RAMP_REACH", "REACH", "RINGS"),
    *("Edges", "ends_of", "find", "kinds", "noise"),
]

REACH = 5  # px; half the width of the window that has both surfaces of an edge, and samples of them

# Steps and ramps. In a map with the levels of a file, steps, slopes and means are simple fractions of each other. If a
# limit were a simple fraction too, rounding would decide. So limits have four digits: 0.3037 instead of 0.3.
RINGS = 3  # px on each side of a step that are checked; larger: corrects wider displacements
_ABRUPT = 0.3037  # smallest jump between neighbours at a step, as a fraction of the step; larger: fewer steps
_FLAT_REACH = 8  # px within which a ramp becomes flat; larger: more slopes count as ramps
RAMP_REACH = 6  # px; half the width of the widest ramp, anything wider is a slope
_LEAST_SLOPE = 0.1  # smallest slope of a ramp per pixel, in smallest steps
_SHALLOW = 0.0303  # smallest slope of a ramp per pixel, as a fraction of the range of nearness around
_FLAT = 0.3037  # slope of the flattest place around a ramp, over the ramp's; larger: more slopes count as ramps
_NEAREST = 0.6037  # a step nearer to the pixel counts from this part of the largest one around; larger: fewer rings
_TIE = 0.0171  # steps by which one axis must lead to give an edge its direction; larger: more diagonal ones

# Kinds of edge pixels
DIRECTIONS = 5  # directions of an edge: up, left, diagonal, right, down
LEVELS = 6  # levels of a ramp
PLACES = 2 * RINGS + LEVELS  # kinds of one direction

# Noise of a map, below which a step is not an edge
_NOISE_OF_BEND = 0.6053  # 1.4826 / sqrt(6): deviation of Gaussian noise over the median of |second difference|
_NOISE_OF_ROUNDING = 0.2887  # 1 / sqrt(12): deviation of rounding over the distance of two levels
_LEVELS_OF_A_FILE = 64  # fewest levels of a map with the noise of rounding; larger: more edges in coarse maps
_NOISE_SAMPLED = 2**13  # pixels per frame that are sampled, half along rows and half along columns


class Edges(NamedTuple):
    """Edges of a map of nearness; all ``[B, 1, H, W]``."""

    near: Tensor  # nearness of the nearer of the two surfaces around the pixel
    far: Tensor  # nearness of the farther one
    is_ramp: Tensor  # the pixel lies on a ramp between the two
    ring: Tensor  # distance to a step in pixels, from 1; ``RINGS + 1`` if no step is within ``RINGS``
    is_edge: Tensor
    direction: Tensor  # towards the near surface: 0 up, 1 left, 2 diagonal, 3 right, 4 down
    level: Tensor  # place of the pixel between the two surfaces, 0 (far) to 1 (near)
    climb: Tensor  # steepness in steps per pixel, 0 away from edges; the sum is the length of all edges in pixels


def find(nearness: Tensor, valid: Tensor, step: Tensor) -> Edges:
    """Finds ramps and steps, and the nearness of the two surfaces that meet there.

    Args:
        nearness: ``[B, 1, H, W]``, finite.
        valid: Whether a pixel counts, like ``nearness``.
        step: Smallest difference of two surfaces, ``[B, 1, H, W]`` or what expands to it.
    """
    ends = ends_of(nearness, valid)
    slope, jump, steepness = _slopes(nearness, valid)
    span = highest(ends, REACH).sum(1, keepdim=True)
    # a ramp is short and has flat places around it; a slope has none
    flattest = -highest(-mean_around(slope, 2), _FLAT_REACH)
    is_steep = (slope > _LEAST_SLOPE * step) & (slope > _SHALLOW * span)
    is_ramp = is_steep & (span > step) & (flattest < _FLAT * slope) & valid

    # the surfaces at both ends of a ramp: extremes spread along it pixel by pixel
    spread = ends
    for _ in range(RAMP_REACH):
        spread = torch.where(is_ramp, highest(spread, 1), spread)
    is_ramp = is_ramp & (spread.sum(1, keepdim=True) > step)
    ends = torch.where(is_ramp, spread, ends)

    # the surfaces on both sides of a step: extremes within k pixels; the smallest k that reaches the step counts
    rings = [torch.cat([ends, jump], 1)]
    for _ in range(RINGS):
        rings.append(highest(rings[-1], 1))
    least = torch.maximum(_NEAREST * rings[-1][:, :2].sum(1, keepdim=True), step)
    ring, sides = torch.full_like(nearness, RINGS + 1, dtype=torch.long), rings[-1][:, :2]
    for k in range(RINGS, 0, -1):
        of_ring, largest_jump = rings[k].split([2, 1], 1)
        gap = of_ring.sum(1, keepdim=True)
        is_step = (gap > least) & (largest_jump > _ABRUPT * gap)
        ring, sides = torch.where(is_step, k, ring), torch.where(is_step, of_ring, sides)
    near, far = torch.where(is_ramp, ends, sides).split(1, 1)
    far = -far
    gap = near - far
    is_edge = (is_ramp | (ring <= RINGS)) & (gap > step) & valid

    mean = mean_around(functional.pad(nearness, (2,) * 4, mode="replicate"), 2)
    right, down = mean[..., 2:-2, 4:] - mean[..., 2:-2, :-4], mean[..., 4:, 2:-2] - mean[..., :-4, 2:-2]
    lead, tie = right.abs() - down.abs(), _TIE * gap
    across = torch.where(lead > tie, right.sign(), 0.0)
    along = torch.where(-lead > tie, down.sign(), 0.0)
    direction = (2.0 * along + across).long() * active().directions + DIRECTIONS // 2
    gap = gap.clamp_min(1e-12)
    level, climb = ((nearness - far) / gap).clamp(0.0, 1.0), torch.where(is_edge, steepness / gap, 0.0)
    return Edges(near, far, is_ramp, ring, is_edge, direction, level, climb)


def kinds(edges: Edges) -> Tensor:
    """Index of the kind of each pixel ``[B, 1, H, W]``; pixels of one kind have one prior.

    A kind is an item, a place and a direction. A place is a ring on one side of a step, or one level of a ramp.
    """
    level = edges.level
    side = (level > 0.5).long() * RINGS + edges.ring.clamp(max=RINGS) - 1
    place = torch.where(edges.is_ramp, 2 * RINGS + (level * LEVELS).long().clamp(0, LEVELS - 1), side)
    item = torch.arange(level.shape[0], device=level.device).view(-1, 1, 1, 1)
    return (item * PLACES + place) * DIRECTIONS + edges.direction


def noise(nearness: Tensor, valid: Tensor) -> Tensor:
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
    rounding = torch.where(span > _LEVELS_OF_A_FILE * quantum, rounding, 0.0)
    return torch.maximum(_NOISE_OF_BEND * bend, rounding)[..., None, None]


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


def ends_of(nearness: Tensor, valid: Tensor) -> Tensor:
    """A map and its negative, ``[B, 2, H, W]``, so that maxima of both are the ends of its range."""
    return torch.where(valid, torch.cat([nearness, -nearness], 1), -NEVER)
