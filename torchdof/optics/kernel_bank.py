"""Kernels of any radius from templates, by two small matrix products.

:func:`torchdof.optics.psf.pixel_kernels` works in two steps. The first integrates a PSF over square *cells*, ``n`` from
the centre to the end of the PSF; the second weights them with the interpolator ``phi`` of each pixel. The first does
not depend on the radius. So the light in the cells, the *template* ``T``, is computed once for each node of a table. A
kernel of any radius, with cells ``h`` pixels high and ``w`` wide, is ``K = A T B'`` with ``A[m, i] = phi(m - i h)`` and
``B[m, i] = phi(m - i w)``, made non-negative and scaled to a sum of 1 as in ``pixel_kernels``.

* Templates have 16, 32, 64, 128 or 256 cells. The one in use has cells of half a pixel to a pixel. The next finer one
  is blended in while cells grow from 0.75 to 1 pixel, so that kernels are continuous functions of the radius. A PSF of
  more than 256 pixels is sampled linearly from its template.
* Between two nodes of a table, templates are interpolated linearly, and the radius follows the interpolated parameters.

The compiled engine makes the same kernels from the same templates (``native/src/kernels.cpp``).
"""

import bisect
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..tensors import is_differentiated
from . import psf
from .kernel_cache import KernelCache

__all__ = ["SPOT_MARGIN_PX", "KernelBank", "Spots", "Table", "bank_of"]

SPOT_MARGIN_PX = 1.0
"""Empty margin in pixels around a spot of a field, so that its samples fall to 0 at their border."""

_LEAST_CELLS = 16  # from the centre to the end of a PSF in the coarsest template
_LEVELS = 5  # templates of 16, 32, 64, 128 and 256 cells
_FADE_START_PX = 0.75  # px a cell; from here to 1 px the next finer template is blended in
_FADE_IN = 4.0  # weight of a blur in focus, over coc_px^2 / M; a larger one makes it complete at a smaller coc
_MIN_REACH_PX = 1e-7  # px; a smaller PSF is rendered with this radius, whose kernel is a single pixel
_MAX_LIGHT = 1e30  # of a cell; more would overflow in float32
_MAX_BANKS = 32  # banks kept in memory, the newest
_MAX_WIDTHS = 64  # image widths for which the blur in focus is kept
_templates = KernelCache(128 * 2**20)
_banks: dict[str, "KernelBank"] = {}


Table = Any
"""A :class:`torchdof.BlurTable`, whose module imports this one."""


class Spots(NamedTuple):
    """Recipe for the kernels of n circles of confusion and C colours, as plain numbers because n is small."""

    templates: list[Tensor]  # those in use, each [C, 2 cells + 3, 2 cells + 3], float32
    which: list[tuple[int, int, int, int]]  # their indices: node below and above, and both of the next finer level
    part: list[float]  # weight of the node above, in [0, 1]
    finer: list[float]  # weight of the finer level, in [0, 1]
    reach: list[list[float]]  # radius of the PSF in pixels, C for each kernel
    fade: list[list[float]]  # weight of the kernel against a single pixel, in [0, 1], C for each kernel
    flipped: list[bool]  # whether the kernel is point-reflected
    half: list[int]  # half width of each kernel in pixels; light beyond it is cut off
    moves: tuple[Tensor, Tensor] | None
    """Zeros to add to ``part`` ``[n]`` and ``reach`` ``[n, C]``, through which gradients flow to the coc; None without
    gradients. The compiled engine ignores them."""


class _Place(NamedTuple):
    """Position of a coc among the nodes of a table, and the radius of its PSF."""

    side: int  # 0 in front of focus, 1 behind it
    node: int  # index of the node below
    part: float  # weight of the next node, in [0, 1]
    reach: list[float]  # radius of the PSF of each colour, in pixels
    part_slope: float  # derivative of part with respect to |coc| in pixels
    reach_slopes: list[float]  # derivatives of reach with respect to it


def bank_of(table: Table) -> "KernelBank":
    """The bank of a table; tables with the same fingerprint share it."""
    key = table.fingerprint()
    bank = _banks.get(key)
    if bank is None:
        bank = _banks.setdefault(key, KernelBank(table))
        for oldest in list(_banks)[:-_MAX_BANKS]:
            _banks.pop(oldest, None)  # another thread may have removed it
    return bank


