"""Surfaces as the steps of the pipeline hand them on, and the frame that they make, continued over its border."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..tensors import is_traced
from .border import continued
from .layer_weights import blur_axis, eased, ramps, weights_at_or_behind

__all__ = ["HIDDEN_WEIGHT", "Frame", "Highlights", "Placed", "Surface", "framed", "going_on"]

HIDDEN_WEIGHT = 0.003
"""Weight of a hidden sample against 1 of a visible one."""

_HAIR = 0.06
"""Share of a surface up to which, in a layer, it does not yet hide what is known behind it."""
_GOES_ON = 0.1
"""Share of a pixel, beyond a hidden one's, from which on its farther surface goes on wholly behind the nearer one."""


class Surface(NamedTuple):
    """What a surface contributes to each pixel: light ``[B, C, H, W]``, signed coc and weight ``[B, 1, H, W]``.

    The weight is the part of the pixel that it covers; None is 1.
    """

    light: Tensor
    coc_px: Tensor
    weight: Tensor | None = None


class Highlights(NamedTuple):
    """Light ``[C, n]`` extracted from one surface at pixels ``[n]`` (:mod:`torchdof.pixels`), and their coc."""

    pixels: Tensor
    light: Tensor
    coc_px: Tensor


class Placed(NamedTuple):
    """A surface continued over the frame's border; ``x`` is its place on the blur axis."""

    light: Tensor
    x: Tensor
    weight: Tensor | None = None


@dataclasses.dataclass(frozen=True)
class Frame:
    """Surfaces of a frame, continued over its border; what the layers scatter is cut out of it.

    Args:
        surfaces: ``[B, ., h + 2 margin, w + 2 margin]`` where ``h, w`` is the area; stacked ones are near to far.
        nodes: Places of the layers on the blur axis, near to far.
        ramps: Of these, as :func:`torchdof.render.layer_weights.ramps` gives them.
        behind: Light behind all surfaces, ``[B, C, h, w]``; None: nothing is.
        margin: Pixels on each side, as many as the widest kernel reaches.
        area: Height and width, continued to whole blocks of the coarsest layer.
        size: Height and width of the image.
        occlusion: Layers occlude each other, and the ramps between them are eased.
        stacked: The surfaces of a pixel, near to far, each cover it by their weight, whatever the others do. False:
            their weights sum to at most 1.
    """

    surfaces: Sequence[Placed]
    nodes: Sequence[float]
    ramps: Tensor
    behind: Tensor | None
    margin: int
    area: tuple[int, int]
    size: tuple[int, int]
    occlusion: bool
    stacked: bool = False

    @property
    def colours(self) -> int:
        """C."""
        return int(self.surfaces[0].light.shape[1])

    def cut(self, values: Tensor, halo: int) -> Tensor:
        """The part of a map of the frame that reaches so far beyond its area."""
        start = self.margin - halo
        return values[..., start : start + self.area[0] + 2 * halo, start : start + self.area[1] + 2 * halo]

    def near_to_far(self) -> "Frame":
        """The same with the nearer one of two surfaces first, pixel by pixel."""
        if self.stacked or len(self.surfaces) == 1:
            return self
        own, other = self.surfaces
        is_nearer = other.x < own.x
        pairs = [(a, b) for a, b in zip(own, other, strict=True) if a is not None and b is not None]
        near = Placed(*(torch.where(is_nearer, b, a) for a, b in pairs))
        far = Placed(*(torch.where(is_nearer, a, b) for a, b in pairs))
        return dataclasses.replace(self, surfaces=[near, far])

    def occupied(self) -> list[bool]:
        """Whether anything lies in each layer; in traced code, which cannot look, anything may."""
        count = len(self.nodes)
        if is_traced():
            return [True] * count
        x = torch.stack([s.x for s in self.surfaces])
        axis = x.new_tensor(self.nodes)
        nearer = (torch.bucketize(x, axis, right=True) - 1).clamp(0, count - 1)  # the node at or before
        counts = torch.bincount((2 * nearer + (x > axis[nearer])).flatten(), minlength=2 * count).tolist()
        return [any(counts[max(2 * k - 1, 0) : 2 * k + 2]) for k in range(count)]

    def any_between(self, low: float, high: float, halo: int) -> Tensor:
        """Whether anything, up to so far beyond the area, lies between two places on the blur axis: a bool ``[]``."""
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        x = torch.cat([s.x for s in self.surfaces], 1)
        return (self.cut(x, halo) - middle).abs().min() < half

    def layers(self, first: int, count: int, halo: int) -> tuple[Tensor, Tensor, Tensor]:
        """What layers that follow each other scatter, with so many pixels beyond the area.

        It is their light ``m_k I``, ``[B, n, C, h, w]``, its weight ``m_k`` and the weight behind them ``M_k - m_k``,
        ``[B, n, 1, h, w]``.
        """
        surfaces = [Placed(*(self.cut(t, halo) for t in s if t is not None)) for s in self.surfaces]
        weights = [weights_at_or_behind(s.x, self.ramps[:, first : first + count + 1]) for s in surfaces]
        if self.occlusion:
            weights = [eased(weight) for weight in weights]
        pairs = [(weight[:, :-1, None], weight[:, 1:, None]) for weight in weights]
        surfaces = [Placed(*(t.unsqueeze(1) for t in s if t is not None)) for s in surfaces]
        return (_stacked if self.stacked else _mixed)(surfaces, pairs)


