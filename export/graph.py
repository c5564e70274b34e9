"""The exported module: a static plan, tensors in, tensors out."""

import copy
import dataclasses
from typing import Any, Literal, get_args
from unittest import mock

import torch
import torch._dynamo.config
import torch.fx.config
from torch import Tensor, nn

from torchdof import DepthOfField, validation
from torchdof.module import render
from torchdof.optics.camera import Camera
from torchdof.options import DepthEdges, Options
from torchdof.render import routes
from torchdof.render.engines.ops import Ops
from torchdof.render.layers.plan import Plan

from .operations import GraphOps, WholeOps

__all__ = ["INPUTS", "ITEMS", "LENS", "OUTPUT", "Layout", "Portable", "Size", "axes", "trace"]

Layout = Literal["tiles", "whole"]
"""Structure of a graph: a loop over tiles, or straight operations on whole frames."""

Size = tuple[int, int] | None
"""Height and width of the only frame that a graph takes, as a batch of one; None: any batch, height and width."""

INPUTS = {
    "depth": ("image", "depth", "focus_m", "f_number"),
    "depth+matte": ("image", "depth", "matte", "focus_m", "f_number"),
    "coc_px": ("image", "coc_px"),
    "coc_px+matte": ("image", "coc_px", "matte"),
}
"""Names of the graph's inputs, in order, for each choice of them."""

LENS = ("focus_m", "f_number")
"""Names of the inputs with a number for each item; the others are maps."""

ITEMS = "B_or_1"
"""Name of the batch axis of every input except the image."""

OUTPUT = "out"
"""Name of the graph's output; ONNX does not let it share the name of the input ``image``."""


class Portable(nn.Module):
    """The module as computed by its ONNX file: all layers up to ``max_coc_px``; pixels with bad values are copied.

    An impossible camera gives NaN. Called outside an export, it gives the same result with eager PyTorch; files are
    verified against it. Arguments as of :func:`torchdof.export.to_onnx`.
    """

    def __init__(
        self,
        dof: DepthOfField,
        inputs: str = "depth",
        width: int | None = None,
        depth_edges: DepthEdges | None = None,
        layout: Layout = "tiles",
        size: Size = None,
    ) -> None:
        super().__init__()
        validation.choice("inputs", inputs, INPUTS)
        validation.choice("layout", layout, get_args(Layout))
        for name in Camera.__dataclass_fields__:
            if isinstance(getattr(dof.camera, name), Tensor):
                raise ValueError(
                    f"the camera's {name} must be a float to be exported, got a tensor; focus_m and f_number are "
                    "inputs of the graph, so any value does for them"
                )
        if size is not None and layout != "whole":
            raise ValueError(f'size is for layout="whole"; tiles are for frames of any size, got size={size!r}')
        if size is not None and (len(size) != 2 or any(not isinstance(n, int) or n < 1 for n in size)):
            raise ValueError(f"size must be height and width of a frame in pixels, such as (1080, 1920), got {size!r}")
        if depth_edges is None:
            depth_edges = "as given" if layout == "whole" else dof.options.depth_edges
        routes.refuse(dof.options, "whole file" if layout == "whole" else "file", repairs=depth_edges != "as given")
        table = dof.options.table
        if table.unit == "relative" and width is not None:
            raise ValueError(f"{table!r} has the same kernels at any image width; leave out width={width}")
        if table.unit != "relative":
            width = size[1] if width is None and size is not None else width
            if isinstance(width, bool) or not isinstance(width, int) or width < 1:
                raise ValueError(
                    f"{table!r} holds lengths in {table.unit!r}, and the kernels in the file are those of one image "
                    f"width; state it as width=1920, say, got {width!r}"
                )
        self.inputs, self.width, self.layout, self.size = inputs, width, layout, size
        self.dof = copy.copy(dof)
        self.dof.options = dataclasses.replace(dof.options, check=False, depth_edges=depth_edges)
        self.called = dataclasses.replace(dof.options, check=False)
        self.plan = Plan.static(dof.options.max_coc_px, dof.options.tolerance, rays=True)
        self.ops = WholeOps() if layout == "whole" else Ops()
        self.ops.lens_width = width
        self.eval()

    def forward(self, image: Tensor, *others: Tensor) -> Tensor:
        """Renders ``[B, C, H, W]`` from the :data:`INPUTS` of the file."""
        out = self._rendered(self.dof.options, self.plan, image, *others)
        if "focus_m" not in INPUTS[self.inputs]:
            return out
        focus_m, f_number = others[-2:]
        camera = self.dof.camera
        nearest_m = float(camera.focal_length_mm) / 1000.0 if camera.focus_breathing else 0.0
        is_possible = (focus_m > nearest_m) & (f_number > 0) & (f_number < torch.inf)
        undefined = torch.where(is_possible[:, None, None, None], out, torch.nan)
        return self.ops.equal_unless(lambda: ~is_possible.all(), undefined, out)

    def as_called(self, image: Tensor, *others: Tensor) -> Tensor:
        """Renders like a call of the module: layers chosen for the scene, its own highlights and edge repair."""
        return self._rendered(self.called, None, image, *others)

    def _rendered(self, options: Options, plan: Plan | None, image: Tensor, *others: Tensor) -> Tensor:
        given = dict(zip(INPUTS[self.inputs][1:], others, strict=True))
        if "depth" in given:
            coc_px = self.dof.coc_as_given(image, given["depth"], given["focus_m"], given["f_number"])
        else:
            coc_px = given["coc_px"]
            validation.scene(image, "coc_px", coc_px, channels=options.table.channels, values=False)
        return render(image, coc_px, options, plan, ops=self.ops, matte=given.get("matte"))


