"""A translated graph made flat, small and plain: what other runtimes read as well as the one it is verified with."""

import itertools
import string
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import onnx_ir
from onnx_ir.passes import common as passes
from onnx_ir.tape import Tape
from onnxscript.optimizer import fold_constants

from .structure import structure

__all__ = ["slim"]

_LARGEST_EQUAL = 64  # numbers of a constant that are written one by one though they are the same


def slim(model: onnx_ir.Model) -> onnx_ir.Model:
    """One flat graph without repeated constants, stack traces and names of source files; with loops and branches."""
    flat: tuple[onnx_ir.passes.PassBase, ...] = (
        passes.InlinePass(),
        passes.RemoveUnusedFunctionsPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(size_limit=2**24),
        passes.ShapeInferencePass(),
        _Casts(),
    )
    tidy: tuple[onnx_ir.passes.PassBase, ...] = (
        passes.ShapeInferencePass(),
        _Parts(),
        _Cuts(),
        _Averages(),
        passes.IdentityEliminationPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
    )
    structured: tuple[onnx_ir.passes.PassBase, ...] = (
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(size_limit=2**24),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
        passes.RemoveUnusedOpsetsPass(),
        passes.ClearMetadataAndDocStringPass(),
    )
    for step in flat:
        step(model)
    fold_constants(model, input_size_limit=2**24, output_size_limit=2**16)
    for step in tidy:
        step(model)
    structure(model)
    for step in structured:
        step(model)
    _place_weights(model)
    passes.RemoveUnusedNodesPass()(model)
    for graph in (model.graph, *model.graph.subgraphs()):
        _as_nodes(graph)
    kept = {value.name for value in (*model.graph.inputs, *model.graph.outputs)}
    names = ("".join(letters) for n in (2, 3, 4) for letters in itertools.product(string.ascii_letters, repeat=n))
    names = (name for name in names if name not in kept)
    for graph in (model.graph, *model.graph.subgraphs()):
        for value in (*graph.inputs, *graph.initializers.values()):
            _shorten(value, kept, names)
        for node in graph:
            node.name = None
            for value in node.outputs:
                _shorten(value, kept, names)
    return model


def _place_weights(model: onnx_ir.Model) -> None:
    """Weights of convolutions in the graph that convolves: only then runtimes arrange them for their fast kernels."""
    for graph in (model.graph, *model.graph.subgraphs()):
        for node in [node for node in graph if node.op_type == "Conv"]:
            weight = node.inputs[1]
            if weight is None or weight.const_value is None:
                continue
            bias = node.inputs[2] if len(node.inputs) > 2 else None
            if bias is not None and bias.const_value is not None and not bias.const_value.numpy().any():
                node.resize_inputs(2)
            rows, index = np.unique(weight.const_value.numpy(), axis=0, return_inverse=True)
            own = _initializer(graph, rows, f"{weight.name}_of_{node.name}")
            if len(rows) < len(index):
                which = _initializer(graph, index.astype(np.int64), f"{own.name}_channels")
                gather = onnx_ir.node("Gather", [own, which], {"axis": 0})
                graph.insert_before(node, [gather])
                own = gather.outputs[0]
            node.replace_input_with(1, own)


def _as_nodes(graph: onnx_ir.Graph) -> None:
    """Initializers as ``Constant`` nodes: ``onnx.compose`` renames these where a branch takes them from outside."""
    first = next(iter(graph), None)
    values: list[Any] = list(graph.initializers.values())
    for value in values:
        if not value.uses():
            del graph.initializers[value.name]
            continue
        tape, array = Tape(), value.const_value.numpy()
        if array.size > _LARGEST_EQUAL and (array == array.flat[0]).all():
            shape = tape.op("Constant", [], {"value_ints": list(array.shape)})
            tape.op("ConstantOfShape", [shape], {"value": onnx_ir.tensor(array.flat[:1])})
            shape.name = f"{value.name}_shape"
        else:
            tape.op("Constant", [], {"value": value.const_value})
        made = tape.nodes[-1].outputs[0]
        made.name = value.name
        del graph.initializers[value.name]
        value.replace_all_uses_with(made)
        if first is not None:
            graph.insert_before(first, list(tape.nodes))


def _initializer(graph: onnx_ir.Graph, array: np.ndarray, name: str) -> onnx_ir.Value:
    tensor = onnx_ir.tensor(array, name=name)
    value = onnx_ir.Value(
        name=name, shape=onnx_ir.Shape(array.shape), type=onnx_ir.TensorType(tensor.dtype), const_value=tensor
    )
    graph.register_initializer(value)
    return value


class _Casts(onnx_ir.passes.InPlacePass):
    """``CastLike`` as ``Cast``, or as nothing where the type is right already: not every runtime folds it."""

    def call(self, model: onnx_ir.Model) -> onnx_ir.passes.PassResult:
        """Replace in all graphs."""
        number = itertools.count()
        for graph in (model.graph, *model.graph.subgraphs()):
            for node in list(graph):
                if node.op_type != "CastLike" or node.domain:
                    continue
                value, like = node.inputs
                kind = None if like is None else like.dtype
                if value is None or kind is None:
                    continue
                if value.const_value is not None and value.is_initializer():
                    new = _cast_constant(model.graph, value, kind, next(number))
                elif value.dtype == kind and not node.outputs[0].is_graph_output():
                    new = value
                else:
                    cast = onnx_ir.node("Cast", [value], {"to": kind.value})
                    graph.insert_before(node, [cast])
                    new = cast.outputs[0]
                    new.type, new.shape = onnx_ir.TensorType(kind), node.outputs[0].shape
                node.outputs[0].replace_all_uses_with(new, replace_graph_outputs=True)
                graph.remove(node, safe=True)
        return onnx_ir.passes.PassResult(model, modified=True)


