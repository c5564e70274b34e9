"""Layers, far to near, to one image: each layer is scattered with its kernel and laid over what is behind it."""

import itertools
from collections.abc import Callable, Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .coarse import Coarse
from .frame import TILE, TILES_AT_ONCE, Frame, alike, cut_tiles
from .plan import Blur, Plan
from .spread import Spread, fold

__all__ = ["accumulate", "accumulate_once", "over"]

Settle = Callable[[Tensor], Tensor]
"""A scattered layer -> what it puts on a canvas.

A layer is scattered light ``[B, C, H, W]`` and, after it, share, room (the share at or behind the layer) and the share
that was seen, where any was not. A canvas is light and its coverage: one for all colours, or one each where they have
kernels of their own.
"""

Join = Callable[[Tensor, Tensor], Tensor]
"""What is in front, and the canvas behind it -> both on one canvas."""

_LEAST = 1e-6  # share of scattered weight below which nothing is known


def over(frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread) -> Tensor:
    """Normalised "over" of soft layers.

    With ``m_k`` the share of layer k, ``M_k`` the share at or behind it and ``K_k`` its kernel:
    ``colour = K_k * (m_k I) / K_k * M_k``, coverage ``a = K_k * m_k / K_k * M_k``, ``out = colour + (1 - a) out``.
    Dividing by ``K_k * M_k`` keeps a surface that spans several layers closed and lets the background reach under the
    blurred edge of what is in front. Outside the frame surfaces go on as they are at the border, but their light is
    unknown and weighs nothing: colours are means over what was seen. Where all layers leave a pixel uncovered, what is
    behind them shows.

    Args:
        frame: The surfaces seen in each pixel.
        plan: Where the layers are.
        blurs: Kernel and resolution of each layer.
        spread: How a layer is scattered.

    Returns:
        ``[B, C, H, W]``.

    Reference:
        Ikoma, Nguyen, Metzler, Peng, Wetzstein, "Depth from defocus with learned optics", ICCP 2021.
    """
    colours, each = frame.colours, blurs[0].kernel.shape[0]

    def settle(layer: Tensor) -> Tensor:
        light_and_share, room, seen = layer.tensor_split((colours + each, colours + 2 * each), 1)
        room = room.clamp_min(_LEAST)
        if seen.shape[1]:  # light that was not seen: the colour of what was, fading out with the last of it
            light, share = light_and_share.tensor_split((colours,), 1)
            floor = share.clamp(_LEAST**2, _LEAST)
            light = light * (share / torch.maximum(seen, floor))
            light_and_share = torch.cat([light, share * (seen / floor).clamp(max=1.0)], 1)
        return light_and_share / _each(room, colours)

    def join(front: Tensor, canvas: Tensor) -> Tensor:
        left = (1.0 - front[:, colours:]).clamp_min(0.0)
        return torch.addcmul(front, _each(left, colours), canvas)

    canvas = _lay_all(frame, plan, blurs, spread, True, settle, join)
    behind = frame.behind
    return frame.image(_mean(canvas, colours) if behind is None else frame.over_behind(canvas, behind))


def accumulate(
    frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread, normalize: bool, traced: Tensor | None = None
) -> Tensor:
    """The paper's scatter: every pixel's light accumulates, whatever lies in front; then divided by the weights' sum.

    Args:
        frame: The surfaces seen in each pixel.
        plan: Where the layers are.
        blurs: Kernel and resolution of each layer.
        spread: How a layer is scattered.
        normalize: False leaves the plain sum, which is dark at the frame's border and uneven at depth edges.
        traced: Light that was taken out of the layers and accumulated ray by ray, ``[B, C, H, W]``.

    Returns:
        ``[B, C, H, W]``.

    Reference:
        Sato, Dobashi, Yamamoto, section 3.
    """
    colours = frame.colours
    canvas = _lay_all(frame, plan, blurs, spread, False, lambda layer: layer, torch.add)
    if traced is None:
        return frame.image(_mean(canvas, colours) if normalize else canvas[:, :colours])
    light, covered = frame.image(canvas).tensor_split((colours,), 1)
    light = light + traced
    return _mean(torch.cat([light, covered], 1), colours) if normalize else light


