"""Makes loops and branches of the placeholder operators in a traced graph (:mod:`.operators`).

Nodes that depend on a window become the body of a ``Loop`` over tiles. Nodes that only one side of a choice uses become
that side's branch of an ``If``, and are computed only if it is taken.
"""

from typing import Any

import onnx_ir
from onnx_ir.tape import Tape

from .operators import CHOICE, COLLECT, DOMAIN, WINDOW

__all__ = ["structure"]

_Owners = dict[Any, onnx_ir.Node]  # node that owns a subgraph


def structure(model: onnx_ir.Model) -> None:
    """Makes loops and branches of a flat graph, in place."""
    owners: _Owners = {a.as_graph(): n for n in model.graph for a in n.attributes.values() if _is_graph(a)}
    for node in _ours(model.graph, COLLECT):
        _loop(model.graph, node, owners)
    _branches(model.graph, owners)


def _ours(graph: onnx_ir.Graph, name: str) -> list[onnx_ir.Node]:
    return [node for node in graph if node.domain == DOMAIN and node.op_type == name]


def _loop(graph: onnx_ir.Graph, collect: onnx_ir.Node, owners: _Owners) -> None:
    """Moves the nodes between windows and ``collect`` into the body of a loop that slices its windows from the frame.

    1. Before the loop: number of tiles, from the frame's size.
    2. In the body: slice each window at the tile's position, then compute the tile.
    3. Replace ``collect`` by the loop's output.
    """
    windows, dependent, body_nodes = [], set(), []
    for node in graph:
        if node is collect:
            break
        if node.domain == DOMAIN and node.op_type == WINDOW:
            windows.append(node)
            dependent.add(node)
        elif any(v is not None and v.producer() in dependent for v in node.inputs):
            dependent.add(node)
            body_nodes.append(node)
    frame = windows[0].inputs[0]
    tile: Any = collect.inputs[0]
    side, margin = (windows[0].attributes[name].as_int() for name in ("side", "margin"))

    outer = Tape()
    shape = outer.op("Shape", [frame])
    sizes = outer.op("Slice", [shape, _ints(outer, 2), _ints(outer, 4)])
    counts = outer.op("Div", [outer.op("Sub", [sizes, _ints(outer, 2 * margin)]), _ints(outer, side)])
    batch = outer.op("Slice", [shape, _ints(outer, 0), _ints(outer, 1)])
    grid = outer.op("Concat", [batch, counts], {"axis": 0})  # items, rows, columns
    total = outer.op("ReduceProd", [grid], {"keepdims": 0})
    rows = outer.op("Slice", [grid, _ints(outer, 1), _ints(outer, 2)])
    columns = outer.op("Slice", [grid, _ints(outer, 2), _ints(outer, 3)])
    true = outer.op("Constant", [], {"value": onnx_ir.tensor(True)})

    step = _value("step", onnx_ir.DataType.INT64, [])
    keep_going = _value("going", onnx_ir.DataType.BOOL, [])
    inner = Tape()
    line = inner.op("Div", [step, columns])
    position = [inner.op("Div", [line, rows]), inner.op("Mod", [line, rows]), inner.op("Mod", [step, columns])]
    tile_position = inner.op("Concat", position, {"axis": 0})
    for window in windows:
        side, margin = (window.attributes[name].as_int() for name in ("side", "margin"))
        start = inner.op("Mul", [tile_position, _ints(inner, 1, side, side)])
        stop = inner.op("Add", [start, _ints(inner, 1, side + 2 * margin, side + 2 * margin)])
        sliced = inner.op("Slice", [window.inputs[0], start, stop, _ints(inner, 0, 2, 3)])
        # runtimes do not know the size of a slice, and use fast convolutions only for known sizes
        size = window.outputs[0].shape
        cut = inner.op("Reshape", [sliced, _ints(inner, *(size.numpy() if size else ()))])
        window.outputs[0].replace_all_uses_with(cut)
    for node in body_nodes:
        graph.remove(node)
    condition = inner.op("Identity", [keep_going])
    last = Tape()
    squeezed = last.op("Squeeze", [tile, _ints(last, 0)])
    nodes = [*inner.nodes, *body_nodes, *last.nodes]
    _type(condition, onnx_ir.DataType.BOOL, [])
    _type(squeezed, tile.dtype, tile.shape[1:])
    body = onnx_ir.Graph([step, keep_going], [condition, squeezed], nodes=nodes, name="tile")
    loop = onnx_ir.node("Loop", [total, true], {"body": body})
    graph.insert_before(collect, [*outer.nodes, loop])
    owners[body] = loop
    _replace(graph, collect, loop)
    for window in windows:
        graph.remove(window, safe=True)


