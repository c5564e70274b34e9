"""Signed circle of confusion to soft layers: how much of each pixel's light each layer carries.

Layers sit at nodes of signed coc, ``nodes[0] < nodes[1] < ...``, so from the nearest to the farthest. A pixel between
two nodes is divided linearly, which makes the picture continuous and differentiable in depth, focus and aperture. All
of it follows from one ramp: the weight of a pixel at or behind node k is
``clamp((x - nodes[k-1]) / (nodes[k] - nodes[k-1]))``; its weight in layer k is the difference of two ramps.

Where layers occlude each other their light is divided by the weight at or behind them, and there the ramp is eased: the
share of a pixel a hair behind a node is next to nothing, and what is divided by it would be all that its layer knows.

Nodes live on the *blur axis* ``x = sign(coc) * max(|coc| - 0.5, 0)``: everything within half a pixel of focus passes
through unchanged and is one layer, at x = 0.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["blur_axis", "eased", "from_blur_axis", "weight_at_or_behind"]

SHARP_PX = 0.5
"""Radius of the circle of confusion up to which a pixel counts as in focus."""


_FOOT = 0.15  # share up to which an eased ramp rises by its square


def blur_axis(coc_px: Tensor) -> Tensor:
    """Place on the blur axis of a signed coc, any shape; 0 wherever the pixel is in focus."""
    return coc_px - coc_px.clamp(-SHARP_PX, SHARP_PX)


def from_blur_axis(x: float) -> float:
    """Signed coc in pixels at a place on the blur axis."""
    return 0.0 if x == 0 else x + SHARP_PX if x > 0 else x - SHARP_PX


def weight_at_or_behind(x: Tensor, nodes: Sequence[float], k: int) -> Tensor:
    """How much of each pixel, 0 to 1, lies in layer ``k`` or behind it: ``M_k`` of the composite.

    Args:
        x: Places on the blur axis, any shape; those beyond the outermost nodes belong to these.
        nodes: Places of the layers, strictly increasing: near to far.
        k: Layer, 0 to ``len(nodes)``, which is behind everything.
    """
    if k == 0:
        return torch.ones_like(x)
    if k == len(nodes):
        return torch.zeros_like(x)
    return ((x - nodes[k - 1]) / (nodes[k] - nodes[k - 1])).clamp(0.0, 1.0)


def eased(weight: Tensor) -> Tensor:
    """A ramp from 0 to 1 whose foot is a parabola, so that it leaves 0 slowly."""
    slope = 1.0 / (1.0 - 0.5 * _FOOT)
    foot = weight.clamp(max=_FOOT)
    return torch.maximum(1.0 - slope * (1.0 - weight), (0.5 * slope / _FOOT) * foot * foot)
