"""Divide pixels into soft layers by their signed circle of confusion: the weight of each pixel in each layer.

Layers sit at nodes of signed coc, ``nodes[0] < nodes[1] < ...``, so from the nearest to the farthest. A pixel between
two nodes is divided linearly, which makes the picture continuous and differentiable in depth, focus and aperture. All
weights follow from one ramp: the weight of a pixel at or behind node k is
``clamp((x - nodes[k-1]) / (nodes[k] - nodes[k-1]))``; its weight in layer k is the difference of two ramps.

Where layers occlude each other, their light is divided by the weight at or behind them. There the ramp is eased, so
that it leaves 0 slowly: a pixel just behind a node has a tiny weight in the layer behind it. If no other pixel there
is known, the division would turn this tiny weight into a full one.

Nodes live on the *blur axis* ``x = sign(coc) * max(coc^2 / (|coc| + 0.5) - 2e-4, 0)``. Far from focus x grows like the
coc, near focus like its square, as does the light that a small kernel moves. So a mixture of the sharp layer, at x = 0,
and the first blurred one represents the blurs between them. Pixels at x = 0, with ``|coc| < 0.01 px``, are in focus
and pass through unchanged; a disc would move 1e-4 of their light.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

_SQUARE_PX = 0.5  # px of coc around which x changes from the square of the coc to the coc itself
_IN_FOCUS = 2e-4  # x below which a pixel is in focus, at a coc of 0.01 px; larger: more pixels pass unchanged
_FOOT = 0.15  # weight up to which an eased ramp is a parabola; larger: it leaves 0 more slowly


def blur_axis(coc_px: Tensor) -> Tensor:
    """Place on the blur axis of a signed coc, any shape; 0 if the pixel is in focus."""
    # no compiler fuses these operations, so both engines agree to the last bit which pixels lie at a node
    x = coc_px * coc_px.abs() / (coc_px.abs() + _SQUARE_PX)
    return x - x.clamp(-_IN_FOCUS, _IN_FOCUS)


def blur_axis_of_radius(radius_px: float) -> float:
    """:func:`blur_axis` of one radius >= 0, computed without a tensor, whose value compiled code could not read."""
    x = radius_px * radius_px / (radius_px + _SQUARE_PX)
    return x - min(x, _IN_FOCUS)


def from_blur_axis(x: float) -> float:
    """Signed coc in pixels at a place on the blur axis; 0 in focus."""
    beyond = (abs(x) + _IN_FOCUS) / 2.0
    return 0.0 if x == 0 else math.copysign(beyond + math.sqrt(beyond * (beyond + 2.0 * _SQUARE_PX)), x)


def ramps(nodes: Sequence[Sequence[float]], like: Tensor) -> Tensor:
    """Start and width of the layers' ramps, ``[P, 2, n + 1]`` like a tensor, for :func:`weights_at_or_behind`.

    ``nodes`` are the places of the layers, near to far: one row for all items of a batch, or one for each item. Every
    pixel is at or behind the first node, none behind the last. An unused layer, which no pixel lies in, has the place
    of the next used one, or infinity behind the last used one.
    """
    rows = []
    for places in nodes:
        ramp = (-math.inf, 1.0)
        row = [ramp]
        for low, high in zip(places, places[1:], strict=False):
            if high > low:  # else the layer before is unused
                ramp = (low, high - low) if high < math.inf else (math.inf, 1.0)
            row.append(ramp)
        rows.append([*zip(*row, (math.inf, 1.0), strict=True)])
    return like.new_tensor(rows)


def weights_at_or_behind(x: Tensor, ramps: Tensor) -> Tensor:
    """Share of each pixel, 0 to 1, that lies in layer k or behind it: ``M_k`` of the composite, ``[B, n, H, W]``.

    ``x`` are places on the blur axis ``[B, 1, H, W]``; those beyond the outermost nodes belong to these. ``ramps`` are
    all or some columns of the result of :func:`ramps`, ``[P, 2, n]``.
    """
    start, width = ramps[..., None, None].unbind(1)
    return ((x - start) / width).clamp(0.0, 1.0)


def eased(weight: Tensor) -> Tensor:
    """A ramp from 0 to 1 whose foot is a parabola, so that it leaves 0 slowly."""
    slope = 1.0 / (1.0 - 0.5 * _FOOT)
    foot = weight.clamp(max=_FOOT)
    return torch.maximum(1.0 - slope * (1.0 - weight), (0.5 * slope / _FOOT) * foot * foot)
