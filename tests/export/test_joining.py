"""``chain``: a depth network and a depth-of-field file joined in one file give the pictures of both in turn."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest

from torchdof.export import chain, describe
from torchdof.export.verification import session

NETWORK = """
<ir_version: 8, opset_import: ["": 17]>
network (float[N,3,{size}] pixels) => (float[N,{size}] map) {{
    axes = Constant<value_ints = [1]>()
    grey = ReduceMean<axes = [1], keepdims = 0>(pixels)
    gain = Constant<value_float = 0.8>()
    least = Constant<value_float = 0.3>()
    scaled = Mul(grey, gain)
    map = Add(scaled, least)
}}
"""


def network(size: str = "28,42") -> onnx.ModelProto:
    """A stand-in for a depth network: brighter pixels have larger values; `size` is fixed or "h,w" for any."""
    return onnx.parser.parse_model(NETWORK.format(size=size))


@pytest.mark.parametrize(
    ("estimate", "size", "more"),
    [
        ("metric", "28,42", {"scale": 2.0}),
        ("inverse", "h,w", {"scale": 0.5, "shift": 0.1}),
        ("relative-inverse", "28,42", {"mean": (0.5, 0.4, 0.4), "std": (0.2, 0.2, 0.2)}),
    ],
)
def test_each_estimate_gives_a_file(plain: Any, estimate: Any, size: str, more: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "both.onnx"
    chain(network(size), plain.path, path, estimate=estimate, **more)
    facts = describe(path)
    assert facts["chain"]["estimate"] == estimate and "metres" in facts["output"]["depth"]
    image = np.random.default_rng(1).random((2, 3, 60, 50), dtype=np.float32)
    feed = {"image": image, "focus_m": np.array([1.0, 2.0], np.float32), "f_number": np.array([0.05, 0.1], np.float32)}
    if estimate == "relative-inverse":
        feed |= {"near_m": np.array([0.5, 1.0], np.float32), "far_m": np.array([9.0, 20.0], np.float32)}
    assert set(feed) == set(facts["inputs"])
    runner = session(path)
    out, depth = runner.run(["out", "depth"], feed)
    assert depth.shape == (2, 1, 60, 50) and np.abs(out - image).max() > 0.1
    if estimate == "relative-inverse":
        assert 0.5 - 1e-4 <= depth[0].min() < 0.7 and 3.0 < depth[0].max() <= 9.0 + 1e-3
    feed["depth"] = depth
    names = ("image", "depth", "focus_m", "f_number")
    (alone,) = plain.runner.run(["out"], {name: feed[name] for name in names})
    np.testing.assert_allclose(out, alone, atol=1e-6)
    if estimate == "metric":
        del feed["depth"]
        (depth,) = runner.run(["depth"], {**feed, "image": np.full((2, 3, 60, 50), 0.5, np.float32)})
        srgb = 1.055 * 0.5 ** (1 / 2.4) - 0.055
        np.testing.assert_allclose(depth, 2.0 * (0.8 * srgb + 0.3), rtol=1e-5)
    assert [file.name for file in tmp_path.iterdir()] == ["both.onnx"]


def two_outputs() -> onnx.ModelProto:
    model = network()
    model.graph.output.append(model.graph.output[0])
    model.graph.output[1].name = "grey"
    return model


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"estimate": "disparity"}, "estimate must be"),
        ({"path": "nowhere/both.onnx"}, "there is no folder"),
        ({"depth_model": "none.onnx"}, "there is no file"),
        ({"depth_model": two_outputs()}, "one input and one output"),
        ({"dof_model": network()}, "not written by torchdof.export"),
    ],
)
def test_bad_arguments_are_refused_and_no_file_is_written(
    plain: Any, change: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given: dict[str, Any] = {"depth_model": network(), "dof_model": plain.path, "path": "both.onnx", **change}
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        chain(given["depth_model"], given["dof_model"], given["path"], estimate=given.get("estimate", "metric"))
    assert not list(tmp_path.iterdir())
