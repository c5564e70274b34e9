"""The compiled engine: the computations of :mod:`torchdof.render` in C++, for eager inference on the CPU.

It has a plain C interface (``api.h``) and is built when the package is installed. Without it the PyTorch engine is
used. The environment variable ``TORCHDOF_ENGINE`` selects: ``auto`` (the default) uses compiled code where it can,
``native`` requires this engine on the CPU, ``gpu`` requires the kernels of :mod:`torchdof.kernels` on CUDA devices, and
``torch`` uses PyTorch alone. The instruction set is the one that PyTorch uses, AVX2 or the
processor's baseline (``ATEN_CPU_CAPABILITY=default`` selects the baseline for both).

Tensors are float32. Every computation uses as many threads as PyTorch does, gives the same bits for any number of them,
and raises ``MemoryError`` if there is not enough memory.
"""

import concurrent.futures
import contextlib
import ctypes
import functools
import importlib.resources
import itertools
import os
import re
import sys
import threading
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

Kind = Literal["image", "background", "stack"]
"""Meaning of the surfaces: one image; an image and the background behind it; any number of surfaces that cover each
other, near to far."""

HALF_LARGEST = 256  # largest half width of a kernel, in pixels of its layer; PyTorch blurs with larger ones
MOST_LEVELS = 7  # most levels of the pyramid of hidden surfaces; more: surfaces are filled in from farther away
MOST_PLANES = 16  # most channels of light and kernels' colours together in blend

_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
_instructions = "avx2" if torch.backends.cpu.get_cpu_capability().startswith("AVX") else "baseline"
"""Instruction set for which the engine in use is compiled."""

_ENGINES = ("auto", "native", "gpu", "torch")  # values of TORCHDOF_ENGINE
_STOPPED = 2  # result of a repair of edges that finds too wide ramps
_SMALL_FRAME = 2**16  # pixels; up to this size the main thread renders itself, which saves 0.1 ms
_of_thread = threading.local()  # count: threads for calls of this thread; is_off: they use the plain engine

Rules = Sequence[tuple[int, float, float, float]]

Surface = tuple[Tensor, Tensor, Tensor | None]
"""Light ``[C, H, W]``, signed coc in pixels and weight (None: 1), ``[H, W]`` or ``[1, H, W]``."""

KernelMask = tuple[Tensor, Tensor, float, float | Tensor]
"""Mask of a lens's field for kernels of one radius (:class:`torchdof.optics.placed_kernels.FieldMask`): transmittance
``[1 or C, distances, rows, columns]``, positions of these samples ``[distances, 3]``, signed radius in pixels; the
fourth is not used."""


_NUMBERS = {"int32_t": ctypes.c_int32, "int64_t": ctypes.c_int64, "float": ctypes.c_float, "double": ctypes.c_double}


class _Structure(ctypes.Structure):
    """A structure made of a value for each field, which it keeps in memory."""

    def __init__(self, *values: Any) -> None:
        self.kept = _contiguous(values)
        super().__init__(*(_plain(field[1], value) for field, value in zip(self._fields_, self.kept, strict=True)))


class Interface(NamedTuple):
    """What a header declares, by names without ``torchdof_`` and ``TORCHDOF_``."""

    constants: dict[str, int]
    structures: dict[str, type[_Structure]]
    functions: dict[str, tuple[Any, list[Any]]]  # type of the result, and types of the arguments
    checksum: int  # of the header's text, as cmake/constants.py computes it


