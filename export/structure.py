"""Loops and branches: placeholder operators in a traced graph, which is flat, and what becomes of them.

One operator numbers the steps of a loop, another takes their results: nodes that depend on a step become the body of a
``Loop``. A third chooses between two results: nodes that only one side of a choice uses become that side's branch of an
``If``, and are computed only if it is taken.
"""

from collections.abc import Sequence
from typing import Any

import onnx_ir
import torch
from onnx_ir.tape import Tape
from torch import Tensor

__all__ = ["carried", "choose", "collect", "last", "operator", "steps", "structure"]

_CHOICE, _STEP, _COLLECT, _CARRIED, _LAST = (f"torchdof::{n}" for n in ("Choice", "Step", "Collect", "Carried", "Last"))
"""``Choice(result, given, needed)``; ``Step(count)``, the number of a step from 0; ``Collect(result, step)``;
``Carried(initial, step)``; ``Last(after, step, carried)``. A finished file contains none of them."""


def choose(needed: Tensor, result: Tensor, given: Tensor) -> Tensor:
    """A branch in the graph: ``result`` if ``needed`` (bool ``[]``) is true, else ``given``."""
    return operator(_CHOICE, [result, given, needed], result.shape)


def steps(count: Any) -> Tensor:
    """Number of the current step in a loop of ``count`` steps, int64 ``[]``; what depends on it is computed there."""
    return operator(_STEP, [torch.scalar_tensor(count, dtype=torch.int64)], ())


def collect(step: Tensor, result: Tensor, count: int | torch.SymInt) -> Tensor:
    """The results ``[1, ...]`` of all steps: ``[count, ...]``."""
    return operator(_COLLECT, [result, step], (count, *result.shape[1:]))


def carried(step: Tensor, initial: Tensor) -> Tensor:
    """A value that each step takes over from the step before it (:func:`last`); in the first step ``initial``."""
    return operator(_CARRIED, [initial, step], initial.shape)


def last(step: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """The value after all steps, each of which makes ``after`` of ``before``, a value of :func:`carried`."""
    return operator(_LAST, [after, step, before], after.shape)


def operator(name: str, inputs: Sequence[Tensor], shape: Sequence[int | torch.SymInt]) -> Tensor:
    """An operator of ONNX in a graph; its result has the dtype of its first input."""
    return torch.onnx.ops.symbolic(name, inputs, dtype=inputs[0].dtype, shape=list(shape))


_Owners = dict[Any, onnx_ir.Node]  # node that owns a subgraph


def structure(model: onnx_ir.Model) -> None:
    """Makes loops and branches of a flat graph, in place."""
    owners: _Owners = {a.as_graph(): n for n in model.graph for a in n.attributes.values() if _is_graph(a)}
    for node in (*_ours(model.graph, _COLLECT), *_ours(model.graph, _LAST)):
        _loop(model.graph, node, owners)
    _branches(model.graph, owners)


def _ours(graph: onnx_ir.Graph, name: str) -> list[onnx_ir.Node]:
    return [node for node in graph if f"{node.domain}::{node.op_type}" == name]


def _loop(graph: onnx_ir.Graph, end: onnx_ir.Node, owners: _Owners) -> None:
    """Moves the nodes between a step and ``end``, which takes its result, into the body of a loop."""
    inputs: list[Any] = list(end.inputs)
    result, step, *carried = inputs
    dependent, body_nodes = {step.producer()}, []
    for node in graph:
        if node is not end and any(v is not None and v.producer() in dependent for v in node.inputs):
            dependent.add(node)
            if node not in [value.producer() for value in carried]:
                body_nodes.append(node)
    for node in body_nodes:
        graph.remove(node)
    number, keep_going = _value("step", onnx_ir.DataType.INT64, []), _value("going", onnx_ir.DataType.BOOL, [])
    befores = [_value("before", value.dtype, value.shape) for value in carried]
    for old, new in zip((step, *carried), (number, *befores), strict=True):
        old.replace_all_uses_with(new)
    inner, outer = Tape(), Tape()
    condition = inner.op("Identity", [keep_going])
    _type(condition, onnx_ir.DataType.BOOL, [])
    axis = inner.op("Constant", [], {"value_ints": [0]})
    after = inner.op("Identity", [result]) if carried else inner.op("Squeeze", [result, axis])
    _type(after, result.dtype, result.shape if carried else result.shape[1:])
    nodes = [*body_nodes, *inner.nodes]
    body = onnx_ir.Graph([number, keep_going, *befores], [condition, after], nodes=nodes, name="step")
    true = outer.op("Constant", [], {"value": onnx_ir.tensor(True)})
    initials = [value.producer().inputs[0] for value in carried]
    loop = onnx_ir.node("Loop", [step.producer().inputs[0], true, *initials], {"body": body})
    graph.insert_before(end, [*outer.nodes, loop])
    owners[body] = loop
    _replace(graph, end, loop)
    graph.remove([value.producer() for value in (*carried, step)], safe=True)


def _branches(graph: onnx_ir.Graph, owners: _Owners) -> None:
    """Makes an ``If`` of each choice in a graph, outermost first, then of those in its branches and loops."""
    subgraphs: list[onnx_ir.Graph] = []
    while choices := _ours(graph, _CHOICE):
        choice = choices[-1]
        branches = [_branch(graph, choice, index, owners) for index in (0, 1)]
        if_node = onnx_ir.node("If", [choice.inputs[2]], {"then_branch": branches[0], "else_branch": branches[1]})
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


def _value(name: str, kind: onnx_ir.DataType, shape: Any) -> onnx_ir.Value:
    return onnx_ir.Value(name=name, shape=onnx_ir.Shape(shape), type=onnx_ir.TensorType(kind))


def _type(value: onnx_ir.Value, kind: onnx_ir.DataType, shape: Any) -> None:
    value.type, value.shape = onnx_ir.TensorType(kind), onnx_ir.Shape(shape)
