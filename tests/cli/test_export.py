"""`torchdof export` as a user runs it."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

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
    modules = []
    monkeypatch.setattr("torchdof.cli.export.to_onnx", lambda dof, *_, **__: modules.append(dof) or 1 / 0)
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give either -o FILE to write or --show FILE to read"),
        (("-o", "dof.onnx", "--show", "dof.onnx"), "give either -o FILE"),
        (("-o", "dof.bin"), "name it dof.onnx"),
        (("-o", "dof.onnx", "--table", "nowhere"), "no blur table 'nowhere'"),
        (("-o", "dof.onnx", "--table", "double_gauss_50mm_f2"), "state it as width=1920"),
        (("-o", "dof.onnx", "--max-coc", "0.2"), "max_coc_px must be"),
        (("-o", "dof.onnx", "--tolerance", "2"), "tolerance must be"),
        (("-o", "dof.onnx", "--channels", "0"), "channels must be"),
        (("-o", "dof.onnx", "--opset", "11"), "opset must be"),
        (("-o", "nowhere/dof.onnx"), "there is no folder"),
        (("--show", "none.onnx"), "there is no file none.onnx"),
    ],
)
def test_wrong_input_is_one_sentence_and_exit_code_2(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.output.replace("\n", " ") and "Traceback" not in result.output
    assert not list(tmp_path.iterdir())
