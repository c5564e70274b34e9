"""Loops and branches: placeholder operators in a traced graph, which is flat, and what becomes of them.

One operator numbers the steps of a loop, another takes their results: nodes that depend on a step become the body of a
``Loop``. A third chooses between two results: nodes that only one side of a choice uses become that side's branch of an
``If``, and are computed only if it is taken.
"""

import collections
from collections.abc import Iterator, Sequence
from typing import Any

import onnx_ir
import torch
from onnx_ir.tape import Tape
from torch import Tensor

__all__ = ["carried", "choose", "collect", "last", "operator", "steps", "structure"]

_CHOICE, _STEP, _COLLECT, _CARRIED, _LAST = (f"torchdof::{n}" for n in ("Choice", "Step", "Collect", "Carried", "Last"))
"""``Choice(result, given, needed)``; ``Step(count)``, the number of a step from 0; ``Collect(result, step)``;
``Carried(initial, step)``; ``Last(after, step, carried[, continues])``. A finished file contains none of them."""


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


def last(step: Tensor, before: Tensor, after: Tensor, continues: Tensor | None = None) -> Tensor:
    """The value after the last step, each of which makes ``after`` of ``before``, a value of :func:`carried`.

    The loop ends early after a step in which ``continues``, a bool ``[]``, is false.
    """
    return operator(_LAST, [after, step, before, *([] if continues is None else [continues])], after.shape)


def operator(name: str, inputs: Sequence[Tensor], shape: Sequence[int | torch.SymInt]) -> Tensor:
    """An operator of ONNX in a graph; its result has the dtype of its first input."""
    return torch.onnx.ops.symbolic(name, inputs, dtype=inputs[0].dtype, shape=list(shape))


def structure(model: onnx_ir.Model) -> None:
    """Makes loops and branches of a flat graph, in place."""
    for node in (*_ours(model.graph, _COLLECT), *_ours(model.graph, _LAST)):
        _loop(model.graph, node)
    _branches(model.graph)


def _ours(graph: onnx_ir.Graph, name: str) -> list[onnx_ir.Node]:
    return [node for node in graph if f"{node.domain}::{node.op_type}" == name]


def _loop(graph: onnx_ir.Graph, end: onnx_ir.Node) -> None:
    """Moves the nodes between a step and ``end``, which takes its result, into the body of a loop."""
    inputs: list[Any] = list(end.inputs)
    result, step, *carried = inputs[:3]
    starts = [value.producer() for value in (step, *carried)]
    dependent, body_nodes = set(starts[:1]), []
    for node in graph:
        if node is not end and any(v is not None and v.producer() in dependent for v in _used_values(node)):
            dependent.add(node)
            if node not in starts:
                body_nodes.append(node)
    graph.remove(body_nodes)
    number = onnx_ir.val("step", onnx_ir.DataType.INT64, [])
    keep_going = onnx_ir.val("going", onnx_ir.DataType.BOOL, [])
    befores = [onnx_ir.val("before", value.dtype, value.shape) for value in carried]
    for old, new in zip((step, *carried), (number, *befores), strict=True):
        old.replace_all_uses_with(new)
    inner, outer = Tape(), Tape()
    condition = inner.op("Identity", inputs[3:] or [keep_going])
    condition.dtype, condition.shape = onnx_ir.DataType.BOOL, onnx_ir.Shape([])
    axis = inner.op("Constant", [], {"value_ints": [0]})
    after = inner.op("Identity", [result]) if carried else inner.op("Squeeze", [result, axis])
    after.dtype, after.shape = result.dtype, onnx_ir.Shape(result.shape if carried else result.shape[1:])
    nodes = [*body_nodes, *inner.nodes]
    body = onnx_ir.Graph([number, keep_going, *befores], [condition, after], nodes=nodes, name="step")
    true = outer.op("Constant", [], {"value": onnx_ir.tensor(True)})
    initials = [start.inputs[0] for start in starts[1:]]
    outer.op("Loop", [starts[0].inputs[0], true, *initials], {"body": body})
    graph.insert_before(end, outer.nodes)
    _replace(graph, end, outer.nodes[-1])
    graph.remove(starts[::-1], safe=True)


def _branches(graph: onnx_ir.Graph) -> None:
    """Makes an ``If`` of each choice in a graph, outermost first, then of those in its branches and loops."""
    while choices := _ours(graph, _CHOICE):
        choice = choices[-1]
        for index, name in enumerate(("then_branch", "else_branch")):
            choice.attributes.add(onnx_ir.AttrGraph(name, _branch(graph, choice, index)))
        if_node = onnx_ir.Node("", "If", [choice.inputs[2]], choice.attributes.values())
        graph.insert_before(choice, [if_node])
        _replace(graph, choice, if_node)
    for subgraph in [subgraph for node in graph for subgraph in _subgraphs(node)]:
        _branches(subgraph)


def _branch(graph: onnx_ir.Graph, choice: onnx_ir.Node, index: int) -> onnx_ir.Graph:
    """The branch that computes one input of a choice, with all nodes that nothing else uses."""
    result: Any = choice.inputs[index]
    last = onnx_ir.node("Identity", [result])  # a branch can only return its own values
    graph.insert_before(choice, [last])
    choice.replace_input_with(index, last.outputs[0])
    users: dict[Any, set[onnx_ir.Node]] = collections.defaultdict(set)
    for node in graph:
        for value in _used_values(node):
            users[value].add(node)
    branch_nodes = {last}
    for node in reversed(graph):  # users come first
        used_by = set().union(*(users[output] for output in node.outputs))
        if used_by and used_by <= branch_nodes and not any(output.is_graph_output() for output in node.outputs):
            branch_nodes.add(node)
    nodes = [node for node in graph if node in branch_nodes]
    graph.remove(nodes)
    last.outputs[0].dtype, last.outputs[0].shape = result.dtype, result.shape
    return onnx_ir.Graph([], last.outputs, nodes=nodes, name="branch")


def _used_values(node: onnx_ir.Node) -> Iterator[onnx_ir.Value | None]:
    """The inputs of a node and of its subgraphs."""
    yield from node.inputs
    for subgraph in _subgraphs(node):
        for inner in subgraph:
            yield from _used_values(inner)


def _subgraphs(node: onnx_ir.Node) -> list[onnx_ir.Graph]:
    return [a.as_graph() for a in node.attributes.values() if a.type == onnx_ir.AttributeType.GRAPH]


def _replace(graph: onnx_ir.Graph, old: onnx_ir.Node, new: onnx_ir.Node) -> None:
    output, other = new.outputs[0], old.outputs[0]
    output.type, output.shape, output.name = other.type, other.shape, other.name
    other.replace_all_uses_with(output, replace_graph_outputs=True)
    graph.remove(old, safe=True)
