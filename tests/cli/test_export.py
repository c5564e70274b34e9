"""`torchdof export` as a user runs it."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from torchdof import DepthOfField
from torchdof.cli.main import app
from torchdof.export import describe


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def test_a_file_is_written_and_its_verification_printed(exported_by_command: tuple[Path, str]) -> None:
    path, told = exported_by_command
    printed = json.loads(told)
    assert printed["out"] == str(path) and "disc" in printed["title"]
    assert "bad depths" in {case["name"] for case in printed["cases"]}
    assert max(case["max_error"] for case in printed["cases"]) < 1e-5
    facts = describe(path)
    assert facts["options"]["max_coc_px"] == 2.0 and not facts["options"]["occlusion"]
    assert list(facts["inputs"]) == ["image", "coc_px"] and "[B, 3, H, W]" in facts["inputs"]["image"]
    assert [file.name for file in path.parent.iterdir()] == ["dof.onnx"]


def test_blades_are_those_of_the_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modules: list[DepthOfField] = []

    def kept(dof: DepthOfField, *_: Any, **__: Any) -> None:
        modules.append(dof)
        raise ValueError("that was it")

    monkeypatch.setattr("torchdof.export.conversion.to_onnx", kept)
    run("-o", tmp_path / "dof.onnx", "--blades", "5", "--rotation", "10", "--squeeze", "2")
    aperture = modules[0].options.table.aperture
    assert aperture is not None and (aperture.blades, aperture.rotation_deg, aperture.squeeze) == (5, 10.0, 2.0)


def test_show_prints_units_camera_table_and_options(plain: Any) -> None:
    result = run("--show", plain.path)
    assert result.exit_code == 0, result.output
    for part in ("metres along the optical axis", "focal_length_mm: ", "family: disc", "max_coc_px: 2.5", "opset: 20"):
        assert part in result.output


def test_json_holds_what_a_file_says_about_itself(plain: Any) -> None:
    assert json.loads(run("--show", plain.path, "--json").stdout) == json.loads(json.dumps(describe(plain.path)))
