"""Layers, far to near, to one image: each layer is scattered with its kernel and laid over what is behind it."""

from collections.abc import Callable, Iterator

import torch
import torch.nn.functional as functional
from torch import Tensor

from .frame import Frame
from .plan import Blur, Plan
from .spread import Spread, fold

__all__ = ["accumulate", "accumulate_once", "over"]

Canvas = tuple[Tensor, Tensor]  # light and coverage
Lay = Callable[[Tensor, Tensor, list[Tensor]], Canvas]

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

    def lay(out: Tensor, covered: Tensor, parts: list[Tensor]) -> Canvas:
        light, share, room = parts[0], parts[1], parts[2].clamp_min(_LEAST)
        coverage = (share / room).clamp(0.0, 1.0)
        colour = light / room
        if len(parts) > 3:  # light that was not seen: the colour of what was, fading out with the last of it
            floor = share.clamp(_LEAST**2, _LEAST)
            colour = colour * (share / torch.maximum(parts[3], floor))
            coverage = coverage * (parts[3] / floor).clamp(max=1.0)
        left = 1.0 - coverage
        return torch.addcmul(colour, left, out), 1.0 - left + left * covered

    out, covered = _lay_all(frame, plan, blurs, spread, True, lay)
    return frame.image(torch.where(covered > _LEAST, out / covered.clamp_min(_LEAST), 0.0))


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

    def lay(total: Tensor, weight: Tensor, parts: list[Tensor]) -> Canvas:
        return total + parts[0], weight + parts[1]

    total, weight = _lay_all(frame, plan, blurs, spread, False, lay)
    if normalize:
        total = torch.where(weight > _LEAST, total / weight.clamp_min(_LEAST), 0.0)
    return frame.image(total)


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
    total, weight = scattered[:, : light.shape[1]], scattered[:, light.shape[1] :]
    if normalize:
        total = torch.where(weight > _LEAST, total / weight.clamp_min(_LEAST), 0.0)
    return frame.image(total)


def _lay_all(frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread, with_room: bool, lay: Lay) -> Canvas:
    """Lay all layers, far to near, on an empty canvas."""
    canvas = frame.canvas(blurs[0].kernel.shape[0])
    for group in frame.groups(plan, blurs):

        def laid(out: Tensor, covered: Tensor, group: list[int] = group) -> Canvas:
            for tiles, parts in _spread_group(frame, plan, blurs, spread, with_room, group):
                if tiles is None:
                    out, covered = lay(out, covered, parts)
                else:
                    out[tiles], covered[tiles] = lay(out[tiles], covered[tiles], parts)
            return out, covered

        if torch.compiler.is_exporting():  # a graph cannot choose its work beforehand: each group becomes a branch
            needed = frame.any_share(plan, group, max(blurs[k].halo for k in group))
            canvas = torch.cond(needed, _dense(laid), _untouched, canvas)
        else:
            canvas = laid(*canvas)
    return canvas


def _dense(laid: Callable[[Tensor, Tensor], Canvas]) -> Callable[[Tensor, Tensor], Canvas]:
    """Both branches of a condition must lie in memory the same way."""

    def dense(out: Tensor, covered: Tensor) -> Canvas:
        out, covered = laid(out, covered)
        kept = torch.contiguous_format
        return out.clone(memory_format=kept), covered.clone(memory_format=kept)

    return dense


def _untouched(out: Tensor, covered: Tensor) -> Canvas:
    return out.clone(), covered.clone()


def _spread_group(
    frame: Frame, plan: Plan, blurs: list[Blur], spread: Spread, with_room: bool, group: list[int]
) -> Iterator[tuple[Tensor | None, list[Tensor]]]:
    """Scattered light, share, room (share at or behind) and seen share of layers, far to near, tiles by tiles."""
    halo = max(blurs[k].halo for k in group)
    for tiles, window in frame.windows(group, halo):
        terms = [window.terms(plan.nodes, k, with_room) for k in group]
        if blurs[group[0]].kernel.shape[0] > 1:
            colours = terms[0][0].shape[1]
            terms = [[part.expand(-1, colours, -1, -1) for part in parts] for parts in terms]
        lengths = [part.shape[1] for parts in terms for part in parts]
        kernels = [(blurs[k], sum(p.shape[1] for p in parts)) for k, parts in zip(group, terms, strict=True)]
        scattered = spread(torch.cat([p for parts in terms for p in parts], 1), kernels, halo).split(lengths, 1)
        each = len(terms[0])
        for i in range(0, len(scattered), each):
            yield tiles, [frame.at(part, tiles) for part in scattered[i : i + each]]
