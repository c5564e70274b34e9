"""Dilates or erodes the foregrounds of depth maps that draw them too thin or too wide, before a repair of edges.

A repair learns how often a map is wrong beside its edges, and corrects this within a window of a few pixels. Where all
foregrounds are too thin, or too wide, colours contradict the map on one side of its edges alone: on every side of every
foreground beside the steps of a hard map, at the clearest pixels of a soft one. Foregrounds are then resized by a pixel
at a time as long as colours ask for it. The repair that follows has smaller errors to correct.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ...tensors import is_traced
from ..engines.ops import EAGER, Ops
from .doubt import OF_OTHER, contradicted
from .edge_search import DIRECTIONS, PLACES, RINGS
from .windows import LARGEST, NEVER, highest

__all__ = ["ANYTHING", "Repaired", "from_resized", "resizing_of"]

_ALL_SIDES = 0.6  # share of wrong pixels beside steps, in each direction, from which a hard map is resized
_OTHER_SIDE = 0.25  # largest share of wrong pixels on the other side of these steps
_THIN = 0.4  # share of clear pixels of the far side that contradict a map, from which its foregrounds are too thin
_BESIDE = 0.2  # the same share beside the steps of a hard map, in each direction
_WIDE, _WIDE_FAR = 0.3, 0.06  # those of near and far side above which they are too wide for the repair
_MOST_PX = 6  # px; by which foregrounds are resized at most

ANYTHING = 2.0
"""Stands for the result of :func:`resizing_of` before the first repair: the map is resized for either error."""

Repaired = tuple[Tensor, Tensor, Tensor]
"""A repaired map ``[B, 1, H, W]``, its doubt, and the result of :func:`resizing_of` for the map before this repair."""


def resizing_of(clear: Tensor, agreed: Tensor, prior: Tensor, is_soft: Tensor) -> Tensor:
    """Whether foregrounds are too thin, 1, too wide, -1, or neither, 0.

    Args:
        clear: As for :func:`.doubt.doubt_of`, ``[2, B, 1, 1, 1]``.
        agreed: The same.
        prior: Shares of pixels that show the near surface, of each kind, of :func:`.edge_prior.calibrate`.
        is_soft: Whether the map is soft, ``[B, 1, 1, 1]``.

    Returns:
        ``[B, 1, 1, 1]``.
    """
    near, far = contradicted(clear, agreed)
    is_thin = (far > _THIN) & (far > OF_OTHER * near)
    # beyond the window of the repair some far pixels contradict a map too, because near colours are not found
    is_wide = (near > _WIDE) & (near > OF_OTHER * far) & (far > _WIDE_FAR)

    beside = prior.view(-1, PLACES, DIRECTIONS)[..., None, None]
    far_wrong, near_wrong = beside[:, :1], 1.0 - beside[:, RINGS : RINGS + 1]
    least_far, least_near = far_wrong.amin(2), near_wrong.amin(2)
    is_thin = is_thin & (is_soft | (least_far > _BESIDE))  # not hair alone
    is_thin = is_thin | (~is_soft & (least_far > _ALL_SIDES) & (near_wrong.amax(2) < _OTHER_SIDE))
    is_wide = is_wide | (~is_soft & (least_near > _ALL_SIDES) & (far_wrong.amax(2) < _OTHER_SIDE))
    return is_thin.to(near.dtype) - is_wide.to(near.dtype)


def from_resized(
    once: Callable[[Tensor, Tensor | None], Repaired], nearness: Tensor, of_coc: bool, ops: Ops = EAGER
) -> tuple[Tensor, Tensor]:
    """Repairs a map whose foregrounds are first dilated or eroded, if colours ask for it.

    Args:
        once: Repairs a map. Its second argument is the result of :func:`resizing_of` for the map before, or
            :data:`ANYTHING`. If the new result is the same, the map is resized again, and only the third result counts;
            never with None.
        nearness: The map, ``[B, 1, H, W]``.
        of_coc: Whether it is a map of the coc instead, in which a larger value is farther.
        ops: Repeats the repair.

    Returns:
        The repaired map, and the doubt in the map from which it is repaired.
    """

    def step(state: Sequence[Tensor], may_resize: bool) -> tuple[Sequence[Tensor], Tensor]:
        before, repaired, doubt, resizing = state
        resized = before
        for by in (-1.0, 1.0):
            wanted = resizing == by
            if is_traced() or wanted.any():
                resized = torch.where(wanted, _resized(before, -by if of_coc else by), resized)
        again, its_doubt, asked = once(resized, resizing if may_resize else None)
        is_new = resizing != 0
        repaired, doubt = torch.where(is_new, again, repaired), torch.where(is_new, its_doubt, doubt)
        continues = (resizing == asked) | (resizing == ANYTHING)  # never back
        resizing = torch.where(continues, asked, 0.0)
        return (resized, repaired, doubt, resizing), (resizing != 0).any()

    first = torch.full((nearness.shape[0], 1, 1, 1), ANYTHING, dtype=nearness.dtype, device=nearness.device)
    if is_traced():
        state, times = (nearness, nearness, first, first), _MOST_PX + 1
    else:
        state, times = (nearness, *once(nearness, first)), _MOST_PX
        if not state[-1].any():
            return state[1:3]
    _, repaired, doubt, _ = ops.repeated(step, state, times)
    return repaired, doubt


def _resized(nearness: Tensor, sign: float) -> Tensor:
    """A map whose larger values, for sign -1 smaller ones, win a pixel on each side. Invalid values stay."""
    valid = nearness.abs() <= LARGEST
    return torch.where(valid, sign * highest(torch.where(valid, sign * nearness, -NEVER), 1), nearness)
