"""The files that ``examples/web`` uses, written with its settings, and what its build says if a part is missing."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import torchdof
from tests.node import ENVIRONMENT, ROOT, needs
from torchdof.tensors import TRACEABLE

WEB = ROOT / "examples" / "web"
ONE_LINE = "pip install '.[export]'"


@pytest.fixture
def script() -> ModuleType:
    """``write_files.py`` as a module."""
    spec = importlib.util.spec_from_file_location("write_files", WEB / "write_files.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(not TRACEABLE, reason="this PyTorch cannot write ONNX files")
@pytest.mark.sweep  # minutes a shape; tests/export/ has the same radius, occlusion and repaired edges, one in each file
def test_the_files_of_the_page_are_written_and_verified(
    script: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the page's own radius, tolerance and shapes: a smaller file may be right where these are not."""
    from torchdof.export import describe

    written = script.write_shapes(tmp_path)
    assert written == [*script.SHAPES]
    for name in written:
        assert describe(tmp_path / name)["depth_edges"] == torchdof.DepthOfField(torchdof.Camera()).depth_edges
    assert capsys.readouterr().out.count("verified (largest error") == len(written)


def test_a_shape_that_cannot_be_written_is_left_out(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert [name for name, _ in script.SHAPES.values()] == ["Round", "Six blades", "Soft, a Gaussian"]
    edges, radii = [], []

    def to_onnx(dof: torchdof.DepthOfField, path: Path, inputs: str) -> str:
        assert inputs == "depth+matte"
        edges.append(dof.options.depth_edges)
        radii.append(dof.max_coc_px)
        if path.name == failing or failing == "all":
            raise ValueError("the file differs from the module")
        return "written"

    monkeypatch.setattr(script, "to_onnx", to_onnx)
    failing = "blades.onnx"
    assert script.write_shapes(tmp_path) == ["dof.onnx", "soft.onnx"]
    assert set(edges) == {torchdof.DepthOfField(torchdof.Camera()).depth_edges} and set(radii) == {64.0}
    told = capsys.readouterr()
    assert told.err == "warning: the page is without the shape 'Six blades': the file differs from the module\n"
    failing = "all"
    with pytest.raises(SystemExit, match="no exported file could be written"):
        script.write_shapes(tmp_path)


def test_a_missing_package_is_named_with_the_extra_that_brings_it(tmp_path: Path) -> None:
    (tmp_path / "onnx.py").write_text("raise ModuleNotFoundError(\"No module named 'onnx'\", name='onnx')")
    call = [sys.executable, str(WEB / "write_files.py"), "--out", str(tmp_path)]
    done = subprocess.run(call, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert (
        done.stderr.startswith(f"the page needs onnx, which {sys.executable} does not have") and ONE_LINE in done.stderr
    )


@needs("onnxruntime-web")
def test_the_build_ends_with_the_message_of_python_alone(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho 'the page needs onnx' >&2\nexit 3\n")
    python.chmod(0o755)
    build = ["node", str(WEB / "build.mjs"), "--out", str(tmp_path / "dist")]
    done = subprocess.run(build, capture_output=True, text=True, env={**ENVIRONMENT, "PYTHON": str(python)})
    assert (done.returncode, done.stdout, done.stderr) == (3, "", "the page needs onnx\n")
    done = subprocess.run(build, capture_output=True, text=True, env={**ENVIRONMENT, "PYTHON": str(tmp_path / "none")})
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "cannot be run (ENOENT)" in done.stderr
    without = {**ENVIRONMENT, "TORCHDOF_NODE_FOLDER": str(tmp_path)}
    done = subprocess.run(build, capture_output=True, text=True, env=without)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1) and "onnxruntime-web is not installed" in done.stderr
