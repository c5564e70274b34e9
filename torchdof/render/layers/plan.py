"""Choose the layers that render a scene within a tolerance, and make their kernels."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ... import native
from ...optics.blur_table import BlurTable
from ...optics.kernel_bank import Spots, bank_of
from ...optics.placed_kernels import FieldMask, layer_mask
from ...tensors import is_traced
from ...validation import engine_reads, show, tolerance_of
from ..engines import traced
from . import layer_cocs
from .downsampling import shrink
from .layer_weights import blur_axis_of_radius, from_blur_axis, ramps, weights_at_or_behind

KERNELS_PER_PX = 32  # kernels for highlights, per px of radius; more are smoother and take more memory
_FEWER_KERNELS_PER_PX = 4  # the same in a graph, which holds all kernels as constants; costs up to 0.02 dB
_COARSE_FROM_PX = (7.2, 18.0, 36.0, 72.0)  # px: layers from these radii on have 1/2, 1/4, ... resolution at 1/255
_LEAST_CUT = 24  # layer pixels: smaller kernels are never cut, so that those of a graph do not depend on its sizes
_SMALL_RADII = 3.0  # blur radii: frames with a shorter side below this are planned for a smaller tolerance
_ROUGH_PX = 8.0  # mean change of coc between neighbours, in pixels, above which a frame needs fewer layers
_ROUGH_TOLERANCE = 4.0 / 255.0  # tolerance of the roughest frames; larger: their errors exceed 1/255
_CROWDS_FROM = 2.5  # finest distances: wider spacings get layers at crowds of the border
_LAST_GAP = 0.3  # least distance of the outermost layer from the next one, over the usual distance
_FARTHEST_PX = 1e9  # px: upper limit of nodes; frames are smaller

_Layer = tuple[float, Tensor] | None  # place on the blur axis and kernel of a layer of one item; None: it has none


@dataclasses.dataclass(frozen=True)
class LayerKernel:
    """How one layer is scattered: at every ``scale``-th pixel, with a kernel ``[1 or C, k, k]`` in such pixels.

    The kernel is ``[B, 1 or C, k, k]`` if each item of a batch has its own. ``mask`` changes the kernel
    across the frame; None means that it is the same everywhere.
    """

    kernel: Tensor
    scale: int
    mask: FieldMask | None = None

    @property
    def half(self) -> int:
        """Pixels of the layer's resolution that the kernel reaches to each side."""
        return self.kernel.shape[-1] // 2

    @property
    def halo(self) -> int:
        """Pixels of the image around a window that the layer needs."""
        return self.half if self.scale == 1 else self.scale * (self.half + 1)


