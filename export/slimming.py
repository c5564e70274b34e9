"""Simplifies a translated graph: one flat, small graph of plain operators that many runtimes can read."""

import itertools
import string
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import onnx_ir
from onnx.reference import ReferenceEvaluator
from onnx_ir.passes import common as passes
from onnx_ir.tape import Tape
from onnxscript.optimizer import fold_constants

from .structure import structure

__all__ = ["slim"]

_WINDOW_DEFAULTS = {"pads": 0, "dilations": 1, "strides": 1}  # defaults of these attributes, for each axis
_Pass = Callable[[onnx_ir.Model], object]

_MAX_EQUAL = 64  # constants with more equal numbers than this are stored as a shape and a value


def slim(model: onnx_ir.Model, straight: bool = False) -> onnx_ir.Model:
    """Makes one graph without repeated constants, stack traces and names of source files, but with loops and branches.

    A ``straight`` graph has none of these; its constants stay initializers, which runtimes for GPUs load once.

    1. Inline functions, fold constants, and replace operators and chains of operators by faster or more common ones.
    2. Make loops and branches.
    3. Put each convolution's weights into its own graph, and turn initializers into nodes.
    4. Remove default attributes and shorten names.
    """
    flat: tuple[_Pass, ...] = (
        passes.InlinePass(),
        passes.RemoveUnusedFunctionsPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(size_limit=2**24),
        # without values of sizes in a straight graph, in which onnx confuses lists of indices with them
        passes.ShapeInferencePass(data_prop=not straight),
        _cast_plainly,
    )
    tidy: tuple[_Pass, ...] = (
        passes.RemoveUnusedNodesPass(),  # folding leaves sequences of a wrong type, which shape inference refuses
        passes.ShapeInferencePass(),
        _take_parts,
        _join_cuts,
        _convolve_averages,
        _fill_channels,
        _join_splits,
        passes.IdentityEliminationPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
    )
    structured: tuple[_Pass, ...] = (
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(size_limit=2**24),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
        passes.RemoveUnusedOpsetsPass(),
        passes.ClearMetadataAndDocStringPass(),
    )
    for step in flat:
        step(model)
    fold_constants(model, input_size_limit=2**24, output_size_limit=2**13)
    _fold_weights(model)
    for step in tidy:
        step(model)
    structure(model)
    for step in structured:
        step(model)
    if not straight:
        _place_weights(model)
        passes.RemoveUnusedNodesPass()(model)
        for graph in (model.graph, *model.graph.subgraphs()):
            _as_nodes(graph)
    _drop_defaults(model)
    _shorten(model)
    return model


def _fold_weights(model: onnx_ir.Model) -> None:
    """Makes constants of weights of convolutions that are larger than the other constants which are folded."""
    for node in [node for node in model.graph if node.op_type == "Conv"]:
        weight = node.inputs[1]
        array = None if weight is None or weight.const_value is not None else _folded(weight)
        if weight is not None and array is not None:
            node.replace_input_with(1, _initializer(model.graph, array, f"{weight.name}_folded"))


def _folded(value: onnx_ir.Value | None) -> np.ndarray | None:
    """The numbers of a value that does not depend on the graph's inputs, else None."""
    tensor = None if value is None else onnx_ir.convenience.get_const_tensor(value)
    node = None if value is None else value.producer()
    if tensor is not None or node is None:
        return None if tensor is None else tensor.numpy()
    feed = {str(source.name): _folded(source) for source in node.inputs if source is not None}
    if any(array is None for array in feed.values()):
        return None
    results: Any = ReferenceEvaluator(onnx_ir.to_proto(node)).run(None, feed)
    return np.asarray(results[0])


def _place_weights(model: onnx_ir.Model) -> None:
    """Puts weights of convolutions into the graph that uses them; only then runtimes arrange them for speed."""
    for graph in (model.graph, *model.graph.subgraphs()):
        for node in [node for node in graph if node.op_type == "Conv"]:
            weight = node.inputs[1]
            if weight is None or weight.const_value is None:
                continue
            bias = node.inputs[2] if len(node.inputs) > 2 else None
            if bias is not None and bias.const_value is not None and not bias.const_value.numpy().any():
                node.resize_inputs(2)
            rows, index = np.unique(weight.const_value.numpy(), axis=0, return_inverse=True)
            local_weight = _initializer(graph, rows, f"{weight.name}_of_{node.name}")
            if len(rows) < len(index):
                channel_index = _initializer(graph, index.astype(np.int64), f"{local_weight.name}_channels")
                gather = onnx_ir.node("Gather", [local_weight, channel_index], {"axis": 0})
                graph.insert_before(node, [gather])
                local_weight = gather.outputs[0]
            node.replace_input_with(1, local_weight)


