"""Kernels that depend on the place in the frame: a kernel of the middle times a mask, turned by the azimuth.

A lens is rotationally symmetric. So field masks, in [0, 1], are computed only along one line from the middle of the
frame, at a few distances, in coordinates ``u`` away from the middle and ``v`` across (:mod:`torchdof.optics.field`).
The kernel of a place ``p`` is ``K_p[m] = K[m] mask_p(m) / sum_m K[m] mask_p(m)``, with ``K`` the kernel of the middle,
and ``mask_p`` interpolated between two distances, turned by the azimuth of ``p`` and sampled bilinearly at the pixels.
The division keeps the light: the sharp image shows the darkening of the corners already.

* Traced and measured spots: ``K`` is a uniform disc, and the mask is the spot itself, averaged over a pixel.
* Cat's eyes (``vignetting=``): ``K`` has the whole opening. A ray through the point ``w`` of the aperture to a place
  ``p`` in the frame (from its middle, in half diagonals) passes where ``|w + 2 front p| <= 1`` and
  ``|w - 2 rear p| <= 1``: it is cut by a rim in front of the aperture and one behind it. The mask is the signed
  distance in pixels to the edge of the nearer rim, plus half a pixel, clamped to [0, 1].
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from .aperture import overlaps
from .field import bracket, deviations
from .kernel_bank import SPOT_MARGIN_PX, Table
from .kernel_cache import KernelCache

__all__ = ["DISTANCES", "FieldMask", "layer_mask", "placed", "placed_between", "ray_masks"]

DISTANCES = 17
"""Number of distances, from the middle of the frame to its corner, at which masks are computed."""

_SAMPLES_PER_PX = 4.0  # samples of a mask per pixel
_MAX_SAMPLES = 64  # most samples on each side of the origin
_MIN_AVERAGED_PX = 0.5  # px; smallest width over which a sample averages the spot
_CENTRE_OFFSET = 1e-6  # half diagonals; offset that gives the middle of the frame an azimuth
_MIN_SCALE_PX = 1e-6  # px; smallest scale of a spot, so that boxes have a size in focus
_MIN_LIGHT = 1e-6  # share of a kernel's light; where less passes, the kernel is not masked
_MIN_SHRINK = 0.5  # smallest scale of a spot, which is shrunk by the blur that sampling adds
_RADIUS_RATIO = 1.09  # ratio of neighbouring radii at which the masks of highlights are computed
_masks = KernelCache(128 * 2**20)


class FieldMask(NamedTuple):
    """Mask for the kernels of one signed circle of confusion, at :data:`DISTANCES` distances from middle to corner."""

    values: Tensor  # [1 or C, distances, rows, columns]; rows along increasing u, columns along v from 0
    boxes: Tensor  # [distances, 3], extent of the values: centre in u, half length in u, width in v, in kernel pixels
    coc_px: float  # in pixels of the kernel
    squeeze: float | Tensor = 1.0  # height of the blur over its width; horizontal offsets are multiplied by it

    def to(self, like: Tensor) -> "FieldMask":
        """These masks with the dtype and device of ``like``."""
        return self._replace(values=self.values.to(like).contiguous(), boxes=self.boxes.to(like).contiguous())


def layer_mask(table: Table, coc_px: float, scale: int, size: tuple[int, int]) -> FieldMask:
    """Field mask of a layer downsampled by ``scale``, with a signed coc in pixels of an image ``size`` (H, W)."""
    key = ("layer", table.fingerprint(), coc_px, scale, size)
    values, boxes = _masks.get(key, lambda: _computed(table, coc_px, scale, size))
    return FieldMask(values, boxes, coc_px / scale, _squeeze(table))


def ray_masks(table: Table, coc_px: Sequence[float], size: tuple[int, int]) -> list[FieldMask]:
    """Field masks for highlights with signed ``coc_px``, ordered by coc.

    They are computed at fixed radii, powers of ``_RADIUS_RATIO``: the two around each highlight.
    """
    below = {
        (math.floor(math.log(max(abs(coc), 1.0)) / math.log(_RADIUS_RATIO)), -1.0 if coc < 0 else 1.0) for coc in coc_px
    }
    radii = sorted({sign * _RADIUS_RATIO ** (exponent + up) for exponent, sign in below for up in (0, 1)})
    keys = [("ray", table.fingerprint(), radius, 1, size) for radius in radii]
    computed = _masks.get_all(keys, lambda missing: [_computed(table, key[2], 1, size) for key in missing])
    squeeze = _squeeze(table)
    return [FieldMask(values, boxes, radius, squeeze) for (values, boxes), radius in zip(computed, radii, strict=True)]


def _squeeze(table: Table) -> float | Tensor:
    return 1.0 if table.aperture is None else table.aperture.squeeze


@torch.inference_mode(False)  # cached tensors must be usable by autograd
def _computed(table: Table, coc_px: float, scale: int, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Values and boxes of :class:`FieldMask`, float64.

    Values of a spot are means over a pixel; its box is shrunk by the variance that downsampling and sampling add.
    """
    distance = _line(0.0, DISTANCES)
    if table.field is None:
        return _through_rims(table, coc_px / scale, size[1] / scale, distance)
    per_unit = table.px_per_unit(size[1])
    boxes, light = table.field.spots(coc_px / per_unit, distance * (0.5 * math.hypot(*size)) / per_unit)
    # below 1 px the spot shrinks with the coc, so that a point in focus stays a point and blur starts continuously
    boxes = boxes * (per_unit / scale * min(1.0, max(abs(coc_px), _MIN_SCALE_PX)))
    # variance added by averaging blocks, interpolating between them, and by the box of a pixel below, in px^2
    added_variance = (1 / 4 - 1 / (12 * scale**2) if scale > 1 else 0.0) + 1 / 12
    length, width = light.shape[-2:]
    cells = boxes[:, 1:] * torch.tensor([2.0 / length, 1.0 / width], dtype=torch.float64, device="cpu")
    spread = deviations(boxes, light).square()
    shrink = (1.0 - added_variance / spread.clamp_min(1e-12)).clamp_min(_MIN_SHRINK**2).sqrt()
    boxes = torch.cat([boxes[:, :1], boxes[:, 1:] * shrink], -1)
    extent = boxes + torch.tensor([0.0, SPOT_MARGIN_PX, SPOT_MARGIN_PX], dtype=torch.float64, device="cpu")
    ideal_counts = (_SAMPLES_PER_PX * extent[:, 1:].amax(0)).clamp(max=_MAX_SAMPLES)
    rows, columns = (math.ceil(number) for number in ideal_counts.tolist())
    counts = torch.tensor([rows, columns], device="cpu")
    extent[:, 1:] *= counts / ideal_counts  # a sample's size is a continuous function of the radius
    along, across = _line(-1.0, 2 * rows + 1) * extent[:, 1:2] + extent[:, :1], _line(0.0, columns + 1) * extent[:, 2:]
    row_edges = _line(-1.0, length + 1) * boxes[:, 1:2] + boxes[:, :1]
    column_edges = _line(-1.0, 2 * width + 1) * boxes[:, 2:]
    mirrored = torch.cat([light.flip(-1), light], -1)  # [C, distances, U, 2 V]
    area = cells.prod(-1)[:, None, None]
    # width of the average: a pixel, minus the variance that cells and linear interpolation between samples add
    sample_px = extent[:, 1:] / counts
    averaged_px = (1.0 - 2.0 * sample_px.square() - 3.0 * cells.square()).clamp_min(_MIN_AVERAGED_PX**2).sqrt()
    half_length, half_width = (0.5 * averaged_px).unsqueeze(-1).unbind(1)
    values = overlaps(along - half_length, along + half_length, row_edges) @ (mirrored / area)
    values = values @ overlaps(across - half_width, across + half_width, column_edges).transpose(-2, -1)
    return values / values.amax((0, 2, 3), keepdim=True), extent