class _Parts(onnx_ir.passes.InPlacePass):
    """Slices of what was put together, as the parts themselves; onnxruntime warns where it does so itself."""

    def call(self, model: onnx_ir.Model) -> onnx_ir.passes.PassResult:
        """Replace in the graph; a flat one, as it is before it gets its branches."""
        for node in list(model.graph):
            if node.op_type == "Slice" and not node.outputs[0].is_graph_output():
                part = _part(node)
                if part is not None:
                    node.outputs[0].replace_all_uses_with(part)
                    model.graph.remove(node, safe=True)
        return onnx_ir.passes.PassResult(model, modified=True)


class _Cuts(onnx_ir.passes.InPlacePass):
    """A slice of a slice along another axis, as one: each would copy."""

    def call(self, model: onnx_ir.Model) -> onnx_ir.passes.PassResult:
        """Replace in the graph."""
        for node in list(model.graph):
            whole = node.inputs[0] if node.op_type == "Slice" else None
            first = None if whole is None else whole.producer()
            if first is None or first.op_type != "Slice" or len(first.inputs) != len(node.inputs):
                continue
            along: list[Any] = [first.inputs[3], node.inputs[3]]
            axes = [onnx_ir.convenience.get_const_tensor(value) for value in along]
            if axes[0] is None or axes[1] is None or set(axes[0].numpy()) & set(axes[1].numpy()):
                continue
            tape = Tape()
            pairs = list(zip(first.inputs, node.inputs, strict=True))[1:]
            bounds = [tape.op("Concat", list(pair), {"axis": 0}) for pair in pairs]
            cut = tape.op("Slice", [first.inputs[0], *bounds])
            cut.type, cut.shape = node.outputs[0].type, node.outputs[0].shape
            model.graph.insert_before(node, list(tape.nodes))
            node.outputs[0].replace_all_uses_with(cut, replace_graph_outputs=True)
            model.graph.remove(node, safe=True)
        return onnx_ir.passes.PassResult(model, modified=True)


class _Averages(onnx_ir.passes.InPlacePass):
    """The mean of blocks before a convolution as a convolution, on which runtimes are several times as fast."""

    def call(self, model: onnx_ir.Model) -> onnx_ir.passes.PassResult:
        """Replace in the graph."""
        for node in list(model.graph):
            following = [use.node for use in node.outputs[0].uses()] if node.op_type == "AveragePool" else []
            if [n.op_type for n in following] != ["Pad"]:
                continue
            (pad,) = following
            scale = node.attributes["kernel_shape"].as_ints()[0]
            filled_shape: Any = pad.outputs[0].shape
            channels = int(filled_shape[1])
            weight = np.full((channels, 1, scale, scale), scale**-2.0, np.float32)
            tape = Tape()
            filled = tape.op("Pad", [node.inputs[0], *pad.inputs[1:]])
            name = f"mean_{node.outputs[0].name}"
            kernel = _initializer(model.graph, weight, f"{name}_weight")
            mean = tape.op("Conv", [filled, kernel], {"group": channels, "strides": [scale, scale]}, name=name)
            mean.type, mean.shape = pad.outputs[0].type, pad.outputs[0].shape
            model.graph.insert_before(pad, list(tape.nodes))
            pad.outputs[0].replace_all_uses_with(mean)
            model.graph.remove(pad, safe=True)
            model.graph.remove(node, safe=True)
        return onnx_ir.passes.PassResult(model, modified=True)


def _part(node: onnx_ir.Node) -> onnx_ir.Value | None:
    """The part that a slice cuts out, if it is exactly one of those that its input is made of."""
    whole, *bounds = node.inputs
    numbers = [v.const_value.numpy().tolist() for v in bounds if v is not None and v.const_value is not None]
    source = None if whole is None else whole.producer()
    if source is None or len(numbers) < max(3, len(bounds)) or any(len(n) != 1 for n in numbers):
        return None
    (start,), (end,), (axis,), (step,) = (*numbers, [1])[:4]
    if (start, end) == (0, 2**63 - 1) and step == 1:
        return whole
    if source.op_type != "Concat" or step != 1 or source.attributes["axis"].as_int() != axis:
        return None
    first = 0
    for value in source.inputs:
        size = None if value is None or value.shape is None else value.shape[axis]
        if not isinstance(size, int):
            return None
        if (first, first + size) == (start, end):
            return value
        first += size
    return None


def _cast_constant(graph: onnx_ir.Graph, value: onnx_ir.Value, kind: onnx_ir.DataType, number: int) -> onnx_ir.Value:
    """A constant in another type, as an initializer of the graph."""
    if value.const_value is None:
        raise ValueError(f"{value.name} is no constant")
    return _initializer(graph, value.const_value.numpy().astype(kind.numpy()), f"cast_{number}")


def _shorten(value: onnx_ir.Value, kept: Collection[str | None], names: Iterator[str]) -> None:
    if value.name in kept:
        return
    value.name = next(names)
    if not value.is_graph_output() and not value.is_graph_input() and not value.is_initializer():
        # names, types and shapes of what lies between would be most of the file; inference finds them
        value.shape = value.type = None