def _as_nodes(graph: onnx_ir.Graph) -> None:
    """Turns initializers into ``Constant`` nodes, which ``onnx.compose`` renames in branches too."""
    first = next(iter(graph), None)
    values: list[Any] = list(graph.initializers.values())
    for value in values:
        if not value.uses():
            del graph.initializers[value.name]
            continue
        tape, array = Tape(), value.const_value.numpy()
        if array.size > _MAX_EQUAL and (array == array.flat[0]).all():
            shape = tape.op("Constant", [], {"value_ints": list(array.shape)})
            tape.op("ConstantOfShape", [shape], {"value": onnx_ir.tensor(array.flat[:1])})
            shape.name = f"{value.name}_shape"
        else:
            tape.op("Constant", [], {"value": value.const_value})
        constant = tape.nodes[-1].outputs[0]
        constant.name = value.name
        del graph.initializers[value.name]
        value.replace_all_uses_with(constant)
        if first is not None:
            graph.insert_before(first, list(tape.nodes))


def _initializer(graph: onnx_ir.Graph, array: np.ndarray, name: str) -> onnx_ir.Value:
    tensor = onnx_ir.tensor(array, name=name)
    value = onnx_ir.Value(
        name=name, shape=onnx_ir.Shape(array.shape), type=onnx_ir.TensorType(tensor.dtype), const_value=tensor
    )
    graph.register_initializer(value)
    return value


def _replace(graph: onnx_ir.Graph, node: onnx_ir.Node, tape: Tape) -> None:
    """Puts the nodes of a tape in the place of a node; the last one gives the same result."""
    new, old = tape.nodes[-1].outputs[0], node.outputs[0]
    new.type, new.shape = old.type, old.shape
    graph.insert_before(node, list(tape.nodes))
    old.replace_all_uses_with(new, replace_graph_outputs=True)
    graph.remove(node, safe=True)


def _cast_plainly(model: onnx_ir.Model) -> None:
    """``CastLike`` becomes ``Cast``, or nothing if the type is right already; not every runtime simplifies it."""
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


def _take_parts(model: onnx_ir.Model) -> None:
    """A slice that is exactly one input of a ``Concat`` becomes that input; onnxruntime would warn of it."""
    for node in list(model.graph):
        if node.op_type == "Slice" and not node.outputs[0].is_graph_output():
            part = _part(node)
            if part is not None:
                node.outputs[0].replace_all_uses_with(part)
                model.graph.remove(node, safe=True)


def _join_cuts(model: onnx_ir.Model) -> None:
    """Two slices in sequence along different axes become one, because each copies."""
    for node in list(model.graph):
        source = node.inputs[0] if node.op_type == "Slice" else None
        first = None if source is None else source.producer()
        if first is None or first.op_type != "Slice" or len(first.inputs) != len(node.inputs):
            continue
        axis_values: list[Any] = [first.inputs[3], node.inputs[3]]
        axes = [onnx_ir.convenience.get_const_tensor(value) for value in axis_values]
        if source is None or axes[0] is None or axes[1] is None or source.shape is None:
            continue
        rank = len(source.shape)  # an axis may be counted from the last one
        if {int(a) % rank for a in axes[0].numpy()} & {int(a) % rank for a in axes[1].numpy()}:
            continue
        tape, bounds = Tape(), []
        for number, pair in enumerate(list(zip(first.inputs, node.inputs, strict=True))[1:]):
            constants = [onnx_ir.convenience.get_const_tensor(value) for value in pair if value is not None]
            if all(constant is not None for constant in constants):
                joined = np.concatenate([constant.numpy() for constant in constants if constant is not None])
                bounds.append(_initializer(model.graph, joined, f"{node.outputs[0].name}_bound_{number}"))
            else:
                bounds.append(tape.op("Concat", list(pair), {"axis": 0}))
        tape.op("Slice", [first.inputs[0], *bounds])
        _replace(model.graph, node, tape)


def _convolve_averages(model: onnx_ir.Model) -> None:
    """Block means before a convolution become a convolution, which is several times as fast in runtimes."""
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
        tape.op("Conv", [filled, kernel], {"group": channels, "strides": [scale, scale]}, name=name)
        _replace(model.graph, pad, tape)
        model.graph.remove(node, safe=True)


def _fill_channels(model: onnx_ir.Model) -> None:
    """Padding channels of a convolution become inputs of the ``Concat`` before it.

    Their values do not matter, because they are not used: they repeat some of the other channels.
    """
    graph = model.graph
    for pad in list(graph):
        missing = _spare_channels(pad)
        concat: Any = pad.inputs[0].producer() if missing and pad.inputs[0] is not None else None
        if concat is None or concat.op_type != "Concat" or concat.attributes["axis"].as_int() != 1:
            continue
        filled, tape = list(concat.inputs), Tape()
        for part in concat.inputs:
            repeats, missing = divmod(missing, part.shape[1])
            filled += [part] * repeats
        if missing:
            name = f"{pad.outputs[0].name}_fill"
            ends = {"start": 0, "stop": missing, "axis": 1}
            bounds = [_initializer(graph, np.array([n]), f"{name}_{end}") for end, n in ends.items()]
            filled.append(tape.op("Slice", [concat.inputs[0], *bounds]))
        tape.op("Concat", filled, {"axis": 1})
        _replace(graph, pad, tape)