def _through_rims(table: Table, coc_px: float, width: float, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Values and boxes for cat's eyes: signed distances in pixels to the nearer rim, plus half a pixel, unclamped."""
    # whole pixels, so that samples lie a pixel apart, whatever the squeeze
    reach = math.ceil((math.ceil(table.reach_px(coc_px, width)) + 1) * max(1.0, float(table.aperture.squeeze)))
    boxes = torch.tensor([0.0, reach, reach], dtype=torch.float64, device="cpu").expand(len(distance), 3)
    count = min(2 * _MAX_SAMPLES, reach)
    along, across = _line(-1.0, 2 * count + 1) * reach, _line(0.0, count + 1) * reach
    front, rear = table.aperture.rims
    depths = []
    for shift in (2.0 * front * coc_px, -2.0 * rear * coc_px):
        distance_px = torch.hypot(along[None, :, None] + shift * distance[:, None, None], across)
        # a rim shifted by less than a pixel cuts less, so that kernels in the middle of the frame are unchanged
        slack = 4.0 * (abs(coc_px) + 1.0) * (1.0 - abs(shift) * distance).clamp_min(0.0)[:, None, None]
        depths.append(abs(coc_px) + 0.5 + slack - distance_px)
    return torch.minimum(*depths).unsqueeze(0), boxes.contiguous()


def _line(start: float, count: int) -> Tensor:
    """Numbers from ``start`` to 1, float64."""
    return torch.linspace(start, 1.0, count, dtype=torch.float64, device="cpu")


def placed(kernel: Tensor, masks: Sequence[tuple[FieldMask, Tensor]], y: Tensor, x: Tensor) -> Tensor:
    """Kernels ``[n, 1 or C, k, k]`` of places in the frame, from that of the middle ``[1 or n, 1 or C, k, k]``.

    ``masks`` are those of one radius, or of two neighbouring ones, each with its weight ``[n]`` or ``[]``; ``y`` and
    ``x`` are places ``[n]``, in half diagonals down and to the right of the middle. The sum of ``kernel`` is kept.
    """
    offset = torch.arange(kernel.shape[-1], dtype=kernel.dtype, device=kernel.device) - kernel.shape[-1] // 2
    y, x = (t.to(kernel.dtype)[:, None, None] for t in (y, x))
    x = x + _CENTRE_OFFSET
    distance = torch.sqrt(y * y + x * x)
    down, right = y / distance, x / distance
    position = distance.flatten().clamp(max=1.0) * (DISTANCES - 1)
    low = position.long().clamp(max=DISTANCES - 2)
    fraction = position - low
    across = offset * masks[0][0].squeeze
    u, v = offset[:, None] * down + across * right, (across * down - offset[:, None] * right).abs()
    boxes = [w.reshape(-1, 1) * torch.lerp(m.boxes[low], m.boxes[low + 1], fraction[:, None]) for m, w in masks]
    box = torch.stack(boxes).sum(0)  # [n, 3]
    grid = torch.stack([2.0 * v / box[:, 2:, None] - 1.0, (u - box[:, :1, None]) / box[:, 1:2, None]], -1)
    mask = kernel.new_zeros(())
    for entry, weight in masks:
        values = torch.lerp(entry.values[:, low], entry.values[:, low + 1], fraction[:, None, None]).transpose(0, 1)
        mask_part = functional.grid_sample(values, grid, padding_mode="border", align_corners=True).clamp(0.0, 1.0)
        mask = mask + weight.reshape(-1, 1, 1, 1) * mask_part
    masked = kernel * mask
    light, light_left = (k.sum((-2, -1), keepdim=True) for k in (kernel, masked))
    return torch.where(light_left > _MIN_LIGHT * light, masked * (light / light_left.clamp_min(1e-30)), kernel)


def placed_between(kernels: Tensor, masks: Sequence[FieldMask], coc: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """As :func:`placed`, with masks of :func:`ray_masks` interpolated between the radii around each coc ``[n]``."""
    radii = torch.tensor([entry.coc_px for entry in masks], dtype=coc.dtype, device=coc.device)
    low, weights = bracket(radii, coc)
    result = torch.empty_like(kernels.expand(-1, max(kernels.shape[1], masks[0].values.shape[0]), -1, -1))
    for k in low.unique().tolist():
        items = (low == k).nonzero()[:, 0]
        pair = [(masks[k], 1.0 - weights[items]), (masks[k + 1], weights[items])]
        result = result.index_put((items,), placed(kernels[items], pair, y[items], x[items]))
    return result
