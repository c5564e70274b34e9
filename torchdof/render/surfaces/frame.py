"""Surfaces, as the steps of the pipeline exchange them, and the padded frame from which layers are cut."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import native
from ...tensors import is_traced
from ..engines.compiled_steps import compiled_step
from ..layers.layer_weights import blur_axis, eased, ramps, weights_at_or_behind
from ..rules import active
from .border import continued, repeated

HIDDEN_WEIGHT = 0.003
"""Weight of a hidden sample, which is guessed; a visible one has 1. A larger value mixes more guessed light in."""

_HIDING_SHARE = 0.06
"""Share of a surface at or behind a layer at which it counts there in full; larger: it fades in over more depth."""
_SLOPES, _SLOPES_LEAST = 0.35, 1.0
"""A stacked surface may be farther nearby by this part of its place on the blur axis, and by this at least."""
_LESS_BLURRED = 0.85  # blur of a surface that keeps its layers behind another one, over that one's, at most
_LEAST_PASSING = 1e-6  # smallest divisor: share of the light that passes the part of a surface in front of a layer
_CONTINUES_FROM = 0.1
"""Visible share of a far surface, above HIDDEN_WEIGHT, at which it continues in full behind the near one."""

# Surfaces that stand in for the background; distances on the blur axis from the focus to the near side
_AT_FOCUS = 0.4  # where another surface begins to count as one at the focus; larger: fewer pixels need a stand-in
_OFF_FOCUS = 0.05  # from which surfaces stand in in full; larger: it fades in over more depth
_BARELY_BLURRED = 1.5  # up to which surfaces stand in in full, and not at all at twice this; larger: fewer bright lines
_COUNTED = 1.25 / HIDDEN_WEIGHT  # per weight: a little less than a hidden sample's weight takes the place of a stand-in
_SEEN_FROM = 2.0 * HIDDEN_WEIGHT  # weight from which a surface stands in; hidden samples have less


class Surface(NamedTuple):
    """A surface in each pixel: light ``[B, C, H, W]``, signed coc and weight ``[B, 1, H, W]``.

    The weight is the share of the pixel that it covers; None means 1.
    """

    light: Tensor
    coc_px: Tensor
    weight: Tensor | None = None


class Highlights(NamedTuple):
    """Light ``[C, n]`` extracted from one surface at pixels ``[n]`` (:mod:`torchdof.pixels`), and their coc."""

    pixels: Tensor
    light: Tensor
    coc_px: Tensor


class PaddedSurface(NamedTuple):
    """A surface continued beyond the frame's border; ``x`` is its place on the blur axis."""

    light: Tensor
    x: Tensor
    weight: Tensor | None = None


def maps_of(surfaces: Sequence[PaddedSurface]) -> list[Tensor]:
    """Light, place and, where given, weight, surface by surface."""
    return [t for surface in surfaces for t in surface if t is not None]


def surfaces_of(maps: Sequence[Tensor], count: int) -> list[PaddedSurface]:
    """The ``count`` surfaces of :func:`maps_of`."""
    each = len(maps) // count
    return [PaddedSurface(*maps[i : i + each]) for i in range(0, len(maps), each)]


