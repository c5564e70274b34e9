"""Which engine renders a call, and which calls no engine renders.

| call | eager, float32 on the CPU | with gradients | on a CUDA device | otherwise | `torch.compile` | ONNX file |
| --- | --- | --- | --- | --- | --- | --- |
| image | compiled | steps | kernels | PyTorch | graph | graph |
| image without occlusion | compiled | steps | PyTorch | PyTorch | graph | graph |
| a known background | compiled | steps | kernels | PyTorch | graph | no such input |
| a matte | compiled | steps | kernels | PyTorch | graph | graph |
| `attention` | compiled | steps | kernels | PyTorch | refused | no such input |
| stack of up to 3 layers (`DepthOfField.layers`) | compiled | steps | kernels | PyTorch | left out | no such input |
| stack of more layers | compiled | steps | PyTorch | PyTorch | left out | no such input |
| a table whose blur depends on the place in the frame | compiled | steps | kernels | PyTorch | refused | refused |
| `method="fold"` | steps | steps | kernels | PyTorch | graph | graph |
| an aperture whose rotation or squeeze has a gradient | steps | steps | kernels | PyTorch | left out | refused |
| kernels wider than 513 pixels of their layer | steps | steps | kernels | PyTorch | graph | graph |
| `torchdof.functional.splat` | PyTorch | PyTorch | PyTorch | PyTorch | refused | no such input |

- compiled: the compiled engine renders the whole picture. What a matte says is computed in PyTorch before.
- steps: PyTorch renders, and the compiled engine computes those of its steps that it supports.
- kernels: PyTorch renders, and CUDA kernels compute those of its steps that they support, in float32, with and without
  gradients (:mod:`torchdof.render.engines.on_gpu`). They split the mixed pixels of images of up to 8 channels, and blur
  and composite layers of up to 8 channels, or of any number of colours with kernels of their own. With a table that
  depends on the place, `method="fold"` or an aperture with a gradient, they split pixels alone. In all these calls, and
  in those without occlusion, they find the edges of depth, which have no gradient; without gradients they block the
  rays of highlights too.
- otherwise: float64, or another device.
- PyTorch: PyTorch renders alone. So it does where there is no compiled engine, or no NVRTC beside PyTorch for the
  kernels; with `TORCHDOF_ENGINE=torch`; and in forward mode or under `torch.func`.
- graph: one static graph. That of `torch.compile` has no rays of highlights.
- left out: `torch.compile` calls it as eager code between two graphs; with `fullgraph=True` it fails.
- float16 and bfloat16 are rendered as float32. A frame wholly in focus is returned unchanged, without an engine.

`logging.getLogger("torchdof").setLevel(logging.DEBUG)` shows a line for each rendered item: the engine and the reason.
"""

import logging
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from .. import native
from ..kernels import layers, loader
from ..options import Options
from ..tensors import is_differentiated, is_traced
from ..validation import engine_reads
from .engines import on_gpu
from .layers.plan import KERNELS_PER_PX, Plan

Call = Literal["image", "stack", "splat", "file", "whole file"]
"""The kind of call: the rendering of an image or of a stack of layers, ``splat``, or the export in tiles or whole."""

Engine = Literal["compiled", "steps", "kernels", "PyTorch", "graph"]

_ENGINES: dict[Engine, str] = {
    "compiled": "the compiled engine",
    "steps": "PyTorch with compiled steps",
    "kernels": "PyTorch with CUDA kernels",
    "PyTorch": "PyTorch",
    "graph": "a graph",
}
_NO_MEMORY = "a map has no plain memory, as in torch.func and forward mode"
_log = logging.getLogger("torchdof")


class Route(NamedTuple):
    """The engine of a rendering, and the reason."""

    engine: Engine
    why: str


def refuse(
    options: Options,
    call: Call = "image",
    *,
    background: bool = False,
    attention: bool = False,
    plan: bool = False,
    matte: bool = False,
    repairs: bool = False,
) -> None:
    """Refuse a combination of arguments that no engine renders: all these combinations are here.

    Args:
        options: Options of the rendering.
        call: The kind of call.
        background: Whether a background is given.
        attention: Whether the viewer's attention is given.
        plan: Whether a plan is given.
        matte: Whether a matte is given.
        repairs: Whether a file is to repair depth edges.

    Raises:
        ValueError: With the combination and the remedy.
    """
    table, traced = options.table, is_traced()
    for is_refused, message in (
        (
            call == "splat" and traced,
            "splat cannot be compiled or exported; use torch.compiler.disable(splat), or blur_by_coc",
        ),
        (
            call == "splat" and table.depends_on_place,
            "splat takes one kernel a radius, no table with a field or vignetting; use blur_by_coc",
        ),
        (
            call == "splat" and table.is_differentiated,
            "splat gives no gradient to the aperture; detach its rotation and squeeze, or use blur_by_coc",
        ),
        (
            call == "stack" and not options.occlusion,
            "layers hide each other: they need occlusion=True",
        ),
        (
            background and not options.occlusion,
            "without occlusion nothing is hidden: a background needs occlusion=True",
        ),
        (
            matte and not options.occlusion,
            "without occlusion all light is added, whatever covers a pixel: a matte needs occlusion=True",
        ),
        (
            attention and plan,
            "attention plans for two tolerances; leave plan out, or attention",
        ),
        (
            attention and traced,
            "attention chooses its work by where the viewer looks; a compiled or exported graph cannot",
        ),
        (
            (traced or call in ("file", "whole file")) and table.depends_on_place,
            "a compiled or exported graph has one kernel a layer; take a table without vignetting or field",
        ),
        (
            call in ("file", "whole file") and table.is_differentiated,
            "a file has constant kernels, without a gradient to the aperture; detach its rotation and squeeze",
        ),
        (
            call == "whole file" and repairs,
            'layout="whole" cannot repair depth edges, whose number depends on the map; repair the map before, or use '
            'layout="tiles"',
        ),
    ):
        if is_refused:
            raise ValueError(message)


