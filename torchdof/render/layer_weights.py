"""Signed circle of confusion to soft layers: how much of each pixel's light each layer carries.

Layers sit at nodes of signed coc, ``nodes[0] < nodes[1] < ...``, so from the nearest to the farthest. A pixel between
two nodes is divided linearly, which makes the picture continuous and differentiable in depth, focus and aperture. All
of it follows from one ramp: the weight of a pixel at or behind node k is
``clamp((x - nodes[k-1]) / (nodes[k] - nodes[k-1]))``; its weight in layer k is the difference of two ramps.

Where layers occlude each other their light is divided by the weight at or behind them, and there the ramp is eased: the
share of a pixel a hair behind a node is next to nothing, and what is divided by it would be all that its layer knows.

Nodes live on the *blur axis* ``x = sign(coc) * max(coc^2 / (|coc| + 0.5) - 2e-4, 0)``. Far from focus it goes as the
coc does, near focus as its square, which is how the light goes that a small kernel moves. So a mixture of the sharp
layer, at x = 0, and the first blurred one stands for the blurs between them. What lies at x = 0 is in focus and passes
through unchanged: |coc| < 0.01 px, where a disc would move 1e-4 of the light.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["blur_axis", "eased", "from_blur_axis", "ramps", "weights_at_or_behind"]

_SQUARE_PX = 0.5  # coc around which the axis goes over from the square to the coc itself
_IN_FOCUS = 2e-4  # where focus ends: a coc of 0.01 px


_FOOT = 0.15  # share up to which an eased ramp rises by its square


def blur_axis(coc_px: Tensor) -> Tensor:
    """Place on the blur axis of a signed coc, any shape; 0 wherever the pixel is in focus."""
    # in a form whose operations no compiler fuses: both engines agree to the last bit about which pixels lie at a node
    x = coc_px * coc_px.abs() / (coc_px.abs() + _SQUARE_PX)
    return x - x.clamp(-_IN_FOCUS, _IN_FOCUS)


def from_blur_axis(x: float) -> float:
    """Signed coc in pixels at a place on the blur axis; 0 in focus."""
    beyond = (abs(x) + _IN_FOCUS) / 2.0
    return 0.0 if x == 0 else math.copysign(beyond + math.sqrt(beyond * (beyond + 2.0 * _SQUARE_PX)), x)


def ramps(nodes: Sequence[float], like: Tensor) -> Tensor:
    """Where the ramps of layers begin and how wide they are, ``[2, n + 1]``, as the second argument of the next.

    Args:
        nodes: Places of the layers, strictly increasing: near to far. Everything is at or behind the first, nothing
            behind the last.
        like: Its dtype and device are taken.
    """
    widths = [1.0, *(high - low for low, high in zip(nodes, nodes[1:], strict=False)), 1.0]
    return like.new_tensor([[-math.inf, *nodes[:-1], math.inf], widths])


def weights_at_or_behind(x: Tensor, ramps: Tensor) -> Tensor:
    """How much of each pixel, 0 to 1, lies in layers or behind them, ``M_k`` of the composite: ``[B, n, H, W]``.

    Args:
        x: Places on the blur axis ``[B, 1, H, W]``; those beyond the outermost nodes belong to these.
        ramps: Some of those that :func:`ramps` gives, ``[2, n]``.
    """
    start, width = ramps[..., None, None]
    return ((x - start) / width).clamp(0.0, 1.0)


def eased(weight: Tensor) -> Tensor:
    """A ramp from 0 to 1 whose foot is a parabola, so that it leaves 0 slowly."""
    slope = 1.0 / (1.0 - 0.5 * _FOOT)
    foot = weight.clamp(max=_FOOT)
    return torch.maximum(1.0 - slope * (1.0 - weight), (0.5 * slope / _FOOT) * foot * foot)
