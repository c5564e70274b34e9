"""The chain: surfaces of a scene, layers, scatter, composite."""

import dataclasses
import math
from collections.abc import Iterator

import torch
import torch.nn.functional as functional
from torch import Tensor

from . import background, composite, highlights, layers
from .attention import Attention, box_around, weight_map
from .frame import Frame, Sample, margin_and_align
from .loop import side, tile_by_tile
from .options import NAMED, Options
from .plan import Blur, Plan
from .spread import layers_by_conv, layers_by_fold

__all__ = ["blur", "blur_attended", "blur_stack"]

_REACH = 4.0  # blur radii within which what lies around a pixel can change it: its light, and what is filled in behind
_SAME_PX = 0.5  # a background whose coc differs by less is the surface that the image shows

Surface = tuple[Tensor, Tensor, Tensor | None]
"""Light ``[B, C, H, W]``, signed coc and weight ``[B, 1, H, W]``; None is 1."""


@dataclasses.dataclass
class _Shown:
    """What an image shows: its surfaces, and light behind all of them as :class:`torchdof.frame.Frame` takes it."""

    surfaces: list[Surface]
    behind: Tensor | None = None

    def samples(self, plan: Plan) -> Iterator[Sample]:
        """The surfaces as a frame takes them, each given away: large frames have no room for two copies."""
        while self.surfaces:
            light, coc, weight = self.surfaces.pop(0)
            yield Sample(light, layers.blur_axis(coc).clamp(plan.nodes[0], plan.nodes[-1]), weight)