def _branches(graph: onnx_ir.Graph, owners: _Owners) -> None:
    """Makes an ``If`` of each choice in a graph, outermost first, then of those in its branches and loops."""
    subgraphs: list[onnx_ir.Graph] = []
    while choices := _ours(graph, CHOICE):
        choice = choices[-1]
        branches = [_branch(graph, choice, index, owners) for index in (1, 2)]
        if_node = onnx_ir.node("If", [choice.inputs[0]], {"then_branch": branches[0], "else_branch": branches[1]})
        for branch in branches:
            owners[branch] = if_node
        graph.insert_before(choice, [if_node])
        _replace(graph, choice, if_node)
        subgraphs += branches
    subgraphs += [a.as_graph() for n in graph if n.op_type == "Loop" for a in n.attributes.values()]
    for subgraph in subgraphs:
        _branches(subgraph, owners)


def _branch(graph: onnx_ir.Graph, choice: onnx_ir.Node, index: int, owners: _Owners) -> onnx_ir.Graph:
    """The branch that computes one input of a choice, with all nodes that nothing else uses."""
    result: Any = choice.inputs[index]
    last = onnx_ir.node("Identity", [result])  # a branch can only return its own values
    graph.insert_before(choice, [last])
    choice.replace_input_with(index, last.outputs[0])
    branch_nodes, open_nodes = {last}, [last]
    while open_nodes:
        for value in _used_values(open_nodes.pop()):
            node = value.producer()
            if node is None or node.graph is not graph or node in branch_nodes:
                continue
            users = {_enclosing(graph, use.node, owners) for output in node.outputs for use in output.uses()}
            if users <= branch_nodes and not any(output.is_graph_output() for output in node.outputs):
                branch_nodes.add(node)
                open_nodes.append(node)
    nodes = [node for node in graph if node in branch_nodes]
    for node in nodes:
        graph.remove(node)
    _type(last.outputs[0], result.dtype, result.shape)
    branch = onnx_ir.Graph([], last.outputs, nodes=nodes, name="branch")
    owners[branch] = choice
    return branch


def _used_values(node: onnx_ir.Node) -> list[onnx_ir.Value]:
    """The inputs of a node and of its subgraphs."""
    values = [value for value in node.inputs if value is not None]
    for attribute in node.attributes.values():
        if _is_graph(attribute):
            values += [value for inner in attribute.as_graph() for value in _used_values(inner)]
    return values


def _is_graph(attribute: onnx_ir.Attr) -> bool:
    return attribute.type == onnx_ir.AttributeType.GRAPH


def _enclosing(graph: onnx_ir.Graph, node: onnx_ir.Node, owners: _Owners) -> onnx_ir.Node:
    """The node of ``graph`` that is, or contains, ``node``."""
    while node.graph is not graph:
        node = owners[node.graph]
    return node


def _replace(graph: onnx_ir.Graph, old: onnx_ir.Node, new: onnx_ir.Node) -> None:
    output, other = new.outputs[0], old.outputs[0]
    output.type, output.shape, output.name = other.type, other.shape, other.name
    other.replace_all_uses_with(output, replace_graph_outputs=True)
    graph.remove(old, safe=True)


def _ints(tape: Tape, *values: int) -> onnx_ir.Value:
    return tape.op("Constant", [], {"value_ints": values})


def _value(name: str, kind: onnx_ir.DataType, shape: list[int]) -> onnx_ir.Value:
    return onnx_ir.Value(name=name, shape=onnx_ir.Shape(shape), type=onnx_ir.TensorType(kind))


def _type(value: onnx_ir.Value, kind: onnx_ir.DataType, shape: Any) -> None:
    value.type, value.shape = onnx_ir.TensorType(kind), onnx_ir.Shape(shape)
