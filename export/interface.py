"""The graph's inputs: one item for a whole batch where possible, and node names that explain runtime errors."""

from typing import Any

import onnx_ir
from onnx_ir.tape import Tape

from .graph import INPUTS

__all__ = ["ITEMS", "broadcast"]

ITEMS = "B_or_1"
"""Name of the batch axis of every input except the image."""


def broadcast(model: onnx_ir.Model, inputs: str) -> onnx_ir.Model:
    """Lets every input except the image have one item for the whole batch, in place.

    For a wrong shape, a runtime's error message contains the name of the node that cannot expand it.
    """
    graph = model.graph
    inputs_in_order: list[Any] = list(graph.inputs)
    image, *others = inputs_in_order
    tape = Tape()
    items, size = (tape.op("Shape", [image], {"start": a, "end": b}) for a, b in ((0, 1), (2, 4)))
    full = tape.op("Concat", [items, tape.op("Constant", [], {"value_ints": [1]}), size], {"axis": 0})
    for value in others:
        is_map = value.name == INPUTS[inputs][1]
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