class KernelBank:
    """Kernels of the middle of the frame from templates that are computed when they are first needed. Thread-safe.

    All banks together keep up to 128 MB of templates, the most recently used ones. For a table with a field the kernels
    are uniform discs as large as its spots, which :mod:`torchdof.optics.placed_kernels` multiplies by the spots.

    With ``gradients`` the templates are not kept, and have gradients to the rotation and squeeze of the aperture.
    """

    def __init__(self, table: Table, gradients: bool = False) -> None:
        self.table, self._gradients = table, gradients
        self.colours, self.is_even = table.channels, table.field is not None
        squeeze = torch.as_tensor(1.0 if table.aperture is None else table.aperture.squeeze, device="cpu")
        self.squeeze = float(squeeze.detach())
        self._squeeze = squeeze if gradients else self.squeeze
        self.widest = max(1.0, 1.0 / self.squeeze)
        self._lens = table.fingerprint()
        self._moved_in_focus = functools.lru_cache(_MAX_WIDTHS)(lambda width: table.moved_in_focus(width).tolist())
        self._light_and_moment = functools.lru_cache(None)(self._summed)
        sides = [table.side_nodes(sign) for sign in (-1, 1)]
        with torch.inference_mode(False), torch.no_grad():
            reaches = [psf.reach(table.family, nodes, table.aperture) for _, nodes in sides]  # [C, N]
        self._nodes = [nodes for _, nodes in sides]
        self._distances: list[list[float]] = [distances.tolist() for distances, _ in sides]
        self._reaches: list[list[list[float]]] = [reach.tolist() for reach in reaches]
        # a node of size 0 has no shape: use that of the next node
        self._shapes = [
            [j + 1 if j + 1 < reach.shape[1] and not bool(reach[:, j].any()) else j for j in range(reach.shape[1])]
            for reach in reaches
        ]
        self._mirrored = self._nodes[0] is self._nodes[1]

    def _place(self, coc_px: float, width: float) -> _Place:
        per_unit = self.table.px_per_unit(width)
        side, distance = int(coc_px >= 0), abs(coc_px) / per_unit
        nodes, reaches = self._distances[side], self._reaches[side]
        node = min(max(bisect.bisect_left(nodes, distance) - 1, 0), len(nodes) - 2)
        part, slope = (distance - nodes[node]) / (nodes[node + 1] - nodes[node]), 1.0 / (nodes[node + 1] - nodes[node])
        if part > 1.0:  # beyond the last node lengths grow with the coc
            sizes, slopes = [r[-1] * distance / nodes[-1] for r in reaches], [r[-1] / nodes[-1] for r in reaches]
            part, slope = 1.0, 0.0
        else:
            slopes = [(r[node + 1] - r[node]) * slope for r in reaches]
            sizes = [r[node] + part * (r[node + 1] - r[node]) for r in reaches]
        if self.table.field is not None:
            coc = torch.tensor([coc_px / per_unit], dtype=torch.float64, device="cpu")
            spot_reach = float(self.table.field.reach(coc)[0])
            sizes, slopes = [spot_reach * min(abs(coc_px), 1.0)] * self.colours, [0.0] * self.colours
        return _Place(side, node, part, [size * per_unit for size in sizes], slope / per_unit, slopes)

    def reach_px(self, coc_px: float, width: float) -> float:
        """Radius in pixels of the kernel of a coc, the largest of all colours."""
        return max(self._place(coc_px, width).reach) * self.widest

    def spots(
        self, coc_px: Tensor | Sequence[float], width: float, scale: Sequence[float] = (), longest: Sequence[int] = ()
    ) -> Spots:
        """The recipe of kernels: templates, weights, radii.

        Args:
            coc_px: Signed coc ``[n]`` in pixels of an image ``width`` pixels wide.
            width: Width of the image in pixels.
            scale: Downsampling factors ``[n]`` of the layers; empty means 1.
            longest: Longer sides ``[n]`` of the frame in downsampled pixels, to which kernels are cut; empty: uncut.
        """
        cocs = coc_px.detach().to("cpu", torch.float64).tolist() if isinstance(coc_px, Tensor) else list(coc_px)
        scales = list(scale) or [1.0] * len(cocs)
        places = [self._place(coc, width) for coc in cocs]
        keys: dict[tuple[int, int, int], int] = {}

        def index_of(side: int, node: int, level: int) -> int:
            key = (1 if self._mirrored else side, self._shapes[side][node], level)
            return keys.setdefault(key, len(keys))

        spots = Spots([], [], [], [], [], [], [], [], None)
        for coc, size, place in zip(cocs, scales, places, strict=True):
            reach, finer, index = [r / size for r in place.reach], 0.0, (0, 0, 0, 0)
            if self.is_even:  # a spot and its margin; a single pixel in focus
                reach = [0.0 if coc == 0 else r + math.sqrt(2.0) * SPOT_MARGIN_PX for r in reach]
                half = math.floor(max(reach))
            else:
                reach = [max(r, _MIN_REACH_PX) for r in reach]
                largest = max(reach) * self.widest
                half = max(0, math.ceil(largest - 1e-9))
                level = min(max(0, math.ceil(math.log2(largest / _LEAST_CELLS))), _LEVELS - 1)
                if level < _LEVELS - 1:
                    cell = largest / (_LEAST_CELLS << level)
                    finer = min(max((cell - _FADE_START_PX) / (1.0 - _FADE_START_PX), 0.0), 1.0)
                nodes, levels = (place.node, place.node + 1), (level, level + (finer > 0))
                low, high, fine_low, fine_high = (index_of(place.side, n, each) for each in levels for n in nodes)
                index = (low, high, fine_low, fine_high)
            spots.which.append(index)
            spots.part.append(place.part)
            spots.finer.append(finer)
            spots.reach.append(reach)
            spots.fade.append(self._fade(coc / size, width / size))
            spots.flipped.append(place.side == 0 and not self.table.is_round)
            spots.half.append(half)
        if self._gradients:
            templates = [self._template(*key) for key in keys]
        else:
            of_lens = [(self._lens, *key) for key in keys]
            templates = _templates.get_all(of_lens, lambda missing: [self._kept_template(*k[1:]) for k in missing])
        halves = [min(half, n - 1) for half, n in zip(spots.half, longest, strict=True)] if longest else spots.half
        moves = None
        if isinstance(coc_px, Tensor) and is_differentiated(coc_px):
            distance = coc_px.to("cpu", torch.float64).abs()
            zero = distance - distance.detach()
            slopes = [[slope / size for slope in p.reach_slopes] for p, size in zip(places, scales, strict=True)]
            part = zero * torch.tensor([p.part_slope for p in places], dtype=torch.float64, device="cpu")
            moves = (part, zero[:, None] * torch.tensor(slopes, dtype=torch.float64, device="cpu"))
        return spots._replace(templates=templates, half=halves, moves=moves)

    def kernels(
        self, coc_px: Tensor | Sequence[float], width: float, scale: Sequence[float] = (), longest: Sequence[int] = ()
    ) -> Tensor:
        """Kernels ``[n, C, k, k]``, float64 on the CPU, as wide as the widest; each sums to 1 minus the light cut off.

        Arguments as in :meth:`spots`. Differentiable in ``coc_px``.
        """
        return self.of_spots(self.spots(coc_px, width, scale, longest))

    def of_spots(self, spots: Spots) -> Tensor:
        """The kernels of :meth:`kernels`, from the result of :meth:`spots`."""
        half = max(spots.half)
        numbers = (spots.part, spots.finer, spots.reach, spots.fade, spots.half)
        parts, finer, reach, fade, halves = (torch.tensor(v, dtype=torch.float64, device="cpu") for v in numbers)
        if spots.moves is not None:
            parts, reach = parts + spots.moves[0], reach + spots.moves[1]
        step = torch.arange(-half, half + 1, dtype=torch.float64, device="cpu")
        outside = (torch.maximum(step.abs(), step.abs()[:, None]) > halves[:, None, None])[:, None]
        if self.is_even:
            disc = (torch.hypot(step[:, None], step) <= reach[:, :, None, None]).to(torch.float64)
            out = disc / disc.sum((-2, -1), keepdim=True)
        else:
            out = torch.zeros(len(spots.part), self.colours, len(step), len(step), dtype=torch.float64, device="cpu")
            for key in set(spots.which):
                items = torch.tensor([i for i, other in enumerate(spots.which) if other == key], device="cpu")
                low, high, fine_low, fine_high = (spots.templates[i].double() for i in key)
                sizes, part = reach[items], parts[items][:, None, None, None]
                cut = halves[items, None] < sizes.detach() * self.widest - 1e-9
                kernel = self._sampled(torch.lerp(low, high, part), sizes, outside[items], cut)
                if key[2:] != key[:2]:
                    fine = self._sampled(torch.lerp(fine_low, fine_high, part), sizes, outside[items], cut)
                    kernel = torch.lerp(kernel, fine, finer[items][:, None, None, None])
                out = out.index_put((items,), kernel)
        if any(spots.flipped):
            out = torch.where(torch.tensor(spots.flipped, device="cpu")[:, None, None, None], out.flip(-2, -1), out)
        if all(part == 1.0 for parts in spots.fade for part in parts):
            return out
        centre = torch.zeros_like(out)
        centre[..., half, half] = 1.0
        return torch.lerp(centre, out, fade[:, :, None, None])

    def _sampled(self, cells: Tensor, reach: Tensor, outside: Tensor, cut: Tensor) -> Tensor:
        """Kernels ``[n, C, k, k]`` from templates ``[n, C, cells, cells]`` and reach ``[n, C]``.

        They are 0 at the pixels ``outside`` ``[n, 1, k, k]``. Each sums to 1; those with ``cut`` to the light inside.
        """
        height = reach / (cells.shape[-1] // 2 - 1)
        width = height / self._squeeze
        kernel = psf.sampled(cells, height, height if self.squeeze == 1.0 else width, outside.shape[-1] // 2)
        kernel = kernel.masked_fill(outside, 0.0)
        light = cells.sum((-2, -1)) * height.clamp_min(1.0) * width.clamp_min(1.0)  # sum of the uncut kernel
        light = torch.where(cut, light, kernel.sum((-2, -1)))
        return kernel / light[..., None, None]

    def variance_px(self, coc_px: float, width: float, scale: float) -> float:
        """Second moment of a kernel, mean of both axes and of colours, in squared pixels of a layer (``scale`` px)."""
        place = self._place(coc_px, width)
        nodes = (self._light_and_moment(place.side, place.node + above) for above in (0, 1))
        total = 0.0
        for below, above, reach in zip(*nodes, place.reach, strict=True):
            light, moment = (a + place.part * (b - a) for a, b in zip(below, above, strict=True))
            total += moment / light * (reach / scale) ** 2
        return total / self.colours

    def _summed(self, side: int, node: int) -> list[tuple[float, float]]:
        """Sum of a template of each colour, and its second moment for a reach of 1."""
        key = (1 if self._mirrored else side, self._shapes[side][node], 0)
        template = _templates.get((self._lens, *key), lambda: self._kept_template(*key)).double()
        half = template.shape[-1] // 2
        step = torch.arange(-half, half + 1, dtype=torch.float64, device="cpu") / _LEAST_CELLS
        square = 0.5 * (step[:, None] ** 2 + step**2 / self.squeeze**2)
        return [(float(cells.sum()), float((cells * square).sum())) for cells in template]

    def _template(self, side: int, node: int, level: int) -> Tensor:
        """Light ``[C, 2 n + 3, 2 n + 3]`` of the cells of a node's PSF, float64."""
        params = {name: values[:, node] for name, values in self._nodes[side].items()}
        template = psf.template(self.table.family, params, _LEAST_CELLS << level, self.table.aperture)
        if not bool((template.detach().sum((-2, -1)) > 0).all()):
            remedy = "its mask is open where the profile is dark; open it nearer the middle"
            raise ValueError(f"the aperture passes no light of a {self.table.family}: {remedy}")
        return template

    @torch.inference_mode(False)
    @torch.no_grad()
    def _kept_template(self, side: int, node: int, level: int) -> Tensor:
        return self._template(side, node, level).clamp(-_MAX_LIGHT, _MAX_LIGHT).float().contiguous()

    def _fade(self, coc_px: float, width: float) -> list[float]:
        """Weight of the kernel of each colour against a single pixel; below 1 where a blur in focus fades in."""
        if self.table.is_sharp_in_focus or self.is_even:
            return [1.0] * self.colours
        return [min(coc_px**2 * _FADE_IN / max(moved, 1e-300), 1.0) for moved in self._moved_in_focus(width)]
