"""A file gives the same pixels in OpenVINO and in onnxruntime-web (WebAssembly in Node) as the module."""

import base64
import importlib.metadata
import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.node import needs, run

LIMIT = 1e-4


def scene() -> list[torch.Tensor]:
    """A batch of two with a bad depth, lamps, an odd size and blur up to the largest radius."""
    depth = torch.linspace(1.2, 6.0, 71).expand(2, 1, 45, 71).contiguous()
    depth = depth + 0.2 * torch.rand(2, 1, 45, 71)
    depth[:, :, 20:30, 30:40] = 1.3
    depth[0, 0, 5, 6] = torch.nan
    image = torch.rand(2, 3, 45, 71)
    image[:, :, 4::13, 5::17] = 30.0
    return [image, depth, torch.tensor([1.5, 3.0]), torch.tensor([0.7, 1.0])]


def compare(exported: Any, tensors: list[torch.Tensor], got: np.ndarray) -> None:
    expected = exported.eager(*tensors)
    assert (expected - tensors[0]).abs().max() > 0.2
    torch.testing.assert_close(torch.from_numpy(np.array(got)), expected, atol=LIMIT, rtol=0)


@pytest.mark.skipif(importlib.util.find_spec("openvino") is None, reason="openvino is not installed (pip)")
def test_openvino_gives_the_same_pixels(layered: Any, record_property: Any) -> None:
    import openvino

    print("openvino", importlib.metadata.version("openvino"))
    record_property("openvino", importlib.metadata.version("openvino"))
    compiled = openvino.Core().compile_model(str(layered.path), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    tensors = scene()
    names = ("image", "depth", "focus_m", "f_number")
    feed = {name: tensor.numpy() for name, tensor in zip(names, tensors, strict=True)}
    compiled(feed)  # the first inference of a size may be wrong: docs/embedding.md
    compare(layered, tensors, compiled(feed)[0])


@needs("onnxruntime-web")
@pytest.mark.parametrize("layout", ["layered", "whole"])
def test_onnxruntime_web_gives_the_same_pixels(
    layout: str, tmp_path: Path, request: pytest.FixtureRequest, record_property: Any
) -> None:
    exported, tensors = request.getfixturevalue(layout), scene()
    feed = {}
    for name, tensor in zip(("image", "depth", "focus_m", "f_number"), tensors, strict=True):
        feed[name] = {"dims": list(tensor.shape), "data": base64.b64encode(tensor.numpy().tobytes()).decode()}
    (tmp_path / "feed.json").write_text(json.dumps(feed))
    web = Path(__file__).with_name("web.mjs")
    run(["node", web, exported.path, tmp_path / "feed.json", tmp_path / "out.json"])
    result = json.loads((tmp_path / "out.json").read_text())
    print("onnxruntime-web", result["version"])
    record_property("onnxruntime-web", result["version"])
    pixels = np.frombuffer(base64.b64decode(result["data"]), np.float32).reshape(result["dims"])
    compare(exported, tensors, pixels)
