"""Registers a depth map to its image before a repair of its edges: resizes its foregrounds and shifts it.

A repair learns how often a map is wrong beside its edges, and corrects this within a window of a few pixels. From what
it learns one also sees in which direction the edges of each side must move: all outward where foregrounds are too thin,
all inward where they are too wide, those of opposite sides in the same direction where the map is shifted. Foregrounds
are then dilated or eroded, or the map is shifted, by a pixel at a time as long as colours ask for it. The repair that
follows has smaller errors to correct.
"""

import functools
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...tensors import is_traced
from ..engines.ops import EAGER, Ops
from .doubt import contradicted
from .edge_search import DIRECTIONS, PLACES, RINGS
from .windows import LARGEST, NEVER, highest

__all__ = ["EDITS", "Repaired", "edits_of", "registered"]

_RESIZED = 0.4  # excess of the near surface at all edges from which foregrounds are resized
_THIN, _WIDE = 0.15, 0.2  # the same at clear pixels from which they are dilated, or eroded
_BESIDE = 0.2  # share of pixels beside the steps of a hard map that are wrong in each direction if it is too thin
_SHIFTED = 0.12  # half the difference of the excess on two opposite sides from which a map is shifted
_ONE_SIDE = 0.065  # least excess on each of the two, with opposite signs
_DILATED = 0.3  # excess, negative, from which a soft map's foregrounds are too wide, and fully from `_RESIZED`
_MOST_PX = 6  # px; by which foregrounds are resized, or a map is shifted, at most
_SIDES = (0, 1, 3, 4)  # directions towards the near surface: at the edge below it, to its right, to its left, above it

EDITS = 6
"""Number of edits: dilated foregrounds, eroded ones, maps shifted down, right, left, and up."""

_ERODES = 1  # index of the edit of foregrounds that are too wide
_ANY = 2.0  # stands for each edit before the first repair. Later 1: is done now, 0: is not, -1: never again

Repaired = tuple[Tensor, Tensor, Tensor]
"""A repaired map ``[B, 1, H, W]``, its doubt, and the edits of :func:`edits_of` for the map before this repair."""

Once = Callable[[Tensor, Tensor, Tensor | None], Repaired]
"""Repairs a map, of which foregrounds are eroded, a bool ``[B, 1, 1, 1]``. The last argument has the edits that may
follow, ``[B, EDITS, 1, 1]``, or is None. If colours ask for one of them, only the third result counts."""


def edits_of(clear: Tensor, agreed: Tensor, prior: Tensor, is_soft: Tensor) -> tuple[Tensor, Tensor]:
    """Which edits colours ask for, 1 or 0, and how far foregrounds of a soft map are dilated, too wide, 0 to 1.

    The excess of the near surface at edges of one direction is the share of far pixels that show the near surface, less
    that of near pixels that show the far one: -1 to 1, positive where these edges must move outward. On ramps, twice
    the mean share of the near surface, less 1, is the same. Clear pixels, farther from the edges, show larger errors.

    Args:
        clear: As for :func:`.doubt.doubt_of`, ``[2, B, DIRECTIONS, 1, 1]``.
        agreed: The same.
        prior: Shares of pixels that show the near surface, of each kind, of :func:`.edge_prior.calibrate`.
        is_soft: Whether the map is soft, ``[B, 1, 1, 1]``: ramps then count, else steps.

    Returns:
        ``[B, EDITS, 1, 1]`` and ``[B, 1, 1, 1]``.
    """
    share = prior.view(-1, PLACES, DIRECTIONS)[..., None, None]
    beside_steps, on_ramps = share[:, 0] + share[:, RINGS] - 1.0, 2.0 * share[:, 2 * RINGS :].mean(1) - 1.0
    excess = torch.where(is_soft, on_ramps, beside_steps)

    near, far = contradicted(clear.sum(2, keepdim=True), agreed.sum(2, keepdim=True))
    least, most = excess.amin(1, keepdim=True), excess.amax(1, keepdim=True)
    is_thin = (far - near > _THIN) & (is_soft | (share[:, 0].amin(1, keepdim=True) > _BESIDE))  # not hair alone
    is_thin = is_thin | (least > _RESIZED)
    is_wide = (near - far > _WIDE) & (most < _RESIZED)
    is_wide = is_wide | (~is_soft & (most < -_RESIZED))  # bright things have too wide ramps
    near_apart, far_apart = contradicted(clear, agreed)
    both = torch.stack([excess, (far_apart - near_apart).to(excess.dtype)])
    outward, inward = (t[:, :, list(_SIDES)] for t in (both, -both.flip(2)))  # of opposite sides
    is_shifted = (torch.minimum(outward, inward) > _ONE_SIDE) & (0.5 * (outward + inward) > _SHIFTED)
    dilated = torch.where(is_soft, ((-most - _DILATED) / (_RESIZED - _DILATED)).clamp(0.0, 1.0), 0.0)
    return torch.cat([is_thin, is_wide, is_shifted.any(0)], 1).to(near.dtype), dilated