@dataclasses.dataclass(frozen=True)
class PaddedFrame:
    """Surfaces of a frame, continued beyond its border; the layers are cut out of it.

    Args:
        surfaces: ``[B, ., h + 2 margin, w + 2 margin]`` where ``h, w`` is the area; stacked ones are near to far.
        nodes: Places of the layers as for :func:`torchdof.render.layers.layer_weights.ramps`.
        ramps: Its result.
        behind: Light behind all surfaces, ``[B, C, h, w]``; None: there is no such light.
        margin: Pixels added on each side, as many as the widest kernel reaches.
        area: Height and width of the image, extended to whole blocks of the coarsest layer.
        size: Height and width of the image.
        occlusion: Whether layers occlude each other; then the ramps between them are eased.
        stacked: True: each surface covers a pixel by its weight, independently of the others. False: the weights of a
            pixel sum to at most 1.
    """

    surfaces: Sequence[PaddedSurface]
    nodes: Sequence[Sequence[float]]
    ramps: Tensor
    behind: Tensor | None
    margin: int
    area: tuple[int, int]
    size: tuple[int, int]
    occlusion: bool
    stacked: bool = False

    @property
    def colours(self) -> int:
        """Number of colour channels, C."""
        return int(self.surfaces[0].light.shape[1])

    def cut(self, values: Tensor, halo: int) -> Tensor:
        """Crop a map of the frame to its area and ``halo`` pixels around it."""
        start = self.margin - halo
        # the end is counted from the last pixel, because sizes are symbols in a graph
        kept = slice(start, -start or None)
        return values[..., kept, kept]

    def near_to_far(self) -> "PaddedFrame":
        """The same frame with its two surfaces sorted near to far in each pixel."""
        if self.stacked or len(self.surfaces) == 1:
            return self
        own, other = self.surfaces
        is_nearer = other.x < own.x
        pairs = [(a, b) for a, b in zip(own, other, strict=True) if a is not None and b is not None]
        near = PaddedSurface(*(torch.where(is_nearer, b, a) for a, b in pairs))
        far = PaddedSurface(*(torch.where(is_nearer, a, b) for a, b in pairs))
        return dataclasses.replace(self, surfaces=[near, far])

    def occupied(self) -> list[bool]:
        """Whether any pixel lies in each layer; True for all in traced code, where values cannot be read."""
        layers = len(self.nodes[0])
        if is_traced():
            return [True] * layers
        x = torch.stack([s.x for s in self.surfaces], 1).reshape(len(self.nodes), -1)
        axis = x.new_tensor(self.nodes)
        # pixels at each node and behind it; an unused layer has the place of the next used one
        at = (torch.searchsorted(axis, x, right=True) - 1).clamp_min(0)
        is_behind = x > axis.gather(1, at)
        index = 2 * at + is_behind + 2 * layers * torch.arange(len(axis), device=x.device)[:, None]
        counts = torch.bincount(index.flatten(), minlength=2 * layers * len(axis)).tolist()
        occupied = [False] * layers
        for row, places in enumerate(self.nodes):
            of_row = counts[2 * layers * row :][: 2 * layers]
            in_front = 0  # pixels between the used layer before and this one
            for k, (place, following) in enumerate(pairwise([*places, math.inf])):
                if place < following:  # else the layer is unused
                    occupied[k] |= in_front + of_row[2 * k] + of_row[2 * k + 1] > 0
                    in_front = of_row[2 * k + 1]
        return occupied

    def any_between(self, low: float, high: float, halo: int) -> Tensor:
        """Whether a pixel within ``halo`` of the area lies between two places on the blur axis: a bool ``[]``."""
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        x = torch.cat([s.x for s in self.surfaces], 1)
        return (self.cut(x, halo) - middle).abs().min() < half

    def layers(self, first: int, count: int, halo: int) -> tuple[Tensor, Tensor, Tensor]:
        """Light and weights of ``count`` layers from ``first`` on, for the area and ``halo`` pixels around it.

        Returns light ``m_k I``, ``[B, n, C, h, w]``, its weight ``m_k`` and the weight behind it ``M_k - m_k``,
        ``[B, n, 1, h, w]``.
        """
        ramps, pairs = self.ramps[..., first : first + count + 1], []
        for surface in self.surfaces:  # one after the other: on a CPU their maps then stay in its caches
            weights = weights_at_or_behind(self.cut(surface.x, halo), ramps)
            weights = (eased(weights) if self.occlusion else weights).unsqueeze(2)
            pairs.append((weights[:, :-1], weights[:, 1:]))
        surfaces = [PaddedSurface(*(self.cut(t.unsqueeze(1), halo) for t in s if t is not None)) for s in self.surfaces]
        if not self.stacked:
            return _mixed(surfaces, pairs)
        ends = [end_of_surface(self.cut(surface.x, halo)) for surface in self.surfaces]
        nearby = [weights_at_or_behind(end, ramps[..., :-1]).unsqueeze(2) for end in ends]
        return _stacked(surfaces, pairs, nearby)

    def stand_ins(self) -> tuple[Tensor, Tensor]:
        """Stand-ins for the picture at and behind the focus: light ``[B, C, h, w]`` and cover ``[B, 1, h, w]``.

        In front of the focus, kernels become smaller with each layer. A kernel may just reach a farther part of its own
        surface whose smaller kernel does not reach back. The light that passes there would come from far behind, and
        draw a bright line on a dark surface. So a barely blurred surface is its own background, in pixels without
        another surface at the focus or behind it. With ``w`` the weights of a pixel's surfaces and ``x`` their places,
        the cover of surface j is ``seen(w_j) stands_in(x_j) prod(1 - counts(w_i) at_focus(x_i))``, i being the others.
        """
        surfaces = [PaddedSurface(*(self.cut(t, 0) for t in s if t is not None)) for s in self.surfaces]
        x = torch.stack([s.x for s in surfaces])
        weight = torch.stack([torch.ones_like(s.x) if s.weight is None else s.weight for s in surfaces])
        missing = 1.0 - counts(weight) * at_focus(x)
        alone = torch.stack([missing[:j].prod(0) * missing[j + 1 :].prod(0) for j in range(len(surfaces))])
        cover = seen(weight) * stands_in(x) * alone
        if self.stacked:  # a surface covers a part of what nearer ones leave
            left = [torch.ones_like(x[0])]
            for share in weight[:-1]:
                left.append(left[-1] * (1.0 - share))
            cover = cover * torch.stack(left)
        return torch.stack([s.light * part for s, part in zip(surfaces, cover, strict=True)]).sum(0), cover.sum(0)


