"""Signed circle of confusion to soft layers: how much of each pixel's light each layer carries.

Layers sit at nodes of signed coc, ``nodes[0] < nodes[1] < ...``, so from the nearest to the farthest. A pixel between
two nodes is divided linearly, which makes the picture continuous and differentiable in depth, focus and aperture. All
of it follows from one ramp: the weight of a pixel at or behind node k is
``clamp((x - nodes[k-1]) / (nodes[k] - nodes[k-1]))``; its weight in layer k is the difference of two ramps.

Nodes live on the *blur axis* ``x = sign(coc) * max(sqrt(coc^2 + 0.5^2) - 0.5 - 1e-4, 0)``. Far from focus it goes as
the coc does, near focus as its square, which is how the light goes that a small kernel moves. So a mixture of the
sharp layer, at x = 0, and the first blurred one stands for the blurs between them. What lies at x = 0 is in focus and
passes through unchanged: |coc| < 0.01 px, where a disc would move 1e-4 of the light.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["blur_axis", "from_blur_axis", "weight_at_or_behind"]

_ROUND_PX = 0.5  # coc at which the axis goes over from the square to the coc itself
_IN_FOCUS = 1e-4  # share of the light that a disc moves where focus ends


def blur_axis(coc_px: Tensor) -> Tensor:
    """Place on the blur axis of a signed coc, any shape; 0 wherever the pixel is in focus."""
    return coc_px.sign() * ((coc_px**2 + _ROUND_PX**2).sqrt() - (_ROUND_PX + _IN_FOCUS)).clamp_min(0.0)


def from_blur_axis(x: float) -> float:
    """Signed coc in pixels at a place on the blur axis; 0 in focus."""
    beyond = abs(x) + _IN_FOCUS
    return 0.0 if x == 0 else math.copysign(math.sqrt(beyond * (beyond + 2.0 * _ROUND_PX)), x)


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
