"""What exported files are measured with runs, and tells what docs/embedding.md shows."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def run(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    module(name).main()


def test_times_are_told_in_turns(plain: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    run(monkeypatch, "exported_speed", str(plain.path), "--size", "64x48", "--runs", "1")
    told = {line[:40].strip(): line[40:].split() for line in capsys.readouterr().out.splitlines()}
    assert {"Y", "plain, onnxruntime", "plain, onnxruntime, in focus", "plain, the module"} <= set(told)
    assert told["Y"][2] == "1.00" and all(float(numbers[0]) > 0 for numbers in told.values())


@pytest.mark.sweep
def test_a_file_comes_as_near_the_truth_as_the_module(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    run(monkeypatch, "exported_scenes", str(ROOT / "tests" / "data" / "scenes"))
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert len(rows) >= 3
    for name, _, _, difference in rows:
        assert float(difference) > (-2.0 if name.startswith("highlights") else -0.3)