def at_focus(x: Tensor) -> Tensor:
    """How far a surface at places ``x`` counts as one at the focus or behind it, 0 to 1."""
    return (1.0 + x / _AT_FOCUS).clamp(0.0, 1.0)


def stands_in(x: Tensor) -> Tensor:
    """How far a surface at places ``x`` in front of the focus stands in for its background, 0 to 1."""
    return (2.0 + x / _BARELY_BLURRED).clamp(0.0, 1.0) * (x / -_OFF_FOCUS).clamp(0.0, 1.0)


def seen(weight: Tensor) -> Tensor:
    """Part of a weight that may stand in: 0 for hidden samples, with which a pixel's weights could exceed 1."""
    return (weight - _SEEN_FROM).clamp_min(0.0)


def counts(weight: Tensor) -> Tensor:
    """How far a surface of this weight takes the place of a stand-in, 0 to 1: a hidden sample does."""
    return (weight * _COUNTED).clamp(0.0, 1.0)


def continuation_weight(cover: Tensor) -> Tensor:
    """Extra coverage given to the far surface of a mixed pixel so that it continues behind the near one.

    ``cover`` is the share of the pixel in which it is visible.
    """
    if not active().continuation:
        return torch.zeros_like(cover)
    return (1.0 - cover) * ((cover - HIDDEN_WEIGHT) / _CONTINUES_FROM).clamp(0.0, 1.0)


def visible_part(nearer: Tensor) -> Tensor:
    """Part of that coverage that counts in a layer, where ``nearer`` is the near surface's share at or behind it."""
    return 1.0 - (nearer / _HIDING_SHARE).clamp(0.0, 1.0)