def registered(once: Once, nearness: Tensor, of_coc: bool, ops: Ops = EAGER) -> tuple[Tensor, Tensor]:
    """Repairs a map after the edits that colours ask for.

    Args:
        once: Repairs a map.
        nearness: The map, ``[B, 1, H, W]``.
        of_coc: Whether it is a map of the coc instead, in which a larger value is farther.
        ops: Repeats the repair.

    Returns:
        The repaired map, and the doubt in the map from which it is repaired.
    """

    def step(state: Sequence[Tensor], may_edit: bool) -> tuple[Sequence[Tensor], Tensor]:
        edited, repaired, doubt, edits = state
        is_new = (edits > 0).any(1, keepdim=True)
        for edit, asked in zip(_edits(of_coc), edits.split(1, 1), strict=True):
            is_done = asked == 1
            if is_traced() or is_done.any():
                edited = torch.where(is_done, edit(edited), edited)
        may_follow = _following(edits)
        again, its_doubt, asked = once(edited, edits[:, _ERODES : _ERODES + 1] == 1, may_follow if may_edit else None)
        repaired, doubt = torch.where(is_new, again, repaired), torch.where(is_new, its_doubt, doubt)
        edits = torch.where(may_follow, asked, -1.0)
        return (edited, repaired, doubt, edits), (edits > 0).any()

    edits = torch.full((nearness.shape[0], EDITS, 1, 1), _ANY, dtype=nearness.dtype, device=nearness.device)
    if is_traced():
        state, times = (nearness, nearness, edits[:, :1], edits), _MOST_PX + 1
    else:
        state, times = (nearness, *once(nearness, edits[:, :1] < 0, edits > 0)), _MOST_PX
        if not state[-1].any():
            return state[1:3]
    _, repaired, doubt, _ = ops.repeated(step, state, times)
    return repaired, doubt


def _following(edits: Tensor) -> Tensor:
    """Which edits may follow: of the same sort, size or place, and none that undoes an earlier one."""
    sorts = edits.split([2, len(_SIDES)], 1)
    return torch.cat([(e >= 0) & (e.flip(1) != 1) & (e > 0).any(1, keepdim=True) for e in sorts], 1)


def _edits(of_coc: bool) -> list[Callable[[Tensor], Tensor]]:
    """Functions of a map ``[B, 1, H, W]``, in the order of :data:`EDITS`."""
    sign = -1.0 if of_coc else 1.0
    sizes = (lambda values: sign * _dilated(sign * values), lambda values: sign * _eroded(sign * values))
    places = (functools.partial(_shifted, right=x, down=y) for x, y in ((0, 1), (1, 0), (-1, 0), (0, -1)))
    return [*sizes, *places]


def _dilated(nearness: Tensor) -> Tensor:
    """A map whose larger values win a pixel on each side. Invalid values stay."""
    valid = nearness.abs() <= LARGEST
    return torch.where(valid, highest(torch.where(valid, nearness, -NEVER), 1), nearness)


def _eroded(nearness: Tensor) -> Tensor:
    """A map whose larger values lose a pixel on each side, except things up to 2 px wide, which would be lost."""
    eroded = -_dilated(-nearness)
    return torch.where(nearness.abs() <= LARGEST, eroded + (nearness - _dilated(eroded)), nearness)


def _shifted(nearness: Tensor, right: int, down: int) -> Tensor:
    """A map moved by ``right`` and ``down`` pixels, -1 to 1. Values that are invalid, or would become so, stay."""
    height, width = nearness.shape[-2:]
    padded = functional.pad(nearness, (1, 1, 1, 1), mode="replicate")
    moved = padded.narrow(-2, 1 - down, height).narrow(-1, 1 - right, width)
    return torch.where((nearness.abs() <= LARGEST) & (moved.abs() <= LARGEST), moved, nearness)
