"""``examples/paper.py``: the paper's figures."""

import re
import runpy
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

SCRIPT = Path(__file__).parents[2] / "examples" / "paper.py"


@pytest.mark.filterwarnings("ignore:.*one distance was measured")  # as in the paper
def test_the_paper_s_experiment_reaches_its_figure_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", [str(SCRIPT), "--out", str(tmp_path)])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    printed = capsys.readouterr().out
    for name in ("sato_fig2", "sato_fig3", "sato_fig4", "traced_fig2_ratio", "traced_fig3", "traced_fig4"):
        picture = np.asarray(oiio.ImageBuf(str(tmp_path / f"{name}.png")).get_pixels())
        assert picture.std() > 0.02, name
    # a thin lens gives 0.318 mm on a sensor of 9 mm and 480 px, 17.0 px; the traced lens is slightly larger
    assert 16.9 < float(re.findall(r"radius = ([\d.]+)", printed)[0]) < 17.3
    assert "sigma = 0.0023476 m" in printed
    assert "samples of its own curve" in printed
    off = {
        n: float(re.findall(rf"{n} +rms radius [\d.]+ px, ([+-][\d.]+) %", printed)[0]) for n in ("ratio", "forward")
    }
    assert abs(off["forward"]) < 2 < abs(off["ratio"])
    assert float(re.findall(r"spot itself: ([\d.]+) dB", printed)[0]) > 45
