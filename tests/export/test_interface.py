"""Inputs of exported files: one depth map for a batch, impossible cameras, wrong shapes, fixed sizes, hard cases."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from torchdof import Camera, DepthOfField
from torchdof.export.cases import cases
from torchdof.export.graph import Portable
from torchdof.export.verification import TOLERANCE

LENS = torch.tensor([1.0]), torch.tensor([0.3])


def test_one_depth_and_one_lens_serve_a_whole_batch(plain: Any) -> None:
    images, depth = torch.rand(3, 3, 20, 31), 1.0 + 4.0 * torch.rand(1, 1, 20, 31)
    apart = torch.cat([plain.render(image[None], depth, *LENS) for image in images])
    assert float((apart - images).abs().max()) > 0.1
    assert torch.equal(plain.render(images, depth, *LENS), apart)


@pytest.mark.parametrize(
    ("focus_m", "f_number"),
    [(0.0, 2.0), (-1.0, 2.0), (math.nan, 2.0), (1.0, 0.0), (1.0, -2.0), (1.0, math.nan), (1.0, math.inf)],
)
def test_an_impossible_camera_gives_nan_for_its_item_only(plain: Any, focus_m: float, f_number: float) -> None:
    images, depth = torch.rand(2, 3, 12, 17), 1.0 + 4.0 * torch.rand(2, 1, 12, 17)
    out = plain.render(images, depth, torch.tensor([focus_m, 1.0]), torch.tensor([f_number, 0.3]))
    assert torch.isnan(out[0]).all() and torch.isfinite(out[1]).all()
    in_focus = plain.render(images[:1], torch.ones(1, 1, 12, 17), *out.new_tensor([[focus_m], [f_number]]))
    assert torch.isnan(in_focus).all(), "also where the plane is in focus"


@pytest.mark.parametrize(
    ("name", "shape"), [("depth", (2, 1, 20, 30)), ("depth", (3, 1, 20, 31)), ("focus_m", (3,)), ("f_number", (3,))]
)
def test_a_wrong_shape_is_named(plain: Any, name: str, shape: tuple[int, ...]) -> None:
    feed = {"image": np.ones((2, 3, 20, 31)), "depth": np.ones((1, 1, 20, 31)), "focus_m": [1.0], "f_number": [2.0]}
    feed[name] = np.ones(shape)
    with pytest.raises(Exception, match=f"{name}_must_have_one_item_or_as_many_as_image"):
        plain.runner.run(None, {key: np.asarray(value, np.float32) for key, value in feed.items()})


def test_sizes_can_be_fixed_by_the_runtimes_tool(plain: Any, tmp_path: Path) -> None:
    tools = pytest.importorskip("onnxruntime.tools.onnx_model_utils")
    model = onnx.load(plain.path)
    for name, number in (("B", 1), ("B_or_1", 1), ("H", 20), ("W", 31)):
        tools.make_dim_param_fixed(model.graph, name, number)
    onnx.save(model, tmp_path / "fixed.onnx")
    runner = onnxruntime.InferenceSession(tmp_path / "fixed.onnx", providers=["CPUExecutionProvider"])
    assert runner.get_inputs()[0].shape == [1, 3, 20, 31] and runner.get_inputs()[1].shape == [1, 1, 20, 31]
    tensors = torch.rand(1, 3, 20, 31), 1.0 + 4.0 * torch.rand(1, 1, 20, 31), *LENS
    names = [value.name for value in runner.get_inputs()]
    (out,) = runner.run(None, {name: tensor.numpy() for name, tensor in zip(names, tensors, strict=True)})
    assert torch.equal(torch.from_numpy(out), plain.render(*tensors))


def test_loading_prints_no_warning(layered: Any, capfd: pytest.CaptureFixture[str]) -> None:
    onnxruntime.InferenceSession(layered.path, providers=["CPUExecutionProvider"])
    assert not capfd.readouterr().err


@pytest.mark.parametrize("kind", ["ONNXModule", "ONNXSequential"])
def test_kornia_runs_a_file(plain: Any, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # Kornia writes its cache into the working folder
    onnx_classes = pytest.importorskip("kornia.onnx")
    tensors = torch.rand(1, 3, 20, 31), 1.0 + 4.0 * torch.rand(1, 1, 20, 31), *LENS
    runner = getattr(onnx_classes, kind)(str(plain.path))
    got = runner(*(tensor.numpy() for tensor in tensors))[0]
    torch.testing.assert_close(torch.from_numpy(got), plain.eager(*tensors), atol=1e-5, rtol=0)


def test_the_pictures_of_verified_cases_do_not_depend_on_rounding() -> None:
    """If they did, a file with large blurs, such as the default, would differ from its module beyond the limit."""
    portable = Portable(DepthOfField(Camera()), "depth", None, "as given")
    for case in cases(portable, 3):
        if case.name in ("depth edges", "bad depths"):
            single, double = (portable(*(t.to(kind) for t in case.tensors)) for kind in (torch.float32, torch.float64))
            assert float((single - double).abs().max()) < TOLERANCE