def read_header(header: str) -> Interface:
    """Constants, structures and functions of a header of plain C: enums, structures and functions of numbers.

    A pointer to ``float`` has the type of any pointer, because tensors are passed as addresses; so has one to a
    structure without fields.

    Raises:
        ValueError: If the header has another declaration than these; the reader must then be extended.
    """
    found = Interface({}, {}, {}, zlib.crc32(header.encode()))
    types: dict[str, Any] = {**_NUMBERS, "void": None}

    def declared(text: str) -> list[tuple[str, Any]]:
        """Names and types of ``const int32_t *first, second``."""
        match = re.fullmatch(r"(?:const |volatile )*(\w+) ?(.*)", text.strip())
        if match is None or match[1] not in types:
            raise ValueError
        pairs = []
        for declarator in match[2].split(","):
            parts = re.fullmatch(r" ?((?:\*(?:const )?)*)(\w+)", declarator)
            if parts is None:
                raise ValueError
            kind, depth = types[match[1]], parts[1].count("*")
            if depth and (match[1] == "float" or kind is None):
                kind, depth = ctypes.c_void_p, depth - 1
            for _ in range(depth):
                kind = ctypes.POINTER(kind)
            pairs.append((parts[2], kind))
        return pairs

    code = re.sub(r"//.*|^ *#.*", "", header, flags=re.MULTILINE)
    for statement in re.findall(r"(?:[^;{]|\{[^}]*\})+;?", " ".join(code.split())):
        try:
            if match := re.fullmatch(r" ?enum \{(.*?),? ?\};", statement):
                pairs = (item.split("=") for item in match[1].split(","))
                found.constants.update({name.strip().removeprefix("TORCHDOF_"): int(value) for name, value in pairs})
            elif match := re.fullmatch(r" ?typedef struct (torchdof_\w+) \1;", statement):
                types[match[1]] = None
            elif match := re.fullmatch(r" ?typedef struct \{(.*); \} torchdof_(\w+);", statement):
                fields = [pair for text in match[1].split(";") for pair in declared(text)]
                types[f"torchdof_{match[2]}"] = made = type(match[2], (_Structure,), {"_fields_": fields})
                found.structures[match[2]] = made
            elif match := re.fullmatch(r" ?TORCHDOF_API (\w+) torchdof_(\w+)\((.*)\);", statement):
                arguments = [] if match[3] == "void" else [declared(text)[0][1] for text in match[3].split(",")]
                found.functions[match[2]] = types[match[1]], arguments
            elif statement.strip():
                raise ValueError
        except (KeyError, ValueError):
            text = f"api.h has a declaration that the reader in native/__init__.py does not know: {statement.strip()}"
            raise ValueError(text) from None
    return found


_API = read_header((importlib.resources.files(__name__) / "api.h").read_text(encoding="utf-8"))


def wanted() -> str:
    """The value of ``TORCHDOF_ENGINE``; ``torch`` in a block of :func:`engine_off`.

    Raises:
        ValueError: If it is not one of its values.
    """
    value = os.environ.get("TORCHDOF_ENGINE", "auto")
    if value not in _ENGINES:
        raise ValueError(f"TORCHDOF_ENGINE must be {', '.join(_ENGINES[:-1])} or {_ENGINES[-1]}, got {value!r}")
    return "torch" if getattr(_of_thread, "is_off", False) else value


def chosen() -> bool:
    """Whether the compiled engine is used.

    Raises:
        ValueError: If ``TORCHDOF_ENGINE`` is not one of its values, or is ``native`` and the engine is missing.
    """
    if wanted() == "torch":
        return False
    library, missing = _library()
    if library is None and wanted() == "native":
        raise ValueError(f"TORCHDOF_ENGINE is native, but {missing}; install torchdof where there is a C++ compiler")
    return library is not None


def engine_off() -> contextlib.AbstractContextManager[None]:
    """A block in which calls of this thread use the plain engine."""
    return _in_this_thread("is_off", True)


def threads_are(count: int) -> contextlib.AbstractContextManager[None]:
    """A block in which the engine uses ``count`` threads for calls of this thread, whatever PyTorch uses."""
    return _in_this_thread("count", count)


@contextlib.contextmanager
def _in_this_thread(name: str, value: int) -> Iterator[None]:
    before = getattr(_of_thread, name, None)
    setattr(_of_thread, name, value)
    try:
        yield
    finally:
        setattr(_of_thread, name, before)


def _threads() -> int:
    return getattr(_of_thread, "count", None) or torch.get_num_threads()