def _mixed(surfaces: Sequence[PaddedSurface], pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """``m_k I``, ``m_k`` and ``M_k - m_k`` of one surface, or of two that share their pixels, near to far.

    Each is a sum over the surfaces. The far surface of a mixed pixel continues behind the near one: it counts in full
    in layers behind the near surface. In the near surface's own layers and those in front, both count by their shares;
    otherwise a surface that spans several layers would have gaps at its edge.

    ``pairs`` holds, for each surface, its shares at or behind layer k and behind it, each ``[B, n, 1, h, w]``.
    """
    sums: list[Tensor] = []
    nearer: Tensor | None = None
    for (light, _, cover), (behind, beyond) in zip(surfaces, pairs, strict=True):
        own = behind - beyond
        if cover is not None:
            if nearer is not None:
                cover = cover + continuation_weight(cover) * visible_part(nearer)
            beyond, own = beyond * cover, own * cover
        terms = [light * own, own, beyond]
        sums = [a + b for a, b in zip(sums, terms, strict=True)] if sums else terms
        nearer = behind
    return sums[0], sums[1], sums[2]


def end_of_surface(x: Tensor) -> Tensor:
    """Farthest place at which a stacked surface at places ``x`` may continue nearby, as one that slopes does."""
    return x + (_SLOPES * x.abs()).clamp_min(_SLOPES_LEAST)


def is_clear(x: Tensor, farther_x: Tensor, cover: Tensor, beyond: Tensor) -> Tensor:
    """How far a layer is clear, 0 to 1, of a surface at places ``farther_x`` that is less blurred than one at ``x``.

    ``beyond`` is the farther surface's share behind the layer, and ``cover`` the part of the pixel that it covers.
    """
    less_blurred = (_LESS_BLURRED * x.abs() - farther_x.abs()).clamp(0.0, 1.0)
    return 1.0 - less_blurred * cover * ((1.0 - beyond) / _HIDING_SHARE).clamp(max=1.0)


def _stacked(
    surfaces: Sequence[PaddedSurface], pairs: Sequence[tuple[Tensor, Tensor]], nearby: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """``m_k I``, ``m_k`` and ``M_k - m_k`` of surfaces that cover a pixel independently, near to far.

    With ``c`` the cover of a surface, ``b`` its share at or behind layer k, ``n`` the same share of
    :func:`end_of_surface`, ``f`` the share :data:`_HIDING_SHARE`, ``e(b) = eased(min(b / f, 1))``, ``q`` the product of
    :func:`is_clear` over the farther surfaces and ``h = c (e(b) + q (e(n) - e(b)))``,

        ``M_k = prod(1 - h (1 - b)) (1 - prod(1 - h))``,

    products over the surfaces: the known part of the pixel at or behind layer k, less the parts of the same surfaces
    in front of it, behind which light from farther surfaces would pass between the layers of a slope. A less blurred
    surface keeps its own layers, as its small kernels reach nothing from beside the pixel. ``q`` has no gradient.
    """
    known = [
        (x, torch.ones_like(x) if weight is None else weight, *pair)
        for (_, x, weight), pair in zip(surfaces, pairs, strict=True)
    ]
    visible = torch.ones_like(surfaces[0].x)
    arriving = unknown = visible
    stopped = []
    for j, ((x, cover, behind, beyond), near) in enumerate(zip(known, nearby, strict=True)):
        clear = torch.ones_like(behind)
        for farther_x, farther_cover, _, farther in known[j + 1 :]:
            clear = clear * is_clear(x, farther_x, farther_cover, farther).detach()
        own, slope = (eased((share / _HIDING_SHARE).clamp(max=1.0)) for share in (behind, near))
        here = cover * (own + clear * (slope - own))
        # share not hidden by the surface's part in front of layer k: 1 - h (1 - b) as a sum of positive terms
        passes = (1.0 - here) + here * behind
        # share of the arriving light stopped in layer k
        stops = cover * (behind - beyond) / passes.clamp_min(_LEAST_PASSING)
        stopped.append(arriving * stops)
        arriving, visible = arriving * (1.0 - stops), visible * passes
        unknown = unknown * (1.0 - here)
    light = torch.stack([s.light * (visible * part) for s, part in zip(surfaces, stopped, strict=True)]).sum(0)
    own = visible * torch.stack(stopped).sum(0)
    return light, own, visible * (1.0 - unknown) - own


class Beyond(NamedTuple):
    """How a frame continues beyond the border of its image."""

    margin: int
    """Pixels added on each side."""
    multiple: int
    """The area is extended to multiples of this many pixels, at least a pixel of the coarsest layer."""
    lit: bool = True
    """Whether light is continued too; False: it is 0 there."""
    limit: Tensor | None = None
    """Largest light that is not a highlight, ``[B, 1, H, W]``: light above it is not continued; None: all is."""


def pad_to_frame(
    surfaces: Sequence[Surface],
    behind: Tensor | None,
    nodes: Sequence[Sequence[float]],
    beyond: Beyond,
    occlusion: bool,
    image: int | None = 0,
) -> PaddedFrame:
    """Continue the surfaces of an image beyond its border to a frame (:mod:`torchdof.render.surfaces.border`).

    Args:
        surfaces: Near to far if stacked; else one surface, or the two that share each pixel.
        behind: As in :class:`PaddedFrame`, as ``nodes``.
        nodes: Surfaces beyond the outermost nodes are clamped to them.
        beyond: How the frame continues.
        occlusion: Whether layers occlude each other.
        image: Index of the image's own surface; None: the surfaces are layers, each known everywhere. Unless it is 0,
            the surfaces are stacked.
    """
    size = (surfaces[0].light.shape[-2], surfaces[0].light.shape[-1])
    margin, multiple, lit, limit = beyond
    height, width = ((n + multiple - 1) // multiple * multiple for n in size)
    to_blocks = (0, width - size[1], 0, height - size[0])  # pixels added right and below
    around = (margin, margin + to_blocks[1], margin, margin + to_blocks[3])
    lights, cocs, weights = zip(*surfaces, strict=True)
    kept = 2 if all(weight is None for weight in weights) else 3
    whole = (torch.ones_like(cocs[0]) if weight is None else weight for weight in weights)
    limit = torch.full_like(cocs[0], torch.finfo(cocs[0].dtype).max) if limit is None else limit
    maps = (*lights, *cocs, *whole, limit)
    farthest = margin + multiple - 1 if lit else None
    plain, found = functools.partial(_continued, nodes, around, farthest, image), None
    if lit and len(nodes) == 1:
        how = (around, nodes[0][0], nodes[0][-1], -1 if image is None else image)
        found = compiled_step(
            lambda *maps: native.continued(maps, *how),
            lambda gradient, *maps: native.continued_gradient(gradient, maps, *how),
            lambda *maps: torch.cat(plain(*maps), 1),
            *maps,
        )
    parts = plain(*maps) if found is None else found.split([lights[0].shape[1], 1, 1] * len(surfaces), 1)
    padded = [PaddedSurface(*parts[k : k + kept]) for k in range(0, len(parts), 3)]
    if behind is not None:
        behind = repeated(behind, to_blocks)
    starts = ramps(nodes, padded[0].x)
    return PaddedFrame(padded, nodes, starts, behind, margin, (height, width), size, occlusion, image != 0)


def _continued(
    nodes: Sequence[Sequence[float]],
    ends: tuple[int, int, int, int],
    farthest: int | None,
    image: int | None,
    *maps: Tensor,
) -> list[Tensor]:
    """Light, place and weight of each surface, continued, from ``maps``: lights, cocs, weights and limit.

    ``farthest`` is the upper limit of ``ends``; None: beyond the border the light is 0.
    """
    count = len(maps) // 3
    x, weight = _places(maps[count : 2 * count], nodes), torch.cat(maps[2 * count : -1])
    if farthest is None:
        lights = [functional.pad(light, ends) for light in maps[:count]]
    else:
        image_x = x if image is None else x.unflatten(0, (count, -1))[image].repeat(count, 1, 1, 1)
        lights = continued(maps[:count], weight, maps[-1], ends, farthest, x, image_x)
    others = (part.unflatten(0, (count, -1)) for part in repeated(torch.cat([x, weight], 1), ends).split(1, 1))
    return [t for parts in zip(lights, *others, strict=True) for t in parts]


def _places(cocs: Sequence[Tensor], nodes: Sequence[Sequence[float]]) -> Tensor:
    """Places of surfaces on the blur axis, clamped to the layers: ``[S B, 1, H, W]``."""
    x = blur_axis(torch.cat(tuple(cocs)))
    if len(nodes) == 1:
        return x.clamp(nodes[0][0], nodes[0][-1])
    ends = [(row[0], max(place for place in row if place < math.inf)) for row in nodes]
    low, high = x.new_tensor(ends).repeat(len(cocs), 1)[..., None, None, None].unbind(1)
    return x.clamp(low, high)
