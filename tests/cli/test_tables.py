"""``torchdof tables`` from the outside."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from torchdof import BlurTable
from torchdof.cli.main import app
from torchdof.io.images import read_image


def run(*arguments: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["tables", *arguments], catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.stdout if code == 0 else result.stderr


def test_every_table_that_ships_is_listed() -> None:
    lines = run().splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["disc", "gaussian"]
    folder = Path(BlurTable.load.__code__.co_filename).parent / "tables"
    assert [line.split()[0] for line in lines[2:]] == sorted(path.stem for path in folder.glob("*.json"))


def test_the_picture_shows_kernels_in_front_above_and_behind_below(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    BlurTable.gaussian().save("mine.json")
    told = run("disc", "mine.json", "--blades", "3", "--rotation", "90", "-o", "kernels.png")
    assert "3 blades, turned by 90" in told and "-24, -12" in told
    picture = read_image("kernels.png").pixels[0, 0]
    assert picture.shape == (6 * 120 + 34 + 8, 2 * 230 + 3 * 8)
    for row, behind in ((0, False), (5, True)):
        kernel = picture[34 + row * 120 : 34 + (row + 1) * 120, 8:238]
        left, right = kernel[:, :115].sum(), kernel[:, 115:].sum()
        assert (left > right) != behind  # the triangle's corner points left behind focus


def test_tables_that_depend_on_the_place_show_kernels_from_the_middle_to_the_corner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    told = run("disc", "--vignetting", "0.6", "-o", "kernels.png")
    assert "vignetting 0.6" in told
    picture = read_image("kernels.png").pixels[0, 0]
    rows = picture[34 + 5 * 120 + 2 : 34 + 6 * 120, 8 : 8 + 4 * 118]
    lit = [float((part > 0.1).sum()) for part in rows.split(118, 1)]
    assert lit[0] > 1.1 * lit[1] > 1.2 * lit[2] > 1.2 * lit[3]


def test_json_tells_programs_the_same() -> None:
    facts = json.loads(run("double_gauss_50mm_f2", "--json"))
    assert (facts["table"], facts["family"], facts["nodes"], facts["unit"]) == (
        "double_gauss_50mm_f2",
        "radial",
        41,
        "mm",
    )
    assert facts["coc"][0] < 0 < facts["coc"][1] and facts["aperture"] is None