def describe() -> str:
    """Name of the engine in use, and the reason if it is not the compiled one.

    Example:
        >>> describe().split()[0] in ("native", "torch")
        True
    """
    if chosen():
        return f"native ({_instructions})"
    if os.environ.get("TORCHDOF_ENGINE") == "torch":
        return "torch (as TORCHDOF_ENGINE says)"
    return f"torch ({_library()[1]})"


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
    covered: Tensor | None = None,
) -> Tensor:
    """Renders depth of field for one image: ``[C, H, W]``.

    1. Begin: the engine splits pixels, fills hidden areas and finds the radii of the highlights' kernels.
    2. Make these kernels and their field masks.
    3. Finish: the engine composites the layers and splats the highlights.

    Arguments are the fields of ``torchdof_scene``, with a kernel ``[1 or C, k, k]`` and a pixel size for each layer.
    ``psfs`` and ``ray_masks`` make such kernels and their field masks for the signed radii of highlights, ascending,
    in steps of 1/32 pixel. Without a field of the lens, there are no ``field_masks``.

    Raises:
        OverflowError: If an image's light exceeds 2^28, whose square sums could overflow; scale it down.
    """
    cancelled, (channels, height, width) = ctypes.c_int32(0), surfaces[0][0].shape
    scene = _API.structures["scene"](
        *(height, width, channels, _API.constants[kind.upper()], len(surfaces), *_maps(surfaces), covered),
        *(occlusion, normalize, masked, highlights, crisp_px, reach, *_of_layers(nodes, layers)),
        *(_field_masks(field_masks), field_masks[0][0].shape[1] if field_masks else 0, squeeze),
        *(_threads(), ctypes.pointer(cancelled)),
    )
    out = _empty(channels, height, width)

    def run() -> None:
        job, steps = ctypes.c_void_p(), ctypes.POINTER(ctypes.c_int32)()
        try:
            _run("begin", scene, job)
            count = _engine().torchdof_radii(job, steps)
            rays = [*psfs(steps[:count])] if count else []
            masks = ray_masks(steps[:count]) if count and field_masks else []
            halves = [psf.shape[-1] // 2 for psf in rays]
            _run("finish", job, rays, halves, _field_masks(masks), len(masks), out)
        finally:
            _engine().torchdof_free(job)

    _interruptible(run, cancelled, height * width)
    return out


def blend(surfaces: Sequence[Surface], *frame: Any) -> Tensor:
    """Blurs and composites the layers of one padded frame, as :func:`torchdof.render.layers.composite.over`.

    Arguments are those of :func:`_layers_of`. The result ``[planes, height, width]`` is light, then coverage or
    transmittance of each colour of the kernels (or, without occlusion, the sum of weights).
    """
    scene = _layers_of(surfaces, *frame)
    out = _empty(scene.channels + scene.kernel_colours, scene.height, scene.width)
    run = functools.partial(_run, "blend", scene, out, None, None, None, None)
    _interruptible(run, scene.cancelled.contents, scene.rows * scene.columns)
    return out


def blend_gradient(gradient: Tensor, surfaces: Sequence[Surface], *frame: Any) -> list[Tensor]:
    """The gradients of :func:`blend` by each map of its surfaces that is given, surface by surface."""
    scene = _layers_of(surfaces, *frame)
    sums = [[None if t is None else _empty(*t.shape).zero_() for t in maps] for maps in zip(*surfaces, strict=True)]
    run = functools.partial(_run, "blend", scene, None, gradient, *sums)
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
) -> Any:
    """``torchdof_layers`` for :func:`blend`; ``area`` is the picture's height and width."""
    channels, rows, columns = surfaces[0][0].shape
    size = (rows, columns, margin, *area, channels, len(surfaces))
    how = (occlusion, backed, *_of_layers(nodes, layers), _threads(), ctypes.pointer(ctypes.c_int32(0)))
    return _API.structures["layers"](*size, *_maps(surfaces), *how)


def _maps(surfaces: Sequence[Surface]) -> list[list[Tensor | None]]:
    """Light, coc and weight, each a list with one map of every surface."""
    return [[None if t is None else t.float() for t in maps] for maps in zip(*surfaces, strict=True)]


