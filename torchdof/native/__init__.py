"""The compiled engine: the computations of :mod:`torchdof.render` in C++, for eager inference on the CPU.

It has a plain C interface (``src/api.h``) and is built when the package is installed. Without it the PyTorch engine is
used. The environment variable ``TORCHDOF_ENGINE`` selects: ``auto`` (the default) uses the compiled engine where it
can, ``native`` requires it, ``torch`` disables it.

Tensors are float32. Every computation uses as many threads as PyTorch does, gives the same bits for any number of them,
and raises ``MemoryError`` if there is not enough memory.
"""

import ctypes
import functools
import importlib.resources
import itertools
import os
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

Kind = Literal["image", "background", "stack"]
"""Meaning of the surfaces: one image; an image and the background behind it; any number of surfaces that cover each
other, near to far."""

HALF_LARGEST = 256
"""Largest half width of a kernel, in pixels of its layer; larger kernels need the PyTorch engine."""

MOST_LEVELS = 4
"""Most levels of :func:`look_behind`."""

MOST_PLANES = 16
"""Most channels of light and kernels' colours together in :func:`blend`."""

_KINDS: dict[Kind, int] = {"image": 0, "background": 1, "stack": 2}
_SUFFIXES = {"win32": ".dll", "darwin": ".dylib"}
_SMALL_FRAME = 2**16  # pixels; up to this size the main thread renders itself, which saves 0.1 ms
_NO_MEMORY, _CANCELLED, _TOO_BRIGHT = 1, 2, 3
_REVISION = 9  # of ``src/api.h``

Rules = Sequence[tuple[int, float, float, float]]

Surface = tuple[Tensor, Tensor, Tensor | None]
"""Light ``[C, H, W]``, signed coc in pixels and weight (None: 1), ``[H, W]`` or ``[1, H, W]``."""

KernelMask = tuple[Tensor, Tensor, float, float | Tensor]
"""Mask of a lens's field for kernels of one radius (:class:`torchdof.optics.placed_kernels.FieldMask`): transmittance
``[1 or C, distances, rows, columns]``, positions of these samples ``[distances, 3]``, signed radius in pixels; the
fourth is not used."""


class Spots(NamedTuple):
    """Recipe for the kernels of n circles of confusion and C colours, as plain numbers because n is small.

    Args:
        templates: Cells of the templates in use, each ``[C, 2 cells + 3, 2 cells + 3]``, float32.
        which: Four indices into ``templates`` for each kernel: node below and above, and both of the next finer level.
        part: Weight of the node above, in [0, 1].
        finer: Weight of the finer level, in [0, 1].
        reach: Radius of the PSF in pixels, C for each kernel.
        fade: Weight of the kernel against a single pixel, in [0, 1], C for each kernel.
        flipped: Whether the kernel is point-reflected.
        half: Half width of each kernel in pixels; light beyond it is cut off.
        moves: Zeros to add to ``part`` ``[n]`` and ``reach`` ``[n, C]``, through which gradients flow to the coc; None
            without gradients. The engine ignores them.
    """

    templates: list[Tensor]
    which: list[tuple[int, int, int, int]]
    part: list[float]
    finer: list[float]
    reach: list[list[float]]
    fade: list[list[float]]
    flipped: list[bool]
    half: list[int]
    moves: tuple[Tensor, Tensor] | None


# Types of ``src/api.h``. Data are pointers to numbers, Arrays those to the data of several tensors.
_Int, _Real, _Double, _Data = ctypes.c_int32, ctypes.c_float, ctypes.c_double, ctypes.c_void_p
_Ints, _Reals, _Doubles = ctypes.POINTER(_Int), ctypes.POINTER(_Real), ctypes.POINTER(_Double)
_Arrays = ctypes.POINTER(_Data)


def _fields(*groups: tuple[Any, str]) -> list[tuple[str, Any]]:
    """Fields of a structure from groups of one type and the names that have it."""
    return [(name, kind) for kind, names in groups for name in names.split()]


