"""Simplifies a translated graph: one flat, small graph of plain operators that many runtimes can read."""

import functools
import itertools
import string
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np
import onnx
import onnx_ir
from onnx_ir.passes import common as passes
from onnx_ir.tape import Tape
from onnxscript.optimizer import fold_constants

from .cpu_forms import (
    chain_reductions,
    concatenate_zeros,
    constant,
    convolve_averages,
    gather_rows,
    initializer,
)
from .structure import structure

__all__ = ["slim"]

_WINDOW_DEFAULTS = {"pads": 0, "dilations": 1, "strides": 1}  # defaults of these attributes, for each axis

_WHOLE_AXIS = 2**62  # ends of slices beyond it are those of an axis of any length
_SINGLE = {"CumSum": (0,), "Max": (0, 1), "Min": (0, 1), "Range": (0, 1, 2), "Resize": (2,), "TopK": (0,)}
"""Inputs that stay in single precision in files converted to half precision."""
_MAX_EQUAL = 64  # constants with more equal numbers than this are stored as a shape and a value


def slim(model: onnx_ir.Model, straight: bool = False) -> onnx_ir.Model:
    """Makes one graph without repeated constants, stack traces and names of source files, but with loops and branches.

    A ``straight`` graph has none of these; its constants stay initializers, which runtimes for GPUs load once.

    1. Inline functions, fold constants, and in tiles use forms that are fast on CPUs (:mod:`.cpu_forms`).
    2. Make loops and branches.
    3. Put each convolution's weights into its own graph, and turn initializers into nodes.
    4. Remove default attributes and shorten names.
    """
    share = passes.DeduplicateInitializersPass(size_limit=2**24)
    lift = passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)
    # in a straight graph the weights of all convolutions become constants; in tiles more would fill the file
    limits: Any = {"input_size_limit": 2**24, "output_size_limit": 2**15 if straight else 2**13}
    steps: tuple[Callable[[onnx_ir.Model], object], ...] = (
        passes.InlinePass(),
        passes.RemoveUnusedFunctionsPass(),
        lift,
        share,
        # without values of sizes in a straight graph, in which onnx confuses lists of indices with them
        passes.ShapeInferencePass(data_prop=not straight),
        functools.partial(fold_constants, **limits),
        passes.RemoveUnusedNodesPass(),  # folding leaves sequences of a wrong type, which shape inference refuses
        passes.ShapeInferencePass(),
        *((_share_sizes,) if straight else ()),
        _join_slices,
        *(() if straight else (convolve_averages, concatenate_zeros, chain_reductions, gather_rows)),
        passes.IdentityEliminationPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
        structure,
        lift,
        share,
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
        passes.RemoveUnusedOpsetsPass(),
        passes.ClearMetadataAndDocStringPass(),
        *((_separate,) if straight else (_place_weights, passes.RemoveUnusedNodesPass(), _as_nodes)),
        _drop_defaults,
        _shorten,
    )
    for step in steps:
        step(model)
    return model


def _share_sizes(model: onnx_ir.Model) -> None:
    """Reads sizes that several values have in common from the first of them; tracing gave equal sizes one name."""
    first: dict[str, onnx_ir.Value] = {}
    sizes: dict[Any, list[Any]] = {}  # names of the sizes that a value holds
    for node in model.graph:
        source: Any = node.inputs[0] if node.inputs else None
        numbers = [constant(value) for value in node.inputs[1:]]
        if node.op_type == "Shape" and source.shape is not None:
            ends = [node.attributes[name].as_int() if name in node.attributes else None for name in ("start", "end")]
            held = list(source.shape)[slice(*ends)]
        elif node.op_type == "Slice" and source in sizes and not any(n is None for n in numbers):
            held = sizes[source][int(numbers[0][0]) : int(numbers[1][0])]
        else:
            continue
        output = node.outputs[0]
        sizes[output] = held
        key = f"{held} {output.shape}"
        if "None" not in key:
            output.replace_all_uses_with(first.setdefault(key, output))


def _join_slices(model: onnx_ir.Model) -> None:
    """Makes one slice along several axes of slices in a row, and removes those that keep everything."""
    for node in model.graph:
        numbers = _bounds(node)
        if numbers is None:
            continue
        source: Any = node.inputs[0]
        if not numbers[0].any() and (numbers[1] > _WHOLE_AXIS).all() and (numbers[3] == 1).all():
            node.outputs[0].replace_all_uses_with(source)
            continue
        before = source.producer()
        others = _bounds(before)
        if others is not None and min(*numbers[2], *others[2]) >= 0 and not set(numbers[2]) & set(others[2]):
            node.replace_input_with(0, before.inputs[0])
            node.resize_inputs(5)
            for index, pair in enumerate(zip(others, numbers, strict=True)):
                name = f"{node.outputs[0].name}_{index}"
                node.replace_input_with(1 + index, initializer(model.graph, np.concatenate(pair), name))


