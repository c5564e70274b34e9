"""What a plan means for one scene: where each layer is computed, how, and what that costs."""

import dataclasses
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from .frame import TILE, Frame, Sample, margin_and_align
from .layers import blur_axis, share_at_or_behind
from .optics.blur_table import BlurTable
from .plan import Blur, Plan

__all__ = ["LayerUse", "Survey", "survey"]

# Costs in nanoseconds, measured on one core; only their ratios matter here.
_PASSES_NS = 40.0  # elementwise work, a pixel of a window
_TAP_NS = 0.12  # a tap of the kernel, a pixel at the layer's resolution
_MEAN_NS = 100.0  # a pixel of the frame that is averaged for a coarser layer
_HIDDEN_NS = 120.0  # mixed and hidden surfaces, a pixel of the frame
_COPY_NS = 20.0  # a layer in focus, a pixel
_ERROR = 0.3  # RMS error over the tolerance, on scenes that are blurred all over; measured: 0 to 0.6


@dataclasses.dataclass(frozen=True)
class LayerUse:
    """One layer in one scene.

    Args:
        coc_px: Signed radius of its kernel.
        pixels: Share of the frame's pixels that it carries; the layers' shares sum to 1.
        frame: Share of the frame's tiles that its light reaches, in which it is computed.
        box: Left, top, right and bottom of these tiles in pixels; None where there is none.
        scale: It is spread at every ``scale``-th pixel.
        kernel_px: Width of its kernel, in pixels of that resolution; 1 is a copy.
        time: Predicted share of the rendering time.
    """

    coc_px: float
    pixels: float
    frame: float
    box: tuple[int, int, int, int] | None
    scale: int
    kernel_px: int
    time: float


@dataclasses.dataclass(frozen=True)
class Survey:
    """A plan in a scene; ``print`` shows it as a table.

    Args:
        size: Height and width of the frame.
        tolerance: What the plan was made for.
        layers: Near to far.
        hidden_time: Predicted share of the rendering time that goes into mixed and hidden surfaces.
        in_focus: Share of the frame's pixels that no blur moves.
        rms_error: Predicted error, display-encoded, in the sense of the tolerance. It is a rule of thumb from
            ray-traced scenes, where errors were between none and twice this.
    """

    size: tuple[int, int]
    tolerance: float
    layers: tuple[LayerUse, ...]
    hidden_time: float
    in_focus: float
    rms_error: float

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        height, width = self.size
        yield (
            f"{width} x {height}, tolerance {255 * self.tolerance:.3g}/255, predicted error "
            f"{255 * self.rms_error:.2g}/255 RMS; {len(self.layers)} layers, {self.in_focus:.0%} in focus"
        )
        yield f"{'coc px':>8} {'pixels':>7} {'frame':>6} {'time':>5}  {'at':5} {'kernel':7} where"
        for layer in self.layers:
            where = "nowhere" if layer.box is None else "x {0} to {2}, y {1} to {3}".format(*layer.box)
            if layer.box == (0, 0, width, height):
                where = "everywhere"
            kernel = "copy" if layer.kernel_px == 1 else f"{layer.kernel_px} px"
            yield (
                f"{layer.coc_px:8.2f} {layer.pixels:7.1%} {layer.frame:6.0%} {layer.time:5.0%}  "
                f"{'1/' + str(layer.scale) if layer.scale > 1 else 'full':5} {kernel:7} {where}"
            )
        if self.hidden_time:
            yield f"{'mixed and hidden surfaces':>23} {self.hidden_time:5.0%}"


def survey(plan: Plan, coc_px: Tensor, table: BlurTable, layered: bool, occlusion: bool) -> Survey:
    """What a plan means for a scene.

    Args:
        plan: Layers.
        coc_px: ``[B, 1, H, W]``; of a batch, the means, and the boxes that hold those of all items.
        table: Blur.
        layered: As ``method="layered"``.
        occlusion: As in :class:`torchdof.DepthOfField`.
    """
    coc = torch.where(torch.isfinite(coc_px), coc_px.detach(), 0.0).float().cpu()
    height, width = (int(n) for n in coc.shape[-2:])
    x = blur_axis(coc).clamp(plan.nodes[0], plan.nodes[-1])
    blurs = plan.blurs(table, (height, width), x.dtype, x.device, coarse=layered)
    at_or_behind = [float(share_at_or_behind(x, plan.nodes, k).mean()) for k in range(len(plan.nodes) + 1)]
    tiles = [_tiles(item, plan, blurs) for item in x.split(1)]
    found, costs = [], []
    for k, (node, blur) in enumerate(zip(plan.coc_px, blurs, strict=True)):
        here = torch.stack([t[k] for t in tiles])
        share = float(here.float().mean())
        pixels = at_or_behind[k] - at_or_behind[k + 1]
        costs.append(_cost(share, pixels, blur, (height, width)))
        found.append(
            LayerUse(node, pixels, share, _box(here.any(0), (height, width)), blur.scale, 2 * blur.half + 1, 0.0)
        )
    hidden = _HIDDEN_NS * height * width if occlusion and len(plan.nodes) > 1 else 0.0
    whole = sum(costs) + hidden
    in_focus = float((x == 0).float().mean())
    return Survey(
        (height, width),
        plan.tolerance,
        tuple(dataclasses.replace(layer, time=cost / whole) for layer, cost in zip(found, costs, strict=True)),
        hidden / whole,
        in_focus,
        _ERROR * plan.tolerance * math.sqrt(1.0 - in_focus) if len(plan.nodes) > 1 else 0.0,
    )


def _tiles(x: Tensor, plan: Plan, blurs: list[Blur]) -> list[Tensor]:
    return Frame([Sample(x, x)], *margin_and_align(blurs), tiled=True, extend=False).occupancy(plan, blurs)


def _cost(share: float, own: float, blur: Blur, size: tuple[int, int]) -> float:
    """Nanoseconds that a layer takes, in windows of tiles or, where these overlap too much, of the frame.

    Args:
        share: Of the frame's tiles that its light reaches.
        own: Of the frame's pixels that it carries.
        blur: How it is spread.
        size: Of the frame.
    """
    area = size[0] * size[1]
    if blur.half == 0:
        return _COPY_NS * share * area
    height, width = (n / blur.scale for n in size)
    windows = share * height * width * ((TILE + 2 * blur.half) / TILE) ** 2
    pixels = min(windows, (height + 2 * blur.half) * (width + 2 * blur.half)) if share else 0.0
    means = 2.0 * own * area * _MEAN_NS if blur.scale > 1 else 0.0  # a pixel lies between two layers
    return pixels * (_PASSES_NS + _TAP_NS * (2 * blur.half + 1) ** 2) + means


def _box(tiles: Tensor, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    if not bool(tiles.any()):
        return None
    rows, columns = (tiles.any(dim).nonzero()[:, 0] for dim in (1, 0))
    right, bottom = min(int(columns[-1] + 1) * TILE, size[1]), min(int(rows[-1] + 1) * TILE, size[0])
    return int(columns[0]) * TILE, int(rows[0]) * TILE, right, bottom
