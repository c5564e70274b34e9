"""Render with the compiled engine (:mod:`torchdof.native`) where it supports the arguments."""

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from .. import native
from ..optics.aperture import Aperture
from ..optics.blur_table import BlurTable
from ..optics.kernel_bank import bank_of
from ..optics.placed_kernels import FieldMask, ray_masks
from ..options import Options
from ..tensors import is_in_memory, is_traced
from . import exposure
from .plan import KERNELS_PER_PX, Plan, kernels_of, layer_spots, longest_px

__all__ = ["picture"]


def picture(
    plan: Plan,
    options: Options,
    light: Tensor,
    coc: Tensor,
    behind_light: Tensor | None = None,
    behind_coc: Tensor | None = None,
    cover: Tensor | None = None,
    lens_width: int | None = None,
) -> Tensor | None:
    """Render ``[B, C, H, W]`` item by item; None if the compiled engine does not support the arguments.

    It supports ``method="layered"`` in float32 on the CPU, in eager code without gradients. Arguments are those of
    ``torchdof.render.pipeline._render_items``; ``lens_width`` is the width in pixels of the image whose kernels are
    used, if it differs from the picture's.
    """
    if options.table.is_differentiated:
        return None
    given = [t for t in (light, coc, behind_light, behind_coc, cover) if t is not None]
    if plan.rays and plan.kernels_per_px != KERNELS_PER_PX:
        return None
    if options.method != "layered" or is_traced() or not native.chosen() or not all(map(_is_plain, given)):
        return None
    height, width = int(light.shape[-2]), int(light.shape[-1])
    lens_width = lens_width or width
    kernels_width, scales = plan.layer_sizes(options.table, (height, lens_width), coarse=True)
    spots = layer_spots(options.table, plan.coc_px, kernels_width, scales, longest_px((height, width), scales))
    if max(spots.half) > native.HALF_LARGEST:
        return None
    layers = list(zip(kernels_of(options.table, spots, torch.float32), scales, strict=True))
    render = functools.partial(_render, plan, options, layers, lens_width)
    if cover is not None:
        low, high = plan.coc_px[0], plan.coc_px[-1]
        coc = coc.clamp(low, high)
        # a black surface behind the layers, for pixels that no layer covers
        nothing, farthest = torch.zeros_like(light[0, 0]), torch.full_like(coc[0, 0, 0], high)
        items = []
        for surfaces in zip(light, coc[:, :, 0], cover[:, :, 0], strict=True):
            items.append(render([*zip(*surfaces, strict=True), (nothing, farthest, None)], "stack"))
    elif behind_light is not None and behind_coc is not None:
        shown, hidden = zip(light, coc[:, 0], strict=True), zip(behind_light, behind_coc[:, 0], strict=True)
        items = [render([(*a, None), (*b, None)], "background") for a, b in zip(shown, hidden, strict=True)]
    else:
        items = [render([(*item, None)], "image") for item in zip(light, coc[:, 0], strict=True)]
    return items[0][None] if len(items) == 1 else torch.stack(items)


def _is_plain(values: Tensor) -> bool:
    """Whether the compiled engine can read a tensor: float32 in CPU memory, without gradients."""
    return values.dtype == torch.float32 and is_in_memory(values)


def _render(
    plan: Plan,
    options: Options,
    layers: Sequence[tuple[Tensor, int]],
    lens_width: int,
    surfaces: Sequence[tuple[Tensor, Tensor, Tensor | None]],
    kind: native.Kind,
) -> Tensor:
    """Render one item to ``[C, H, W]``."""
    height, width = surfaces[0][0].shape[-2:]
    aperture = options.table.aperture or Aperture()
    like = torch.empty(0, device="cpu")
    render = functools.partial(
        native.render,
        kind=kind,
        nodes=plan.nodes,
        layers=layers,
        psfs=functools.partial(_psfs, options.table, lens_width, int(max(height, width))),
        occlusion=options.occlusion,
        normalize=options.normalize,
        masked=kind != "stack" and not options.check,
        highlights=plan.rays,
        crisp_px=plan.crisp_px,
        reach=plan.reach(options.table, lens_width),
        field_masks=plan.field_masks(options.table, [scale for _, scale in layers], (int(height), int(width)), like),
        ray_masks=functools.partial(_ray_masks, options.table, (int(height), int(width))),
        squeeze=float(aperture.squeeze),
    )
    if kind != "background":
        try:
            return render(surfaces)  # raises OverflowError if light is too bright; a stack is scaled already
        except OverflowError:
            pass
    scale = float(exposure.scale_of(*(light[None] for light, _, _ in surfaces[:2])))
    return render([(light * scale, coc, weight) for light, coc, weight in surfaces]) / scale


def _ray_masks(table: BlurTable, size: tuple[int, int], steps: Sequence[int]) -> list[FieldMask]:
    """Field masks for the kernels of highlights with a coc of ``steps / KERNELS_PER_PX`` pixels."""
    return [
        s.to(torch.empty(0, device="cpu")) for s in ray_masks(table, [step / KERNELS_PER_PX for step in steps], size)
    ]


def _psfs(table: BlurTable, width: int, longest: int, steps: Sequence[int]) -> list[Tensor]:
    """Kernels ``[1 or C, k, k]`` of highlights with a coc of ``steps / KERNELS_PER_PX`` pixels."""
    coc_px = [step / KERNELS_PER_PX for step in steps]
    spots = bank_of(table).spots(coc_px, width, longest=[longest] * len(coc_px))
    return kernels_of(table, spots, torch.float32)
