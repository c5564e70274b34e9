"""Layers, far to near, to one image: each is scattered with its kernel and composited with what is behind it."""

import functools
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from . import field
from .convolution import CHANNELS
from .downsampling import downsampled, upsampled
from .ops import EAGER, Ops
from .plan import Blur
from .scatter import fold
from .surfaces import Frame

__all__ = ["Scatter", "accumulate", "accumulate_once", "mean", "over"]

Scatter = Callable[[Tensor, Tensor, int], Tensor]
"""``(light [B, C, H, W], kernels [1 or C, k, k], halo) -> [B, C, H - 2 halo, W - 2 halo]``."""

Picture = tuple[Tensor, Tensor]
"""Light ``[B, C, h, w]`` and what it is to be weighed with, of one channel or C."""

Pictures = Sequence[Picture]
Lights = Sequence[Tensor]  # named here, for a graph that is compiled reads annotations of inner functions

_LEAST = 1e-6  # share of scattered weight below which nothing is known
_KNOWN = 0.002  # share of scattered weight from which on a layer is known in full


def over(frame: Frame, blurs: Sequence[Blur], scatter: Scatter, ops: Ops = EAGER) -> Tensor:
    """Normalised "over" of soft layers.

    With ``m_k`` the weight of layer k, ``M_k`` the weight at or behind it and ``K_k`` its kernel:
    ``colour = K_k * (m_k I) / K_k * M_k``, coverage ``a = K_k * m_k / K_k * M_k``, ``out = colour + (1 - a) out``.
    Dividing by ``K_k * M_k`` keeps a surface that spans several layers closed and lets the background reach under the
    blurred edge of what is in front. A layer of which next to nothing is known covers next to nothing: without that, a
    hair more or less in it would change the picture. Where all layers leave a pixel uncovered, what is behind them
    shows.

    Args:
        frame: The surfaces seen in each pixel.
        blurs: Kernel and resolution of each layer.
        scatter: How a layer is scattered.
        ops: How layers that nothing lies in are skipped.

    Reference:
        Ikoma, Nguyen, Metzler, Peng, Wetzstein, "Depth from defocus with learned optics", ICCP 2021.
    """
    frame = frame.near_to_far()
    colours, backed = frame.colours, frame.behind is not None

    # Beside light goes the share 1 - a that is left of what is behind, in sums of what is positive: behind bright light
    # the rounding of a difference would show. Where nothing is behind, a itself: what is divided by it in the end.
    def normalised(lights: Lights, weight: Tensor, beyond: Tensor) -> Pictures:
        lacking = (_KNOWN - weight - beyond).clamp_min(0.0)
        beyond = beyond + lacking * lacking * (0.5 / _KNOWN)
        known = weight + beyond
        share = (beyond if backed else weight) / known
        return [(light / k, s) for light, k, s in zip(lights, *_each(known, share, layers=len(lights)), strict=True)]

    def composited(front: Picture, behind: Picture) -> Picture:
        (light, share), (light_behind, share_behind) = front, behind
        left = share if backed else (1.0 - share).clamp_min(0.0)
        share = left * share_behind if backed else torch.addcmul(share, left, share_behind)
        return torch.addcmul(light, left, light_behind), share

    picture = _composite_layers(frame, blurs, scatter, composited, ops, 1.0 if backed else 0.0, normalised)
    light, left = _parts(picture, colours)
    out = mean(picture, colours) if frame.behind is None else torch.addcmul(light, left, frame.behind)
    return out[..., : frame.size[0], : frame.size[1]]


def accumulate(frame: Frame, blurs: Sequence[Blur], scatter: Scatter, ops: Ops = EAGER) -> Tensor:
    """The paper's scatter: every pixel's light accumulates, whatever lies in front; after it come its weights.

    It is what :func:`mean` takes. Arguments are those of :func:`over`.

    Reference:
        Sato, Dobashi, Yamamoto, section 3.
    """

    def added(front: Picture, behind: Picture) -> Picture:
        return front[0] + behind[0], front[1] + behind[1]

    return _composite_layers(frame, blurs, scatter, added, ops)[..., : frame.size[0], : frame.size[1]]


