"""Converts a module to a file: traces, translates, simplifies, labels and verifies it, then moves it into place."""

import contextlib
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import onnx
import onnx_ir
import torch
from onnx_ir.tape import Tape
from onnxscript import opset20

from torchdof import DepthOfField
from torchdof.io.atomic import atomic_file
from torchdof.options import DepthEdges
from torchdof.tensors import TRACEABLE
from torchdof.validation import whole

from .graph import INPUTS, ITEMS, OUTPUT, Layout, Portable, Size, axes, trace
from .metadata import label
from .slimming import slim
from .verification import Verification, verify

__all__ = ["OPSET", "to_onnx"]

OPSET = 20


def to_onnx(
    dof: DepthOfField,
    path: str | os.PathLike[str],
    *,
    inputs: str = "depth",
    channels: int = 3,
    width: int | None = None,
    depth_edges: DepthEdges | None = None,
    layout: Layout = "tiles",
    size: Size = None,
    opset: int = OPSET,
    progress: Callable[[str], object] = lambda _: None,
) -> Verification:
    """Writes a module as one ONNX file, verified against the module.

    The graph takes ``image [B, C, H, W]`` (linear light), ``depth [B, 1, H, W]`` (metres), ``focus_m [B]`` and
    ``f_number [B]``, or ``image`` and ``coc_px [B, 1, H, W]``, all float32, and returns ``out [B, C, H, W]``. B, H and
    W may be any number from 1; all inputs except the image may have one item for the whole batch. A pixel whose depth
    is NaN, zero or negative is copied and does not affect others. An impossible camera (focus within the focal length,
    f-number or focus not positive, NaN) gives a picture of NaN.

    The graph has the layers of every radius up to ``dof.max_coc_px``. With ``layout="tiles"``, for CPUs, it renders
    tile by tile in an ONNX ``Loop`` and skips, with ``If``, tiles in focus and layers without pixels in or near a tile.
    Highlights are rendered ray by ray in another ``Loop``. With ``layout="whole"``, for GPUs and browsers, it has no
    loops, branches, functions or lists of pixels: it computes every layer of the whole frame, and has no rays, so that
    highlights are soft discs, without crisp outlines of surfaces in front of them (numbers in docs/embedding.md).

    Args:
        dof: The module. The file contains its camera, table and options, except focus and f-number, which are inputs.
        path: The file. It is written to a temporary file beside it, verified, and moved into place.
        inputs: ``"depth"``, or ``"coc_px"`` for pipelines that already have the circle of confusion. With
            ``"depth+matte"`` or ``"coc_px+matte"`` the third input is ``matte [B, 1, H, W]``, coverage in [0, 1]; a
            matte of zeros changes nothing.
        channels: Channels of the image, C.
        width: Required for a table with lengths in millimetres or fractions of the width: the image width for which the
            file's kernels are made. The file uses the same kernel for a radius in pixels at any width.
        depth_edges: As in :class:`DepthOfField`. None takes the option of ``dof``; ``layout="whole"`` can only leave
            edges as given, and does so by default. The repair doubles the time of a frame (docs/embedding.md).
        layout: ``"tiles"`` or ``"whole"``, see above.
        size: For the layout ``"whole"``, height and width of the only frame that the graph takes, in a batch of one:
            fewer operations, for runtimes that need fixed sizes.
        opset: ONNX operator set, 20 or newer.
        progress: Called with the name of each step: tracing, translating, slimming, then each verified case.

    Returns:
        The comparison with the module; ``print`` shows a table.

    Raises:
        ValueError: If an argument is invalid, PyTorch is older than 2.13, or the file's result differs from the
            module's; no file is written then.

    Example:
        >>> import tempfile, torchdof
        >>> dof = torchdof.DepthOfField(torchdof.Camera(), max_coc_px=1.0, tolerance="draft", occlusion=False)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     len(to_onnx(dof, f"{folder}/dof.onnx").cases) > 5
        True
    """
    if not isinstance(dof, DepthOfField):
        raise ValueError(f"dof must be a torchdof.DepthOfField, got {type(dof).__name__}")
    whole("opset", opset, OPSET, 2**31)
    whole("channels", channels, 1, 2**31)
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: there is no folder {path.parent}")
    portable = Portable(dof, inputs, width, depth_edges, layout, size)
    if not TRACEABLE:
        raise ValueError(
            f"torchdof needs PyTorch 2.13 or newer to write ONNX files, this is {torch.__version__}; what a newer "
            "one has written can be verified here"
        )
    progress("tracing")
    with _quiet():
        program = trace(portable, channels)
        progress("translating")
        graph = _translate(program, portable, opset)
    progress("slimming")
    slimmed = slim(graph, straight=layout == "whole")
    model = onnx_ir.to_proto(slimmed if size is not None else broadcast(slimmed))
    label(model, dof, portable, channels, opset)
    with atomic_file(path) as temporary:
        onnx.save_model(model, temporary, format="protobuf")
        return verify(temporary, dof, progress=progress)


