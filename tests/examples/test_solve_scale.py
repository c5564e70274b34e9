"""``examples/solve_scale.py``, which finds the scale of relative depth from defocus; with fewer steps at full size."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "examples" / "solve_scale.py"))


def test_gradient_descent_finds_the_blur_and_with_a_known_lens_the_metres(
    example: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    main = example["main"]
    *coarse, (factor, steps, rate) = example["STAGES"]
    monkeypatch.setitem(main.__globals__, "STAGES", (*coarse, (factor, 4, rate)))
    scene = ROOT / "tests" / "data" / "scenes" / "room"
    monkeypatch.setattr(
        "sys.argv", ["solve_scale.py", "--scene", str(scene), "--out", str(tmp_path), "--known", "f_number", "focus_m"]
    )
    main()
    printed = capsys.readouterr().out
    rows = {line.split()[0]: [float(x) for x in line.split()[1:]] for line in re.findall(r"  \w+ +[\d. ]+", printed)}
    (*_, radius_px, depth_percent, close_db), guess = rows["found"], rows["guess"]
    assert radius_px < 0.15 < 1.0 < guess[4]
    assert close_db > rows["true"][6] - 0.3
    assert depth_percent < 4
    assert (tmp_path / "room_1_scale.png").is_file()