@dataclasses.dataclass(frozen=True)
class Plan:
    """Layers of a rendering, near to far; ``print(plan)`` lists them.

    Args:
        nodes: Places of the layers on the blur axis (:mod:`torchdof.render.layers.layer_weights`), strictly increasing.
        tolerance: Tolerance that the plan was made for, in [0, 1).
        rays: Whether highlights are splatted (:mod:`torchdof.render.highlights`) where layers would soften them.
        grows: Whether layers are added for a scene that is blurred more than the outermost ones. False, as in a static
            plan, clamps larger blurs to the outermost layers.
        kernels_per_px: Kernels of highlights per pixel of radius; between them kernels are interpolated.
        pixels: Share of the scene's pixels in each layer; None unless :meth:`with_pixels` computed it.

    Raises:
        ValueError: If ``nodes`` are not strictly increasing numbers, or ``tolerance`` is not a number in [0, 1).
    """

    nodes: tuple[float, ...]
    tolerance: float
    rays: bool = True
    grows: bool = True
    kernels_per_px: int = KERNELS_PER_PX
    pixels: tuple[float, ...] | None = dataclasses.field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if is_traced():  # values cannot be read
            return
        nodes = self.nodes
        plain = isinstance(nodes, tuple) and all(isinstance(x, int | float) and abs(x) < _FARTHEST_PX for x in nodes)
        if not plain or not nodes or any(low >= high for low, high in zip(nodes, nodes[1:], strict=False)):
            raise ValueError(
                f"plan must hold layers as a tuple of strictly increasing numbers below 1e9 px, got {show(nodes)}"
            )
        if isinstance(self.tolerance, str):  # names such as "draft" are for options
            raise ValueError(f"tolerance of a plan must be a number in [0, 1), such as 1/255, got {self.tolerance!r}")
        tolerance_of(self.tolerance)

    @classmethod
    def for_scene(cls, coc_px: Tensor, tolerance: float, on_grid: bool = False, adapt: bool = True) -> "Plan":
        """Layers for one scene ``[B, 1, H, W]``, at both ends of its coc range and dense near the coc of its border.

        A scene of one plane gets one layer, whose kernel is exact. NaN is ignored.

        Args:
            coc_px: Signed coc in pixels.
            tolerance: Largest error of the picture, in [0, 1).
            on_grid: Whether layers lie at places that do not depend on the scene, as gradients need.
            adapt: Whether the tolerance is changed for small and for rough frames. Errors are largest beside depth
                edges and the border. In a frame that is small compared with its blur radii, most pixels are near one,
                so the tolerance is multiplied by ``shorter side / (3 * radius)``, with the mean radius of the most
                blurred hundredth of its pixels. In a rough frame, such as noise as depth, each pixel of the picture is
                a mean over many layers, whose errors cancel. So the tolerance is multiplied by the root of the mean
                change of the coc between neighbours, divided by 8 px, if this is more than 1, up to a tolerance of
                4/255. With ``on_grid`` the factor is rounded down to a power of 2.
        """
        if not adapt:
            return cls._between(layer_cocs.spreads(coc_px, len(coc_px))[0], tolerance)
        return cls.for_scenes([coc_px], tolerance, on_grid)[0]

    @classmethod
    def for_scenes(cls, scenes: Sequence[Tensor], tolerance: float, on_grid: bool = False) -> list["Plan"]:
        """The plan of :meth:`for_scene` for each scene ``[N, 1, H, W]``, all of one shape.

        Values are copied to the host once for all scenes, and once more if a frame is small beside its blur radii.
        """
        if not on_grid and engine_reads(*scenes):
            return [cls(*native.plan(scene, tolerance)) for scene in scenes]
        coc_px = torch.cat([scene.detach() for scene in scenes])
        count, shorter = len(scenes[0]), min(coc_px.shape[-2:])
        spreads = layer_cocs.spreads(coc_px, count)
        radii = [max(abs(from_blur_axis(spread.low)), abs(from_blur_axis(spread.high))) for spread in spreads]
        if shorter < _SMALL_RADII * max(radii):  # otherwise the mean radius is not needed
            radii = layer_cocs.largest_radii(coc_px, count)
        plans = []
        for spread, radius in zip(spreads, radii, strict=True):
            factor = min(1.0, shorter / (_SMALL_RADII * max(radius, 1.0)))
            loosest = max(1.0, _ROUGH_TOLERANCE / max(tolerance * factor, 1e-9))
            factor *= min(max(1.0, math.sqrt(spread.change / _ROUGH_PX)), loosest)
            if on_grid:
                planned_for = tolerance * 2.0 ** math.floor(math.log2(factor))
                plans.append(cls(layer_cocs.spaced_nodes(spread.low, spread.high, planned_for), planned_for))
            else:
                plans.append(cls._between(spread, tolerance * factor))
        return plans

    @classmethod
    def _between(cls, spread: layer_cocs.Spread, tolerance: float) -> "Plan":
        """Layers for a scene of this spread."""
        low, high = spread.low, spread.high
        if high <= low:
            return cls((low,), tolerance)
        fixed = [low, high]
        for crowded in layer_cocs.border_nodes(spread.border):
            finest = layer_cocs.finest(crowded)
            if layer_cocs.spacing(crowded, tolerance) > _CROWDS_FROM * finest:
                for node in (crowded, crowded - finest, crowded + finest):
                    if low < node < high and min(abs(node - other) for other in fixed) > layer_cocs.APART * finest:
                        fixed.append(node)
        # nodes between the fixed ones slide smoothly onto them, so that the picture does not jump when a scene moves
        nodes = {*fixed}
        for node in layer_cocs.spaced_nodes(low, high, tolerance):
            if low < node < high:
                nodes.add(node if node == 0.0 else layer_cocs.moved_to_fixed(node, fixed, tolerance))
        return cls(tuple(sorted(nodes)), tolerance)

    @classmethod
    def static(cls, max_coc_px: float, tolerance: float, rays: bool = False) -> "Plan":
        """Layers for every scene up to a radius: the plan of a compiled module or, with ``rays``, of an exported one.

        The coc at the borders of these scenes is unknown, so the coarse layers, whose errors it affects, are denser.
        """
        reach, dense_from = blur_axis_of_radius(max_coc_px), blur_axis_of_radius(_COARSE_FROM_PX[0])
        last = reach - _LAST_GAP * layer_cocs.spacing(reach, layer_cocs.DENSE * tolerance)
        inner = [x for x in layer_cocs.spaced_nodes(-reach, reach, tolerance, dense_from) if abs(x) < last]
        return cls((-reach, *inner, reach), tolerance, rays, grows=False, kernels_per_px=_FEWER_KERNELS_PER_PX)

    def extended_to(self, coc_px: Tensor) -> "Plan":
        """This plan with layers added outwards until they span a scene ``[B, 1, H, W]``."""
        nearest, farthest = layer_cocs.extent(coc_px)
        if not self.grows or (self.nodes[0] <= nearest and farthest <= self.nodes[-1]):
            return self
        nodes, scene = list(self.nodes), Plan.for_scene(coc_px, self.tolerance, adapt=False)
        for sign, last in ((-1.0, -self.nodes[0]), (1.0, self.nodes[-1])):
            gap = _LAST_GAP * layer_cocs.spacing(last, self.tolerance)
            beyond = [sign * x for x in scene.nodes if sign * x > last]
            nodes += [sign * x for x in beyond if x > last + gap or x == max(beyond)]
        return dataclasses.replace(self, nodes=tuple(sorted(nodes)), pixels=None)

    def with_pixels(self, coc_px: Tensor) -> "Plan":
        """This plan with ``pixels``: the share of a scene ``[B, 1, H, W]`` that lies in each layer."""
        x = layer_cocs.on_axis(coc_px.detach(), max(coc_px.shape[-2:])).clamp(self.nodes[0], self.nodes[-1])
        ends = ramps([self.nodes], x).split(1, -1)  # one at a time, to bound the memory
        behind = [float(weights_at_or_behind(x, end).double().mean()) for end in ends]
        pixels = tuple(behind[k] - behind[k + 1] for k in range(len(self.nodes)))
        return dataclasses.replace(self, pixels=pixels)

    def __str__(self) -> str:
        lines = [f"{len(self.nodes)} layers, near to far, tolerance {255 * self.tolerance:.3g}/255"]
        lines.append(f"{'coc px':>8} {'radius':>7} {'at':>5}" + (f" {'pixels':>7}" if self.pixels else ""))
        for k, coc in enumerate(self.coc_px):
            scale = self._scale(coc) if len(self.nodes) > 1 else 1
            share = f" {self.pixels[k]:7.1%}" if self.pixels else ""
            lines.append(f"{coc:8.2f} {abs(coc):7.2f} {'full' if scale == 1 else f'1/{scale}':>5}{share}")
        return "\n".join(lines)

    @property
    def coc_px(self) -> tuple[float, ...]:
        """Signed coc of the layers, near to far."""
        return tuple(from_blur_axis(x) for x in self.nodes)

    @property
    def crisp_px(self) -> float:
        """Radius in pixels above which highlights soften: a coarser resolution has at least a part in their blur."""
        coarse = [abs(coc) for coc in self.coc_px if self._scale(coc) > 1]
        if not coarse:
            return math.inf
        return max([0.0, *(abs(coc) for coc in self.coc_px if abs(coc) < min(coarse))])

    def reach(self, table: BlurTable, width: int) -> float:
        """Radius of the most blurred layer's kernel divided by the radius of its disc, at least 1."""
        coc = max(self.coc_px, key=abs)
        reach = bank_of(table).reach_px(coc, 1 if table.unit == "relative" else int(width))
        return max(reach / max(abs(coc), 1.0), 1.0)

    def layer_kernels(
        self,
        table: BlurTable,
        size: tuple[int, int],
        dtype: torch.dtype,
        device: torch.device,
        coarse: bool,
        lens_width: int | None = None,
        kept: Sequence[Tensor] | None = None,
    ) -> list[LayerKernel]:
        """Kernel and resolution of each layer for a frame of ``size`` (height, width).

        Kernels are cut to the offsets between two pixels of the frame; those that reach at most 23 pixels of their
        layer stay whole. Traced code holds kernels as constants, so a table with lengths fixes the image width as well.
        ``lens_width`` is the width of the image whose kernels are used, if it differs from the frame's; ``kept`` are
        the results of :meth:`constants`, if they exist already.
        """
        width, scales = self.layer_sizes(table, lens_width or size[1], coarse)
        if kept is not None or is_traced():
            whole = traced.constants(_layer_kernels, table, self.coc_px, width, scales) if kept is None else kept
            bank = [_masked(k.to(device, dtype), size, s) for k, s in zip(whole, scales, strict=True)]
        else:
            made = _layer_kernels(table, self.coc_px, width, scales, longest_px(size, scales), dtype)
            bank = _moved(made, device, dtype)
        masks: Sequence[FieldMask | None] = self.field_masks(table, scales, size) or [None] * len(bank)
        return [LayerKernel(*each) for each in zip(bank, scales, masks, strict=True)]

    def constants(self, table: BlurTable, coarse: bool, lens_width: int) -> list[Tensor]:
        """Kernels of the layers as constants of a trace, not cut to a frame."""
        return _layer_kernels(table, self.coc_px, *self.layer_sizes(table, lens_width, coarse))

    def field_masks(self, table: BlurTable, scales: Sequence[int], size: tuple[int, int]) -> Sequence[FieldMask]:
        """Field masks of each layer's kernel; empty for a lens without a field."""
        if not table.depends_on_place:
            return []
        size = (int(size[0]), int(size[1]))  # only here: it would fix the size of a graph
        return [layer_mask(table, coc, scale, size) for coc, scale in zip(self.coc_px, scales, strict=True)]

    def layer_sizes(self, table: BlurTable, width: int, coarse: bool) -> tuple[int, tuple[int, ...]]:
        """Image width for the kernels (1 if they do not depend on it) and downsampling factor of each layer."""
        width = 1 if table.unit == "relative" else int(width)
        coarse = coarse and len(self.nodes) > 1  # a plane is exact
        return width, tuple(self._scale(table.finest_px(coc, width)) if coarse else 1 for coc in self.coc_px)

    def _scale(self, coc_px: float) -> int:
        """Downsampling factor of a layer, a power of two."""
        # rounded, so that float32 and float64 give the same factor
        reach = round(abs(coc_px) * math.sqrt(self.tolerance * 255.0), 4)
        return 2 ** sum(reach >= start for start in _COARSE_FROM_PX)