def _bounds(node: onnx_ir.Node | None) -> list[Any] | None:
    """Starts, ends, axes and steps of a slice; None if they are unknown. Axes are from 0 on if the rank is known."""
    numbers = [constant(value) for value in node.inputs[1:]] if node is not None and node.op_type == "Slice" else []
    if len(numbers) < 3 or any(n is None for n in numbers):
        return None
    numbers = numbers if len(numbers) > 3 else [*numbers, np.ones_like(numbers[2])]
    shape = cast(Any, cast(Any, node).inputs[0]).shape
    return [*numbers[:2], numbers[2] if shape is None else numbers[2] % len(shape), numbers[3]]


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
            local_weight = initializer(graph, rows, f"{weight.name}_of_{node.name}")
            if len(rows) < len(index):
                channel_index = initializer(graph, index.astype(np.int64), f"{local_weight.name}_channels")
                gather = onnx_ir.node("Gather", [local_weight, channel_index], {"axis": 0})
                graph.insert_before(node, [gather])
                local_weight = gather.outputs[0]
            node.replace_input_with(1, local_weight)


def _as_nodes(model: onnx_ir.Model) -> None:
    """Turns initializers into nodes; many equal numbers then take no space."""
    for graph in (model.graph, *model.graph.subgraphs()):
        tape = Tape()
        values: list[Any] = list(graph.initializers.values())
        for value in values:
            del graph.initializers[value.name]
            if not value.uses():
                continue
            array = value.const_value.numpy()
            if array.size > _MAX_EQUAL and (array == array.flat[0]).all():
                shape = tape.op("Constant", [], {"value_ints": list(array.shape)})
                shape.name = f"{value.name}_shape"
                constant = tape.op("ConstantOfShape", [shape], {"value": onnx_ir.tensor(array.flat[:1])})
            else:
                constant = tape.op("Constant", [], {"value": value.const_value})
            constant.name = value.name
            value.replace_all_uses_with(constant)
        if tape.nodes:
            graph.insert_before(next(iter(graph)), list(tape.nodes))


def _separate(model: onnx_ir.Model) -> None:
    """Gives each operation that stays in single precision its own copy of a value that several of them read.

    onnxruntime's converter to half precision casts their inputs, and names the cast after the value: two casts of one
    value make a file that cannot be loaded.
    """
    readers: dict[onnx_ir.Value, onnx_ir.Node] = {}
    for node in [node for node in model.graph if node.op_type in _SINGLE]:
        for index in _SINGLE[node.op_type]:
            value = node.inputs[index] if index < len(node.inputs) else None
            if value is None or readers.setdefault(value, node) is node:
                continue
            if value.const_value is not None:
                copy = initializer(model.graph, value.const_value.numpy(), f"{value.name}_{len(readers)}_{index}")
                readers[copy] = node
            else:
                identity = onnx_ir.node("Identity", [value])
                model.graph.insert_before(node, [identity])
                copy = identity.outputs[0]
            node.replace_input_with(index, copy)


def _drop_defaults(model: onnx_ir.Model) -> None:
    for node in model.graph.all_nodes():
        schema = onnx.defs.get_schema(node.op_type, model.opset_imports[""]).attributes
        for name, attribute in list(node.attributes.items()):
            is_default = onnx_ir.to_proto(attribute) == schema[name].default_value
            is_window_default = name in _WINDOW_DEFAULTS and set(attribute.as_ints()) == {_WINDOW_DEFAULTS[name]}
            if is_default or is_window_default or (node.op_type, name) == ("Conv", "kernel_shape"):
                del node.attributes[name]


def _names() -> Iterator[str]:
    """Names of one to four letters, the shortest first."""
    return ("".join(letters) for n in range(1, 5) for letters in itertools.product(string.ascii_letters, repeat=n))


def _shorten(model: onnx_ir.Model) -> None:
    """Shortens names of values, the most frequent ones most; removes names of nodes except in subgraphs.

    There they are needed by onnxruntime: it names new values after nodes, and without them its optimised copy of a file
    has the same names in several subgraphs. Types and shapes of intermediate values are also removed, because they
    would be most of the file; inference finds them.
    """
    interface_names = {value.name for value in (*model.graph.inputs, *model.graph.outputs)}
    values: list[onnx_ir.Value] = []
    names_of_nodes = _names()
    for graph in (model.graph, *model.graph.subgraphs()):
        values += [*graph.inputs]
        for node in graph:
            node.name = None if graph is model.graph else f"_{next(names_of_nodes)}"  # not a name of a value
            values += node.outputs
            for value in node.outputs:
                if not value.is_graph_output():
                    value.shape = value.type = None
    values = sorted((v for v in values if v.name not in interface_names), key=lambda v: -len(v.uses()))
    for value, name in zip(values, (name for name in _names() if name not in interface_names), strict=False):
        value.name = name
