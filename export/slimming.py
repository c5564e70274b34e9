"""A translated graph made flat, small and plain: what other runtimes read as well as the one it is verified with."""

import itertools
from collections.abc import Collection, Iterator

import onnx_ir
from onnx_ir.passes import common as passes

__all__ = ["slim"]


def slim(model: onnx_ir.Model) -> onnx_ir.Model:
    """One flat graph without repeated constants, stack traces and names of source files; its loop is a ``Loop``."""
    before: tuple[onnx_ir.passes.PassBase, ...] = (
        passes.InlinePass(),
        passes.RemoveUnusedFunctionsPass(),
        passes.LiftSubgraphInitializersToMainGraphPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(size_limit=2**24),
    )
    after: tuple[onnx_ir.passes.PassBase, ...] = (
        passes.ShapeInferencePass(),
        _Casts(),
        passes.DeduplicateInitializersPass(size_limit=2**24),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
        passes.RemoveUnusedOpsetsPass(),
        passes.ClearMetadataAndDocStringPass(),
    )
    for step in before:
        step(model)
    for node in list(model.graph):
        if node.op_type == "Scan":
            _loop(model.graph, node)
    for step in after:
        step(model)
    kept = {value.name for value in (*model.graph.inputs, *model.graph.outputs)}
    names = (f"v{i}" for i in itertools.count())
    for graph in (model.graph, *model.graph.subgraphs()):
        for value in (*graph.inputs, *graph.initializers.values()):
            _shorten(value, kept, names)
        for node in graph:
            node.name = None
            for value in node.outputs:
                _shorten(value, kept, names)
    return model


def _loop(graph: onnx_ir.Graph, scan: onnx_ir.Node) -> None:
    """A ``Scan`` over the first axis as a ``Loop``: OpenVINO reads only this one where the body uses outer values."""
    body = scan.attributes["body"].as_graph()
    states = len(scan.inputs) - scan.attributes["num_scan_inputs"].as_int()
    initial, scanned = scan.inputs[:states], scan.inputs[states:]
    step = onnx_ir.Value(name="loop_step", shape=onnx_ir.Shape([]), type=onnx_ir.TensorType(onnx_ir.DataType.INT64))
    going = onnx_ir.Value(name="loop_going", shape=onnx_ir.Shape([]), type=onnx_ir.TensorType(onnx_ir.DataType.BOOL))
    each = list(body.inputs)[states:]
    gathers = [onnx_ir.node("Gather", [whole, step], {"axis": 0}) for whole in scanned]
    for i, (value, gather) in enumerate(zip(each, gathers, strict=True)):
        tile = gather.outputs[0]
        tile.name, tile.type, tile.shape = f"loop_tile_{i}", value.type, value.shape
        value.replace_all_uses_with(tile)
    for value in each:
        body.inputs.remove(value)
    body.inputs.insert(0, going)
    body.inputs.insert(0, step)
    body.insert_before(next(iter(body)), gathers)
    on = onnx_ir.node("Identity", [going])
    on.outputs[0].name, on.outputs[0].type, on.outputs[0].shape = "loop_goes_on", going.type, onnx_ir.Shape([])
    body.append(on)
    body.outputs.insert(0, on.outputs[0])
    counts = onnx_ir.node("Shape", [scanned[0]], {"start": 0, "end": 1})
    first = onnx_ir.node("Squeeze", [counts.outputs[0]])
    always = onnx_ir.node("Constant", [], {"value": onnx_ir.tensor(True)})
    for name, node in {"loop_counts": counts, "loop_count": first, "loop_always": always}.items():
        node.outputs[0].name = name
    inputs = [first.outputs[0], always.outputs[0], *initial]
    loop = onnx_ir.Node("", "Loop", inputs, [onnx_ir.AttrGraph("body", body)], num_outputs=len(scan.outputs))
    scan.attributes.pop("body")
    graph.insert_before(scan, [counts, first, always, loop])
    for old, new in zip(scan.outputs, loop.outputs, strict=True):
        new.name, new.type, new.shape = old.name, old.type, old.shape
        old.replace_all_uses_with(new)
    graph.remove(scan, safe=True)


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


def _cast_constant(graph: onnx_ir.Graph, value: onnx_ir.Value, kind: onnx_ir.DataType, number: int) -> onnx_ir.Value:
    """A constant in another type, as an initializer of the graph."""
    if value.const_value is None:
        raise ValueError(f"{value.name} is no constant")
    tensor = onnx_ir.tensor(value.const_value.numpy().astype(kind.numpy()), name=f"cast_{number}")
    constant = onnx_ir.Value(
        name=tensor.name, shape=onnx_ir.Shape(tensor.numpy().shape), type=onnx_ir.TensorType(kind), const_value=tensor
    )
    graph.register_initializer(constant)
    return constant


def _shorten(value: onnx_ir.Value, kept: Collection[str | None], names: Iterator[str]) -> None:
    if value.name in kept:
        return
    value.name = next(names)
    if not value.is_graph_output() and not value.is_graph_input() and not value.is_initializer():
        # names, types and shapes of what lies between would be most of the file; inference finds them
        value.shape = value.type = None