def joined_layers(
    plans: Sequence[Plan], table: BlurTable, size: tuple[int, int], like: Tensor
) -> tuple[list[tuple[float, ...]], list[LayerKernel]]:
    """Layers of several items, each with its own plan, as layers of the whole batch.

    Layers are joined if they lie on the same side of the focus and have the same resolution. An item with fewer of them
    than another has unused layers, see :func:`torchdof.render.layers.layer_weights.ramps`.

    Returns places on the blur axis, ``[B][n]``, and the kernels of each of the n layers, with the dtype and device of
    ``like``, for a frame of ``size``. The table does not depend on the place in the frame.
    """
    sizes = [plan.layer_sizes(table, size[1], coarse=True) for plan in plans]
    scales = [scale for _, of_plan in sizes for scale in of_plan]
    coc_px = [coc for plan in plans for coc in plan.coc_px]
    kernels = iter(_layer_kernels(table, coc_px, sizes[0][0], scales, longest_px(size, scales), like.dtype))
    # place and kernel of the layers of each plan, by a key that grows from near to far: signed resolution
    layers: list[dict[int, list[_Layer]]] = [{} for _ in plans]
    for of_plan, plan, (_, own_scales) in zip(layers, plans, sizes, strict=True):
        for node, scale in zip(plan.nodes, own_scales, strict=True):
            key = 0 if node == 0.0 else int(math.copysign(scale, node))
            of_plan.setdefault(key, []).append((node, next(kernels)))
    columns: list[tuple[_Layer, ...]] = []
    joined_scales = []
    for key in sorted({key for of_plan in layers for key in of_plan}):
        rows = [of_plan.get(key, []) for of_plan in layers]
        most = max(map(len, rows))
        unused: list[list[_Layer]] = [[None] * (most - len(row)) for row in rows]
        # at the focus, where kernels are small
        aligned = [none + row if key < 0 else row + none for none, row in zip(unused, rows, strict=True)]
        columns += zip(*aligned, strict=True)
        joined_scales += [max(abs(key), 1)] * most
    nodes = []
    for of_item in zip(*columns, strict=True):
        places = [math.inf]
        for layer in reversed(of_item):  # an unused layer has the place of the next used one
            places.append(places[-1] if layer is None else layer[0])
        nodes.append(tuple(places[:0:-1]))
    joined = [_stacked([None if layer is None else layer[1] for layer in column]) for column in columns]
    moved = _moved(joined, like.device, like.dtype)
    return nodes, [LayerKernel(kernel, scale) for kernel, scale in zip(moved, joined_scales, strict=True)]