_LAYERS = (
    (_Int, "layers"),
    (_Doubles, "nodes"),
    (_Ints, "scales halves"),
    (_Int, "kernel_colours"),
    (_Data, "kernels"),
)
"""Fields of the structures that have layers, see :func:`_of_layers`."""


class _FieldMask(ctypes.Structure):
    _fields_ = _fields((_Data, "values boxes"), (_Real, "radius"), (_Int, "colours rows columns"))


class _Spots(ctypes.Structure):
    _fields_ = _fields(
        *((_Int, "count colours"), (_Arrays, "templates"), (_Ints, "cells index")),
        *((_Doubles, "part finer reach fade"), (_Ints, "flipped half"), (_Double, "squeeze"), (_Int, "round even")),
    )


class _Scene(ctypes.Structure):
    _fields_ = _fields(
        *((_Int, "height width channels kind surfaces"), (_Arrays, "light coc weight")),
        *((_Int, "occlusion normalize masked highlights"), (_Real, "crisp_px reach"), *_LAYERS),
        *((ctypes.POINTER(_FieldMask), "field_masks"), (_Int, "distances"), (_Real, "squeeze")),
        *((_Int, "threads"), (_Ints, "cancelled")),
    )


class _Map(ctypes.Structure):
    _fields_ = _fields(
        *((_Int, "height width channels"), (_Data, "light nearness"), (_Int, "of_coc"), (_Data, "steps")),
        *((_Real, "step"), (_Int, "automatic threads"), (_Ints, "cancelled"), (_Data, "out")),
    )


class _Layers(ctypes.Structure):
    _fields_ = _fields(
        *((_Int, "rows columns margin height width channels surfaces"), (_Arrays, "light place weight")),
        *((_Int, "occlusion backed"), *_LAYERS, (_Int, "threads"), (_Ints, "cancelled")),
    )


class _Level(ctypes.Structure):
    _fields_ = _fields((_Data, "values"), (_Int, "rows columns step"), (_Real, "least_px slope most"))


_LEVELS = (ctypes.POINTER(_Level), _Int, _Int, _Data, _Int, _Int, _Int)
_ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "begin": (ctypes.POINTER(_Scene), _Arrays),
    "radii": (_Data, ctypes.POINTER(_Ints)),
    "finish": (_Data, _Arrays, _Ints, ctypes.POINTER(_FieldMask), _Int, _Data),
    "free": (_Data,),
    "convolve": (_Data, _Int, _Int, _Data, _Int, _Data),
    "repair_edges": (ctypes.POINTER(_Map), _Ints),
    "blend": (ctypes.POINTER(_Layers), _Data),
    "blend_gradient": (ctypes.POINTER(_Layers), _Data, _Arrays, _Arrays, _Arrays),
    "farthest": (_Arrays, *[_Int] * 6, _Data),
    "farthest_gradient": (_Arrays, *[_Int] * 6, _Data, _Arrays),
    "look_behind": (*_LEVELS, _Data),
    "look_behind_gradient": (*_LEVELS, _Data, _Arrays, _Data),
    "coc": (_Data, ctypes.c_int64, _Real, _Real, _Real, _Int, _Data),
    "plan": (_Data, _Int, _Int, _Int, _Doubles, _Int, _Doubles, _Int, _Ints),
    "kernels": (ctypes.POINTER(_Spots), _Int, _Arrays),
    "ends": (_Data, ctypes.c_int64, _Int, _Reals, _Reals),
    "instructions": (),
    "use": (ctypes.c_char_p,),
}
_RESULTS = {"radii": ctypes.c_int64, "free": None, "convolve": None, "instructions": ctypes.c_char_p}  # others: int32


def chosen() -> bool:
    """Whether the compiled engine is used.

    Raises:
        ValueError: If ``TORCHDOF_ENGINE`` is not one of the three values, or is ``native`` and the engine is missing.
    """
    wanted = os.environ.get("TORCHDOF_ENGINE", "auto")
    if wanted not in ("auto", "native", "torch"):
        raise ValueError(f"TORCHDOF_ENGINE must be auto, native or torch, got {wanted!r}")
    if wanted == "torch":
        return False
    library, missing = _library()
    if library is None and wanted == "native":
        raise ValueError(f"TORCHDOF_ENGINE is native, but {missing}; install torchdof where there is a C++ compiler")
    return library is not None


