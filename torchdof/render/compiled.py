"""Render with the compiled engine (:mod:`torchdof.native`) where it supports the arguments."""

import functools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .. import native
from ..optics.aperture import Aperture
from ..optics.kernel_bank import bank_of
from ..optics.placed_kernels import ray_masks
from ..options import Options
from ..tensors import is_in_memory, is_traced
from . import exposure
from .plan import KERNELS_PER_PX, Plan, kernels_of, layer_spots, longest_px


def picture(
    plan: Plan,
    options: Options,
    light: Tensor,
    coc: Tensor,
    behind_light: Tensor | None = None,
    behind_coc: Tensor | None = None,
    moved_px: Tensor | None = None,
    cover: Tensor | None = None,
    lens_width: int | None = None,
) -> Tensor | None:
    """Render ``[B, C, H, W]`` item by item; None if the compiled engine does not support the arguments.

    It supports ``method="layered"`` in float32 on the CPU, in eager code without gradients. Arguments are those of
    :mod:`torchdof.render.pipeline`; ``lens_width`` is the width in pixels of the image whose kernels are
    used, if it differs from the picture's.
    """
    table, given = options.table, [t for t in (light, coc, behind_light, behind_coc, moved_px, cover) if t is not None]
    if table.is_differentiated or options.method != "layered" or is_traced() or not native.chosen():
        return None
    if plan.rays and cover is None and plan.kernels_per_px != KERNELS_PER_PX:
        return None
    if not all(t.dtype == torch.float32 and is_in_memory(t) for t in given):
        return None
    size = (int(light.shape[-2]), int(light.shape[-1]))
    lens_width = lens_width or size[1]
    kernels_width, scales = plan.layer_sizes(table, lens_width, coarse=True)
    spots = layer_spots(table, plan.coc_px, kernels_width, scales, longest_px(size, scales))
    if max(spots.half) > native.HALF_LARGEST:
        return None
    cpu = torch.empty(0, dtype=torch.float32, device="cpu")

    def psfs(steps: Sequence[int]) -> list[Tensor]:
        radii = [step / KERNELS_PER_PX for step in steps]
        return kernels_of(table, bank_of(table).spots(radii, lens_width, longest=[max(size)] * len(radii)), cpu.dtype)

    render = functools.partial(
        native.render,
        nodes=plan.nodes,
        layers=list(zip(kernels_of(table, spots, cpu.dtype), scales, strict=True)),
        psfs=psfs,
        occlusion=options.occlusion,
        normalize=options.normalize,
        masked=cover is None and not options.check,
        highlights=plan.rays and cover is None,
        crisp_px=plan.crisp_px,
        reach=plan.reach(table, lens_width),
        field_masks=[mask.to(cpu) for mask in plan.field_masks(table, scales, size)],
        ray_masks=lambda steps: [m.to(cpu) for m in ray_masks(table, [step / KERNELS_PER_PX for step in steps], size)],
        squeeze=float((table.aperture or Aperture()).squeeze),
    )
    moved = [None] * len(light) if moved_px is None else moved_px[:, 0]
    if cover is not None:
        low, high = plan.coc_px[0], plan.coc_px[-1]
        # a black surface behind the layers, for pixels that no layer covers
        nothing, farthest = torch.zeros_like(light[0, 0]), torch.full_like(coc[0, 0, 0], high)
        items = []
        for surfaces in zip(light, coc[:, :, 0].clamp(low, high), cover[:, :, 0], strict=True):
            items.append(render([*zip(*surfaces, strict=True), (nothing, farthest, None)], "stack"))
    elif behind_light is not None and behind_coc is not None:
        items = []
        each = zip(light, coc[:, 0], behind_light, behind_coc[:, 0], moved, strict=True)
        for own, own_coc, other, other_coc, moved_by in each:
            scale = exposure.scale_of(own[None], other[None])[0]
            scaled = [(own * scale, own_coc, None), (other * scale, other_coc, None)]
            items.append(render(scaled, "background", moved=moved_by) / scale)
    else:
        items = [_image(render, *item) for item in zip(light, coc[:, 0], moved, strict=True)]
    return items[0][None] if len(items) == 1 else torch.stack(items)


def _image(render: Callable[..., Tensor], light: Tensor, coc: Tensor, moved: Tensor | None) -> Tensor:
    """Render one image, with very bright light scaled down."""
    try:
        return render([(light, coc, None)], "image", moved=moved)
    except OverflowError:
        scale = exposure.scale_of(light[None])[0]
        return render([(light * scale, coc, None)], "image", moved=moved) / scale