def _stacked(kernels: Sequence[Tensor | None]) -> Tensor:
    """Kernels ``[1 or C, k, k]`` of one layer, padded to one size: ``[B, 1 or C, k, k]``. None becomes zeros."""
    used = [(i, kernel) for i, kernel in enumerate(kernels) if kernel is not None]
    largest = max((kernel for _, kernel in used), key=lambda kernel: kernel.shape[-1])
    stacked = largest.new_zeros((len(kernels), *largest.shape))
    for i, kernel in used:
        spare = (largest.shape[-1] - kernel.shape[-1]) // 2
        stacked[i, :, spare : spare + kernel.shape[-1], spare : spare + kernel.shape[-1]] = kernel
    return stacked


def _moved(kernels: Sequence[Tensor], device: torch.device, dtype: torch.dtype) -> list[Tensor]:
    """Kernels on a device. A GPU gets all of them in one transfer, as each transfer waits for earlier operations."""
    if device.type == "cpu":
        return [kernel.to(device, dtype) for kernel in kernels]
    moved = torch.cat([kernel.flatten() for kernel in kernels]).to(device, dtype)
    parts = moved.split([kernel.numel() for kernel in kernels])
    return [part.view(kernel.shape) for part, kernel in zip(parts, kernels, strict=True)]


