"""An exported file renders the module's pictures, at other sizes and of other scenes than the traced ones."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir
import onnxruntime
import pytest
import torch

import torchdof
from torchdof.export import conversion, to_onnx
from torchdof.export.graph import Portable, trace
from torchdof.export.rays import kernels_of
from torchdof.export.verification import session
from torchdof.options import DepthEdges

CAMERA = torchdof.Camera.from_fov(50.0, 0.05, 2.0)
SIMPLE: dict[str, Any] = {"occlusion": False, "tolerance": "draft", "max_coc_px": 1.0, "check": False}


def test_the_file_is_small_and_every_case_agrees_within_1e_5(layered: Any) -> None:
    assert layered.path.stat().st_size < 200_000
    assert len(layered.verification.cases) >= 14
    assert 0 < layered.verification.max_error < 1e-5


def test_an_image_in_focus_is_returned_bit_for_bit(layered: Any) -> None:
    image = torch.rand(1, 3, 50, 40)
    out = layered.render(image, torch.full((1, 1, 50, 40), 2.0), torch.tensor([2.0]), torch.tensor([0.5]))
    assert torch.equal(out, image)


def test_the_kernels_of_a_graph_are_those_of_the_stated_width(monkeypatch: pytest.MonkeyPatch) -> None:
    table = torchdof.BlurTable.load("double_gauss_50mm_f2")
    portable = Portable(torchdof.DepthOfField(CAMERA, table, **SIMPLE), "coc_px", 1920)
    traced: list[Portable] = []
    monkeypatch.setattr(torch.export, "export", lambda module, *_, **__: traced.append(module))
    trace(portable, 1)
    ops: Any = traced[0].ops
    for width in (1920, 1000):
        expected = [portable.plan.constants(table, True, width)[0], kernels_of(table, portable.plan, width)[0]]
        made = [ops.kernels[0], ops.rays[0]]
        assert all(map(torch.equal, made, expected)) == any(map(torch.equal, made, expected)) == (width == 1920)
    assert ops.lens_width == 1920


def test_the_graph_has_standard_operators_and_loops_that_skip_layers_without_pixels(layered: Any) -> None:
    model = onnx_ir.load(layered.path)
    assert model.opset_imports.keys() == {""}
    nodes: list[Any] = list(model.graph.all_nodes())
    loops = [node.attributes["body"].as_graph() for node in nodes if node.op_type == "Loop"]
    kinds = [[node.op_type for node in body.all_nodes()] for body in loops]
    rays, looking, layers = sorted(kinds, key=lambda of_loop: of_loop.count("If"))
    assert looking.count("If") >= 1 and layers.count("If") >= 5
    assert {"ScatterElements", "NonZero"} <= set(rays)
    assert not {node.op_type for node in nodes} & {"Scan", "CastLike"} and not {node.domain for node in nodes} - {""}
    # operators that a frame in focus does not need are inside a branch
    assert len(model.graph) < 0.1 * len(nodes)
    assert not {node.op_type for node in model.graph} & {"Conv", "Loop", "NonZero", "TopK", "ScatterElements"}
    for node in nodes:  # convolutions take constant weights of their own graph
        if node.op_type == "Conv":
            _, weight = node.inputs
            maker = weight.producer()
            makers = [maker] if maker.op_type != "Gather" else [value.producer() for value in maker.inputs]
            assert all(m.op_type in ("Constant", "ConstantOfShape") and m.graph is node.graph for m in makers)


@pytest.mark.parametrize("depth_edges", ["auto", "repair", "as given"])
def test_a_file_treats_edges_as_its_module_unless_it_cannot(depth_edges: DepthEdges) -> None:
    dof = torchdof.DepthOfField(CAMERA, max_coc_px=2.0, depth_edges=depth_edges)
    assert Portable(dof).dof.options.depth_edges == depth_edges
    assert Portable(dof, layout="whole").dof.options.depth_edges == "as given"
    assert Portable(dof, depth_edges="repair").dof.options.depth_edges == "repair"


CATS_EYES = torchdof.BlurTable.polygon(5, vignetting=0.4)
RANGE = CAMERA.replace(focus_range_m=(1.0, 2.0))
SIMPLY = torchdof.DepthOfField(CAMERA, **SIMPLE)


@pytest.mark.parametrize(
    ("dof", "change", "message"),
    [
        (SIMPLY, {"inputs": "disparity"}, "inputs must be one of depth, depth.matte, coc_px, coc_px.matte"),
        (SIMPLY, {"opset": 17}, "opset must be a whole number from 20"),
        (SIMPLY, {"width": 640}, "same kernels at any image width"),
        (SIMPLY, {"channels": 0}, "channels must be a whole number"),
        (SIMPLY, {"path": "nowhere/dof.onnx"}, "there is no folder"),
        (SIMPLY, {"layout": "rows"}, "layout must be one of tiles, whole, got 'rows'"),
        (SIMPLY, {"size": (40, 50)}, 'size is for layout="whole"'),
        (SIMPLY, {"layout": "whole", "size": (40, 0)}, r"height and width of a frame in pixels, .* got \(40, 0\)"),
        (SIMPLY, {"layout": "whole", "depth_edges": "auto"}, "cannot repair depth edges"),
        (torch.nn.Identity(), {}, r"dof must be a torchdof\.DepthOfField"),
        (torchdof.DepthOfField(torchdof.Camera(focus_m=torch.tensor([1.0, 2.0]))), {}, "focus_m must be a float"),
        (torchdof.DepthOfField(CAMERA, CATS_EYES, **SIMPLE), {}, "take a table without vignetting"),
        (torchdof.DepthOfField(RANGE, **SIMPLE), {}, "remove it: focus_range_m=None"),
    ],
)
def test_bad_arguments_are_refused_and_no_file_is_written(
    dof: Any, change: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Exception, match=message):
        to_onnx(dof, **{"path": "dof.onnx", **change})
    assert not list(tmp_path.iterdir())


def test_a_file_unlike_its_module_is_not_written(plain: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dof.onnx").write_text("older")
    monkeypatch.setattr("torchdof.export.verification.TOLERANCE", -1.0)
    monkeypatch.setattr(conversion, "trace", lambda *_: None)  # the graph is that of a file, to save its tracing
    monkeypatch.setattr(conversion, "_translate", lambda *_: None)
    monkeypatch.setattr(conversion, "slim", lambda _, straight: onnx_ir.load(plain.path))
    monkeypatch.setattr(conversion, "broadcast", lambda graph: graph)
    with pytest.raises(ValueError, match="differs from the module"):
        to_onnx(plain.dof, tmp_path / "dof.onnx")
    assert [file.name for file in tmp_path.iterdir()] == ["dof.onnx"]
    assert (tmp_path / "dof.onnx").read_text() == "older"


def test_an_exporter_that_is_too_old_is_refused_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(conversion, "TRACEABLE", False)
    with pytest.raises(ValueError, match=r"needs PyTorch 2\.13 or newer to write ONNX files, this is "):
        to_onnx(torchdof.DepthOfField(torchdof.Camera()), tmp_path / "dof.onnx")
    assert list(tmp_path.iterdir()) == []


def test_onnxruntimes_optimised_copy_of_a_file_with_tiles_can_be_loaded(layered: Any, tmp_path: Path) -> None:
    """It names new values after nodes, so that those of subgraphs need names."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    onnxruntime.InferenceSession(layered.path, options, providers=["CPUExecutionProvider"])
    copy = onnxruntime.InferenceSession(tmp_path / "optimised.onnx", providers=["CPUExecutionProvider"])
    feed = {"image": torch.rand(1, 3, 20, 30).numpy(), "depth": torch.linspace(1, 9, 600).reshape(1, 1, 20, 30).numpy()}
    feed |= {"focus_m": torch.tensor([2.0]).numpy(), "f_number": torch.tensor([1.0]).numpy()}
    np.testing.assert_allclose(copy.run(None, feed)[0], layered.runner.run(None, feed)[0], rtol=0, atol=1e-6)