def broadcast(model: onnx_ir.Model) -> onnx_ir.Model:
    """Lets every input except the image have one item for the whole batch, in place.

    For a wrong shape, a runtime's error message contains the name of the node that cannot expand it.
    """
    graph = model.graph
    values: list[Any] = list(graph.inputs)
    image, *others = values
    tape = Tape()
    items, size = (tape.op("Shape", [image], {"start": a, "end": b}) for a, b in ((0, 1), (2, 4)))
    full = tape.op("Concat", [items, tape.op("Constant", [], {"value_ints": [1]}), size], {"axis": 0})
    for value in others:
        is_map = len(value.shape) == 4
        hint = "one_item_or_as_many_as_image" + ("_and_its_height_and_width" if is_map else "")
        uses = list(value.uses())
        expanded = tape.op("Expand", [value, full if is_map else items], name=f"{value.name}_must_have_{hint}")
        for use in uses:
            use.node.replace_input_with(use.idx, expanded)
        value.shape = onnx_ir.Shape([ITEMS, *value.shape[1:]])
    graph.outputs[0].shape = onnx_ir.Shape(image.shape)
    graph.insert_before(next(iter(graph)), list(tape.nodes))
    for number, node in enumerate(tape.nodes):
        node.outputs[0].name = f"batch_{number}"
    return model


def _translate(program: torch.export.ExportedProgram, portable: Portable, opset: int) -> onnx_ir.Model:
    """The module as an ONNX graph, translated by torch.onnx and not yet simplified."""
    # torch.onnx would trace everything again to decompose operators, most of which it can translate as they are
    vars(program)["run_decompositions"] = lambda _: program
    # conditions on sizes; torch.onnx leaves their terms, some of which are beyond 64 bits
    program.graph.eliminate_dead_code(lambda node: node.op in ("placeholder", "output"))
    converted: Any = torch.onnx.export(
        program,
        dynamo=True,
        opset_version=opset,
        input_names=list(INPUTS[portable.inputs]),
        output_names=[OUTPUT],
        dynamic_shapes=axes(portable, "B", "H", "W"),
        optimize=False,
        verbose=False,
        custom_translation_table=_TRANSLATIONS,
    )
    model: onnx_ir.Model = converted.model
    return model


def _index_copy(self: Any, dim: int, index: Any, source: Any) -> Any:
    return opset20.ScatterElements(self, _expanded(index, dim, source), source, axis=dim)


def _expanded(index: Any, dim: int, source: Any) -> Any:
    """An index ``[n]`` along one axis, in the shape of the values."""
    others = [axis for axis in range(len(source.shape)) if axis != dim]
    if not others:
        return index
    index = opset20.Unsqueeze(index, opset20.Constant(value_ints=others))  # type: ignore[arg-type]
    return opset20.Expand(index, opset20.Shape(source))


def _all(self: Any, dim: int, keepdim: bool = False) -> Any:
    # torch.onnx reduces int64, which runtimes on GPUs leave to the CPU
    axis: Any = [dim]
    as_float: Any = opset20.Cast(self, to=onnx_ir.DataType.FLOAT)
    least: Any = opset20.ReduceMin(as_float, axis, keepdims=keepdim)
    return opset20.Cast(least, to=onnx_ir.DataType.BOOL)


def _where(condition: Any, self: Any, other: Any) -> Any:
    if self.dtype != onnx_ir.DataType.BOOL:
        return opset20.Where(condition, self, other)
    neither = opset20.And(opset20.Not(condition), other)  # onnxruntime has no Where for bool
    return opset20.Or(opset20.And(condition, self), neither)


