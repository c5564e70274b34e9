"""Blurs the edges of depth maps that the image contradicts.

Estimated depth often has its edges some pixels beside those of the image, on either side. Decisions pixel by pixel then
leave sharp scraps beside blurred foregrounds, and rough rims on surfaces in focus. The share of the clearest pixels
that have the colour of the surface across the edge measures this doubt. A map that misses parts of its foregrounds
(:mod:`.missed`) is in doubt as well: they are found only within a few pixels, and hair is longer. In doubt, a blurred
foreground blurs its surroundings too, less with every pixel of distance and where they resemble the background, and
everything at an edge is a little blurred. Colours that contradict only the near side mean that foregrounds are too
wide, as portrait modes draw them.
"""

import torch
from torch import Tensor

from ... import native
from ...tensors import is_traced
from ...validation import engine_reads
from ..engines.compiled_steps import by_items
from ..engines.ops import EAGER, Ops
from ..rules import active
from .windows import LARGEST, NEVER, highest, mean_around

__all__ = ["blurred_in_doubt", "contradicted", "doubt_of", "hiding_px"]

_CONTRADICTED = 0.03  # share of clear pixels that contradict the map, on either side, from which it is in doubt
_OFTEN_CONTRADICTED = 0.045  # the same from which it is fully in doubt
_ASSUMED = 15.0  # pixels that are assumed to agree with the map; larger: maps with few edges are trusted
_MOVED_PX = 1.0  # px; change of the coc by which the repair of edges has half moved a pixel
_REACH = 8  # px; distance from a blurred foreground at which its blur has faded; larger: fewer scraps, softer pictures
_NEAR_FROM, _NEAR_SLOPE = 0.375, 4.0  # blur, over the largest around, above which a pixel is near; slope of this weight
_OF_NEAR = 0.8  # blur beside it in full doubt, over its own; larger: the same
_BACKGROUND = 0.1  # mean of how unlike the background pixels are up to which all of them belong to it
_FROM_BACKGROUND = 3.0  # slope over this mean of the blur beside a foreground; larger: fewer scraps, softer pictures
_AROUND_PX = 3  # px; half the width of the window of this mean
_LEAST_BLUR_PX = 1.0  # px; least blur at an edge in full doubt
_AT_EDGE_PX = 2  # px; half the width of the window in which this blur fades
_EDGE_REACH = 3  # px; distance at which surfaces on both sides of an edge are found
_LEAST_STEP_PX = 3.0  # px; difference in coc of two surfaces from which they have an edge, by half
_SHARPER = 0.7037  # largest blur of a pixel beyond an edge, over that of the near surface; no simple fraction
_APART_PX = 2.0  # px; subtracted from it; larger: fewer edges


def hiding_px(blur_px: Tensor) -> Tensor:
    """Blur from which a near surface is clearly more blurred than, and thus in front of, a pixel with this blur."""
    return (blur_px + _APART_PX) * (1.0 / _SHARPER)


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


def blurred_in_doubt(given: Tensor, repaired: Tensor, unlike: Tensor, doubt: Tensor, ops: Ops = EAGER) -> Tensor:
    """Raises the blur beside edges that the repair has moved.

    1. Beside a near surface with blur r, the blur is at least ``_OF_NEAR doubt r``. This fades with the share of the
       near surface among the pixels up to ``_REACH`` away, from a half to 0, and with how unlike the background the
       pixels around are, to 0 at ``_BACKGROUND``: detail that is seen between what a map misses stays.
    2. At any edge, it is at least ``_LEAST_BLUR_PX doubt``, which fades within a few pixels.

    Pixels with a raised blur lie behind the focus, where they hide nothing. In front of it they would be a surface of
    their own, with an outline, which surfaces in focus and the foreground do not have.

    Args:
        given: Coc in pixels before the repair, ``[B or 1, 1, H, W]``. Invalid values stay.
        repaired: The same after it.
        unlike: How unlike the background each pixel is, 0 to 1, ``[B, 1, H, W]``, of :func:`.missed.completed`.
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
            lambda a, b, c, d: (native.blurred_in_doubt(a[0], b, c[0], float(d)), 0.0), after, before, unlike, doubt
        )[0]
    else:
        blurred = ops.equal_unless(lambda: (doubt > 0).any(), _blurred(before, after, unlike, doubt), after)
    return torch.where(blurred == after, repaired, blurred.to(repaired.dtype))


@torch.no_grad()
def _blurred(given: Tensor, repaired: Tensor, unlike: Tensor, doubt: Tensor) -> Tensor:
    """:func:`blurred_in_doubt` by PyTorch, for float32."""
    valid = repaired.abs() <= LARGEST
    moved = torch.where(valid, (repaired - given).abs() / _MOVED_PX - 0.5, 0.0).clamp(0.0, 1.0)
    nearness = torch.where(valid, -repaired, -NEVER)
    near = highest(nearness, _REACH)
    # a pixel beside a surface compares its surroundings with that surface, which may be twice the reach away from them
    is_near = (_NEAR_SLOPE * (nearness / highest(near, _REACH).clamp_min(1.0) - _NEAR_FROM)).clamp(0.0, 1.0)
    is_beyond = (near - hiding_px(nearness.abs()) + 0.5).clamp(0.0, 1.0) * highest(moved, _REACH)
    is_foreign = (_FROM_BACKGROUND * (mean_around(unlike, _AROUND_PX) - _BACKGROUND)).clamp(0.0, 1.0)
    beside = is_beyond * is_foreign * _OF_NEAR * near * (2.0 * mean_around(is_near, _REACH)).clamp(max=1.0)

    step = highest(nearness, _EDGE_REACH) + highest(torch.where(valid, -nearness, -NEVER), _EDGE_REACH)
    is_step = (step - _LEAST_STEP_PX + 0.5).clamp(0.0, 1.0)
    at_edge = is_step * _LEAST_BLUR_PX * mean_around(highest(moved, 1), _AT_EDGE_PX)
    least = doubt * torch.maximum(beside, at_edge)
    return torch.where(valid & (nearness.abs() < least), least, repaired)