@pytest.mark.sweep  # a minute and a half; tests/render/surfaces/test_coverage.py tries the same step without a file
def test_a_file_takes_a_matte_and_zeros_change_nothing(tmp_path: Path) -> None:
    """``to_onnx`` compares the file with the module on every case."""
    dof = torchdof.DepthOfField(CAMERA, max_coc_px=1.5, tolerance=64 / 255, depth_edges="as given")
    report = to_onnx(dof, tmp_path / "matte.onnx", inputs="coc_px+matte", layout="whole")
    assert report.passed
    image, coc = torch.rand(1, 3, 24, 32), torch.where(torch.arange(32) < 16, -1.2, 1.2).expand(1, 1, 24, 32)
    feed = {"image": image.numpy(), "coc_px": coc.numpy().astype(np.float32)}
    run = session(tmp_path / "matte.onnx").run
    plain = run(None, {**feed, "matte": np.zeros((1, 1, 24, 32), np.float32)})[0]
    shifted = run(None, {**feed, "matte": (coc < 0).roll(2, -1).float().numpy()})[0]
    np.testing.assert_allclose(Portable(dof, "coc_px", layout="whole")(image, coc).numpy(), plain, rtol=0, atol=1e-5)
    assert float(np.abs(shifted - plain).max()) > 0.01