def _join_splits(model: onnx_ir.Model) -> None:
    """A slice of the first channels and a split become one split, whose last part is not used."""
    graph = model.graph
    for node in [n for n in graph if n.op_type == "Split" and n.attributes["axis"].as_int() == 1]:
        cut: Any = None if node.inputs[0] is None else node.inputs[0].producer()
        if cut is None or cut.op_type != "Slice" or cut.inputs[0].shape is None:
            continue
        source, kept_shape = cut.inputs[0], cut.outputs[0].shape
        is_equal = [a == b for a, b in zip(source.shape, kept_shape, strict=True)]
        bounds: list[Any] = [cut.inputs[1], node.inputs[1]]
        first, sizes = (onnx_ir.convenience.get_const_tensor(value) for value in bounds)
        if first is None or sizes is None or first.numpy().any() or is_equal != [True, False, True, True]:
            continue
        parts = np.array([*sizes.numpy(), source.shape[1] - kept_shape[1]])
        all_sizes = _initializer(graph, parts, f"{node.outputs[0].name}_sizes")
        split = onnx_ir.node("Split", [source, all_sizes], {"axis": 1}, num_outputs=len(parts))
        graph.insert_before(node, [split])
        for old, new in zip(node.outputs, split.outputs, strict=False):
            new.type, new.shape = old.type, old.shape
            old.replace_all_uses_with(new)
        graph.remove(node, safe=True)


def _spare_channels(node: onnx_ir.Node) -> int:
    """Number of channels that a ``Pad`` appends, if it does nothing else; otherwise 0."""
    pads = node.inputs[1] if node.op_type == "Pad" and len(node.inputs) > 1 else None
    ends = [] if pads is None or pads.const_value is None else pads.const_value.numpy().tolist()
    return ends[5] if len(ends) == 8 and not any(ends[:5] + ends[6:]) else 0


def _part(node: onnx_ir.Node) -> onnx_ir.Value | None:
    """The input of a ``Concat`` that a slice cuts out exactly, else None."""
    source_value, *bounds = node.inputs
    numbers = [v.const_value.numpy().tolist() for v in bounds if v is not None and v.const_value is not None]
    source = None if source_value is None else source_value.producer()
    if source is None or len(numbers) < max(3, len(bounds)) or any(len(n) != 1 for n in numbers):
        return None
    (start,), (end,), (axis,), (step,) = (*numbers, [1])[:4]
    if (start, end) == (0, 2**63 - 1) and step == 1:
        return source_value
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
    """A constant cast to another type, as an initializer of the graph."""
    if value.const_value is None:
        raise ValueError(f"{value.name} is not a constant")
    return _initializer(graph, value.const_value.numpy().astype(kind.numpy()), f"cast_{number}")


def _drop_defaults(model: onnx_ir.Model) -> None:
    for node in model.graph.all_nodes():
        schema = onnx.defs.get_schema(node.op_type, model.opset_imports[""]).attributes
        for name, attribute in list(node.attributes.items()):
            default = schema[name].default_value
            is_default = default.type and onnx.helper.get_attribute_value(default) == _onnx_value(attribute)
            is_window_default = name in _WINDOW_DEFAULTS and set(attribute.as_ints()) == {_WINDOW_DEFAULTS[name]}
            if is_default or is_window_default or (node.op_type, name) == ("Conv", "kernel_shape"):
                del node.attributes[name]


def _onnx_value(attribute: onnx_ir.Attr) -> Any:
    """Value of an attribute in :mod:`onnx`'s types; None for graphs and tensors."""
    value = attribute.value
    return value.encode() if isinstance(value, str) else value if isinstance(value, int | float) else None


def _shorten(model: onnx_ir.Model) -> None:
    """Removes names of nodes, and shortens names of values; the most frequent names become the shortest.

    Types and shapes of intermediate values are also removed, because they would be most of the file; inference finds
    them.
    """
    interface_names = {value.name for value in (*model.graph.inputs, *model.graph.outputs)}
    values: list[onnx_ir.Value] = []
    for graph in (model.graph, *model.graph.subgraphs()):
        values += [*graph.inputs]
        for node in graph:
            node.name = None
            values += node.outputs
            for value in node.outputs:
                if not value.is_graph_output():
                    value.shape = value.type = None
    values = sorted((v for v in values if v.name not in interface_names), key=lambda v: -len(v.uses()))
    alphabet = string.ascii_letters
    lengths = ([alphabet] + [alphabet + string.digits] * n for n in range(4))
    names = ("".join(letters) for length in lengths for letters in itertools.product(*length))
    for value, name in zip(values, (name for name in names if name not in interface_names), strict=False):
        value.name = name
