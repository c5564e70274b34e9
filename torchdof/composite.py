"""Layers, far to near, to one image: each layer is scattered with its kernel and laid over what is behind it."""

from collections.abc import Callable, Iterator

import torch
import torch.nn.functional as functional
from torch import Tensor

from .frame import Frame
from .plan import Blur, Plan
from .spread import Spread, fold

__all__ = ["accumulate", "accumulate_once", "over"]

Lay = Callable[[Tensor, Tensor], Tensor]
"""What lies on a canvas, and a scattered layer -> what lies on it then.

A canvas is light ``[B, C, H, W]`` and, after it, its coverage: one for all colours, or one each where they have kernels
of their own. A layer is scattered light, share, room (the share at or behind the layer) and the share that was seen,
where any was not.
"""

_LEAST = 1e-6  # share of scattered weight below which nothing is known


def over(frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread) -> Tensor:
    """Normalised "over" of soft layers.

    With ``m_k`` the share of layer k, ``M_k`` the share at or behind it and ``K_k`` its kernel:
    ``colour = K_k * (m_k I) / K_k * M_k``, coverage ``a = K_k * m_k / K_k * M_k``, ``out = colour + (1 - a) out``.
    Dividing by ``K_k * M_k`` keeps a surface that spans several layers closed and lets the background reach under the
    blurred edge of what is in front. Outside the frame surfaces go on as they are at the border, but their light is
    unknown and weighs nothing: colours are means over what was seen.

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

    def lay(canvas: Tensor, layer: Tensor) -> Tensor:
        light_and_share, room, seen = layer.tensor_split((colours + each, colours + 2 * each), 1)
        room = room.clamp_min(_LEAST)
        if seen.shape[1]:  # light that was not seen: the colour of what was, fading out with the last of it
            light, share = light_and_share.tensor_split((colours,), 1)
            floor = share.clamp(_LEAST**2, _LEAST)
            light = light * (share / torch.maximum(seen, floor))
            light_and_share = torch.cat([light, share * (seen / floor).clamp(max=1.0)], 1)
        laid = light_and_share / _each(room, colours)
        left = (1.0 - laid[:, colours:]).clamp_min(0.0)
        return torch.addcmul(laid, _each(left, colours), canvas)

    canvas = _lay_all(frame, plan, blurs, spread, True, lay)
    return frame.image(_mean(canvas, colours))


def accumulate(frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread, normalize: bool) -> Tensor:
    """The paper's scatter: every pixel's light accumulates, whatever lies in front; then divided by the weights' sum.

    Args:
        frame: The surfaces seen in each pixel.
        plan: Where the layers are.
        blurs: Kernel and resolution of each layer.
        spread: How a layer is scattered.
        normalize: False leaves the plain sum, which is dark at the frame's border and uneven at depth edges.

    Returns:
        ``[B, C, H, W]``.

    Reference:
        Sato, Dobashi, Yamamoto, section 3.
    """

    colours = frame.colours

    def lay(canvas: Tensor, layer: Tensor) -> Tensor:
        return canvas + layer

    canvas = _lay_all(frame, plan, blurs, spread, False, lay)
    return frame.image(_mean(canvas, colours) if normalize else canvas[:, :colours])


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
    ((_, window),) = frame.windows([0], halo)
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
    return torch.where(covered > _LEAST, light / covered.clamp_min(_LEAST), 0.0)


def _each(share: Tensor, colours: int) -> Tensor:
    """One value for light and coverage, or those of the colours twice."""
    return share if share.shape[1] == 1 else share.repeat(1, 2, 1, 1)


def _lay_all(frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread, with_room: bool, lay: Lay) -> Tensor:
    """Lay all layers, far to near, on an empty canvas."""
    canvas = frame.canvas(blurs[0].kernel.shape[0])
    for group in frame.groups(plan, blurs):

        def laid(canvas: Tensor, group: list[int] = group) -> Tensor:
            for tiles, layer in _spread_group(frame, plan, blurs, spread, with_room, group):
                if tiles is None:
                    canvas = lay(canvas, layer)
                else:
                    canvas.index_copy_(0, tiles, lay(canvas.index_select(0, tiles), layer))
            return canvas

        if torch.compiler.is_exporting():  # a graph cannot choose its work beforehand: each group becomes a branch
            needed = frame.any_share(plan, group, max(blurs[k].halo for k in group))
            canvas = torch.cond(needed, _dense(laid), torch.clone, (canvas,))
        else:
            canvas = laid(canvas)
    return canvas


def _dense(laid: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Both branches of a condition must lie in memory the same way."""
    return lambda canvas: laid(canvas).clone(memory_format=torch.contiguous_format)


def _spread_group(
    frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread, with_room: bool, group: list[int]
) -> Iterator[tuple[Tensor | None, Tensor]]:
    """Scattered layers, far to near, tiles by tiles."""
    halo = max(blurs[k].halo for k in group)
    for tiles, window in frame.windows(group, halo):
        terms = [window.terms(plan.nodes, k, with_room) for k in group]
        if blurs[group[0]].kernel.shape[0] > 1:
            terms = [[part.expand(-1, frame.colours, -1, -1) for part in parts] for parts in terms]
        lengths = [sum(part.shape[1] for part in parts) for parts in terms]
        kernels = [(blurs[k], length) for k, length in zip(group, lengths, strict=True)]
        scattered = spread(torch.cat([part for parts in terms for part in parts], 1), kernels, halo)
        for layer in scattered.split(lengths, 1):
            yield tiles, frame.at(layer, tiles)