def blur(
    image: Tensor, coc_px: Tensor, plan: Plan | None, options: Options, behind: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Depth of field of checked arguments; see :func:`torchdof.blur_by_coc`.

    Args:
        image: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]`` or ``[1, 1, H, W]``.
        plan: Layers to render with; None plans for each item.
        options: Options.
        behind: Background and its coc, where they are known.
    """
    wide = torch.float64 if torch.float64 in (image.dtype, coc_px.dtype) else torch.float32
    maps = [image, coc_px, *(behind or ())]
    maps = [t.to(wide).contiguous().expand(image.shape[0], -1, -1, -1) for t in maps]
    if plan is None and _traced():
        plan = Plan.all(_constant(options.max_coc_px), _constant(options.tolerance))
    elif plan is None and torch.is_grad_enabled() and any(coc.requires_grad for coc in maps[1::2]):
        plan = Plan.still(torch.cat(maps[1::2]), options.tolerance)
    if plan is not None:
        return _render(plan, options, *maps).to(image.dtype)
    # each item has its own layers, as it would have alone
    items = []
    for item in zip(*(t.split(1) for t in maps), strict=True):
        items.append(_render(Plan.of_scene(torch.cat(item[1::2]), options.tolerance), options, *item))
    return (items[0] if len(items) == 1 else torch.cat(items)).to(image.dtype)


def blur_attended(
    image: Tensor,
    coc_px: Tensor,
    plan: Plan | None,
    options: Options,
    behind: tuple[Tensor, Tensor] | None,
    attention: Attention | None,
) -> Tensor:
    """:func:`blur` that keeps the tolerance where the viewer looks; elsewhere that of a draft is enough."""
    if attention is None:
        return blur(image, coc_px, plan, options, behind)
    weight = weight_map(attention, image)
    loose = dataclasses.replace(options, tolerance=max(options.tolerance, NAMED["draft"]))
    known = torch.nan_to_num(coc_px.detach(), nan=0.0, posinf=0.0, neginf=0.0)
    box = box_around(weight, _REACH * float(known.abs().amax()))
    if box is None or loose.tolerance == options.tolerance:
        return blur(image, coc_px, None, loose, behind)
    part = (..., *box)
    if image[part].shape == image.shape and bool((weight == 1).all()):
        return blur(image, coc_px, None, options, behind)
    around = blur(image, coc_px, None, loose, behind)
    there = None if behind is None else (behind[0][part], behind[1][part])
    looked_at = blur(image[part], coc_px[part], None, options, there)
    share = functional.pad(weight[part], _ends(image, box)).to(image.dtype)
    return torch.lerp(around, functional.pad(looked_at, _ends(image, box)), share)


def _ends(image: Tensor, box: tuple[slice, slice]) -> tuple[int, int, int, int]:
    """Pixels of the image on each side of a part of it, as ``pad`` takes them."""
    rows, columns = box
    return columns.start, image.shape[-1] - columns.stop, rows.start, image.shape[-2] - rows.stop


def blur_stack(rgba: Tensor, coc_px: Tensor, options: Options) -> Tensor:
    """Depth of field of a stack of layers; see :meth:`torchdof.DepthOfField.layers`.

    Args:
        rgba: ``[B, N, C + 1, H, W]``, premultiplied.
        coc_px: ``[B, N, 1, H, W]``.
        options: Options.

    Returns:
        ``[B, C + 1, H, W]``, premultiplied.
    """
    wide = torch.float64 if torch.float64 in (rgba.dtype, coc_px.dtype) else torch.float32
    light, coc = rgba.to(wide), coc_px.to(wide)
    cover = light[:, :, -1:].clamp(0.0, 1.0)
    valid = torch.isfinite(coc) & torch.isfinite(light).all(2, keepdim=True)
    there = valid & (cover > 0)
    cover, coc = torch.where(there, cover, 0.0), torch.where(there, coc, coc.new_zeros(()))
    light = torch.where(there, light / cover.clamp_min(1e-12), 0.0)
    moves = torch.is_grad_enabled() and coc.requires_grad
    plan = (Plan.still if moves else Plan.of_scene)(coc.flatten(0, 1), options.tolerance)
    plan = Plan(plan.nodes, plan.tolerance, rays=False)
    order = coc.argsort(1)  # near to far
    light, coc, cover = (t.gather(1, order.expand_as(t)) for t in (light, coc, cover))
    stack: list[Surface] = [(light[:, i], _within(coc[:, i], plan), cover[:, i]) for i in range(light.shape[1])]
    # what no layer covers is seen through all of them
    stack.append((torch.zeros_like(light[:, 0]), torch.full_like(coc[:, 0], plan.coc_px[-1]), None))
    return _composite(_Shown(stack), plan, options, independent=True).to(rgba.dtype)


def _render(
    plan: Plan,
    options: Options,
    light: Tensor,
    coc: Tensor,
    behind_light: Tensor | None = None,
    behind_coc: Tensor | None = None,
) -> Tensor:
    if plan.nodes == (0.0,):
        # in focus: nothing changes, but whoever asks for the gradient of the coc is told that it is 0
        return light + 0.0 * torch.nan_to_num(coc) if torch.is_grad_enabled() and coc.requires_grad else light.clone()
    image, valid = light, None
    if not options.check:
        valid = torch.isfinite(coc) & torch.isfinite(light).all(1, keepdim=True)
        coc, light = torch.where(valid, coc, 0.0), torch.where(valid, light, 0.0)
    coc = _within(coc, plan)
    weight = None if valid is None else valid.to(light.dtype)
    limit = None
    if len(plan.nodes) > 1 and (options.occlusion or _needs_rays(plan, options, light)):
        limit = highlights.ordinary(light, valid)
    shown = _shown(plan, options, light, coc, weight, limit if options.occlusion else None, behind_light, behind_coc)
    rays = [] if limit is None or not plan.rays else _take_highlights(shown, plan, options, limit, coc)
    traced = None
    if rays:
        traced = highlights.trace(rays, coc, options.table, light.shape[1], plan.shared_px, options.occlusion)
    out = _composite(shown, plan, options, behind_light is not None, traced)
    return out if valid is None else torch.where(valid, out, image)


def _needs_rays(plan: Plan, options: Options, light: Tensor) -> bool:
    """Whether without occlusion a light may be too bright for a coarse layer: brighter than a display shows."""
    coarse = plan.rays and _crisp_px(plan, options) < max(abs(c) for c in plan.coc_px)
    return coarse and bool((light.detach() > 1.0).any())


def _crisp_px(plan: Plan, options: Options) -> float:
    """Radius from which on layers soften highlights."""
    return plan.crisp_px if options.method == "layered" else math.inf


def _shown(
    plan: Plan,
    options: Options,
    light: Tensor,
    coc: Tensor,
    weight: Tensor | None,
    limit: Tensor | None,
    behind_light: Tensor | None,
    behind_coc: Tensor | None,
) -> _Shown:
    """Surfaces of an image; ``limit`` is None without occlusion."""
    if behind_light is not None and behind_coc is not None:
        return _Shown(_before(light, coc, weight, behind_light, _within(behind_coc, plan), options))
    if limit is None:
        return _Shown([(light, coc, weight)])
    levels = min(math.ceil(math.log2(max(2.0, *(abs(c) for c in plan.coc_px)))) + 1, 7)
    own, seen, other, other_coc, share, farthest = background.surfaces(light, coc, weight, limit, levels)
    return _Shown([(own, coc, seen), (other, other_coc, share)], farthest)


def _take_highlights(shown: _Shown, plan: Plan, options: Options, limit: Tensor, coc: Tensor) -> list[highlights.Rays]:
    """Take the highlights that must be traced out of what is shown."""
    rays = []
    crisp_px = _crisp_px(plan, options)
    for i, (light, place, weight) in enumerate(shown.surfaces):
        left, some = highlights.take(light, place, weight, limit, coc if options.occlusion else None, crisp_px)
        shown.surfaces[i] = (left, place, weight)
        rays += [] if some is None else [some]
    return rays


def _before(
    light: Tensor, coc: Tensor, weight: Tensor | None, behind: Tensor, behind_coc: Tensor, options: Options
) -> list[Surface]:
    """Surfaces of an image in front of a known background, near to far."""
    own, other, other_coc, share = background.split_mixed(light, coc, weight)
    # what shows past a nearer surface of a mixed pixel is the background's to tell
    seen, share = 1.0 - share, torch.where(other_coc < coc, share, 0.0)
    if weight is not None:
        seen, share = seen * weight, share * weight
    apart = (behind_coc - coc - _SAME_PX).clamp(0.0, 1.0)  # else the image itself shows it
    behind_weight = apart + (1.0 - apart) * share
    if not options.check:
        valid = torch.isfinite(behind_coc) & torch.isfinite(behind).all(1, keepdim=True)
        behind, behind_coc, behind_weight = (torch.where(valid, t, 0.0) for t in (behind, behind_coc, behind_weight))
    behind_coc = torch.maximum(behind_coc, coc)
    return [(other, other_coc, share), (own, coc, seen), (behind, behind_coc, behind_weight)]


def _composite(shown: _Shown, plan: Plan, options: Options, independent: bool, traced: Tensor | None = None) -> Tensor:
    """Render what is shown, and the light of rays. Takes it over: the frame copies it to give it a margin."""
    light = shown.surfaces[0][0]
    layered = options.method == "layered"
    blurs = plan.blurs(options.table, (light.shape[-2], light.shape[-1]), light.dtype, light.device, coarse=layered)
    moves = torch.is_grad_enabled() and any(t.requires_grad for s in shown.surfaces for t in s[:2])
    exporting = torch.compiler.is_exporting()
    margin, align = margin_and_align(blurs)
    tiled = layered and not _traced() and not moves and light.shape[0] == 1
    del light
    frame = Frame(
        shown.samples(plan),
        margin=margin,
        align=side(margin) if exporting else align,
        tiled=tiled,
        extend=options.border == "extend",
        independent=independent,
        behind=shown.behind,
    )

    def rendered(frame: Frame, blurs: list[Blur]) -> Tensor:
        if options.occlusion:
            out = composite.over(frame, plan, blurs, layers_by_conv if layered else layers_by_fold)
            return out if traced is None else out + traced
        if not layered:
            return composite.accumulate_once(frame, plan, blurs, options.normalize)
        return composite.accumulate(frame, plan, blurs, layers_by_conv, options.normalize, traced)

    return tile_by_tile(frame, blurs, rendered) if exporting else rendered(frame, blurs)


def _within(coc: Tensor, plan: Plan) -> Tensor:
    """Beyond the plan's reach blurs are alike, and differences of huge ones would cancel."""
    return coc.clamp(plan.coc_px[0], plan.coc_px[-1])


def _constant(number: float) -> float:
    """A number whose value a compiled graph is made for: one that differs between two modules is a variable in it."""
    return float.fromhex(float(number).hex())


def _traced() -> bool:
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()
