"""Forms that are fast on a CPU give the values of the operations that they replace."""

from collections.abc import Callable

import numpy as np
import onnx
import onnx_ir
import onnxruntime
import pytest
from onnx_ir.passes import common as passes

from torchdof.export import cpu_forms

MAPS = "float[1, 3, 6, 7] x, float[3, 1, 6, 7] y, int64[9] at"
CASES: dict[str, tuple[Callable[[onnx_ir.Model], None], str, str, set[str]]] = {
    # form, inputs, operations, operators that are left
    **{
        f"{name} of colours": (
            cpu_forms.chain_reductions,
            MAPS,
            f"axis = Constant<value_ints=[1]>() result = {name}<keepdims=1>(x, axis)",
            {"Split", operator},
        )
        for name, operator in (("ReduceMax", "Max"), ("ReduceMin", "Min"), ("ReduceSum", "Add"), ("ReduceProd", "Mul"))
    },
    "sum of a stack": (
        cpu_forms.chain_reductions,
        MAPS,
        "axis = Constant<value_ints=[-4]>() result = ReduceSum<keepdims=0>(y, axis)",
        {"Split", "Add", "Squeeze"},
    ),
    "columns": (cpu_forms.gather_rows, MAPS, "result = Gather<axis=-1>(x, at)", {"Transpose", "Gather"}),
    "zeros": (
        cpu_forms.concatenate_zeros,
        MAPS,
        "ends = Constant<value_ints=[0, 0, 0, 0, 0, 2, 0, 0]>() both = Concat<axis=1>(x, x) result = Pad(both, ends)",
        {"Concat"},
    ),
    "means": (
        cpu_forms.convolve_averages,
        "float[1, 3, 6, 8] x, float[3, 1, 6, 8] y, int64[9] at",
        "ends = Constant<value_ints=[0, 0, 0, 0, 0, 13, 0, 0]>() "
        "mean = AveragePool<kernel_shape=[2, 2], strides=[2, 2]>(x) result = Pad(mean, ends)",
        {"Pad", "Conv"},
    ),
    # left as they are
    "maximum of rows": (
        cpu_forms.chain_reductions,
        MAPS,
        "axis = Constant<value_ints=[2]>() result = ReduceMax<keepdims=1>(x, axis)",
        {"ReduceMax"},
    ),
    "rows": (cpu_forms.gather_rows, MAPS, "result = Gather<axis=2>(x, at)", {"Gather"}),
    "zeros around": (
        cpu_forms.concatenate_zeros,
        MAPS,
        "ends = Constant<value_ints=[0, 0, 0, 1, 0, 2, 0, 0]>() both = Concat<axis=1>(x, x) result = Pad(both, ends)",
        {"Concat", "Pad"},
    ),
}


def run(model: onnx.ModelProto) -> np.ndarray:
    draw = np.random.default_rng(3)
    feed = {
        value.name: draw.integers(0, 6, 9)
        if value.name == "at"
        else draw.random([n.dim_value for n in value.type.tensor_type.shape.dim], np.float32)
        for value in model.graph.input
    }
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, feed)[0])


@pytest.mark.parametrize("name", CASES)
def test_a_form_has_the_values_of_what_it_replaces(name: str) -> None:
    form, inputs, operations, left = CASES[name]
    text = f'<ir_version: 10, opset_import: ["" : 20]> g ({inputs}) => (float out) {{ {operations} out = Neg(result) }}'
    given = onnx.shape_inference.infer_shapes(onnx.parser.parse_model(text))
    model = onnx_ir.from_proto(given)
    form(model)
    passes.RemoveUnusedNodesPass()(model)
    changed = onnx_ir.to_proto(model)
    assert {node.op_type for node in changed.graph.node} - {"Constant", "Neg"} == left
    np.testing.assert_allclose(run(changed), run(given), rtol=1e-6)
