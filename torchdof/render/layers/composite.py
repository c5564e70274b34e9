"""Composite layers to one image, far to near: scatter each with its kernel and lay it over the layers behind it."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import native
from ...tensors import recomputed
from ..engines import on_gpu
from ..engines.compiled_steps import compiled_step
from ..engines.ops import EAGER, Ops
from ..rules import active
from ..surfaces.frame import PaddedFrame, maps_of, surfaces_of
from . import field
from .convolution import convolve
from .downsampling import downsampled, upsampled
from .plan import LayerKernel
from .scatter import fold

Scatter = Callable[[Tensor, Tensor, int], Tensor]
"""``(light [B, C, H, W], kernels [1 or C, k, k], halo) -> [B, C, H - 2 halo, W - 2 halo]``."""

Picture = tuple[Tensor, Tensor]
"""Light ``[B, C, h, w]`` and its weight ``[B, 1 or C, h, w]``: a sum of weights, a coverage or a transmittance."""

_LEAST = 1e-6  # scattered weight, of 1: pixels with less are unknown and become 0
_KNOWN = 0.002  # scattered weight, of 1: layers with less cover gradually less; larger fades more of them


def over(frame: PaddedFrame, blurs: Sequence[LayerKernel], scatter: Scatter, ops: Ops = EAGER) -> Tensor:
    """Normalised "over" of soft layers: ``[B, C, H, W]``. Pixels that no layer covers show ``frame.behind``.

    With ``m_k`` the weight of layer k, ``M_k`` the weight at or behind it and ``K_k`` its kernel:
    ``colour = K_k * (m_k I) / K_k * M_k``, coverage ``a = K_k * m_k / K_k * M_k``, ``out = colour + (1 - a) out``.
    Dividing by ``K_k * M_k`` keeps a surface that spans several layers closed and lets the background reach under the
    blurred edge of a foreground. Where ``K_k * M_k`` is near 0 the coverage fades to 0; otherwise the first bit of
    weight in a layer would change the picture abruptly.

    Reference:
        Ikoma, Nguyen, Metzler, Peng, Wetzstein, "Depth from defocus with learned optics", ICCP 2021.
    """
    picture = _layers(frame, blurs, scatter, ops)
    light, left = _parts(picture, frame.colours)
    out = mean(picture, frame.colours) if frame.behind is None else torch.addcmul(light, left, frame.behind)
    return out[..., : frame.size[0], : frame.size[1]]


def accumulate(frame: PaddedFrame, blurs: Sequence[LayerKernel], scatter: Scatter, ops: Ops = EAGER) -> Tensor:
    """The paper's scatter: the light of all layers, ignoring occlusion, then the sum of its weights, for :func:`mean`.

    Reference:
        Sato, Dobashi, Yamamoto, section 3.
    """
    return _layers(frame, blurs, scatter, ops)[..., : frame.size[0], : frame.size[1]]


def accumulate_once(frame: PaddedFrame, blurs: Sequence[LayerKernel]) -> Tensor:
    """The scatter of :func:`accumulate` as in the paper: one pass, in which each pixel has its own kernel.

    The kernel is interpolated between those of the two layers around the pixel's coc, at full resolution.
    """
    halo = frame.margin
    weights = frame.layers(0, len(blurs), halo)[1][:, :, 0]
    kernels = torch.stack([functional.pad(b.kernel, (halo - b.half,) * 4) for b in blurs])  # [n, 1 or C, k, k]
    light = frame.surfaces[0].light
    each = kernels.shape[1]
    light = torch.cat([light, torch.ones_like(light[:, :each])], 1)
    masks = None if blurs[0].mask is None else [b.mask for b in blurs if b.mask is not None]
    summed = fold(light, kernels.repeat(1, min(2, each), 1, 1), halo, weights, masks, frame.size)
    return summed[..., : frame.size[0], : frame.size[1]]


def _layers(frame: PaddedFrame, blurs: Sequence[LayerKernel], scatter: Scatter, ops: Ops) -> Tensor:
    """:func:`_composite_layers`, by the kernels of a GPU or by the compiled engine if they can compute it."""
    kernels, maps, count = [blur.kernel for blur in blurs], maps_of(frame.surfaces), len(frame.surfaces)
    scaled = [(blur.kernel, blur.scale) for blur in blurs]
    one_kernel_a_layer = scatter is not fold and blurs[0].mask is None
    if one_kernel_a_layer:
        picture = on_gpu.composited(frame, scaled, _by_convolution)
        if picture is not None:
            return picture

    def plain(*maps: Tensor) -> Tensor:
        given = dataclasses.replace(frame, surfaces=surfaces_of(maps, count))
        return _composite_layers(given.near_to_far(), blurs, scatter, ops)

    planes, half = frame.colours + max(k.shape[-3] for k in kernels), max(blur.half for blur in blurs)
    found, is_one_plan = None, len(frame.nodes) == 1 and not frame.stacked
    if is_one_plan and planes <= native.MOST_PLANES and half <= native.HALF_LARGEST:
        if one_kernel_a_layer and not any(k.requires_grad for k in kernels):
            how = (frame.margin, frame.area, frame.nodes[0], scaled, frame.occlusion, frame.behind is not None)
            found = compiled_step(
                lambda *maps: native.blend(surfaces_of(maps, count), *how),
                lambda gradient, *maps: native.blend_gradient(gradient, surfaces_of(maps, count), *how),
                plain,
                *maps,
            )
    return plain(*maps) if found is None else found


def _by_convolution(frame: PaddedFrame, kernels: Sequence[tuple[Tensor, int]]) -> Tensor:
    """:func:`_composite_layers` with a kernel and a resolution for each layer."""
    blurs = [LayerKernel(*of_layer) for of_layer in kernels]
    return _composite_layers(frame.near_to_far(), blurs, functools.partial(convolve, turned=True), EAGER)


def _composite_layers(frame: PaddedFrame, blurs: Sequence[LayerKernel], scatter: Scatter, ops: Ops) -> Tensor:
    """Composite all layers, far to near: light ``[B, C, h, w]`` followed by its weights.

    The weight is the transmittance of all layers, or, if there is no light behind them, the coverage, by which the
    final light is divided; without occlusion the sum of weights. It has C channels if each colour has its own kernel.

    1. Drop empty layers.
    2. Group neighbours of one resolution whose kernels have similar sizes.
    3. Scatter each group by one convolution.
    4. Put its layers in front of the picture at their resolution.
    5. Upsample coarse results and put them in front of the full picture in the same way.
    6. Between the focus and the layers in front of it, put :meth:`PaddedFrame.stand_ins` in front of the picture.
    """
    light, colours, backed = frame.surfaces[0].light, frame.colours, frame.behind is not None
    each = blurs[0].kernel.shape[-3]

    def blank(height: int, width: int) -> Tensor:
        none = light.new_zeros(light.shape[0], colours, height, width)
        return torch.cat([none, light.new_full((light.shape[0], each, height, width), 1.0 if backed else 0.0)], 1)

    def in_front(front: Picture, behind: Picture) -> Picture:
        (light, share), (light_behind, share_behind) = front, behind
        if not frame.occlusion:
            return light + light_behind, share + share_behind
        left = share if backed else (1.0 - share).clamp_min(0.0)
        share = left * share_behind if backed else torch.addcmul(share, left, share_behind)
        return torch.addcmul(light, left, light_behind), share

    def with_group(part: Tensor, group: list[int]) -> Tensor:
        """A picture with a group of layers in front of it."""
        lights, weights = _scattered(frame, blurs, scatter, group)
        shares = weights[0].split(each, 1)
        if frame.occlusion:
            weight, beyond = weights
            beyond = raised(weight, beyond)
            known = weight + beyond
            # the transmittance as a sum of positive terms: a difference would round badly behind bright light
            shares = ((beyond if backed else weight) / known).split(each, 1)
            lights = [light / k for light, k in zip(lights, known.split(each, 1), strict=True)]
        picture = _parts(part, colours)
        for layer in list(zip(lights, shares, strict=True))[::-1]:
            picture = in_front(layer, picture)
        return torch.cat(picture, 1)

    picture = blank(*frame.area)
    has_stand_ins = frame.occlusion and active().stand_ins
    for (scale, is_before_focus), groups in _runs(frame, blurs, ops.channels).items():
        if is_before_focus and has_stand_ins:
            has_stand_ins = False
            light, share = frame.stand_ins()
            picture = torch.cat(in_front((light, 1.0 - share if backed else share), _parts(picture, colours)), 1)
        part = picture
        if scale > 1:  # one more pixel on each side, for the interpolation
            part = blank(*(n // scale + 2 for n in frame.area))
        for group in groups:
            front = recomputed(functools.partial(with_group, part, group))
            part = ops.equal_unless(_needed(frame, blurs, group), front, part)
        if scale > 1:
            fine = upsampled(part, scale)
            fine = fine[..., scale:-scale, scale:-scale]
            needed = _needed(frame, blurs, [k for group in groups for k in group])
            together = torch.cat(in_front(_parts(fine, colours), _parts(picture, colours)), 1)
            part = ops.equal_unless(needed, together, picture)
        picture = part
    return picture


def _runs(frame: PaddedFrame, blurs: Sequence[LayerKernel], channels: int) -> dict[tuple[int, bool], list[list[int]]]:
    """Groups of the occupied layers, far to near, by their resolution and whether they are in front of the focus.

    A group has neighbours whose kernels have similar sizes, at most as many as fill one convolution.
    """
    is_uniform = blurs[0].kernel.shape[-3] == 1 and blurs[0].mask is None
    most = channels // (frame.colours + 1 + frame.occlusion) if is_uniform else 1
    before_focus = [min(places) < 0 for places in zip(*frame.nodes, strict=True)]
    runs: dict[tuple[int, bool], list[list[int]]] = {}
    for k in [k for k, occupied in enumerate(frame.occupied()) if occupied][::-1]:
        groups = runs.setdefault((blurs[k].scale, before_focus[k]), [])
        group = groups[-1] if groups else []
        widths = [blurs[j].kernel.shape[-1] for j in [*group, k]]
        if group and group[-1] == k + 1 and len(group) < most and max(widths) ** 2 <= 2 * min(widths) ** 2:
            group.append(k)
        else:
            groups.append([k])
    return runs


def raised(weight: Tensor, beyond: Tensor) -> Tensor:
    """The weight beyond a layer, raised where it and the layer's lack ``l`` to :data:`_KNOWN`: by ``l^2 / (2 _KNOWN)``.

    So the coverage ``weight / (weight + beyond)`` fades to 0 with the weight.
    """
    lacking = (_KNOWN - weight - beyond).clamp_min(0.0)
    return beyond + lacking * lacking * (0.5 / _KNOWN)


def _scattered(
    frame: PaddedFrame, blurs: Sequence[LayerKernel], scatter: Scatter, group: list[int]
) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """Scatter the layers of a group, near to far: light of each; and weights, with occlusion also the weights behind.

    Light is ``[B, C, h, w]``; the weights of n layers are ``[B, n, h, w]``, or ``[B, n C, h, w]`` if each colour has
    its own kernel.
    """
    halo, half, each = max(blurs[k].halo for k in group), max(blurs[k].half for k in group), blurs[0].kernel.shape[-3]
    mask, scale, kernels = blurs[group[0]].mask, blurs[group[0]].scale, blurs[group[0]].kernel
    terms = frame.layers(min(group), len(group), halo)[: 2 + frame.occlusion]
    if each > 1:
        terms = tuple(term.expand(-1, -1, each, -1, -1) for term in terms)
    widths = [term.shape[2] for term in terms]  # C, and 1 or C
    channels = downsampled(torch.cat([term.flatten(1, 2) for term in terms], 1), scale)
    if mask is not None and scatter is fold:  # the group is a single layer
        kernels = kernels.repeat(channels.shape[1] // each, 1, 1)
        scattered = fold(channels, kernels, half, None, [mask], frame.size)
    elif mask is not None:
        scattered = field.scattered(mask, channels, kernels, half, scale, frame.size)
    else:
        if len(group) > 1:
            padded = torch.cat(
                [functional.pad(blurs[k].kernel, (half - blurs[k].half,) * 4) for k in sorted(group)], -3
            )
            kernels = torch.cat([padded.repeat_interleave(width, -3) for width in widths], -3)
        elif each > 1:
            kernels = torch.cat([kernels] * len(terms), -3)
        scattered = scatter(channels, kernels, half)
    parts = scattered.split([widths[0]] * len(group) + [width * len(group) for width in widths[1:]], 1)
    return parts[: len(group)], parts[len(group) :]


def _needed(frame: PaddedFrame, blurs: Sequence[LayerKernel], layers: list[int]) -> Callable[[], Tensor]:
    """A function that computes whether any pixel within reach of the area lies in these consecutive layers."""
    nodes = frame.nodes[0]  # graphs have the same layers for all items
    ends = (nodes[0] - 1.0, *nodes, nodes[-1] + 1.0)
    halo = max(blurs[k].halo for k in layers)
    return functools.partial(frame.any_between, ends[min(layers)], ends[max(layers) + 2], halo)


def _parts(values: Tensor, colours: int) -> Picture:
    """Split channels into light and its weights."""
    light, weight = values.split([colours, values.shape[1] - colours], 1)
    return light, weight


def mean(summed: Tensor, colours: int, normalize: bool = True, highlights: Tensor | None = None) -> Tensor:
    """Divide light by the weight that follows it in the channels; 0 where the weight is 0.

    Without ``normalize``, return the plain sum, which is dark at the border and uneven at depth edges. ``highlights``
    is light to add, which was extracted from the layers and splatted ray by ray.
    """
    light, weight = summed[:, :colours], summed[:, colours:]
    light = light if highlights is None else light + highlights
    return light if not normalize else light / torch.where(weight > _LEAST, weight, torch.inf)
