"""Render one image: plan layers, split mixed pixels, fill hidden areas, extract highlights, blur layers, composite.

Each step takes ``ops`` (:mod:`torchdof.render.engines.ops`): operations for eager code, or those for exported graphs.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import native
from ..options import Options
from ..tensors import is_differentiated, is_in_memory, is_traced
from ..validation import NAMED_TOLERANCES
from . import exposure, highlights, routes, rules
from .attention import Attention, box_around, weight_map
from .engines import compiled
from .engines.on_gpu import matte
from .engines.ops import EAGER, Ops
from .engines.traced import is_compiled
from .layers import composite
from .layers.convolution import convolve
from .layers.layer_weights import blur_axis
from .layers.plan import Plan, joined_layers
from .layers.scatter import fold
from .surfaces import edges
from .surfaces.coverage import covered_by
from .surfaces.disocclusion import behind_pixels, surfaces_of_image
from .surfaces.frame import Beyond, PaddedFrame, Surface, pad_to_frame

_REACH = 4.0  # margin around an attention area, in largest blur radii; less changes its light and hidden surfaces
_TOGETHER = 2**21  # pixels of items rendered together; larger: fewer, larger operations, and more memory
_SAME_PX = 0.5  # px of coc: a background at most this far behind the image's surface counts as the same surface


def blur(
    image: Tensor,
    coc_px: Tensor,
    plan: Plan | None,
    options: Options,
    behind: tuple[Tensor, Tensor] | None = None,
    attention: Attention | None = None,
    ops: Ops = EAGER,
    matte: Tensor | None = None,
) -> Tensor:
    """Render depth of field from the checked arguments of :func:`torchdof.blur_by_coc`.

    Args:
        image: ``[B, C, H, W]``.
        coc_px: ``[B or 1, 1, H, W]``, before the repair of depth edges.
        plan: Layers; None plans each item separately.
        options: Options of the rendering.
        behind: Known background ``[B, C, H, W]`` and its coc ``[B, 1, H, W]``.
        attention: Area rendered within ``options.tolerance``; the rest is rendered with the tolerance ``"draft"``.
        ops: Operations of all steps.
        matte: Coverage by the subject ``[B or 1, 1, H, W]``, in [0, 1].
    """
    if attention is not None and len(image) > 1:  # the area depends on the largest blur of each item
        given = (image, coc_px, weight_map(attention, image), matte, *(behind or ()))
        maps = [[None] * len(image) if t is None else t.expand(len(image), -1, -1, -1).split(1) for t in given]
        items = zip(*maps, strict=True)
        return torch.cat([blur(i, c, plan, options, tuple(b) or None, w, ops, a) for i, c, w, a, *b in items])
    coc_px, covered = edges.mended(image, coc_px, options.depth_edges, ops, matte), None
    if matte is not None:
        coc_px, covered = covered_by(image, coc_px, matte, highlights.threshold, ops)
    whole = functools.partial(_planned, image, coc_px, behind=behind, ops=ops, covered=covered)
    if attention is None:
        return whole(plan, options)
    weight = weight_map(attention, image)
    if options.table.depends_on_place:  # kernels depend on the distance from the frame's middle, so no part is cut out
        return whole(plan, options)
    loose = dataclasses.replace(options, tolerance=max(options.tolerance, NAMED_TOLERANCES["draft"]))
    known = torch.nan_to_num(coc_px.detach(), nan=0.0, posinf=0.0, neginf=0.0)
    box = box_around(weight, _REACH * float(known.abs().amax()))
    if box is None or loose.tolerance == options.tolerance:
        return whole(None, loose)
    part = (..., *box)
    if image[part].shape == image.shape and bool((weight == 1).all()):
        return whole(None, options)
    around = whole(None, loose)
    behind_part = None if behind is None else (behind[0][part], behind[1][part])
    covered_part = None if covered is None else covered[part]
    looked_at = _planned(image[part], coc_px[part], None, options, behind_part, ops, covered_part)
    rows, columns = box
    ends = (columns.start, image.shape[-1] - columns.stop, rows.start, image.shape[-2] - rows.stop)
    return torch.lerp(around, functional.pad(looked_at, ends), functional.pad(weight[part], ends).to(image.dtype))


def _planned(
    image: Tensor,
    coc_px: Tensor,
    plan: Plan | None,
    options: Options,
    behind: tuple[Tensor, Tensor] | None,
    ops: Ops,
    covered: Tensor | None,
) -> Tensor:
    """Render images with repaired depth edges; the given plan grows to the blur of each item; None plans each."""
    wide = torch.float64 if torch.float64 in (image.dtype, coc_px.dtype) else torch.float32
    given = {"light": image, "coc": coc_px}
    if behind is not None:
        given |= {"behind_light": behind[0], "behind_coc": behind[1]}
    if covered is not None:
        given["covered"] = covered
    maps = {name: t.to(wide).contiguous() for name, t in given.items()}
    maps = {n: (t if is_traced() else t.resolve_neg()).expand(image.shape[0], -1, -1, -1) for n, t in maps.items()}
    cocs = [maps["coc"]] if behind is None else [maps["coc"], maps["behind_coc"]]
    render = functools.partial(_image, options, ops)
    if is_traced():
        if plan is None:
            # Floats rebuilt from hex become constants of the graph. The options' own floats would become inputs of the
            # graph if they differ between two modules.
            max_coc_px, tolerance = (float.fromhex(float(n).hex()) for n in (options.max_coc_px, options.tolerance))
            plan = Plan.static(max_coc_px, tolerance)
        return render([plan], **maps).to(image.dtype)
    scenes = [torch.cat(of_item) for of_item in zip(*(t.split(1) for t in cocs), strict=True)]
    if plan is None:
        plans = Plan.for_scenes(scenes, options.tolerance, on_grid=any(map(is_differentiated, cocs)))
    elif plan.extended_to(torch.cat(cocs)) is plan:
        plans = [plan] * len(scenes)
    else:
        plans = [plan.extended_to(scene) for scene in scenes]
    return _each_planned(render, plans, options, maps).to(image.dtype)


def blur_stack(rgba: Tensor, coc_px: Tensor, options: Options) -> Tensor:
    """Render checked layers ``[B, N, C + 1, H, W]``; see :meth:`torchdof.DepthOfField.layers`."""
    wide = torch.float64 if torch.float64 in (rgba.dtype, coc_px.dtype) else torch.float32
    light, coc = rgba.to(wide), coc_px.to(wide)
    order = torch.where(torch.isfinite(coc), coc, torch.inf).argsort(1)  # near to far
    cover = light[:, :, -1:].clamp(0.0, 1.0)
    scale = exposure.scale_of(light.flatten(1, 2))  # before the division, which makes light of tiny coverage huge
    valid = torch.isfinite(coc) & torch.isfinite(light).all(2, keepdim=True) & (cover > 0)
    cover, coc = torch.where(valid, cover, 0.0), torch.where(valid, coc, coc.new_zeros(()))
    light = torch.where(valid, light * scale[:, None] / cover.clamp_min(1e-12), 0.0)
    given = {"light": light, "coc": coc, "cover": cover}
    maps = {name: t.gather(1, order.expand_as(t)) for name, t in given.items()}
    plans = Plan.for_scenes([*maps["coc"]], options.tolerance, on_grid=is_differentiated(coc))
    rendered = _each_planned(functools.partial(_stack, options), plans, options, maps)
    return (rendered / scale).to(rgba.dtype)


def _each_planned(
    render: Callable[..., Tensor], plans: Sequence[Plan], options: Options, maps: Mapping[str, Tensor]
) -> Tensor:
    """Render items, each with its own plan, so that the result does not depend on the rest of the batch.

    Together are rendered all items if they have one plan, otherwise as many as have layers that can be joined.
    ``render(plans, **maps)`` renders some items, with one plan or one for each; ``maps`` are those of all items,
    ``[B, ...]``.
    """
    if len(plans) == 1 or _is_in_memory(maps):
        return _by_item(render, plans, maps)
    if len({*plans}) == 1:
        return render(plans[:1], **maps)
    if options.method != "layered" or options.table.depends_on_place:
        return _by_item(render, plans, maps)
    most = max(1, _TOGETHER // math.prod(maps["coc"].shape[-2:]))
    joined = [i for i, plan in enumerate(plans) if len(plan.nodes) > 1]  # a plane has one layer, whose kernel is exact
    groups = [joined[i : i + most] for i in range(0, len(joined), most)]
    groups += [[i] for i in range(len(plans)) if i not in joined]
    if len(groups) == 1:
        return render(plans, **maps)
    by_index: dict[int, Tensor] = {}
    for group in groups:
        of_group = {name: torch.cat([t[i : i + 1] for i in group]) for name, t in maps.items()}
        by_index |= zip(group, render([plans[i] for i in group], **of_group).split(1), strict=True)
    return torch.cat([by_index[i] for i in range(len(plans))])


def _is_in_memory(maps: Mapping[str, Tensor]) -> bool:
    """Whether the compiled engine, which renders item by item, can read the maps."""
    return native.chosen() and all(is_in_memory(t, backward=True) for t in maps.values())


def _by_item(render: Callable[..., Tensor], plans: Sequence[Plan], maps: Mapping[str, Tensor]) -> Tensor:
    """Render items one after the other, each with its plan."""
    items = zip(*(t.split(1) for t in maps.values()), strict=True)
    rendered = [render([plan], **dict(zip(maps, item, strict=True))) for plan, item in zip(plans, items, strict=True)]
    return rendered[0] if len(rendered) == 1 else torch.cat(rendered)


def _compiled(
    plans: Sequence[Plan],
    options: Options,
    lens_width: int | None,
    light: Tensor,
    coc: Tensor,
    **others: Tensor | None,
) -> Tensor | None:
    """A picture by the compiled engine; None if another engine renders. ``others`` are further maps of its function."""
    plan, size, made = plans[0], (light.shape[-2], light.shape[-1]), []

    def half_widths() -> list[int]:
        made.append(compiled.layer_spots_of(plan, options.table, size, lens_width))
        return made[0].half

    maps = [light, coc, *(t for t in others.values() if t is not None)]
    if routes.route(plan, options, maps, "cover" in others, half_widths).engine != "compiled":
        return None
    return compiled.picture(plan, options, made[0], light, coc, lens_width=lens_width, **others)


def _stack(options: Options, plans: Sequence[Plan], light: Tensor, coc: Tensor, cover: Tensor) -> Tensor:
    """Render float maps of layers ``[B, N, ...]``, near to far, with one plan or with one for each item."""
    picture = _compiled(plans, options, None, light, coc, cover=cover)
    if picture is not None:
        return picture
    reach = _reach(plans, coc)
    stack = [Surface(light[:, i], coc[:, i].clamp(*reach), cover[:, i]) for i in range(light.shape[1])]
    # a black surface behind the layers, for pixels that no layer covers
    stack.append(Surface(torch.zeros_like(light[:, 0]), torch.zeros_like(coc[:, 0]) + reach[1]))
    return _composite(stack, None, plans, options, EAGER, image=None)


def _image(
    options: Options,
    ops: Ops,
    plans: Sequence[Plan],
    light: Tensor,
    coc: Tensor,
    behind_light: Tensor | None = None,
    behind_coc: Tensor | None = None,
    covered: Tensor | None = None,
) -> Tensor:
    """Render float maps of images, optionally with a known background, with one plan or with one for each item.

    Several plans have more than one layer each, and their table does not depend on the place in the frame.

    1. Let the compiled engine render, if it supports the arguments. All in focus: return the image.
    2. Set invalid pixels to 0, and scale down light whose powers would overflow.
    3. Compute the limit above which light belongs to a highlight.
    4. Split mixed pixels, and fill hidden surfaces or take the known background.
    5. Take the highlights out of the surfaces and splat them ray by ray.
    6. Blur and composite the layers, add the highlights, and undo step 2.
    """
    if len(plans) == 1 and plans[0].nodes == (0.0,):
        # all in focus: the image is unchanged; with the term 0 * coc, the coc has a gradient of 0 instead of None
        return light + 0.0 * torch.nan_to_num(coc) if is_differentiated(coc) else light.clone()
    others = {"behind_light": behind_light, "behind_coc": behind_coc, "covered": covered}
    picture = _compiled(plans, options, ops.lens_width, light, coc, **others)
    if picture is not None:
        return picture
    image, valid, weight = light, None, None
    if not options.check:
        valid = torch.isfinite(coc) & torch.isfinite(light).all(1, keepdim=True)
        coc, light, weight = torch.where(valid, coc, 0.0), torch.where(valid, light, 0.0), valid.to(light.dtype)
    ends = _reach(plans, coc)
    coc = coc.clamp(*ends)  # differences of huge values would round badly
    scale = exposure.scale_of(light, behind_light)
    light = light * scale

    splatted_px = _splatted_px(plans, options, ops)
    has_limit = options.occlusion or options.normalize or splatted_px is not None
    limit = highlights.threshold(light, weight) if has_limit else None

    # surfaces of each pixel, and the light behind all of them
    surfaces, own, behind = [Surface(light, coc, weight)], 0, None
    if behind_light is not None and behind_coc is not None:
        surfaces, own = _before_background(surfaces[0], behind_light * scale, behind_coc, ends, options, covered), 1
    elif options.occlusion and limit is not None and _has_several_kernels(plans, options):
        widest = [max(map(abs, plan.coc_px)) for plan in plans]
        levels = [min(math.ceil(math.log2(max(2.0, most))) + 1, native.MOST_LEVELS) for most in widest]
        surfaces, behind = surfaces_of_image(light, coc, weight, limit, levels, ops, covered)
        behind = behind if rules.active().light_behind else None

    splats = None
    if limit is not None and splatted_px is not None:
        surfaces, splats = _splat_highlights(surfaces, own, limit, splatted_px, plans, options, ops)

    out = _composite(surfaces, behind, plans, options, ops, own, limit, splats) / scale
    out = out if valid is None else torch.where(valid, out, image)
    return ops.equal_unless(lambda: blur_axis(coc).abs().max() > 0, out, image)


def _has_several_kernels(plans: Sequence[Plan], options: Options) -> bool:
    """Whether there are several layers, or kernels that change across the frame; else the only kernel is exact."""
    return len(plans[0].nodes) > 1 or options.table.depends_on_place


def _splatted_px(plans: Sequence[Plan], options: Options, ops: Ops) -> list[float] | None:
    """Blur in pixels from which highlights are splatted ray by ray, of all items or of each plan; None: none are.

    With occlusion all are; without, only those that a coarse layer would soften. A compiled graph has no rays, as their
    number depends on the light.
    """
    has_rays = plans[0].rays and ops.has_rays and rules.active().rays and not is_compiled()
    if not has_rays or not _has_several_kernels(plans, options):
        return None
    if options.occlusion:
        return [0.0]
    crisp_px = [plan.crisp_px if options.method == "layered" else math.inf for plan in plans]
    is_coarse = any(crisp < max(map(abs, plan.coc_px)) for crisp, plan in zip(crisp_px, plans, strict=True))
    return [crisp - 1.0 for crisp in crisp_px] if is_coarse else None


def _splat_highlights(
    surfaces: list[Surface],
    own: int,
    limit: Tensor,
    splatted_px: Sequence[float],
    plans: Sequence[Plan],
    options: Options,
    ops: Ops,
) -> tuple[list[Surface], Tensor | None]:
    """Takes the highlights out of surfaces and splats them: the surfaces without them, and the light of the rays.

    ``own`` is the index of the image's own surface: 1 if there is a known background, which comes last.
    """
    coc = surfaces[own].coc_px
    (from_px,) = _of_plans([(px,) for px in splatted_px], coc)
    # with a known background, mixed pixels need no second surface for their highlights
    beside = [(s, coc) for s in surfaces[::-1]] if len(surfaces) == 2 else [None] * len(surfaces)
    reach = [plan.reach(options.table, ops.lens_width or coc.shape[-1]) for plan in plans]
    most_taps = highlights.affordable_taps(coc, reach) if options.occlusion else None
    extracted = [
        highlights.extract(s, limit, from_px, b, most_taps, ops) for s, b in zip(surfaces, beside, strict=True)
    ]
    surfaces, rays = [s for s, _ in extracted], [r for _, r in extracted if r is not None]
    if not rays:
        return surfaces, None
    # surfaces that can block rays, the image's own first; a known background is the farthest and blocks none
    shown = surfaces[1::-1] if own else surfaces
    stops = options.occlusion and rules.active().occluders
    return surfaces, highlights.splat(rays, shown, options.table, stops, plans[0].kernels_per_px, ops)


def _reach(plans: Sequence[Plan], like: Tensor) -> Sequence[Any]:
    """Smallest and largest coc of the layers, of the only plan or ``[B, 1, 1, 1]``."""
    return _of_plans([(plan.coc_px[0], plan.coc_px[-1]) for plan in plans], like)


def _of_plans(values: Sequence[Sequence[float]], like: Tensor) -> Sequence[Any]:
    """The values of the only plan, or tensors ``[B, 1, 1, 1]`` of those of all plans."""
    return values[0] if len(values) == 1 else like.new_tensor(values)[..., None, None, None].unbind(1)


def _before_background(
    surface: Surface,
    behind: Tensor,
    behind_coc: Tensor,
    ends: Sequence[Any],
    options: Options,
    covered: Tensor | None,
) -> list[Surface]:
    """Surfaces of an image in front of a known background, near to far; its coc is clamped to ``ends``."""
    light, coc, weight = surface
    valid = None if options.check else torch.isfinite(behind_coc) & torch.isfinite(behind).all(1, keepdim=True)
    behind_coc = behind_coc.clamp(*ends)
    own_light, other_light, other_coc, other_weight = matte(light, coc, weight, covered=covered)
    # 0 where the background is the surface in the image, or the farther one of a mixed pixel
    apart, of_farther = ((behind_coc - c - _SAME_PX).clamp(0.0, 1.0) for c in (coc, torch.maximum(coc, other_coc)))
    # of two surfaces the nearer one stays; the background replaces the farther one if that shows it
    own_weight = 1.0 - other_weight * (1.0 - of_farther)
    other_weight = torch.where(other_coc < coc, other_weight, 0.0)
    if weight is not None:
        own_weight, other_weight = own_weight * weight, other_weight * weight
    behind_weight = apart + (1.0 - apart) * other_weight
    if valid is not None:
        behind, behind_coc, behind_weight = (torch.where(valid, t, 0.0) for t in (behind, behind_coc, behind_weight))
    own, other = Surface(own_light, coc, own_weight), Surface(other_light, other_coc, other_weight)
    background = Surface(behind, torch.maximum(behind_coc, coc), behind_weight)
    return [other, own, background]


def _composite(
    surfaces: list[Surface],
    behind: Tensor | None,
    plans: Sequence[Plan],
    options: Options,
    ops: Ops,
    image: int | None,
    limit: Tensor | None = None,
    splats: Tensor | None = None,
) -> Tensor:
    """Composite surfaces and add highlights; ``image`` is the index of the image's own surface, None for a stack."""
    light, layered = surfaces[0].light, options.method == "layered"
    size = (light.shape[-2], light.shape[-1])
    if len(plans) == 1:
        nodes, table = [plans[0].nodes], options.table
        blurs = plans[0].layer_kernels(table, size, light.dtype, light.device, layered, ops.lens_width, ops.kernels)
    else:
        nodes, blurs = joined_layers(plans, options.table, size, light)
    coarsest = max(blur.scale for blur in blurs)
    margin = -(-max(blur.halo for blur in blurs) // coarsest) * coarsest
    behind = None if behind is None else behind_pixels(behind, size)
    beyond = Beyond(margin, coarsest, options.occlusion or options.normalize, limit)
    frame = pad_to_frame(surfaces, behind, nodes, beyond, options.occlusion, image)
    scatter = functools.partial(convolve, turned=not options.table.is_round) if layered else fold

    def scattered(frame: PaddedFrame) -> Tensor:
        if options.occlusion:
            return composite.over(frame, blurs, scatter, ops)
        if layered:
            return composite.accumulate(frame, blurs, scatter, ops)
        return composite.accumulate_once(frame, blurs)

    out = ops.render(frame, scattered)
    if options.occlusion:
        return out if splats is None else out + splats
    return composite.mean(out, frame.colours, options.normalize, splats)