def accumulate_once(frame: Frame, plan: Plan, blurs: list[Blur], normalize: bool) -> Tensor:
    """The same scatter as :func:`accumulate`, as the paper does it: one pass, in which each pixel has its own kernel.

    Args:
        frame: The surface seen in each pixel; not tiled.
        plan: Where the layers are; a pixel's kernel is interpolated between the nodes around its coc.
        blurs: Kernel of each layer, at full resolution.
        normalize: As in :func:`accumulate`.

    Returns:
        ``[B, C, H, W]``.

    Reference:
        Sato, Dobashi, Yamamoto, section 3: (a) read the depth, (b) choose its blur texture, (c) multiply and
        accumulate.
    """
    halo = frame.margin
    window = frame.whole(halo)
    terms = [window.terms(plan.nodes, k, with_room=True)[1] for k in range(len(plan.nodes))]
    kernels = torch.stack([functional.pad(b.kernel, (halo - b.half,) * 4) for b in blurs])  # [n, 1 or C, k, k]
    light = window.samples[0].light
    known = torch.ones_like(light) if window.known is None else window.known.expand_as(light)
    if kernels.shape[1] == 1:
        scattered = fold(torch.cat([light, known[:, :1]], 1), kernels, torch.cat(terms, 1))
    else:
        scattered = fold(torch.cat([light, known], 1), kernels.repeat(1, 2, 1, 1), torch.cat(terms, 1))
    scattered = scattered[..., halo : scattered.shape[-2] - halo, halo : scattered.shape[-1] - halo]
    return frame.image(_mean(scattered, frame.colours) if normalize else scattered[:, : frame.colours])


def _mean(canvas: Tensor, colours: int) -> Tensor:
    """Light over its coverage; 0 where nothing is known."""
    light, covered = canvas.tensor_split((colours,), 1)
    return light / torch.where(covered > _LEAST, covered, torch.inf)


def _each(share: Tensor, colours: int) -> Tensor:
    """One value for light and coverage, or those of the colours twice."""
    return share if share.shape[1] == 1 else share.repeat(1, 2, 1, 1)


def _lay_all(
    frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread, with_room: bool, settle: Settle, join: Join
) -> Tensor:
    """Lay all layers, far to near, on what is behind them.

    Neighbouring layers of one coarser resolution are laid on a canvas of that resolution first.
    """
    exporting, kernels = torch.compiler.is_exporting(), blurs[0].kernel.shape[0]
    canvas = frame.canvas(kernels)

    def lay(layer: Tensor, canvas: Tensor) -> Tensor:
        return join(settle(layer), canvas)

    for groups in _runs(frame.groups(plan, blurs), plan, blurs):
        scale = blurs[groups[0][0]].scale
        layers = [k for group in groups for k in group]
        part: Frame | Coarse = frame
        if frame.tiled and scale == 1:
            _lay_patches(frame, plan, blurs, spread, with_room, layers, canvas, lay)
            continue
        if frame.tiled:
            half = max(blurs[k].half for k in layers)
            part = Coarse(frame, scale, half, plan, range(min(layers), max(layers) + 1), with_room)
            own = part.canvas(kernels)
        else:
            own = canvas if scale == 1 else frame.canvas(kernels, scale)
        for group in groups:

            def laid(canvas: Tensor, part: Frame | Coarse = part, group: list[int] = group) -> Tensor:
                for tiles, layer in _scattered(part, plan, blurs, spread, with_room, group):
                    canvas = _lay_at(canvas, tiles, layer, lay)
                return canvas

            own = _where_needed(laid, frame, plan, blurs, group, own) if exporting else laid(own)
        if scale == 1:
            canvas = own
        elif isinstance(part, Coarse):
            _join_finer(part.image(own), scale, canvas, frame.colours, join)
        else:

            def joined(canvas: Tensor, own: Tensor = own, scale: int = scale) -> Tensor:
                return join(_finer(own, scale), canvas)

            canvas = _where_needed(joined, frame, plan, blurs, layers, canvas) if exporting else joined(canvas)
    return canvas


