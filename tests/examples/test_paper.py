"""The example that draws the paper's figures, run as a user runs it."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

SCRIPT = Path(__file__).parents[2] / "examples" / "paper.py"


def test_the_paper_s_experiment_reaches_its_figure_4(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, SCRIPT, "--out", tmp_path], capture_output=True, text=True, timeout=110, check=False
    )
    assert run.returncode == 0, run.stderr
    for name in ("sato_fig2", "sato_fig3", "sato_fig4", "traced_fig2_ratio", "traced_fig3", "traced_fig4"):
        picture = np.asarray(oiio.ImageBuf(str(tmp_path / f"{name}.png")).get_pixels())
        assert picture.std() > 0.02, name
    # 0.318 mm on a sensor of 9 mm and 480 pixels is the thin lens's; the traced lens is a little more
    assert 16.9 < float(re.findall(r"radius = ([\d.]+)", run.stdout)[0]) < 17.3
    assert "sigma = 0.0023476 m" in run.stdout
    assert "samples of its own curve" in run.stdout
    off = {
        n: float(re.findall(rf"{n} +rms radius [\d.]+ px, ([+-][\d.]+) %", run.stdout)[0]) for n in ("ratio", "forward")
    }
    assert abs(off["forward"]) < 2 < abs(off["ratio"])
    assert float(re.findall(r"spot itself: ([\d.]+) dB", run.stdout)[0]) > 45
