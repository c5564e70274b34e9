"""The example that finds the scale of relative depth in a picture that is out of focus, run as a user runs it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("known", "metres"), [(["f_number", "focus_m"], True), ([], False)])
def test_gradient_descent_finds_the_blur_and_with_the_lens_known_metres(
    tmp_path: Path, known: list[str], metres: bool
) -> None:
    scene = ROOT / "tests" / "data" / "scenes" / "room"
    command = [sys.executable, str(ROOT / "examples" / "solve_scale.py"), "--scene", str(scene), "--out", str(tmp_path)]
    run = subprocess.run([*command, "--known", *known], capture_output=True, text=True, timeout=300, check=False)
    assert run.returncode == 0, run.stderr
    rows = {line.split()[0]: [float(x) for x in line.split()[1:]] for line in re.findall(r"  \w+ +[\d. ]+", run.stdout)}
    (*_, radius_px, depth_percent, close_db), guess = rows["found"], rows["guess"]
    assert radius_px < 0.15 < 1.0 < guess[4]
    assert close_db > rows["true"][6] - 0.3
    assert (depth_percent < 4) == metres
    assert (tmp_path / "room_1_scale.png").is_file()