def _nan_to_num(self: Any) -> Any:
    limits = torch.finfo(torch.float32)
    return opset20.Where(opset20.IsNaN(self), 0.0, opset20.Clip(self, limits.min, limits.max))


def _index_select(self: Any, dim: int, index: Any) -> Any:
    if dim != 1:
        return opset20.Gather(self, index, axis=dim)
    index = opset20.Unsqueeze(index, opset20.Constant(value_ints=[0]))  # type: ignore[arg-type]
    if self.shape[0] != 1:
        one: Any = opset20.Constant(value_ints=[1])
        size: Any = opset20.Concat(opset20.Shape(self, start=0, end=1), one, axis=0)
        index = opset20.Expand(index, size)
    return opset20.GatherElements(self, index, axis=dim)  # five times as fast in onnxruntime as Gather


def _index_add(self: Any, dim: int, index: Any, source: Any) -> Any:
    # not ScatterND: runtimes add in parallel there, and would lose some values
    return opset20.ScatterElements(self, _expanded(index, dim, source), source, axis=dim, reduction="add")


def _floor_divide(self: Any, other: Any) -> Any:
    other = opset20.CastLike(other, self)
    return opset20.Div(opset20.Sub(self, opset20.Mod(self, other)), other)  # torch.onnx needs eight operators


def _diff(self: Any, n: int = 1, dim: int = -1, prepend: Any = None, append: Any = None) -> Any:
    axis: Any = [dim]
    bounds: Any = [0], [1], [-1], [2**63 - 1]
    before = opset20.Slice(self, bounds[0], bounds[2], axis)
    return opset20.Sub(opset20.Slice(self, bounds[1], bounds[3], axis), before)


_TRANSLATIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    torch.ops.aten.to.dtype: lambda self, dtype, non_blocking=False, copy=False: opset20.Cast(self, to=dtype),
    torch.ops.aten.to.device: lambda self, device, dtype, non_blocking=False, copy=False: opset20.Cast(self, to=dtype),
    torch.ops.aten.all.dim: _all,
    torch.ops.aten.where.self: _where,
    torch.ops.aten.index_select.default: _index_select,
    torch.ops.aten.aminmax.default: lambda self: (
        opset20.ReduceMin(self, keepdims=0),
        opset20.ReduceMax(self, keepdims=0),
    ),
    torch.ops.aten.diff.default: _diff,
    torch.ops.aten.nan_to_num.default: _nan_to_num,
    torch.ops.aten.index_add.default: _index_add,
    torch.ops.aten.addcmul.default: lambda self, first, second: opset20.Add(self, opset20.Mul(first, second)),
    torch.ops.aten.index_copy.default: _index_copy,
    torch.ops.aten.sym_numel.default: lambda self: opset20.Size(self),
    torch.ops.aten.item.default: lambda self: opset20.Identity(self),
    torch.ops.aten.detach_.default: lambda self: opset20.Identity(self),
    torch.ops.aten.__and__.Tensor: lambda self, other: opset20.And(self, other),
    torch.ops.aten.__or__.Tensor: lambda self, other: opset20.Or(self, other),
    torch.ops.aten.square.default: lambda self: opset20.Mul(self, self),
    torch.ops.aten.rsub.Scalar: lambda self, other: opset20.Sub(opset20.CastLike(other, self), self),
    # index % width with a width known only at run time; torch.onnx accepts only numbers
    torch.ops.aten.remainder.Scalar: lambda self, other: opset20.Mod(self, opset20.CastLike(other, self)),
    torch.ops.aten.floor_divide.default: _floor_divide,
    torch.ops.aten.hypot.default: lambda self, other: opset20.Sqrt(
        opset20.Add(opset20.Mul(self, self), opset20.Mul(other, other))
    ),
}
"""Translations of operators that torch.onnx does not translate itself."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silences messages of torch.onnx and onnxscript that do not concern the module."""
    with warnings.catch_warnings():
        # torch's own copy of its tree specs calls a constructor that torch deprecates
        warnings.filterwarnings("ignore", message=r".*isinstance\(treespec, LeafSpec\).*", category=FutureWarning)
        # depth, focus and f-number share the image's axes, as intended
        warnings.filterwarnings("ignore", message=r".*axis name: [BHW] will not be used", category=UserWarning)
        # each export warns of missing torchvision operators and of size ranges that torch cannot express
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(before)