def longest_px(size: tuple[int, int], scales: Sequence[int]) -> list[int]:
    """Longer side of a frame of ``size`` in pixels of each layer: kernels are cut to it."""
    return [max(-(-max(size) // scale), _LEAST_CUT) for scale in scales]


def kernels_for(table: BlurTable, coc_px: Tensor, width: int, longest: int, per_px: int = KERNELS_PER_PX) -> Tensor:
    """Kernels ``[n, 1 or C, k, k]`` of single pixels, such as highlights, with signed coc ``[n]``, in its dtype.

    Each is interpolated between kernels at ``per_px`` radii per pixel, which gives its gradient too. They are cut to
    the offsets within a frame whose longer side is ``longest`` pixels.
    """
    if table.is_differentiated:
        kernels = table.kernels(coc_px, width).to(coc_px)
    else:
        steps = coc_px.double() * per_px
        below = steps.detach().floor()
        radii, which = torch.unique(torch.stack([below, below + 1.0]), return_inverse=True)
        spots = bank_of(table).spots((radii / per_px).tolist(), width, longest=[longest] * len(radii))
        spots = spots._replace(half=[max(spots.half)] * len(radii))
        of_radii = torch.stack(kernels_of(table, spots, coc_px.dtype)).to(coc_px)
        part = (steps - below).to(coc_px.dtype)[:, None, None, None]
        kernels = torch.lerp(of_radii[which[0]], of_radii[which[1]], part)
    spare = max(0, kernels.shape[-1] // 2 - (longest - 1))
    return kernels[..., spare : kernels.shape[-1] - spare, spare : kernels.shape[-1] - spare]


def kernels_of(table: BlurTable, spots: Spots, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Kernels ``[1 or C, k, k]`` on the CPU from their spots; by the compiled engine if float32 suffices."""
    bank = bank_of(table)
    is_plain = dtype == torch.float32 and spots.moves is None
    if is_plain and engine_reads(torch.empty(0, dtype=dtype, device="cpu")):  # not so in torch.func and fake modes
        return native.kernels(*spots[:-1], squeeze=bank.squeeze, is_round=table.is_round, is_even=bank.is_even)
    made = bank.of_spots(spots)
    spare = [made.shape[-1] // 2 - half for half in spots.half]
    return [k[:, n : k.shape[-1] - n, n : k.shape[-1] - n] for k, n in zip(made, spare, strict=True)]


def layer_spots(
    table: BlurTable, coc_px: Sequence[float], width: int, scales: Sequence[int], longest: Sequence[int] = ()
) -> Spots:
    """Spots from which the kernels of layers are made, cut to frames of ``longest`` layer pixels."""
    bank = bank_of(table)
    sizes = [coc * shrink(bank, coc, width, scale) for coc, scale in zip(coc_px, scales, strict=True)]
    return bank.spots(sizes, width, scales, longest)


@torch.inference_mode(False)  # kept tensors are used by autograd too, which refuses inference tensors
def _layer_kernels(
    table: BlurTable,
    coc_px: Sequence[float],
    width: int,
    scales: Sequence[int],
    longest: Sequence[int] = (),
    dtype: torch.dtype = torch.float64,
) -> list[Tensor]:
    """Kernels ``[1 or C, k, k]`` of the layers of :func:`layer_spots`, at least as exact as ``dtype``."""
    bank = bank_of(table)
    if table.is_differentiated:  # gradients to the aperture's rotation and squeeze need the PSF itself
        kernels = []
        for k, (coc, scale) in enumerate(zip(coc_px, scales, strict=True)):
            coarse = torch.tensor([coc * shrink(bank, coc, width, scale) / scale], dtype=torch.float64, device="cpu")
            window = 2 * longest[k] - 1 if longest else None
            kernels.append(table.kernels(coarse, width / scale, window=window)[0])
        return kernels
    return kernels_of(table, layer_spots(table, coc_px, width, scales, longest), dtype)


def _masked(kernel: Tensor, size: tuple[int, int], scale: int) -> Tensor:
    """Set taps that reach beyond a frame of ``size`` to 0: in traced code a kernel keeps its shape."""
    half = kernel.shape[-1] // 2
    if half < _LEAST_CUT:
        return kernel
    longest = torch.sym_max((torch.sym_max(*size) + scale - 1) // scale, _LEAST_CUT)
    within = (torch.arange(-half, half + 1, device=kernel.device).abs() < longest).to(kernel.dtype)
    return kernel * within * within[:, None]
