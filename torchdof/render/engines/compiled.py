"""Render with the compiled engine (:mod:`torchdof.native`) where it supports the arguments."""

import functools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ... import native
from ...optics.aperture import Aperture
from ...optics.blur_table import BlurTable
from ...optics.kernel_bank import Spots, bank_of
from ...optics.placed_kernels import ray_masks
from ...options import Options
from .. import exposure
from ..layers.plan import KERNELS_PER_PX, Plan, kernels_of, layer_spots, longest_px


def layer_spots_of(plan: Plan, table: BlurTable, size: tuple[int, int], lens_width: int | None) -> Spots:
    """Recipe for the kernels of the layers of a picture of ``size``; ``lens_width`` as for :func:`picture`."""
    width, scales = plan.layer_sizes(table, lens_width or size[1], coarse=True)
    return layer_spots(table, plan.coc_px, width, scales, longest_px(size, scales))


def picture(
    plan: Plan,
    options: Options,
    spots: Spots,
    light: Tensor,
    coc: Tensor,
    behind_light: Tensor | None = None,
    behind_coc: Tensor | None = None,
    cover: Tensor | None = None,
    covered: Tensor | None = None,
    lens_width: int | None = None,
) -> Tensor:
    """Render ``[B, C, H, W]`` item by item, if the compiled engine can (:func:`torchdof.render.routes.route`).

    ``spots`` are those of :func:`layer_spots_of`. The other arguments are those of :mod:`torchdof.render.pipeline`;
    ``lens_width`` is the width in pixels of the image whose kernels are used, if it differs from the picture's.
    """
    table, size = options.table, (int(light.shape[-2]), int(light.shape[-1]))
    lens_width = lens_width or size[1]
    _, scales = plan.layer_sizes(table, lens_width, coarse=True)
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
    if cover is not None:
        low, high = plan.coc_px[0], plan.coc_px[-1]
        # a black surface behind the layers, for pixels that no layer covers
        nothing, farthest = torch.zeros_like(light[0, 0]), torch.full_like(coc[0, 0, 0], high)
        items = []
        for surfaces in zip(light, coc[:, :, 0].clamp(low, high), cover[:, :, 0], strict=True):
            items.append(render([*zip(*surfaces, strict=True), (nothing, farthest, None)], "stack"))
        return torch.stack(items)
    of_items = [None] * len(light) if covered is None else [*covered]
    if behind_light is not None and behind_coc is not None:
        items = []
        each = zip(light, coc[:, 0], behind_light, behind_coc[:, 0], of_items, strict=True)
        for own, own_coc, other, other_coc, known in each:
            scale = exposure.scale_of(own[None], other[None])[0]
            scaled = [(own * scale, own_coc, None), (other * scale, other_coc, None)]
            items.append(render(scaled, "background", covered=known) / scale)
    else:
        items = [_image(render, *item) for item in zip(light, coc[:, 0], of_items, strict=True)]
    return items[0][None] if len(items) == 1 else torch.stack(items)


def _image(render: Callable[..., Tensor], light: Tensor, coc: Tensor, covered: Tensor | None) -> Tensor:
    """Render one image, with very bright light scaled down."""
    try:
        return render([(light, coc, None)], "image", covered=covered)
    except OverflowError:
        scale = exposure.scale_of(light[None])[0]
        return render([(light * scale, coc, None)], "image", covered=covered) / scale
