"""`torchdof fit` as a user runs it."""

import json
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner, Result

from torchdof import BlurTable
from torchdof.cli.main import app


def kernel(distance: float) -> tuple[str, dict[str, float]]:
    return "disc", {"radius": 10.0 * abs(1 / 0.5 - 1 / distance)}


@pytest.fixture(scope="module")
def folder(simulator: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    fields = 'focal_length_mm = 50.0\nf_number = 1.543\nsensor_width_mm = 36.0\nname = "my lens"'
    return simulator.write_captures(
        tmp_path_factory.mktemp("lens"), camera, 0.5, [0.4, 0.8, 1.0], kernel, camera_fields=fields
    )


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["fit", *map(str, arguments)])


def test_a_folder_becomes_a_table_with_pictures(folder: Path, tmp_path: Path) -> None:
    result = run(folder, "-o", tmp_path / "mine.json", "--plots", tmp_path / "pictures")
    assert result.exit_code == 0, result.output
    table = BlurTable.load(tmp_path / "mine.json")
    assert table.family == "disc" and len(table.coc) == 3 and table.name == "my lens"
    assert table.provenance["command"].startswith("torchdof fit ")
    assert "±" in result.output and "family: disc" in result.output and "x noise" in result.output
    assert sorted(f.name for f in (tmp_path / "pictures").iterdir()) == [
        "mine_1000mm.png", "mine_400mm.png", "mine_800mm.png", "mine_table.png", "mine_texture.png",
    ]  # fmt: skip


def test_json_holds_the_fits(folder: Path, tmp_path: Path) -> None:
    result = run(folder, "-o", tmp_path / "mine.json", "--family", "disc", "--json")
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["name"] == "my lens" and facts["focus_m"] == 0.5 and facts["family"] == "disc"
    assert [fit["distance_m"] for fit in facts["fits"]] == [0.4, 0.8, 1.0]
    assert all(fit["stderr"]["radius"] > 0 for fit in facts["fits"]) and isinstance(facts["warnings"], list)


def test_a_lens_becomes_a_table(tmp_path: Path) -> None:
    arguments = ("--lens", "double_gauss_50mm", "--f-number", "4", "--nodes", "5", "-o", tmp_path / "lens.json")
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    facts = json.loads(run(*arguments, "--json").stdout)
    assert facts["out"] == str(tmp_path / "lens.json") and facts["f_number"] == 4.0 and facts["family"] == "radial"
    assert BlurTable.load(tmp_path / "lens.json").unit == "mm"
    told = " ".join(result.output.split())
    assert "50.3582 mm, f/4, focus 2.0 m; 5 distances from" in told and "family: radial, residual" in told


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "either a folder of captures or --lens"),
        (("nowhere",), "capture.toml"),
        (("--lens", "nowhere"), "nowhere"),
        (("nowhere", "-o", "table.txt"), "name it table.json"),
    ],
)
def test_wrong_input_is_one_sentence_and_exit_code_2(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.output.replace("\n", " ") and "Traceback" not in result.output


def test_help_teaches() -> None:
    result = run("--help")
    assert result.exit_code == 0 and "capture.toml" in result.output and "--lens" in result.output