def trace(portable: Portable, channels: int) -> torch.export.ExportedProgram:
    """Traces the module, with dynamic batch, height and width unless it has a size."""
    table = portable.dof.options.table
    if table.channels not in (1, channels):
        raise ValueError(f"the table blurs {table.channels} channels, the image has {channels}")
    # With a single row or column of tiles, PyTorch would record the number of tiles as the number of items, because
    # both are the same in the example: take several, of the largest tiles too. They are not computed while tracing.
    batch, size = (5, (600, 850)) if portable.size is None else (1, portable.size)
    shapes = {"image": (batch, channels, *size), **dict.fromkeys(LENS, (batch,))}
    sizes = [shapes.get(name, (batch, 1, *size)) for name in INPUTS[portable.inputs]]
    example = tuple(torch.ones(1, dtype=torch.float32).expand(shape) for shape in sizes)  # values do not matter
    traced = copy.copy(portable)
    layered = portable.dof.options.method == "layered"
    if portable.layout == "whole":
        traced.ops = copy.copy(portable.ops)
        traced.ops.kernels = portable.plan.constants(table, layered, portable.width or 1)
    else:
        traced.ops = GraphOps(portable.plan, table, layered, portable.width)
    # Leaving out these two saves half of the time: the cache of fake tensor results, which costs more than it saves,
    # because sizes are symbols; and stack traces, which nothing here reads.
    uncached = torch._dynamo.config.patch(fake_tensor_cache_enabled=False)
    unexplained = mock.patch.object(torch.fx.config, "do_not_emit_stack_traces", True)
    with torch.no_grad(), uncached, unexplained:
        return torch.export.export(
            traced, example, dynamic_shapes=axes(portable, *[torch.export.Dim.AUTO] * 3), strict=False
        )


def axes(portable: Portable, batch: Any, height: Any, width: Any) -> tuple[Any, ...] | None:
    """Names of each input's free axes, given those of batch, height and width; None if the sizes are fixed."""
    if portable.size is not None:
        return None
    frame = {0: batch, 2: height, 3: width}
    others = tuple({0: batch} if name in LENS else frame for name in INPUTS[portable.inputs][1:])
    return frame, others  # of forward(image, *others)