def describe() -> str:
    """Name of the engine in use, and the reason if it is not the compiled one.

    Example:
        >>> describe().split()[0] in ("native", "torch")
        True
    """
    if chosen():
        return f"native ({_engine().torchdof_instructions().decode()})"
    if os.environ.get("TORCHDOF_ENGINE") == "torch":
        return "torch (as TORCHDOF_ENGINE says)"
    return f"torch ({_library()[1]})"


def use_instructions(name: Literal["avx2", "baseline"]) -> bool:
    """Selects the instruction set, for tests; False if the processor lacks it."""
    return bool(_engine().torchdof_use(name.encode()))


def render(
    surfaces: Sequence[Surface],
    kind: Kind,
    *,
    nodes: Sequence[float],
    layers: Sequence[tuple[Tensor, int]],
    psfs: Callable[[list[int]], Sequence[Tensor]],
    occlusion: bool,
    normalize: bool,
    masked: bool,
    highlights: bool,
    crisp_px: float,
    reach: float,
    field_masks: Sequence[KernelMask],
    ray_masks: Callable[[list[int]], Sequence[KernelMask]],
    squeeze: float,
) -> Tensor:
    """Renders depth of field for one image: ``[C, H, W]``.

    1. Begin: the engine splits pixels, fills hidden areas and finds the radii of the highlights' kernels.
    2. Make these kernels and their field masks.
    3. Finish: the engine composites the layers and splats the highlights.

    Args:
        surfaces: Surfaces of the scene.
        kind: Meaning of the surfaces.
        nodes: Positions of the layers on the blur axis, near to far.
        layers: Kernel ``[1 or C, k, k]`` and pixel size of each layer.
        psfs: Kernels ``[1 or C, k, k]`` for signed radii of highlights, in steps of 1/32 pixel.
        occlusion: As in :class:`torchdof.DepthOfField`.
        normalize: As in :class:`torchdof.DepthOfField`.
        masked: Whether values may be NaN or infinite; such pixels are copied.
        highlights: Whether highlights are rendered ray by ray where layers would soften them.
        crisp_px: Blur in pixels above which layers soften highlights.
        reach: Radius of the widest kernel divided by the radius of its disc, at least 1.
        field_masks: Transmittance of the field for each layer, contiguous; empty if the lens has no field.
        ray_masks: The same for highlights, as ``psfs``, in ascending order of radius.
        squeeze: Height of the blur divided by its width.

    Raises:
        OverflowError: If an image's light exceeds 2^28, whose square sums could overflow; scale it down.
    """
    maps = [[None if t is None else t.float().contiguous() for t in each] for each in zip(*surfaces, strict=True)]
    of_layers, _kernels = _of_layers(nodes, layers)
    cancelled = ctypes.c_int32(0)
    channels, height, width = surfaces[0][0].shape
    how = (occlusion, normalize, masked, highlights, crisp_px, reach, *of_layers)
    field = (_field_masks(field_masks), field_masks[0][0].shape[1]) if field_masks else (None, 0)
    threads = torch.get_num_threads()
    size = (height, width, channels, _KINDS[kind], len(surfaces))
    scene = _Scene(*size, *map(_pointers, maps), *how, *field, squeeze, threads, ctypes.pointer(cancelled))
    out = torch.empty(channels, height, width, dtype=torch.float32, device="cpu")

    def run() -> None:
        engine, job = _engine(), ctypes.c_void_p()
        try:
            _run("begin", ctypes.byref(scene), ctypes.byref(job))
            steps = ctypes.POINTER(ctypes.c_int32)()
            count = engine.torchdof_radii(job, ctypes.byref(steps))
            rays = [psf.contiguous() for psf in psfs(steps[:count])] if count else []
            halves = _array(ctypes.c_int32, max(1, count))(*(psf.shape[-1] // 2 for psf in rays))
            spots = ray_masks(steps[:count]) if count and field_masks else []
            of_rays = _field_masks(spots) if spots else None
            _run("finish", job, _pointers(rays), halves, of_rays, len(spots), out.data_ptr())
        finally:
            engine.torchdof_free(job)

    _interruptible(run, cancelled, height * width)
    return out


def blend(surfaces: Sequence[Surface], *frame: Any) -> Tensor:
    """Blurs and composites the layers of a padded frame, as :func:`torchdof.render.composite.over`, for one image.

    Arguments are those of :func:`_layers_of`. The result ``[planes, height, width]`` is light, then coverage or
    transmittance of each colour of the kernels (or, without occlusion, the sum of weights).
    """
    scene, _memory = _layers_of(surfaces, *frame)
    planes, size = scene.channels + scene.kernel_colours, (scene.height, scene.width)
    out = torch.empty(planes, *size, dtype=torch.float32, device="cpu")
    run = functools.partial(_run, "blend", ctypes.byref(scene), out.data_ptr())
    _interruptible(run, scene.cancelled.contents, scene.rows * scene.columns)
    return out


def blend_gradient(gradient: Tensor, surfaces: Sequence[Surface], *frame: Any) -> list[Tensor]:
    """The gradients of :func:`blend` by each map of its surfaces that is given, surface by surface."""
    (scene, _memory), gradient = _layers_of(surfaces, *frame), gradient.contiguous()
    sums = [
        [None if t is None else torch.zeros_like(t, memory_format=torch.contiguous_format) for t in each]
        for each in zip(*surfaces, strict=True)
    ]
    arguments = (ctypes.byref(scene), gradient.data_ptr(), *map(_pointers, sums))
    run = functools.partial(_run, "blend_gradient", *arguments)
    _interruptible(run, scene.cancelled.contents, scene.rows * scene.columns)
    return [t for of_surface in zip(*sums, strict=True) for t in of_surface if t is not None]


def _layers_of(
    surfaces: Sequence[Surface],
    margin: int,
    area: tuple[int, int],
    nodes: Sequence[float],
    layers: Sequence[tuple[Tensor, int]],
    occlusion: bool,
    backed: bool,
) -> tuple[_Layers, list[Any]]:
    """The structure for :func:`blend`, and the memory to which it points.

    Args:
        surfaces: One, or two that share each pixel, with places on the blur axis instead of the coc.
        margin: Pixels of the maps before the picture.
        area: Height and width of the picture. They, the margin and the maps' sizes are multiples of all pixel sizes.
        nodes: Positions of the layers on the blur axis, near to far.
        layers: Kernel ``[1 or C, k, k]`` and pixel size of each layer.
        occlusion: Whether layers occlude each other; otherwise their light and weights are added.
        backed: Whether the transmittance of all layers is computed, not their coverage.
    """
    maps = [[None if t is None else t.contiguous() for t in each] for each in zip(*surfaces, strict=True)]
    of_layers, kernels = _of_layers(nodes, layers)
    channels, rows, columns = surfaces[0][0].shape
    size = (rows, columns, margin, *area, channels, len(surfaces))
    how = (occlusion, backed, *of_layers, torch.get_num_threads(), ctypes.pointer(ctypes.c_int32(0)))
    return _Layers(*size, *map(_pointers, maps), *how), [maps, kernels]


def _of_layers(nodes: Sequence[float], layers: Sequence[tuple[Tensor, int]]) -> tuple[list[Any], Tensor]:
    """Values of :data:`_LAYERS`, and the memory of the kernels, which must outlive them."""
    kernels, count = [kernel.float() for kernel, _ in layers], len(nodes)
    colours = max(kernel.shape[0] for kernel in kernels)
    bank = torch.cat([kernel.expand(colours, -1, -1).flatten() for kernel in kernels])
    made = [
        count,
        _array(ctypes.c_double, count)(*nodes),
        _array(ctypes.c_int32, count)(*(scale for _, scale in layers)),
        _array(ctypes.c_int32, count)(*(kernel.shape[-1] // 2 for kernel in kernels)),
        colours,
        bank.data_ptr(),
    ]
    return made, bank


def farthest(maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
    """The finest level of a pyramid of the farthest surfaces, as ``torchdof.render.disocclusion`` defines it.

    ``maps`` are those of ``_finest_level`` there, for one image; ``size`` is the level's height and width. The result
    is light, coc and weight, ``[C + 2, h, w]``.
    """
    memory = [values.contiguous() for values in maps]
    out = torch.empty(memory[0].shape[0] + 2, *size, dtype=torch.float32, device="cpu")
    _run("farthest", _pointers([*memory, None]), *memory[0].shape, *size, torch.get_num_threads(), out.data_ptr())
    return out


def farthest_gradient(maps: Sequence[Tensor], size: tuple[int, int], gradient: Tensor) -> list[Tensor]:
    """The gradients of :func:`farthest` by its first five maps."""
    memory, gradient = [values.contiguous() for values in maps], gradient.contiguous()
    sums = [torch.zeros_like(values) for values in memory[:5]]
    arguments = (*memory[0].shape, *size, torch.get_num_threads(), gradient.data_ptr(), _pointers(sums))
    _run("farthest_gradient", _pointers([*memory, None]), *arguments)
    return sums


def look_behind(levels: Sequence[Tensor], rules: Rules, coc: Tensor) -> Tensor:
    """Surfaces behind those of an image with coc ``[1, H, W]``, as ``torchdof.render.disocclusion`` defines them.

    Args:
        levels: Light, coc and weight of each level of a pyramid, ``[C + 2, h, w]``.
        rules: For each level the distance of two samples in pixels, the smallest blur at which a pixel reads it, the
            votes for each weight, and the most votes.
        coc: Signed coc of the image.

    Returns:
        Light, coc and votes, ``[C + 2, H, W]``.
    """
    coc, levels = coc.contiguous(), [values.contiguous() for values in levels]
    out = torch.empty(levels[0].shape[0], *coc.shape[1:], dtype=torch.float32, device="cpu")
    _run("look_behind", *_level_arguments(levels, rules, coc), out.data_ptr())
    return out


def look_behind_gradient(levels: Sequence[Tensor], rules: Rules, coc: Tensor, gradient: Tensor) -> list[Tensor]:
    """The gradients of :func:`look_behind` by coc and by each level."""
    coc, levels, gradient = coc.contiguous(), [values.contiguous() for values in levels], gradient.contiguous()
    of_coc, of_levels = torch.empty_like(coc), [torch.zeros_like(values) for values in levels]
    pointers = (gradient.data_ptr(), _pointers(of_levels), of_coc.data_ptr())
    _run("look_behind_gradient", *_level_arguments(levels, rules, coc), *pointers)
    return [of_coc, *of_levels]


def _level_arguments(levels: Sequence[Tensor], rules: Rules, coc: Tensor) -> tuple[Any, ...]:
    each = [_Level(values.data_ptr(), *values.shape[1:], *rule) for values, rule in zip(levels, rules, strict=True)]
    count, threads = len(each), torch.get_num_threads()
    return _array(_Level, count)(*each), count, levels[0].shape[0] - 2, coc.data_ptr(), *coc.shape[1:], threads


def repair_edges(light: Tensor, nearness: Tensor, step: Tensor, auto: bool, of_coc: bool = False) -> Tensor:
    """Repairs the edges of a depth map, as :func:`torchdof.render.edges.repair`, for one image.

    ``light`` is ``[C, H, W]``, ``nearness`` ``[H, W]``, ``step`` ``[H, W]`` or ``[]``. The result ``[H, W]`` is the
    input itself if it needs no repair.
    """
    light, nearness, step = light.contiguous(), nearness.contiguous(), step.contiguous()
    out, cancelled, changed = torch.empty_like(nearness), ctypes.c_int32(0), ctypes.c_int32(0)
    steps = (None, float(step)) if step.ndim == 0 else (step.data_ptr(), 0.0)
    maps = (*nearness.shape, light.shape[0], light.data_ptr(), nearness.data_ptr(), of_coc, *steps)
    scene = _Map(*maps, auto, torch.get_num_threads(), ctypes.pointer(cancelled), out.data_ptr())
    run = functools.partial(_run, "repair_edges", ctypes.byref(scene), ctypes.byref(changed))
    _interruptible(run, cancelled, nearness.numel())
    return out if changed.value else nearness


def coc_px(depth: Tensor, scale: float, nearest_m: float, farthest_m: float) -> Tensor:
    """Signed circle of confusion in pixels, as :meth:`torchdof.Camera.coc_px` for a lens without tilt.

    ``depth`` in metres has any shape; ``scale`` is the radius in pixels for each dioptre between a depth and the focus,
    and depths from ``nearest_m`` to ``farthest_m`` are in focus. NaN where depth is not > 0.
    """
    depth = depth.contiguous()
    out, threads = torch.empty_like(depth), torch.get_num_threads()
    _run("coc", depth.data_ptr(), depth.numel(), scale, nearest_m, farthest_m, threads, out.data_ptr())
    return out


def plan(coc_px: Tensor, tolerance: float) -> tuple[tuple[float, ...], float]:
    """Positions of the layers for a frame ``[B, 1, H, W]``, and its tolerance, as ``torchdof.render.plan``."""
    coc_px, kept, count, capacity = coc_px.contiguous(), ctypes.c_double(), ctypes.c_int32(), 256
    while True:
        nodes = _array(ctypes.c_double, capacity)()
        size = (coc_px.shape[0], *coc_px.shape[-2:])
        kept.value = tolerance
        arguments = (*size, ctypes.byref(kept), torch.get_num_threads(), nodes, capacity, ctypes.byref(count))
        _run("plan", coc_px.data_ptr(), *arguments)
        if count.value <= capacity:
            return tuple(nodes[: count.value]), kept.value
        capacity = count.value


def kernels(spots: Spots, *, squeeze: float, is_round: bool, is_even: bool) -> list[Tensor]:
    """Makes the kernels of a lens.

    Args:
        spots: Input from which they are made.
        squeeze: Height of the blur divided by its width.
        is_round: Whether they are symmetric about both axes.
        is_even: Whether they are constant within their radius.

    Returns:
        Kernels ``[C, 2 half + 1, 2 half + 1]``, non-negative; they sum to 1 unless they are cropped.
    """
    count, colours = len(spots.reach), len(spots.reach[0])
    sides = [2 * half + 1 for half in spots.half]
    areas = [colours * side * side for side in sides]
    memory = torch.empty(sum(areas), dtype=torch.float32, device="cpu")
    made = [part.view(colours, side, side) for part, side in zip(memory.split(areas), sides, strict=True)]
    cells = [template.shape[-1] // 2 - 1 for template in spots.templates]
    reach, fade = (list(itertools.chain.from_iterable(each)) for each in (spots.reach, spots.fade))
    index = list(itertools.chain.from_iterable(spots.which))
    lists: list[list[int]] = [cells, index, list(map(int, spots.flipped)), spots.half]
    whole = [_array(ctypes.c_int32, max(1, len(each)))(*each) for each in lists]
    numbers = [_array(ctypes.c_double, len(each))(*each) for each in (spots.part, spots.finer, reach, fade)]
    arrays = [*whole[:2], *numbers, *whole[2:]]
    scene = _Spots(count, colours, _pointers(spots.templates), *arrays, squeeze, is_round, is_even)
    _run("kernels", ctypes.byref(scene), torch.get_num_threads(), _pointers(made))
    return made


def ends(values: Tensor) -> tuple[float, float]:
    """Smallest and largest of some float32 values; NaN if any value is NaN.

    PyTorch's own reduction would leave its threads spinning, which slows down the engine's threads.
    """
    values, low, high = values.contiguous(), ctypes.c_float(), ctypes.c_float()
    threads = torch.get_num_threads()
    _run("ends", values.data_ptr(), values.numel(), threads, ctypes.byref(low), ctypes.byref(high))
    return low.value, high.value


def _interruptible(run: Callable[[], None], cancelled: ctypes.c_int32, pixels: int) -> None:
    """Runs a long computation outside Python so that Ctrl-C stops it.

    Python delivers signals to the main thread, and only between two of its instructions. Therefore another thread does
    the work, and the main thread waits in a call that signals can interrupt. A small frame is rendered directly.
    """
    if pixels <= _SMALL_FRAME or threading.current_thread() is not threading.main_thread():
        run()
        return
    failure: list[BaseException] = []
    grad_enabled, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    finished = threading.Event()

    def guarded() -> None:
        try:
            with torch.inference_mode(inference), torch.set_grad_enabled(grad_enabled):
                run()
        except BaseException as error:  # of any kind: the main thread raises it
            failure.append(error)
        finally:
            finished.set()

    # Not Thread.join: once interrupted, in Python 3.11 it takes a running thread for finished, and the next call
    # returns at once. The arrays would then be freed, or the process end, while the engine still runs.
    interruption: BaseException | None = None
    threading.Thread(target=guarded, name="torchdof").start()
    while not finished.is_set():
        try:
            finished.wait()
        except BaseException as error:  # Ctrl-C, possibly several times
            cancelled.value, interruption = 1, error
    if interruption:
        raise interruption
    if failure:
        raise failure[0]


def _run(name: str, *arguments: Any) -> None:
    """Calls a function of the engine, and raises the error that its status means."""
    status = getattr(_engine(), f"torchdof_{name}")(*arguments)
    if status == _NO_MEMORY:
        raise MemoryError("there is too little memory to render this image")
    if status == _TOO_BRIGHT:
        raise OverflowError("light beyond 2 to the 28th is too bright for float32")
    if status == _CANCELLED:
        raise KeyboardInterrupt


def _field_masks(masks: Sequence[KernelMask]) -> Any:
    made = []
    for values, boxes, coc_px, _ in masks:
        colours, _, rows, columns = values.shape
        made.append(_FieldMask(values.data_ptr(), boxes.data_ptr(), coc_px, colours, rows, columns))
    return _array(_FieldMask, len(made))(*made)


def _pointers(tensors: Sequence[Tensor | None]) -> Any:
    return _array(ctypes.c_void_p, max(1, len(tensors)))(*(None if t is None else t.data_ptr() for t in tensors))


@functools.lru_cache(maxsize=1024)
def _array(kind: Any, count: int) -> Any:
    """Array type of ``count`` elements, cached: making one takes 20 microseconds, and ctypes does not keep it."""
    return kind * count


def _engine() -> ctypes.CDLL:
    library, missing = _library()
    if library is None:
        raise RuntimeError(missing)
    return library


def _fits(library: ctypes.CDLL) -> bool:
    """Whether a library has this file's interface: an old build may be left beside new sources."""
    try:
        interface = library.torchdof_interface
    except AttributeError:
        return False
    interface.restype = ctypes.c_int64
    others = ctypes.sizeof(_Map) + ctypes.sizeof(_Layers) + ctypes.sizeof(_Level)
    expected: int = _REVISION << 32 | ctypes.sizeof(_Scene) << 16 | others
    return bool(interface() == expected)


@functools.cache
def _library() -> tuple[ctypes.CDLL | None, str]:
    """The compiled engine, or the reason why it is missing."""
    file = importlib.resources.files(__name__) / f"_engine{_SUFFIXES.get(sys.platform, '.so')}"
    if not file.is_file():
        return None, "the compiled engine was not built when torchdof was installed"
    try:
        with importlib.resources.as_file(file) as path:
            library = ctypes.CDLL(str(path))
    except OSError as error:
        if "failed to map segment" in str(error) and "permitted" not in str(error):  # a file system may also forbid it
            raise MemoryError("there is too little memory to load the compiled engine") from None
        return None, f"the compiled engine cannot be loaded: {error}"
    if not _fits(library):
        stale = "the compiled engine is of another version of torchdof"
        warnings.warn(f"{stale}, and is not used: install torchdof again", RuntimeWarning, stacklevel=2)
        return None, stale
    for name, arguments in _ARGUMENTS.items():
        function = getattr(library, f"torchdof_{name}")
        function.argtypes, function.restype = arguments, _RESULTS.get(name, _Int)
    return library, ""