def route(
    plan: Plan, options: Options, maps: Sequence[Tensor], is_stack: bool, half_widths: Callable[[], Sequence[int]]
) -> Route:
    """The engine that renders an item, whose name and reason are logged.

    Args:
        plan: Its layers.
        options: Options of the rendering.
        maps: All its light, circles of confusion and weights.
        is_stack: Whether it is a stack of layers instead of an image.
        half_widths: Half widths of the layers' kernels, in pixels of the layer; called only if all else fits.
    """
    if is_traced():
        return Route("graph", "the call is compiled or exported")
    chosen = _of_eager(plan, options, maps, is_stack, half_widths)
    _log.debug("rendered by %s: %s", _ENGINES[chosen.engine], chosen.why)
    return chosen


def _of_eager(
    plan: Plan, options: Options, maps: Sequence[Tensor], is_stack: bool, half_widths: Callable[[], Sequence[int]]
) -> Route:
    """As :func:`route`, in eager code and without a line in the log."""
    if maps[0].device.type == on_gpu.DEVICE:
        return _of_gpu(options, maps, is_stack)
    if not native.chosen():
        return Route("PyTorch", native.describe())
    if any(t.dtype != torch.float32 for t in maps):
        return Route("PyTorch", "the compiled engine computes in float32, and a map is float64")
    if not engine_reads(*maps, backward=True):
        device = maps[0].device.type
        return Route("PyTorch", _NO_MEMORY if device == "cpu" else f"on {device}")
    if any(map(is_differentiated, maps)):
        return Route("steps", "gradients are recorded")
    if options.table.is_differentiated:
        return Route("steps", "the aperture's rotation or squeeze has a gradient")
    if options.method != "layered":
        return Route("steps", f"method={options.method!r} is in PyTorch alone")
    if is_stack and plan.nodes == (0.0,):
        return Route("steps", "all layers of the stack are in focus")
    if plan.rays and not is_stack and plan.kernels_per_px != KERNELS_PER_PX:
        return Route("steps", "the plan has the kernels of a graph's highlights")
    half = max(half_widths())
    if half > native.HALF_LARGEST:
        return Route("steps", f"a kernel is {2 * half + 1} pixels wide, the largest is {2 * native.HALF_LARGEST + 1}")
    return Route("compiled", "float32 in CPU memory, no gradients")


def _of_gpu(options: Options, maps: Sequence[Tensor], is_stack: bool) -> Route:
    """As :func:`route`, for a device with kernels, as :mod:`torchdof.render.engines.on_gpu` decides for each step."""
    device, channels = maps[0].device.type, maps[0].shape[-3]
    for is_refused, why in (
        (native.wanted() == "torch", "as TORCHDOF_ENGINE says"),
        (any(t.dtype != torch.float32 for t in maps), "the kernels compute in float32, and a map is float64"),
        (not options.occlusion, "without occlusion"),
        (not on_gpu.takes(maps), _NO_MEMORY),
    ):
        if is_refused:
            return Route("PyTorch", f"on {device}, {why}")
    # a stack has a black surface behind it; a known background is behind the two surfaces of a pixel
    surfaces = maps[0].shape[1] + 1 if is_stack else 3 if len(maps) > 2 else 2
    for has_no_kernels, why in (
        (options.method != "layered", f"method={options.method!r}"),
        (options.table.depends_on_place, "the blur depends on the place in the frame"),
        (options.table.is_differentiated, "the aperture's rotation or squeeze has a gradient"),
        (options.table.channels == 1 and channels > loader.MOST_CHANNELS, f"more than {loader.MOST_CHANNELS} channels"),
        (surfaces > layers.MOST_SURFACES, f"a stack of more than {layers.MOST_SURFACES - 1} layers"),
    ):
        if has_no_kernels:
            if is_stack or channels > loader.MOST_CHANNELS:
                return Route("PyTorch", f"on {device}, {why}")
            return Route("kernels", f"float32 on {device}; PyTorch blurs the layers: {why}")
    return Route("kernels", f"float32 on {device}")