def _lay_patches(
    frame: Frame,
    plan: Plan,
    blurs: list[Blur],
    spread: Spread,
    with_room: bool,
    layers: list[int],
    canvas: Tensor,
    lay: Callable[[Tensor, Tensor], Tensor],
) -> None:
    """Lay neighbouring layers of full resolution, patch by patch, but those that spread over the frame one by one."""
    for wide, some in itertools.groupby(layers, lambda k: frame.is_wide(k, blurs[k].halo)):
        if wide:
            for k in some:
                for tiles, layer in _scattered(frame, plan, blurs, spread, with_room, [k]):
                    _lay_at(canvas, tiles, layer, lay)
            continue
        for patch in frame.patches(blurs, list(some)):
            own = canvas.index_select(0, patch.tiles)
            for k, its in patch.layers:
                window = patch.window.part(its, patch.halo - blurs[k].halo)
                (layer,) = _spread([window.terms(plan.nodes, k, with_room)], blurs, [k], spread)
                own = _lay_at(own, its, layer, lay)
            canvas.index_copy_(0, patch.tiles, own)


def _lay_at(
    canvas: Tensor, tiles: Tensor | slice | None, layer: Tensor, lay: Callable[[Tensor, Tensor], Tensor]
) -> Tensor:
    """Lay a scattered layer on tiles of a canvas, which are changed, or on all of it."""
    if tiles is None:
        return lay(layer, canvas)
    if isinstance(tiles, slice):
        canvas[tiles] = lay(layer, canvas[tiles])
        return canvas
    return canvas.index_copy_(0, tiles, lay(layer, canvas.index_select(0, tiles)))


def _runs(groups: list[list[int]], plan: Plan, blurs: list[Blur]) -> list[list[list[int]]]:
    """Neighbouring groups of one resolution together."""
    runs: list[list[list[int]]] = []
    for group in groups:
        if runs and alike(plan, blurs, runs[-1][0][0], group[0]):
            runs[-1].append(group)
        else:
            runs.append([group])
    return runs


def _where_needed(
    laid: Callable[[Tensor], Tensor], frame: Frame, plan: Plan, blurs: list[Blur], group: list[int], canvas: Tensor
) -> Tensor:
    """A graph cannot choose its work beforehand: each group becomes a branch, taken where its light falls."""
    needed = frame.any_share(plan, group, max(blurs[k].halo for k in group))

    def dense(canvas: Tensor) -> Tensor:  # both branches must lie in memory the same way
        return laid(canvas).clone(memory_format=torch.contiguous_format)

    return torch.cond(needed, dense, torch.clone, (canvas,))


def _finer(canvas: Tensor, scale: int) -> Tensor:
    """A coarser canvas, which has a pixel more on each side, at the frame's resolution."""
    fine = functional.interpolate(canvas, scale_factor=float(scale), mode="bilinear", align_corners=False)
    return fine[..., scale : fine.shape[-2] - scale, scale : fine.shape[-1] - scale]


def _join_finer(front: Tensor, scale: int, canvas: Tensor, colours: int, join: Join) -> None:
    """Join what is on a coarser canvas with one in tiles, in the tiles that it reaches."""
    step = TILE // scale
    there = front[0, colours:].amax(0).unfold(0, step + 2, step).unfold(1, step + 2, step).amax((2, 3)) > 0
    for tiles in there.flatten().nonzero()[:, 0].split(TILES_AT_ONCE):
        if len(tiles):
            _lay_at(canvas, tiles, _finer(cut_tiles(front, 1, tiles, step), scale), join)


def _scattered(
    part: Frame | Coarse, plan: Plan, blurs: list[Blur], spread: Spread, with_room: bool, group: list[int]
) -> Iterator[tuple[Tensor | None, Tensor]]:
    """Scattered layers, far to near, tiles by tiles."""
    for tiles, layers in part.terms(plan, blurs, group, with_room):
        for layer in _spread(layers, blurs, group, spread):
            yield tiles, part.at(layer, tiles) if isinstance(part, Frame) else layer


def _spread(layers: list[list[Tensor]], blurs: list[Blur], group: list[int], spread: Spread) -> Sequence[Tensor]:
    """What layers of a group scatter -> scattered."""
    half, each = max(blurs[k].half for k in group), blurs[group[0]].kernel.shape[0]
    if each > 1:
        layers = [[term.expand(-1, each, -1, -1) for term in terms] for terms in layers]
    lengths = [sum(term.shape[1] for term in terms) for terms in layers]
    kernels = [(blurs[k], length) for k, length in zip(group, lengths, strict=True)]
    return spread(torch.cat([term for terms in layers for term in terms], 1), kernels, half).split(lengths, 1)