def going_on(cover: Tensor) -> Tensor:
    """What the farther surface of a mixed pixel, of which it covers so much, may count more: behind the nearer one."""
    return (1.0 - cover) * ((cover - HIDDEN_WEIGHT) / _GOES_ON).clamp(0.0, 1.0)


def _mixed(surfaces: Sequence[Placed], pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """``m_k I``, ``m_k`` and ``M_k - m_k`` of one surface, or of two that share their pixels, near to far.

    Each is a sum over the surfaces. The farther one of a mixed pixel goes on behind the nearer one: in layers behind
    that one it counts whole. Where the nearer one lies in a layer itself, or behind it, both count by their shares, for
    else a surface that spans several layers would be open at its edge.

    Pairs are how much of each surface lies at or behind layers k, and behind them, ``[B, n, 1, h, w]``.
    """
    sums: list[Tensor] = []
    nearer: Tensor | None = None
    for (light, _, cover), (behind, beyond) in zip(surfaces, pairs, strict=True):
        own = behind - beyond
        if cover is not None:
            if nearer is not None:
                cover = cover + going_on(cover) * (1.0 - (nearer / _HAIR).clamp(0.0, 1.0))
            beyond, own = beyond * cover, own * cover
        terms = [light * own, own, beyond]
        sums = [a + b for a, b in zip(sums, terms, strict=True)] if sums else terms
        nearer = behind
    return sums[0], sums[1], sums[2]


def _stacked(surfaces: Sequence[Placed], pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """The same of surfaces that cover a pixel independently, near to far.

    A pixel counts for layer k as far as what is at or behind it is known, but for what that has in front. A surface of
    which only a hair lies there is in front of it.
    """
    visible = torch.ones_like(surfaces[0].x)
    arriving = unknown = visible
    stopped = []
    for (_, x, weight), (behind, beyond) in zip(surfaces, pairs, strict=True):
        cover = torch.ones_like(x) if weight is None else weight
        here = cover * eased((behind / _HAIR).clamp(max=1.0))
        passes = 1.0 - here * (1.0 - behind)  # what layers in front leave
        stops = cover * (behind - beyond) / passes.clamp_min(1e-6)  # of what arrives at the surface in this layer
        stopped.append(arriving * stops)
        arriving, visible = arriving * (1.0 - stops), visible * passes
        unknown = unknown * (1.0 - here)
    light = torch.stack([s.light * (visible * part) for s, part in zip(surfaces, stopped, strict=True)]).sum(0)
    own = visible * torch.stack(stopped).sum(0)
    return light, own, visible * (1.0 - unknown) - own


def framed(
    surfaces: Sequence[Surface],
    behind: Tensor | None,
    nodes: Sequence[float],
    margin: int,
    multiple: int,
    occlusion: bool,
    stacked: bool,
    lit: bool = True,
    limit: Tensor | None = None,
    image: int | None = 0,
) -> Frame:
    """Surfaces of an image as a frame: they go on beyond the border as they are at it (:mod:`torchdof.render.border`).

    Args:
        surfaces: Near to far if stacked; else one, or the two that share each pixel.
        nodes: As in :class:`Frame`; surfaces beyond the outermost ones belong to these.
        behind: Light behind all of them, ``[B, C, H, W]``; None: nothing is.
        margin: As in :class:`Frame`.
        multiple: What the sides of the area must be multiples of: of the coarsest layer's pixel at least.
        occlusion: As in :class:`Frame`.
        stacked: As in :class:`Frame`.
        lit: Light goes on beyond the border as well; False: nothing comes from there.
        limit: Largest light that is no highlight's, ``[B, 1, H, W]``; None: all of it goes on.
        image: Which of the surfaces each pixel of the image has; None: they are layers, each seen everywhere.
    """
    size = (surfaces[0].light.shape[-2], surfaces[0].light.shape[-1])
    height, width = ((n + multiple - 1) // multiple * multiple for n in size)
    beyond = (0, width - size[1], 0, height - size[0])  # right and below, to whole blocks
    ends = (margin, margin + beyond[1], margin, margin + beyond[3])
    lights, cocs, weights = zip(*surfaces, strict=True)
    x = blur_axis(torch.cat(cocs)).clamp(nodes[0], nodes[-1])
    light, cover = torch.cat(lights), None
    if any(weight is not None for weight in weights):
        cover = torch.cat([torch.ones_like(cocs[0]) if weight is None else weight for weight in weights])
    if lit:
        image_x = None if image is None else x.unflatten(0, (len(surfaces), -1))[image]
        light = continued(light, cover, limit, ends, margin + multiple - 1, x, image_x, len(surfaces))
    else:
        light = functional.pad(light, ends)
    x = functional.pad(x if cover is None else torch.cat([x, cover], 1), ends, mode="replicate")
    maps = [light, *x.split(1, 1)]
    placed = [Placed(*parts) for parts in zip(*(t.unflatten(0, (len(surfaces), -1)) for t in maps), strict=True)]
    if behind is not None:
        behind = functional.pad(behind, beyond, mode="replicate")
    return Frame(placed, nodes, ramps(nodes, placed[0].x), behind, margin, (height, width), size, occlusion, stacked)
