"""The exported module: a static plan, tensors in, tensors out."""

import copy
import dataclasses

import torch
import torch._dynamo.config
from torch import Tensor, nn

from torchdof import BlurTable, DepthOfField
from torchdof.module import blur
from torchdof.optics.camera import Camera
from torchdof.options import DepthEdges, Options
from torchdof.render.ops import Ops
from torchdof.render.plan import LayerKernel, Plan

from .operations import GraphOps

__all__ = ["INPUTS", "OUTPUT", "Portable", "trace"]

INPUTS = {"depth": ("image", "depth", "focus_m", "f_number"), "coc_px": ("image", "coc_px")}
"""Names of the graph's inputs, in order, for each kind of map."""

OUTPUT = "out"
"""Name of the graph's output; ONNX does not let it share the name of the input ``image``."""


class Portable(nn.Module):
    """The module as computed by its ONNX file: all layers up to ``max_coc_px``; pixels with bad values are copied.

    An impossible camera gives NaN.

    Called outside an export, it gives the same result with eager PyTorch; files are verified against it.

    Args:
        dof: The module. Its camera must have floats, not tensors.
        inputs: The map that the graph takes: ``"depth"`` or ``"coc_px"``.
        width: Image width for the kernels of a table with lengths in millimetres or fractions of the width.
        depth_edges: Repair of the map's edges in the graph.

    Raises:
        ValueError: If the camera has tensors, or the width is missing or superfluous.
    """

    def __init__(
        self,
        dof: DepthOfField,
        inputs: str = "depth",
        width: int | None = None,
        depth_edges: DepthEdges = "as given",
    ) -> None:
        super().__init__()
        if inputs not in INPUTS:
            raise ValueError(f"inputs must be one of {', '.join(INPUTS)}, got {inputs!r}")
        for name in Camera.__dataclass_fields__:
            if isinstance(getattr(dof.camera, name), Tensor):
                raise ValueError(
                    f"the camera's {name} must be a float to be exported, got a tensor; "
                    "focus_m and f_number are inputs "
                    "of the graph, so any value does for them"
                )
        check_width(dof.options.table, width)
        self.inputs, self.width = inputs, width
        self.dof = copy.copy(dof)
        self.dof.options = dataclasses.replace(dof.options, check=False, depth_edges=depth_edges)
        self.called = dataclasses.replace(dof.options, check=False)
        self.plan = Plan.all(dof.options.max_coc_px, dof.options.tolerance, rays=True)
        self.ops = Ops()
        self.ops.lens_width = width
        self.eval()

    def forward(self, image: Tensor, map_: Tensor, *lens: Tensor) -> Tensor:
        """Renders ``[B, C, H, W]`` from depth and ``(focus_m, f_number)``, or from a map of the coc."""
        out = self._rendered(self.dof.options, self.plan, image, map_, *lens)
        if self.inputs == "coc_px":
            return out
        focus_m, f_number = lens
        camera = self.dof.camera
        nearest_m = float(camera.focal_length_mm) / 1000.0 if camera.focus_breathing else 0.0
        is_possible = (focus_m > nearest_m) & (f_number > 0) & (f_number < torch.inf)
        undefined = torch.where(is_possible[:, None, None, None], out, torch.nan)
        return self.ops.choose(lambda: ~is_possible.all(), undefined, out)

    def as_called(self, image: Tensor, map_: Tensor, *lens: Tensor) -> Tensor:
        """Renders like a call of the module: layers chosen for the scene, its own highlights and edge repair."""
        return self._rendered(self.called, None, image, map_, *lens)

    def _rendered(self, options: Options, plan: Plan | None, image: Tensor, map_: Tensor, *lens: Tensor) -> Tensor:
        if self.inputs == "coc_px":
            return blur(image, map_, options, plan, ops=self.ops)
        focus_m, f_number = lens
        coc_px = self.dof.coc_as_given(image, map_, focus_m, f_number)
        return blur(image, coc_px, options, plan, ops=self.ops)

    def blurs(self, size: tuple[int, int]) -> list[LayerKernel]:
        """Kernels of the graph's layers, for a frame of this height and width."""
        coarse = self.dof.options.method == "layered"
        return self.plan.blurs(self.dof.options.table, size, torch.float32, torch.device("cpu"), coarse, self.width)


def check_width(table: BlurTable, width: int | None) -> None:
    """Raises an error for a width that the table does not need, or a missing width that it needs.

    Raises:
        ValueError: With the required change.
    """
    if table.unit == "relative":
        if width is not None:
            raise ValueError(f"{table!r} has the same kernels at any image width; leave out width={width}")
    elif isinstance(width, bool) or not isinstance(width, int) or width < 1:
        raise ValueError(
            f"{table!r} holds lengths in {table.unit!r}, and the kernels in the file are those of one image width; "
            f"state it as width=1920, say, got {width!r}"
        )


def trace(portable: Portable, channels: int) -> torch.export.ExportedProgram:
    """Traces the module with dynamic batch, height and width.

    Raises:
        ValueError: If the channels do not fit the table.
    """
    table = portable.dof.options.table
    if table.channels not in (1, channels):
        raise ValueError(f"the table blurs {table.channels} channels, the image has {channels}")
    # With a single row or column of tiles, PyTorch would record the number of tiles as the number of items, because
    # both are the same in the example: take several, of the largest tiles too. They are not computed while tracing.
    batch_size, size = 5, (600, 850)
    sizes = [(batch_size, n, *size) for n in (channels, 1)] + [(batch_size,)] * 2
    # the graph does not depend on the values
    example = tuple(torch.ones(1).expand(n) for n in sizes[: len(INPUTS[portable.inputs])])
    traced = copy.copy(portable)
    traced.ops = GraphOps(portable.plan, table, portable.dof.options.method == "layered", portable.width)
    free = torch.export.Dim.AUTO
    batch, frame = {0: free}, {0: free, 2: free, 3: free}
    shapes = (frame, frame, *((batch, batch),) * (len(example) > 2))
    # the cache of fake tensor results costs more time than it saves, because sizes are symbols
    uncached = torch._dynamo.config.patch(fake_tensor_cache_enabled=False)
    with torch.no_grad(), uncached:
        return torch.export.export(traced, example, dynamic_shapes=shapes, strict=False)
