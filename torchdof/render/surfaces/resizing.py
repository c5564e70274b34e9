"""Dilates or erodes the foregrounds of depth maps that draw them too thin or too wide, before a repair of edges.

A repair learns how often a map is wrong beside its edges, and corrects this within a window of a few pixels. Where all
foregrounds are too thin, or too wide, colours contradict the map on one side of its edges alone: on every side of every
foreground beside the steps of a hard map, at the clearest pixels of a soft one. Foregrounds are then resized by a pixel
at a time as long as colours ask for it. The repair that follows has smaller errors to correct.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from .doubt import OF_OTHER, contradicted
from .edge_search import DIRECTIONS, PLACES, RINGS
from .windows import LARGEST, NEVER, highest

__all__ = ["from_resized", "resizing_of"]

_ALL_SIDES = (
    0.6  # share of wrong pixels beside steps, in each direction, from which foregrounds of hard maps are resized
)
_OTHER_SIDE = 0.25  # largest share of wrong pixels on the other side of these steps
_THIN = 0.4  # share of clear pixels of the far side that contradict a map, from which its foregrounds are too thin
_WIDE, _WIDE_FAR = 0.3, 0.06  # those of near and far side above which they are too wide for the repair
_MOST_PX = 6  # px; by which foregrounds are resized at most

Repaired = tuple[Tensor, Tensor, Tensor]
"""A repaired map ``[B, 1, H, W]``, its doubt, and what :func:`resizing_of` says of the map it is repaired from."""


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
    lowest = [wrong.amin(2) > _ALL_SIDES for wrong in (far_wrong, near_wrong)]
    trusted = [wrong.amax(2) < _OTHER_SIDE for wrong in (far_wrong, near_wrong)]
    is_thin = is_thin | (~is_soft & lowest[0] & trusted[1])
    is_wide = is_wide | (~is_soft & lowest[1] & trusted[0])
    return is_thin.to(near.dtype) - is_wide.to(near.dtype)


def from_resized(once: Callable[[Tensor, bool], Repaired], nearness: Tensor, sign: float) -> tuple[Tensor, Tensor]:
    """Repairs a map whose foregrounds are first dilated or eroded, if colours ask for it.

    Args:
        once: Repairs a map. Where it is resized again, the bool is true, and only the third result counts.
        nearness: The map, ``[B, 1, H, W]``.
        sign: -1 if a smaller value is nearer, else 1.

    Returns:
        The repaired map, and the doubt in the map from which it is repaired.
    """
    repaired, doubt, asked = once(nearness, True)
    resizing = asked
    for left in reversed(range(_MOST_PX)):
        resizing = torch.where(asked == resizing, resizing, 0.0)  # never back
        if not resizing.any():
            break
        for by in (-1.0, 1.0):
            nearness = torch.where(resizing == by, _resized(nearness, by * sign), nearness)
        again, its_doubt, asked = once(nearness, left > 0)
        repaired, doubt = (torch.where(resizing != 0, *t) for t in ((again, repaired), (its_doubt, doubt)))
    return repaired, doubt


def _resized(nearness: Tensor, sign: float) -> Tensor:
    """A map whose larger values, for sign -1 smaller ones, win a pixel on each side. Invalid values stay."""
    valid = nearness.abs() <= LARGEST
    return torch.where(valid, sign * highest(torch.where(valid, sign * nearness, -NEVER), 1), nearness)