def _of_layers(nodes: Sequence[float], layers: Sequence[tuple[Tensor, int]]) -> tuple[Any, ...]:
    """Values of the fields of ``torchdof_scene`` from ``layers`` to ``kernels``."""
    kernels = [kernel.float() for kernel, _ in layers]
    colours = max(kernel.shape[0] for kernel in kernels)
    bank = torch.cat([kernel.expand(colours, -1, -1).flatten() for kernel in kernels])
    halves = [kernel.shape[-1] // 2 for kernel in kernels]
    return len(nodes), nodes, [scale for _, scale in layers], halves, colours, bank


def _field_masks(masks: Sequence[KernelMask]) -> list[Any] | None:
    mask_of = _API.structures["field_mask"]
    return [mask_of(values, boxes, coc, len(values), *values.shape[2:]) for values, boxes, coc, _ in masks] or None


def matte(light: Tensor, coc: Tensor, valid: Tensor | None = None) -> Tensor:
    """Splits the mixed pixels of one image, as :func:`torchdof.render.surfaces.matting.matte`.

    The result ``[2 C + 2, H, W]`` is own light, and light, coc and weight of the other surface.
    """
    channels, *size = light.shape
    out = _empty(2 * channels + 2, *size)
    _run("matte", [light, coc, valid], channels, *size, _threads(), out, None, None)
    return out


def matte_gradient(gradient: Tensor, light: Tensor, coc: Tensor, valid: Tensor | None = None) -> list[Tensor]:
    """The gradients of :func:`matte` by light and coc."""
    sums = [_empty(*values.shape).zero_() for values in (light, coc)]
    _run("matte", [light, coc, valid], *light.shape, _threads(), None, gradient, sums)
    return sums


def farthest(maps: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
    """A level of a pyramid of the farthest surfaces, as ``torchdof.render.surfaces.disocclusion`` defines it.

    ``maps`` are those of ``_finest_level`` there, for one image; or light, coc and weight of the next finer level.
    ``size`` is the level's height and width. The result is light, coc and weight, ``[C + 2, h, w]``.
    """
    out = _empty(maps[0].shape[0] + 2, *size)
    _run("farthest", _of_surfaces(maps), *maps[0].shape, *size, _threads(), out, None, None)
    return out


def farthest_gradient(maps: Sequence[Tensor], size: tuple[int, int], gradient: Tensor) -> list[Tensor]:
    """The gradients of :func:`farthest` by its first five maps, or by all three."""
    sums, threads = [_empty(*values.shape).zero_() for values in maps[:5]], _threads()
    _run("farthest", _of_surfaces(maps), *maps[0].shape, *size, threads, None, gradient, _of_surfaces(sums))
    return sums


def _of_surfaces(maps: Sequence[Tensor]) -> list[Tensor | None]:
    return [*maps[:2], None, None, maps[2], None, None] if len(maps) == 3 else [*maps, None]


def look_behind(levels: Sequence[Tensor], rules: Rules, coc: Tensor, wanted: Tensor | None = None) -> Tensor:
    """Surfaces behind those of an image with coc ``[1, H, W]``, as in ``torchdof.render.surfaces.disocclusion``.

    ``levels`` have light, coc and weight of each level of a pyramid, ``[C + 2, h, w]``, and ``rules`` its step,
    least_px, slope and most, as in ``torchdof_level``. The result is light, coc and votes, ``[C + 2, H, W]``. With a
    map ``wanted`` ``[1, H, W]``, it is that of cells, ``[C + 2 or 2 C + 4, h, w]``.
    """
    planes, *size = levels[0].shape[0], *coc.shape[1:]
    if wanted is not None:  # cells of 4 x 4 pixels; levels from the third on are coarse
        planes, size = planes * (2 if len(levels) > 2 else 1), [n * rules[0][0] // 4 for n in levels[0].shape[1:]]
    out = _empty(planes, *size)
    _run("look_behind", *_level_arguments(levels, rules, coc, wanted), out, None, None, None)
    return out


def look_behind_gradient(
    levels: Sequence[Tensor], rules: Rules, coc: Tensor, gradient: Tensor, wanted: Tensor | None = None
) -> list[Tensor]:
    """The gradients of :func:`look_behind` by coc and by each level."""
    of_coc, *of_levels = (_empty(*values.shape).zero_() for values in (coc, *levels))
    _run("look_behind", *_level_arguments(levels, rules, coc, wanted), None, gradient, of_levels, of_coc)
    return [of_coc, *of_levels]


def _level_arguments(levels: Sequence[Tensor], rules: Rules, coc: Tensor, wanted: Tensor | None) -> tuple[Any, ...]:
    each = [
        _API.structures["level"](values, *values.shape[1:], *rule) for values, rule in zip(levels, rules, strict=True)
    ]
    return each, len(each), levels[0].shape[0] - 2, coc, wanted, *coc.shape[1:], _threads()


def continued(maps: Sequence[Tensor], ends: Sequence[int], *axis: Any) -> Tensor:
    """S surfaces continued beyond the frame's border, as in :func:`torchdof.render.surfaces.frame.pad_to_frame`.

    ``maps`` are light of each surface ``[C, H, W]``, then coc of each, weight of each, and the limit of highlights, all
    ``[1, H, W]``; ``axis`` holds the ends of the blur axis, and the index of the image's own surface or -1. The result
    is light, place on the blur axis and weight of each surface, ``[S (C + 2), H + ends, W + ends]``.
    """
    (channels, height, width), (left, right, top, bottom), count = maps[0].shape, ends, len(maps) // 3
    out = _empty(count * (channels + 2), top + height + bottom, left + width + right)
    _run("continued", maps, count, channels, height, width, ends, *axis, _threads(), out, None, None)
    return out


def continued_gradient(gradient: Tensor, maps: Sequence[Tensor], ends: Sequence[int], *axis: Any) -> list[Tensor]:
    """The gradients of :func:`continued` by all maps but the last."""
    sums = [_empty(*values.shape).zero_() for values in maps[:-1]]
    _run("continued", maps, len(maps) // 3, *maps[0].shape, ends, *axis, _threads(), None, gradient, sums)
    return sums


def repair_edges(
    light: Tensor,
    nearness: Tensor,
    step: Tensor,
    auto: bool,
    of_coc: bool = False,
    stops_if_wide: bool = False,
    is_related: bool = False,
    stops: int = 0,
    eroded: bool = False,
) -> tuple[Tensor, float, bool, int]:
    """Repairs the edges of a depth map, as :func:`torchdof.render.surfaces.edges.repair`, for one image.

    ``light`` is ``[C, H, W]``, ``nearness`` ``[H, W]``, ``step`` ``[H, W]`` or ``[]``. The results are the map, the
    input itself if it needs no repair, how much it is in doubt, 0 to 1, less how far its foregrounds are dilated, 0 to
    1, whether the repair has stopped because of ramps too wide to be found, with ``stops_if_wide``, and which edits of
    the map colours ask for, of :func:`torchdof.render.surfaces.registration.edits_of`, a bit each. The map stays as it
    is if they ask for one of ``stops``. ``is_related``: the colours are known to be related to the map. ``eroded``: its
    foregrounds were too wide and have been eroded.
    """
    steps = (None, float(step)) if step.ndim == 0 else (step, 0.0)
    out, doubt = _empty(*nearness.shape), ctypes.c_double(0.0)
    changed, edits = ctypes.c_int32(0), ctypes.c_int32(0)
    options = (of_coc, *steps, auto, stops_if_wide, is_related, stops, eroded)
    _of_map("repair_edges", light, nearness, options, out, changed, doubt, edits)
    return out if changed.value == 1 else nearness, doubt.value, changed.value == _STOPPED, edits.value


def missed_parts(light: Tensor, coc_px: Tensor) -> tuple[Tensor, float]:
    """Completes a map of the coc, as :func:`torchdof.render.surfaces.missed.completed`, for one image.

    ``light`` is ``[C, H, W]``, ``coc_px`` ``[H, W]``. The results are the map ``[H, W]`` and how far it has missed
    parts, 0 to 1.
    """
    out, share = _empty(*coc_px.shape), ctypes.c_double(0.0)
    _of_map("missed_parts", light, coc_px, (True, None, 0.0, *(False,) * 5), out, share)
    return out, share.value


def blurred_in_doubt(given: Tensor, repaired: Tensor, doubt: float) -> Tensor:
    """Blurs the edges of a map of the coc ``[H, W]``, as :func:`torchdof.render.surfaces.doubt.blurred_in_doubt`."""
    out = _empty(*repaired.shape)
    _run("blurred_in_doubt", given, repaired, *repaired.shape, doubt, _threads(), out)
    return out


def _of_map(function: str, light: Tensor, map_: Tensor, options: Sequence[Any], out: Tensor, *results: Any) -> None:
    """Runs a function of ``api.h`` that reads a map and its image."""
    cancelled = ctypes.c_int32(0)
    maps = (*map_.shape, light.shape[0], light, map_, *options)
    scene = _API.structures["map"](*maps, _threads(), ctypes.pointer(cancelled), out)
    _interruptible(lambda: _run(function, scene, *results), cancelled, map_.numel())


def coc_px(depth: Tensor, scale: float, nearest_m: float, farthest_m: float) -> Tensor:
    """Signed circle of confusion in pixels, as :meth:`torchdof.Camera.coc_px` for a lens without tilt.

    ``depth`` in metres has any shape; ``scale`` is the radius in pixels for each dioptre between a depth and the focus,
    and depths from ``nearest_m`` to ``farthest_m`` are in focus. NaN where depth is not > 0.
    """
    out = _empty(*depth.shape)
    _run("coc", depth, depth.numel(), scale, nearest_m, farthest_m, _threads(), out)
    return out


def plan(coc_px: Tensor, tolerance: float) -> tuple[tuple[float, ...], float]:
    """Positions of the layers for a frame ``[B, 1, H, W]``, and its tolerance, as ``torchdof.render.layers.plan``."""
    count, capacity = ctypes.c_int32(0), 256
    while True:
        nodes, kept = _array(ctypes.c_double, capacity)(), ctypes.c_double(tolerance)
        size = (coc_px.shape[0], *coc_px.shape[-2:])
        _run("plan", coc_px, *size, kept, _threads(), nodes, capacity, count)
        if count.value <= capacity:
            return tuple(nodes[: count.value]), kept.value
        capacity = count.value


def kernels(
    templates: list[Tensor],
    which: list[tuple[int, int, int, int]],
    part: list[float],
    finer: list[float],
    reach: list[list[float]],
    fade: list[list[float]],
    flipped: list[bool],
    half: list[int],
    *,
    squeeze: float,
    is_round: bool,
    is_even: bool,
) -> list[Tensor]:
    """Makes the kernels of a lens, ``[C, 2 half + 1, 2 half + 1]``; they sum to 1 unless they are cropped.

    The lists are those of :class:`torchdof.optics.kernel_bank.Spots`. ``squeeze`` is the height of the blur divided by
    its width; a round kernel is symmetric about both axes, an even one is constant within its radius.
    """
    colours = len(reach[0])
    made = [_empty(colours, 2 * n + 1, 2 * n + 1) for n in half]
    cells = [template.shape[-1] // 2 - 1 for template in templates]
    index, reaches, fades = ([*itertools.chain(*each)] for each in (which, reach, fade))
    numbers = (part, finer, reaches, fades, flipped, half, squeeze, is_round, is_even)
    scene = _API.structures["spots"](len(made), colours, templates, cells, index, *numbers)
    _run("kernels", scene, _threads(), made)
    return made


def ends(values: Tensor) -> tuple[float, float]:
    """Smallest and largest of some float32 values; NaN if any value is NaN.

    PyTorch's own reduction would leave its threads spinning, which slows down the engine's threads.
    """
    low, high = ctypes.c_float(), ctypes.c_float()
    _run("ends", values, values.numel(), _threads(), ctypes.byref(low), ctypes.byref(high))
    return low.value, high.value


def _interruptible(run: Callable[[], None], cancelled: ctypes.c_int32, pixels: int) -> None:
    """Runs a long computation outside Python so that Ctrl-C stops it.

    Python delivers signals to the main thread, and only between two of its instructions. Therefore another thread does
    the work, and the main thread waits in a call that signals can interrupt. A small frame is rendered directly.
    """
    if pixels <= _SMALL_FRAME or threading.current_thread() is not threading.main_thread():
        run()
        return
    outcome: concurrent.futures.Future[None] = concurrent.futures.Future()
    grad_enabled, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def guarded() -> None:
        try:
            with torch.inference_mode(inference), torch.set_grad_enabled(grad_enabled):
                run()
            outcome.set_result(None)
        except BaseException as error:  # of any kind: the main thread raises it
            outcome.set_exception(error)

    # Not Thread.join: once interrupted, in Python 3.11 it takes a running thread for finished, and the next call
    # returns at once. The arrays would then be freed, or the process end, while the engine still runs.
    interruption: BaseException | None = None
    threading.Thread(target=guarded, name="torchdof").start()
    while not outcome.done():
        try:
            outcome.exception()
        except BaseException as error:  # Ctrl-C, possibly several times
            cancelled.value, interruption = 1, error
    if interruption:
        raise interruption
    outcome.result()


def _run(name: str, *arguments: Any) -> None:
    """Calls a function of the engine, and raises the error that its status means."""
    function, kept = getattr(_engine(), f"torchdof_{name}"), _contiguous(arguments)
    status = function(*(_plain(kind, value) for kind, value in zip(function.argtypes, kept, strict=True)))
    if status == _API.constants["NO_MEMORY"]:
        raise MemoryError("there is too little memory to render this image")
    if status == _API.constants["TOO_BRIGHT"]:
        raise OverflowError("light beyond 2 to the 28th is too bright for float32")
    if status == _API.constants["CANCELLED"]:
        raise KeyboardInterrupt


def _contiguous(value: Any) -> Any:
    """Nested lists of values, in which tensors are contiguous."""
    if isinstance(value, Tensor):
        return value.contiguous()
    if not isinstance(value, (list, tuple)):
        return value
    return [each if type(each) in (int, float) else _contiguous(each) for each in value]


def _plain(kind: Any, value: Any) -> Any:
    """A value as ctypes takes it for a type: a tensor becomes a pointer to its numbers, a list an array."""
    if isinstance(value, Tensor):
        return value.data_ptr()
    if not isinstance(value, list):
        return value
    element = kind._type_
    is_numbers = value and isinstance(value[0], (int, float))
    return _array(element, max(1, len(value)))(*(value if is_numbers else (_plain(element, each) for each in value)))


def _empty(*size: int) -> Tensor:
    return torch.empty(size, dtype=torch.float32, device="cpu")


@functools.lru_cache(maxsize=1024)
def _array(kind: Any, count: int) -> Any:
    """Array type of ``count`` elements, cached: making one takes 20 microseconds, and ctypes does not keep it."""
    return kind * count


def _engine() -> ctypes.CDLL:
    library, missing = _library()
    if library is None:
        raise RuntimeError(missing)
    return library


def _library() -> tuple[ctypes.CDLL | None, str]:
    """The compiled engine, or the reason why it is missing."""
    return _loaded("_engine_avx2" if _instructions == "avx2" else "_engine")


@functools.cache
def _loaded(name: str) -> tuple[ctypes.CDLL | None, str]:
    file = importlib.resources.files(__name__) / f"{name}{_SUFFIX}"
    if not file.is_file():
        return None, "the compiled engine was not built when torchdof was installed"
    try:
        with importlib.resources.as_file(file) as path:
            library = ctypes.CDLL(str(path))
    except OSError as error:
        if "failed to map segment" in str(error) and "permitted" not in str(error):  # a file system may also forbid it
            raise MemoryError("there is too little memory to load the compiled engine") from None
        return None, f"the compiled engine cannot be loaded: {error}"
    try:
        for name, (result, arguments) in _API.functions.items():
            function = getattr(library, f"torchdof_{name}")
            function.restype, function.argtypes = result, arguments
        is_current = library.torchdof_interface() == _API.checksum
    except AttributeError:  # an old build, left beside new sources
        is_current = False
    if is_current:
        return library, ""
    stale = "the compiled engine is of another version of torchdof"
    warnings.warn(f"{stale}, and is not used: install torchdof again", RuntimeWarning, stacklevel=2)
    return None, stale