def accumulate_once(frame: Frame, blurs: Sequence[Blur]) -> Tensor:
    """The same scatter as :func:`accumulate`, as the paper does it: one pass, in which each pixel has its own kernel.

    A pixel's kernel is interpolated between those of the layers around its coc, at full resolution.

    Reference:
        Sato, Dobashi, Yamamoto, section 3: (a) read the depth, (b) choose its blur texture, (c) multiply and
        accumulate.
    """
    halo = frame.margin
    weights = frame.layers(0, len(blurs), halo)[1][:, :, 0]
    kernels = torch.stack([functional.pad(b.kernel, (halo - b.half,) * 4) for b in blurs])  # [n, 1 or C, k, k]
    light = frame.surfaces[0].light
    each = kernels.shape[1]
    light = torch.cat([light, torch.ones_like(light[:, :each])], 1)
    shares = None if blurs[0].shares is None else [b.shares for b in blurs if b.shares is not None]
    summed = fold(light, kernels.repeat(1, min(2, each), 1, 1), halo, weights, shares, frame.size)
    return summed[..., : frame.size[0], : frame.size[1]]


def _composite_layers(
    frame: Frame,
    blurs: Sequence[Blur],
    scatter: Scatter,
    composited: Callable[[Picture, Picture], Picture],
    ops: Ops,
    empty: float = 0.0,
    normalised: Callable[[Lights, Tensor, Tensor], Pictures] | None = None,
) -> Tensor:
    """All layers, far to near: light ``[B, C, h, w]`` and, after it, what it is to be weighed with.

    The weights have one channel, or C where each colour has a kernel of its own, and are ``empty`` where there is no
    layer. ``composited`` puts what is in front and what is behind it together; ``normalised`` makes each layer's of the
    light of scattered layers, their weights and the weights behind them.
    """
    order = [k for k, occupied in enumerate(frame.occupied()) if occupied][::-1]
    light, colours = frame.surfaces[0].light, frame.colours
    each = blurs[0].kernel.shape[0]

    def blank(height: int, width: int) -> Tensor:
        none = light.new_zeros(light.shape[0], colours, height, width)
        return torch.cat([none, light.new_full((light.shape[0], each, height, width), empty)], 1)

    picture = blank(*frame.area)

    # neighbouring layers of one coarser resolution are composited at it: on one side of focus, lest others lie between;
    # those whose kernels are of like size are scattered by one convolution, as many as fill its channels
    uniform = each == 1 and blurs[0].shares is None
    most = CHANNELS // (colours + (2 if normalised else 1)) if uniform else 1
    runs: dict[tuple[int, bool], list[list[int]]] = {}
    for k in order:
        groups = runs.setdefault((blurs[k].scale, blurs[k].scale > 1 and frame.nodes[k] < 0), [])
        group = groups[-1] if groups else []
        widths = [blurs[j].kernel.shape[-1] for j in [*group, k]]
        if group and group[-1] == k + 1 and len(group) < most and max(widths) ** 2 <= 2 * min(widths) ** 2:
            group.append(k)
        else:
            groups.append([k])
    for (scale, _), groups in runs.items():
        part = picture
        if scale > 1:  # one pixel more on each side, to interpolate from
            part = blank(*(n // scale + 2 for n in frame.area))
        for group in groups:
            lights, *weights = _scattered(frame, blurs, scatter, group, normalised is not None)
            if normalised is None:
                layers: Pictures = list(zip(lights, *_each(weights[0], layers=len(group)), strict=True))
            else:
                layers = normalised(lights, *weights)
            front = _parts(part, colours)
            for layer in reversed(layers):
                front = composited(layer, front)
            part = ops.choose(_needed(frame, blurs, group), torch.cat(front, 1), part)
        if scale > 1:
            fine = upsampled(part, scale)
            fine = fine[..., scale : fine.shape[-2] - scale, scale : fine.shape[-1] - scale]
            needed = _needed(frame, blurs, [k for group in groups for k in group])
            together = torch.cat(composited(_parts(fine, colours), _parts(picture, colours)), 1)
            part = ops.choose(needed, together, picture)
        picture = part
    return picture


def _scattered(
    frame: Frame, blurs: Sequence[Blur], scatter: Scatter, group: list[int], visibility: bool
) -> tuple[Lights, Tensor] | tuple[Lights, Tensor, Tensor]:
    """Scattered layers of a group, near to far: light of each, weights and, with visibility, the weights behind.

    Light is ``[B, C, h, w]``; the weights of n layers are ``[B, n, h, w]``, or ``[B, n C, h, w]`` where each colour has
    a kernel of its own.
    """
    halo, half, each = max(blurs[k].halo for k in group), max(blurs[k].half for k in group), len(blurs[0].kernel)
    shares, scale, kernels = blurs[group[0]].shares, blurs[group[0]].scale, blurs[group[0]].kernel
    terms = frame.layers(min(group), len(group), halo)[: 2 + visibility]
    if each > 1:
        terms = tuple(term.expand(-1, -1, each, -1, -1) for term in terms)
    widths = [term.shape[2] for term in terms]  # C, and 1 or C
    channels = downsampled(torch.cat([term.flatten(1, 2) for term in terms], 1), scale)
    if shares is not None and scatter is fold:  # one layer, as where each colour has a kernel
        kernels = kernels.repeat(channels.shape[1] // each, 1, 1)
        scattered = fold(channels, kernels, half, None, [shares], frame.size)
    elif shares is not None:
        scattered = field.scattered(shares, channels, kernels, half, scale, frame.size)
    else:
        if len(group) > 1:
            padded = torch.cat([functional.pad(blurs[k].kernel, (half - blurs[k].half,) * 4) for k in sorted(group)])
            kernels = torch.cat([padded.repeat_interleave(width, 0) for width in widths])
        elif each > 1:
            kernels = kernels.repeat(len(terms), 1, 1)
        scattered = scatter(channels, kernels, half)
    parts = scattered.split([widths[0]] * len(group) + [width * len(group) for width in widths[1:]], 1)
    return parts[: len(group)], *parts[len(group) :]


def _needed(frame: Frame, blurs: Sequence[Blur], layers: list[int]) -> Callable[[], Tensor]:
    """Asks whether anything within reach of the frame's area lies in layers that follow each other."""
    ends = (frame.nodes[0] - 1.0, *frame.nodes, frame.nodes[-1] + 1.0)
    halo = max(blurs[k].halo for k in layers)
    return functools.partial(frame.any_between, ends[min(layers)], ends[max(layers) + 2], halo)


def _each(*weights: Tensor, layers: int) -> list[tuple[Tensor, ...]]:
    """Weights ``[B, n or n C, h, w]`` of n layers, one by one."""
    return [t.split([t.shape[1] // layers] * layers, 1) for t in weights]


def _parts(values: Tensor, colours: int) -> Picture:
    """Light, and the channels after it."""
    light, weight = values.split([colours, values.shape[1] - colours], 1)
    return light, weight


def mean(summed: Tensor, colours: int, normalize: bool = True, highlights: Tensor | None = None) -> Tensor:
    """Light over the weight that comes after it; 0 where nothing is known.

    Not normalised, the plain sum of what was seen, dark at the border and uneven at depth edges. ``highlights`` is
    light that was extracted from the layers and splatted ray by ray.
    """
    light, weight = summed[:, :colours], summed[:, colours:]
    light = light if highlights is None else light + highlights
    return light if not normalize else light / torch.where(weight > _LEAST, weight, torch.inf)
