"""`torchdof export` as a user runs it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest

from torchdof import DepthOfField
from torchdof.export import describe


def test_a_file_is_written_and_its_verification_printed(exported_by_command: tuple[Path, str]) -> None:
    path, output = exported_by_command
    printed = json.loads(output)
    assert printed["out"] == str(path) and "disc" in printed["title"]
    assert "bad depths" in {case["name"] for case in printed["cases"]}
    assert max(case["max_error"] for case in printed["cases"]) < 1e-5
    facts = describe(path)
    assert facts["options"]["max_coc_px"] == 2.0 and not facts["options"]["occlusion"]
    assert list(facts["inputs"]) == ["image", "coc_px"] and "[B, 1, H, W]" in facts["inputs"]["image"]
    assert facts["opset"] == 21 and [entry.version for entry in onnx.load(path).opset_import] == [21]
    assert [file.name for file in path.parent.iterdir()] == ["dof.onnx"]


def test_options_of_the_aperture_arrive(scene: Path, run: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    modules: list[DepthOfField] = []

    def record(dof: DepthOfField, *_: Any, **__: Any) -> None:
        modules.append(dof)
        raise ValueError("not exported")

    monkeypatch.setattr("torchdof.export.conversion.to_onnx", record)
    run("export -o dof.onnx --blades 5 --rotation 10 --squeeze 2", code=2)
    aperture = modules[0].options.table.aperture
    assert aperture is not None and (aperture.blades, aperture.rotation_deg, aperture.squeeze) == (5, 10.0, 2.0)


def test_show_prints_units_camera_table_and_options(plain: Any, run: Callable[..., str]) -> None:
    output = run("export --show", plain.path)
    for part in ("metres along the optical axis", '"focal_length_mm": ', '"family": "disc"', '"max_coc_px": 2.5'):
        assert part in output
    assert json.loads(run("export --json --show", plain.path)) == json.loads(json.dumps(describe(plain.path)))
