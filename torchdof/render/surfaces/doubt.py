"""Blurs the edges of depth maps that the image contradicts.

Estimated depth often has its edges some pixels beside those of the image, on either side. Decisions pixel by pixel then
leave sharp scraps beside blurred foregrounds, and rough rims on surfaces in focus. The share of the clearest pixels
that have the colour of the surface across the edge measures this doubt. A map that misses parts of its foregrounds
(:mod:`.missed`) is in doubt as well: they are found only within a few pixels, and hair is longer. In doubt, a blurred
foreground blurs its surroundings too, less with every pixel of distance, and everything at an edge is a little blurred.
Colours that contradict only the near side mean that foregrounds are too wide, as portrait modes draw them.
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import native
from ...tensors import is_traced
from ...validation import engine_reads
from ..engines.compiled_steps import by_items
from ..engines.ops import EAGER, Ops
from ..rules import active
from .windows import LARGEST, NEVER, highest, mean_around

__all__ = ["blurred_in_doubt", "contradicted", "doubt_of"]

_CONTRADICTED = 0.03  # share of clear pixels that contradict the map, on either side, from which it is in doubt
_OFTEN_CONTRADICTED = 0.045  # the same from which it is fully in doubt
_ASSUMED = 15.0  # pixels that are assumed to agree with the map; larger: maps with few edges are trusted
_MOVED_PX = 1.0  # px; change of the coc by which the repair of edges has half moved a pixel
_OF_NEAR = 0.4  # blur beside a foreground in full doubt, over its own; larger: fewer scraps, softer pictures
_FALL = 0.5  # px per px of distance; how fast this blur falls; larger: sharper surroundings, lines beside foregrounds
_DOUBLINGS = 7  # of a distance of 1 px; no blur reaches farther
_DIAGONAL_PX = 1.41421356  # px; distance of diagonal neighbours
_LEAST_BLUR_PX = 1.0  # px; least blur at an edge in full doubt
_AROUND_PX = 2  # px; half the width of the window in which blur is averaged, and in which that at an edge fades
_EDGE_REACH = 3  # px; distance at which surfaces on both sides of an edge are found
_LEAST_STEP_PX = 3.0  # px; difference in coc of two surfaces from which they have an edge, by half


def contradicted(clear: Tensor, agreed: Tensor) -> tuple[Tensor, Tensor]:
    """Shares of the clear pixels of near and far surfaces that contradict a map; arguments as for :func:`doubt_of`."""
    near, far = ((clear - agreed) / (clear + _ASSUMED)).unbind(0)
    return near, far


def doubt_of(clear: Tensor, agreed: Tensor) -> Tensor:
    """How much a map is in doubt, 0 to 1, ``[...]``.

    The less contradicted side counts, because colours of a map that is only too thin, or too wide, contradict it on one
    side, and the repair of edges cures that.

    Args:
        clear: Weights of clear pixels of near and far surfaces, ``[2, ...]``.
        agreed: Those of pixels that have the colour of the surface that the map gives them.
    """
    near, far = contradicted(clear, agreed)
    doubt = (torch.minimum(near, far) - _CONTRADICTED) / (_OFTEN_CONTRADICTED - _CONTRADICTED)
    return doubt.clamp(0.0, 1.0)


def blurred_in_doubt(given: Tensor, repaired: Tensor, doubt: Tensor, ops: Ops = EAGER) -> Tensor:
    """Raises the blur beside edges.

    1. At a distance ``d`` from a surface in front of the focus with blur ``r``, the blur is at least ``doubt (_OF_NEAR
       r - _FALL d)``. It changes so slowly that nobody sees where it begins; more blur, beside the foreground alone,
       would draw a line around it.
    2. At any edge that the repair has moved, it is at least ``_LEAST_BLUR_PX doubt``, which fades within a few pixels.

    Pixels with a raised blur lie behind the focus, where they hide nothing. In front of it they would be a surface of
    their own, with an outline, which surfaces in focus and the foreground do not have.

    Args:
        given: Coc in pixels before the repair, ``[B or 1, 1, H, W]``. Invalid values stay.
        repaired: The same after it.
        doubt: 0 to 1, ``[B, 1, 1, 1]``.
        ops: Skips maps that are not in doubt.

    Returns:
        ``[B, 1, H, W]``.
    """
    if not active().in_doubt or (not is_traced() and not (doubt > 0).any()):
        return repaired
    before, after = (t.detach().float().expand(doubt.shape[0], -1, -1, -1) for t in (given, repaired))
    if engine_reads(before, after):
        blurred = by_items(
            lambda given, repaired, doubt: (native.blurred_in_doubt(given[0], repaired, float(doubt)), 0.0),
            after,
            before,
            doubt,
        )[0]
    else:
        blurred = ops.equal_unless(lambda: (doubt > 0).any(), _blurred(before, after, doubt), after)
    return torch.where(blurred == after, repaired, blurred.to(repaired.dtype))


@torch.no_grad()
def _blurred(given: Tensor, repaired: Tensor, doubt: Tensor) -> Tensor:
    """:func:`blurred_in_doubt` by PyTorch, for float32."""
    valid = repaired.abs() <= LARGEST
    moved = torch.where(valid, (repaired - given).abs() / _MOVED_PX - 0.5, 0.0).clamp(0.0, 1.0)
    nearness = torch.where(valid, -repaired, -NEVER)
    beside = _falling(_OF_NEAR * mean_around(nearness.clamp_min(0.0), _AROUND_PX))

    step = highest(nearness, _EDGE_REACH) + highest(torch.where(valid, -nearness, -NEVER), _EDGE_REACH)
    is_step = (step - _LEAST_STEP_PX + 0.5).clamp(0.0, 1.0)
    at_edge = is_step * _LEAST_BLUR_PX * mean_around(highest(moved, 1), _AROUND_PX)
    least = doubt * torch.maximum(beside, at_edge)
    return torch.where(valid & (nearness.abs() < least), least, repaired)


def _falling(blur_px: Tensor) -> Tensor:
    """The largest of the blurs around each pixel, each less :data:`_FALL` times its distance, ``[B, 1, H, W]``.

    Distances are paths along rows, columns and diagonals of pixels. Each doubling adds steps twice as long.
    """
    blur_px = blur_px.clamp(max=_FALL * (2.0**_DOUBLINGS - 1.0))
    for step in (2**k for k in range(_DOUBLINGS)):
        straight = torch.maximum(_beside(blur_px, -1, step), _beside(blur_px, -2, step)) - _FALL * step
        blur_px = torch.maximum(blur_px, straight)
        diagonal = _beside(_beside(blur_px, -1, step), -2, step) - _FALL * _DIAGONAL_PX * step
        blur_px = torch.maximum(blur_px, diagonal)
    return blur_px


def _beside(values: Tensor, dim: int, step: int) -> Tensor:
    """The larger of both values ``step`` pixels away along an axis, 0 beyond the frame."""
    size = values.shape[dim]
    padded = functional.pad(values, (step, step) if dim == -1 else (0, 0, step, step))
    return torch.maximum(padded.narrow(dim, 0, size), padded.narrow(dim, 2 * step, size))
