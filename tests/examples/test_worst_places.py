import sys
from pathlib import Path

import pytest

from examples.benchmarks import worst_places
from torchdof.io.images import read_image
from torchdof.reference.scenes import read_scenes

SCENES = Path(__file__).parents[1] / "data" / "scenes"


def test_the_worst_place_is_where_the_error_is_and_not_at_the_border() -> None:
    (scene,) = read_scenes(SCENES / "planes")
    picture, m = scene.truth.clone(), scene.margin_px
    picture[..., m + 5 : m + 9, m + 11 : m + 15] += 0.1
    picture[..., 0, :] += 1.0
    assert worst_places.worst_place(picture, scene, 4) == (m + 5, m + 11)


def test_the_sheet_holds_the_cases_that_are_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    arguments = [str(SCENES), "--out", str(sheet), "--cases", "planes/0", "--side", "32", "--times", "4"]
    monkeypatch.setattr(sys, "argv", ["worst_places.py", *arguments])
    worst_places.main()
    assert tuple(read_image(sheet).pixels.shape) == (1, 3, 128 + 34 + 8, 3 * (128 + 8) + 8)


def test_a_case_that_is_not_there_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = tmp_path / "sheet.png"
    monkeypatch.setattr(sys, "argv", ["worst_places.py", str(SCENES), "--out", str(sheet), "--cases", "planes/7"])
    with pytest.raises(SystemExit):
        worst_places.main()
    assert "planes/7" in capsys.readouterr().err and not sheet.exists()
