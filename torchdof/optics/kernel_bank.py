"""Kernels at the cost of two small matrix products, for every picture is a first one, with blurs that no cache holds.

:func:`torchdof.optics.psf.pixel_kernels` integrates a PSF over square *cells*, ``n`` from its centre to its end, and
then over the interpolator ``phi`` of each pixel. How much light a cell holds does not depend on the size of the PSF.
So that part, the *template* ``T``, is made once for each node of a table. A kernel of any radius follows from it:

    ``K = A T B'``  with  ``A[m, i] = phi(m - i h)``,  ``B[m, i] = phi(m - i w)``

for cells ``h`` pixels high and ``w`` pixels wide. ``K`` is then limited, made non-negative and scaled to a sum of 1, as
there. Templates have 16, 32, 64, 128 or 256 cells; the one used has cells of half a pixel to a pixel, and the next
finer one fades in over the last quarter of a pixel: kernels are continuous functions of the radius. A PSF of more than
256 pixels is sampled linearly from its template.

Between two nodes of a table the template is the mean of theirs, and its size that of the interpolated parameters.

The compiled engine makes the same kernels from the same templates (``native/src/kernels.cpp``).
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from . import psf
from .blur_table import BlurTable
from .kernel_cache import KernelCache

__all__ = ["LEAST_CELLS", "SPOT_MARGIN_PX", "KernelBank", "Spots", "bank_of"]

LEAST_CELLS = 16
"""Cells from the centre to the end of a PSF in the coarsest template."""

_LEVELS = 5  # templates of 16, 32, 64, 128 and 256 cells
_FADES_FROM = 0.75  # px of a cell, from which on the next finer template fades in
_SMALLEST = 1e-7  # px; a smaller PSF counts as one of that size, whose kernel is a single pixel
_BANKS = 32  # tables whose nodes are kept
SPOT_MARGIN_PX = 1.0
"""Pixels around a spot of a field, none of whose light is at the border of its samples."""

_WIDTHS = 64  # widths of images for which a table's blur in focus is kept
_templates = KernelCache(128 * 2**20)


class Spots(NamedTuple):
    """What the kernels of some circles of confusion ``[n]`` are made from, with C colours.

    Args:
        templates: Cells of the templates in use, each ``[C, 2 n + 3, 2 n + 3]``, float32.
        index: Which of these, ``[n, 4]``: those of the nodes below and above, and of the next finer level the same.
        part: How far each lies from the node below to the one above, 0 to 1, ``[n]``.
        finer: Share of the finer level, 0 to 1, ``[n]``.
        reach: Radius of the PSF in pixels, ``[n, C]``.
        fade: Share of the kernel, the rest being a single pixel, ``[n, C]``.
        flipped: Whether the kernel is turned by half, ``[n]``.
        half: Pixels that the kernel reaches to each side, ``[n]``; what reaches farther is cut off.
    """

    templates: list[Tensor]
    index: Tensor
    part: Tensor
    finer: Tensor
    reach: Tensor
    fade: Tensor
    flipped: Tensor
    half: Tensor


def bank_of(table: BlurTable) -> "KernelBank":
    """The bank of a table; tables of the same numbers share it."""
    return _bank(table.fingerprint(), _Same(table))


class _Same:
    """A table as an argument that does not count for :func:`functools.lru_cache`: its fingerprint does."""

    def __init__(self, table: BlurTable) -> None:
        self.table = table

    def __eq__(self, other: object) -> bool:
        return True

    def __hash__(self) -> int:
        return 0


@functools.lru_cache(_BANKS)
def _bank(fingerprint: str, same: _Same) -> "KernelBank":
    return KernelBank(same.table)


class KernelBank:
    """Kernels of a table from templates that are made when they are first needed.

    All banks together keep up to 128 MB of templates, those used latest. Thread-safe: two threads that miss a template
    at once both make it. Kernels are those of the middle of the frame; of a table with a field they are even light as
    far as its spots reach, of which :mod:`torchdof.optics.placed_kernels` takes shares.

    Args:
        table: Its aperture's rotation and squeeze are taken as numbers, without gradients.
    """

    def __init__(self, table: BlurTable) -> None:
        self.table, self.colours, self.is_even = table, table.channels, table.field is not None
        self.squeeze = 1.0 if table.aperture is None else float(table.aperture.squeeze)
        self.widest = max(1.0, 1.0 / self.squeeze)
        self._lens = table.fingerprint()
        self._moved: dict[float, Tensor] = {}
        self._found: dict[float, float] = {}
        with torch.inference_mode(False), torch.no_grad():
            sides = [table.side_nodes(sign) for sign in (-1, 1)]
            self._distances, self._nodes = zip(*sides, strict=True)
            self._reaches = [psf.reach(table.family, nodes, table.aperture) for nodes in self._nodes]  # [C, N]
        # a node without size has the shape of the next one
        self._shapes = [
            [j + 1 if j + 1 < r.shape[1] and not bool(r[:, j].any()) else j for j in range(r.shape[1])]
            for r in self._reaches
        ]
        self._mirrored = self._nodes[0] is self._nodes[1]

    def _place(self, coc_px: Tensor, width: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Side (0 in front of focus), node below, part of the way to the next ``[n]``; reach in px ``[n, C]``."""
        per_unit = self.table.px_per_unit(width)
        coc_px = coc_px.to("cpu", torch.float64)
        signed = coc_px / per_unit
        distance, behind = signed.abs(), signed.detach() >= 0
        places = []
        for distances, reaches in zip(self._distances, self._reaches, strict=True):
            low = (torch.searchsorted(distances, distance.detach()) - 1).clamp(0, len(distances) - 2)
            part = ((distance - distances[low]) / (distances[low + 1] - distances[low])).clamp(max=1.0)
            reach = torch.lerp(reaches[:, low], reaches[:, low + 1], part)
            reach = reach * (distance / distances[-1]).clamp_min(1.0) * per_unit
            places.append((low, part, reach.t()))
        near, far = places
        node, part = (torch.where(behind, far[k], near[k]) for k in (0, 1))
        reach = torch.where(behind[:, None], far[2], near[2])
        if self.table.field is not None:
            seen = self.table.field.reach(signed.detach()) * (per_unit * coc_px.detach().abs().clamp(max=1.0))
            reach = seen[:, None].expand_as(reach)
        return behind.long(), node, part, reach

    def spots(
        self, coc_px: Tensor, width: float, scale: Tensor | float = 1.0, longest: Tensor | int | None = None
    ) -> Spots:
        """What kernels are made from.

        Args:
            coc_px: Signed coc ``[n]`` in pixels of the image.
            width: Width of the image in pixels.
            scale: Kernels are for every ``scale``-th pixel, ``[n]`` or a number.
            longest: Pixels of these that the longer side of the frame has, ``[n]`` or a number: kernels are cut to what
                reaches from one to another. None leaves them whole.
        """
        side, node, part, reach = self._place(coc_px, width)
        scale = torch.as_tensor(scale, dtype=torch.float64).reshape(-1, 1)
        in_px = reach.detach()
        reach = reach / scale
        if self.is_even:  # a spot, as pixels see it; in focus a single one
            reach = torch.where(coc_px.detach().cpu()[:, None] == 0, 0.0, reach + math.sqrt(2.0) * SPOT_MARGIN_PX)
            largest = reach.detach().amax(1)
            half, level, finer = largest.floor(), torch.zeros_like(node), torch.zeros_like(largest)
            index, templates = torch.zeros(len(node), 4, dtype=torch.int32), []
        else:
            reach = reach.clamp_min(_SMALLEST)
            largest = reach.detach().amax(1) * self.widest
            half = (largest - 1e-9).ceil().clamp_min(0)
            level = (largest / LEAST_CELLS).log2().ceil().clamp(0, _LEVELS - 1)
            cell = largest / (LEAST_CELLS * 2.0**level)
            finer = torch.where(level < _LEVELS - 1, (cell - _FADES_FROM) / (1.0 - _FADES_FROM), 0.0).clamp(0.0, 1.0)
            index, templates = self._index(side.tolist(), node.tolist(), level.long().tolist(), (finer > 0).tolist())
        if longest is not None:
            half = torch.minimum(half, torch.as_tensor(longest, dtype=torch.float64) - 1.0)
        flipped = (side == 0) & (not self.table.is_round)
        fade = self._fade(coc_px.to("cpu", torch.float64)[:, None] / scale, width, scale)
        return Spots(templates, index, part, finer, reach, fade.expand_as(in_px), flipped, half.long())

    def kernels(
        self,
        coc_px: Tensor,
        width: float,
        scale: Tensor | float = 1.0,
        longest: Tensor | int | None = None,
    ) -> Tensor:
        """Kernels ``[n, C, k, k]``, float64 on the CPU, as :meth:`torchdof.BlurTable.kernels` has them.

        They are as wide as the widest of them, non-negative, and each sums to 1, but for what is cut off. Arguments are
        those of :meth:`spots`. Differentiable in ``coc_px``.
        """
        return self.of_spots(self.spots(coc_px, width, scale, longest))

    def of_spots(self, spots: Spots) -> Tensor:
        """The kernels of :meth:`kernels`, from what :meth:`spots` gives."""
        half = int(spots.half.max())
        step = torch.arange(-half, half + 1, dtype=torch.float64)
        outside = torch.maximum(step.abs(), step.abs()[:, None]) > spots.half[:, None, None]
        if self.is_even:
            disc = (torch.hypot(step[:, None], step) <= spots.reach[:, :, None, None]).to(torch.float64)
            made = disc / disc.sum((-2, -1), keepdim=True)
        else:
            shape = (len(spots.part), self.colours, 2 * half + 1, 2 * half + 1)
            made = torch.zeros(shape, dtype=torch.float64)
            for key, which in _groups(spots.index.tolist()):
                low, high, fine_low, fine_high = (spots.templates[i].double() for i in key)
                reach, part = spots.reach[which], spots.part[which][:, None, None, None]
                cut = spots.half[which, None] < reach.detach() * self.widest - 1e-9
                kernel = self._sampled(torch.lerp(low, high, part), reach, half, cut)
                finer = spots.finer[which][:, None, None, None]
                if bool((finer > 0).any()):
                    fine = self._sampled(torch.lerp(fine_low, fine_high, part), reach, half, cut)
                    kernel = torch.lerp(kernel, fine, finer)
                made = made.index_put((torch.tensor(which),), kernel)
        made = torch.where(outside[:, None], 0.0, made)
        made = torch.where(spots.flipped[:, None, None, None], made.flip(-2, -1), made)
        if bool((spots.fade.detach() == 1.0).all()):
            return made
        centre = torch.zeros_like(made)
        centre[..., half, half] = 1.0
        return torch.lerp(centre, made, spots.fade[:, :, None, None])

    def _sampled(self, cells: Tensor, reach: Tensor, half: int, cut: Tensor) -> Tensor:
        """Kernels ``[n, C, 2 half + 1, 2 half + 1]`` from templates ``[n, C, cells, cells]`` and reach ``[n, C]``.

        Those that are cut have their share of the light.
        """
        high = reach / (cells.shape[-1] // 2 - 1)
        wide = high / self.squeeze
        kernel = psf.sampled(cells, high, high if self.squeeze == 1.0 else wide, half)
        light = cells.sum((-2, -1)) * high.clamp_min(1.0) * wide.clamp_min(1.0)  # of all pixels
        light = torch.where(cut, light, kernel.sum((-2, -1)))
        return kernel / light[..., None, None]

    def variance_px(self, coc_px: Tensor, width: float, scale: Tensor) -> Tensor:
        """Second moment ``[n]`` of kernels, mean of both axes and of colours, in squares of ``scale`` pixels."""
        side, node, part, reach = self._place(coc_px.detach(), width)
        index, templates = self._index(side.tolist(), node.tolist(), [0] * len(part), [False] * len(part))
        step = torch.arange(-LEAST_CELLS - 1.0, LEAST_CELLS + 2.0, dtype=torch.float64) / LEAST_CELLS
        square = 0.5 * (step[:, None] ** 2 + step**2 / self.squeeze**2)
        cells = torch.stack(templates).double()  # [templates, C, cells, cells]
        light, moment = cells.sum((-2, -1)), (cells * square).sum((-2, -1))
        low, high = index[:, 0], index[:, 1]
        moment, light = (torch.lerp(sums[low], sums[high], part[:, None]) for sums in (moment, light))
        return (moment / light * (reach / scale[:, None]) ** 2).mean(1)

    def kept(self, sign: float, find: Callable[["KernelBank", float, float], float]) -> float:
        """A number that a function finds of the blur on one side of focus, found once.

        The function takes this bank, a coc of 1 or -1 pixel, and the width in pixels of an image in which that is the
        coc of the side's last node.
        """
        sign = 1.0 if self._mirrored and self.table.is_round else sign
        if sign not in self._found:
            last = float(self._distances[sign > 0][-1]) * self.table.px_per_unit(1.0)
            self._found[sign] = find(self, sign, 1.0 if self.table.unit == "relative" else 1.0 / last)
        return self._found[sign]

    def _index(
        self, side: Sequence[int], node: Sequence[int], level: Sequence[int], finer: Sequence[bool]
    ) -> tuple[Tensor, list[Tensor]]:
        """Templates, and which of them each of n kernels needs, ``[n, 4]``."""
        keys: dict[tuple[int, int, int], int] = {}

        def index_of(k: int, j: int, of_level: int) -> int:
            key = (1 if self._mirrored else k, self._shapes[k][j], of_level)
            return keys.setdefault(key, len(keys))

        rows = []
        for k, j, of_level, is_finer in zip(side, node, level, finer, strict=True):
            row = [index_of(k, j, of_level), index_of(k, j + 1, of_level)]
            rows.append(row + ([index_of(k, j, of_level + 1), index_of(k, j + 1, of_level + 1)] if is_finer else row))
        wanted = [(self._lens, *key) for key in keys]
        made = _templates.get_all(wanted, lambda missing: [self._template(*key[1:]) for key in missing])
        return torch.tensor(rows, dtype=torch.int32), made

    @torch.inference_mode(False)
    @torch.no_grad()
    def _template(self, side: int, node: int, level: int) -> Tensor:
        """Light ``[C, 2 n + 3, 2 n + 3]`` of the cells of a node's PSF, float32."""
        params = {name: values[:, node] for name, values in self._nodes[side].items()}
        return psf.template(self.table.family, params, LEAST_CELLS << level, self.table.aperture).float().contiguous()

    def _fade(self, coc_px: Tensor, width: float, scale: Tensor) -> Tensor:
        """Share of a kernel, the rest being a single pixel, ``[n, C]``: below 1 near the focus of a blurred table."""
        if self.table.is_sharp_in_focus or self.is_even:
            return torch.ones(1, 1, dtype=torch.float64)
        sizes = scale.flatten().tolist()
        moved = {size: self._moved_in_focus(width / size) for size in set(sizes)}
        return self.table.fade_in(coc_px, torch.stack([moved[size] for size in sizes]))

    def _moved_in_focus(self, width: float) -> Tensor:
        """Share ``[C]`` of its light that the kernel in focus moves to other pixels."""
        if width not in self._moved:
            if len(self._moved) >= _WIDTHS:
                self._moved.clear()
            self._moved[width] = self.table.moved_in_focus(width)
        return self._moved[width]


def _groups(rows: list[list[int]]) -> list[tuple[tuple[int, ...], list[int]]]:
    """Equal rows, and where they stand."""
    places: dict[tuple[int, ...], list[int]] = {}
    for i, row in enumerate(rows):
        places.setdefault(tuple(row), []).append(i)
    return list(places.items())
