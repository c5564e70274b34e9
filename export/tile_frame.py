"""The frame of one tile: the weights of its layers in a form that runtimes compute in few passes over small maps.

A runtime computes each operation in a pass over whole maps, and takes more time for memory than for arithmetic. So each
layer has its own maps of one channel, which stay in the processor's caches, and ramps take five operations, not ten.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchdof.render.layers.layer_weights import FOOT
from torchdof.render.surfaces.frame import HIDING_SHARE, PaddedFrame, PaddedSurface, continuation_weight

from .structure import operator

__all__ = ["TileFrame"]

_LINEAR_PART = (1.0 - FOOT) / (1.0 - 0.5 * FOOT)
"""Part of an eased ramp that its straight piece rises, the rest being its parabola."""

_PARABOLA = (0.5 * FOOT / (1.0 - 0.5 * FOOT)) / _LINEAR_PART  # rise of the parabola, in units of the straight piece
_ROUNDING = 5e-6, 2e-6
"""Parts by which both pieces of a ramp are shortened, more than they round: 0 and 1 at its ends are exact."""


@dataclasses.dataclass(frozen=True)
class TileFrame(PaddedFrame):
    """A window of a :class:`PaddedFrame`, with the same layers to 1e-6."""

    def near_to_far(self) -> "TileFrame":
        """As in :class:`PaddedFrame`, by arithmetic: ``Where`` takes several times as long as the sums here."""
        if self.stacked or len(self.surfaces) == 1:
            return self
        own, other = self.surfaces
        is_nearer = (other.x < own.x).to(own.x.dtype)
        nears, fars = [], []
        for a, b in zip(own, other, strict=True):
            if a is not None and b is not None:
                change = is_nearer * (b - a)  # 0 where nothing is to change, so that light stays exact there
                nears.append(torch.minimum(a, b) if a is own.x else a + change)
                fars.append(torch.maximum(a, b) if a is own.x else b - change)
        return dataclasses.replace(self, surfaces=[PaddedSurface(*nears), PaddedSurface(*fars)])

    def layers(self, first: int, count: int, halo: int) -> tuple[Tensor, Tensor, Tensor]:
        """As in :class:`PaddedFrame`.

        With ``e_k`` the ramp of layer k in units of :data:`_LINEAR_PART`, and covers in its inverse, the weights at or
        behind a layer are ``cover e_k``: products with the unit are left out.
        """
        near, far = self.surfaces[0], self.surfaces[-1]
        if not self.occlusion or near is far or near.weight is None or far.weight is None:
            return super().layers(first, count, halo)
        continued = continuation_weight(far.weight)
        maps = (
            *(near.light, near.x, _LINEAR_PART * near.weight),
            *(far.light, far.x, _LINEAR_PART * far.weight),
            _LINEAR_PART * (far.weight + continued),
            (_LINEAR_PART**2 / HIDING_SHARE) * continued,
        )
        light, x, cover, far_light, far_x, least, most, lost = (self.cut(t, halo) for t in maps)
        near_ramps, far_ramps = (self._ramps(first, count, places) for places in (x, far_x))
        shares = [cover * ramp for ramp in near_ramps]
        lights, weights, beyonds = [], [], []
        for k in range(count):
            # the far surface of a mixed pixel continues behind the near one
            far_cover = torch.maximum(most - lost * near_ramps[k], least)
            own, other = shares[k] - shares[k + 1], far_cover * (far_ramps[k] - far_ramps[k + 1])
            lights.append(light * own + far_light * other)
            weights.append(own + other)
            beyonds.append(shares[k + 1] + far_cover * far_ramps[k + 1])
        # [B, n C, h, w] and [B, n, h, w] to those of the base class
        parts = (torch.cat(lights, 1).unflatten(1, (count, -1)), *(torch.cat(p, 1) for p in (weights, beyonds)))
        return parts[0], parts[1].unsqueeze(2), parts[2].unsqueeze(2)

    def _ramps(self, first: int, count: int, x: Tensor) -> Sequence[Tensor]:
        """Eased ramps of some layers and of the next one, in units of :data:`_LINEAR_PART`.

        With t from 0 to 1 along a ramp it is ``g + p f^2``: ``f = clamp(t / FOOT, 0, 1)`` its parabola and
        ``g = clamp((t - FOOT) / (1 - FOOT), 0, 1)`` its straight piece, both one operator of a graph.
        """
        nodes = [float(np.float32(node)) for node in self.nodes[0]]  # as the ramps of the base class
        middle = nodes[min(first + count // 2, len(nodes) - 1)]
        distance = x - middle  # differences of large places would round badly
        ramps = []
        for k in range(first, first + count + 1):
            if k in (0, len(nodes)):  # all pixels are at or behind the first layer, none are behind the last one
                ramps.append(torch.full_like(x, 0.0 if k else 1.0 + _PARABOLA))
                continue
            width = nodes[k] - nodes[k - 1]
            foot, straight = FOOT * width, (1.0 - FOOT) * width
            spare, late = _ROUNDING
            start = nodes[k - 1] - middle
            parabola = _clamped(distance, start + spare * foot, start + foot)
            slope = _clamped(distance, start + foot, start + foot + (1.0 - late) * straight)
            ramps.append(slope + parabola * (_PARABOLA * parabola))
        return ramps


def _clamped(values: Tensor, start: float, end: float) -> Tensor:
    """``clamp((values - start) / (end - start), 0, 1)``."""
    numbers = {"alpha": 1.0 / (end - start), "beta": -start / (end - start)}
    return operator("HardSigmoid", [values], values.shape, numbers)
