"""A file with ``layout="whole"`` is one straight graph, and gives the module's picture without rays of highlights."""

import math
from pathlib import Path
from typing import Any

import onnx
import onnx.shape_inference
import pytest
import torch
from onnxruntime.transformers.float16 import convert_float_to_float16

import torchdof
from tests.exported import CAMERA
from torchdof import BlurTable
from torchdof.export import chain, describe, to_onnx, verify
from torchdof.export.graph import Portable
from torchdof.export.verification import session
from torchdof.render.layers.plan import Plan

CONTROL = {"Loop", "If", "Scan", "NonZero", "SequenceMap"}
FEW: dict[str, Any] = {"occlusion": False, "tolerance": "draft", "max_coc_px": 1.0, "check": False}


def is_map(value: onnx.ValueInfoProto) -> bool:
    """Whether a value has the height and width of the frame."""
    return {"H", "W"} <= {dim.dim_param for dim in value.type.tensor_type.shape.dim}


def test_the_graph_is_straight_and_computes_maps_in_single_precision(whole: Any) -> None:
    model = onnx.load(whole.path)
    graph = model.graph
    assert {entry.domain for entry in model.opset_import} == {""} and not model.functions
    assert len(graph.node) < 2300 and whole.path.stat().st_size < 200_000
    assert not {node.op_type for node in graph.node} & CONTROL
    assert not any(attribute.HasField("g") for node in graph.node for attribute in node.attribute)
    weights = {tensor.name for tensor in graph.initializer}
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    assert len(convolutions) >= 3 and all(node.input[1] in weights for node in convolutions)
    maps = list(filter(is_map, onnx.shape_inference.infer_shapes(model, data_prop=True).graph.value_info))
    kinds = {value.type.tensor_type.elem_type for value in maps}
    assert len(maps) > 50 and kinds == {onnx.TensorProto.FLOAT, onnx.TensorProto.BOOL}


def test_every_case_agrees_and_a_highlight_is_the_only_difference_from_tiles(whole: Any) -> None:
    assert len(whole.verification.cases) >= 16 and 0 < whole.verification.max_error < 1e-5
    generator = torch.Generator().manual_seed(0)
    image, depth = torch.rand(1, 3, 60, 90, generator=generator), torch.full((1, 1, 60, 90), 9.0)
    depth[..., 20:40, 30:50] = 1.0
    lens = torch.tensor([2.0]), torch.tensor([0.4])
    layouts = [Portable(whole.dof, layout=layout) for layout in ("tiles", "whole")]
    tiles, straight = (portable(image, depth, *lens) for portable in layouts)
    torch.testing.assert_close(straight, tiles, atol=1e-6, rtol=0)
    image[..., 50, 80] = 300.0
    tiles, straight = (portable(image, depth, *lens) for portable in layouts)
    assert (straight - tiles).abs().max() > 0.1
    near = (straight - tiles).abs().amax(1) > 1e-3
    assert not near[:, :40].any() and not near[:, :, :70].any()


def test_the_converter_of_onnxruntime_makes_a_file_in_half_precision(whole: Any, tmp_path: Path) -> None:
    half = convert_float_to_float16(onnx.load(whole.path), keep_io_types=True)
    onnx.save(half, tmp_path / "half.onnx")
    tensors = {name for node in half.graph.node for name in (*node.input, *node.output)}
    assert len(tensors) > 100 and sum(t.data_type == onnx.TensorProto.FLOAT16 for t in half.graph.initializer) > 3
    generator = torch.Generator().manual_seed(0)
    image, depth = torch.rand(1, 3, 270, 480, generator=generator), torch.full((1, 1, 270, 480), 9.0)
    depth[..., 80:160, 120:300] = 1.0
    given = {"image": image, "depth": depth, "focus_m": torch.tensor([2.0]), "f_number": torch.tensor([0.4])}
    feeds = {name: value.numpy() for name, value in given.items()}
    single, rounded = (session(path).run(None, feeds)[0] for path in (whole.path, tmp_path / "half.onnx"))
    assert abs(single - image.numpy()).max() > 0.1 and 0 < abs(single - rounded).max() < 4e-3


def test_a_file_can_have_one_size_and_one_channel(tmp_path: Path) -> None:
    table, path, steps = BlurTable.load("double_gauss_50mm_f2"), tmp_path / "dof.onnx", list[str]()
    dof, size = torchdof.DepthOfField(CAMERA, table, **FEW), (20, 1920)
    report = to_onnx(dof, path, inputs="coc_px", channels=1, layout="whole", size=size, progress=steps.append)
    assert steps[:4] == ["tracing", "translating", "slimming", "verifying: depth edges"]
    assert {row.shape for row in report.cases} == {(1, 1, *size)}
    facts = describe(path)
    assert (facts["layout"], facts["size"], facts["width"]) == ("whole", [*size], 1920)
    dims = [[d.dim_value for d in v.type.tensor_type.shape.dim] for v in onnx.load(path).graph.input]
    assert dims == [[1, 1, *size]] * 2
    with pytest.raises(ValueError, match="dof_model must take a depth"):
        chain(path, path, tmp_path / "chain.onnx", estimate="metric")
    assert verify(path, dof).passed
    image, coc = torch.rand(1, 1, *size), torch.linspace(-1.0, 1.0, 1920).expand(1, 1, *size).contiguous()
    coc[..., 4, 7] = math.nan
    out = torch.from_numpy(session(path).run(None, {"image": image.numpy(), "coc_px": coc.numpy()})[0])
    assert torch.equal(out[..., 4, 7], image[..., 4, 7])
    options = {**dof.options.arguments(), "plan": Plan.static(1.0, dof.options.tolerance)}
    torch.testing.assert_close(out, torchdof.blur_by_coc(image, coc, **options), atol=1e-5, rtol=0)
