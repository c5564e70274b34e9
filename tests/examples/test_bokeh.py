"""``examples/bokeh.py``: night lights through six lenses."""

import subprocess
import sys
from pathlib import Path

from torchdof.io.images import read_image

SCRIPT = Path(__file__).parents[2] / "examples" / "bokeh.py"


def test_the_sheet_shows_six_lenses(tmp_path: Path) -> None:
    sheet = tmp_path / "bokeh.png"
    run = subprocess.run(
        [sys.executable, SCRIPT, "--out", sheet, "--height", "96"],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    picture = read_image(sheet).pixels
    assert picture.shape == (1, 3, 96 + 34 + 8, 6 * (72 + 8) + 8)
    panels = [picture[..., 34:130, 8 + 80 * k : 80 + 80 * k] for k in range(6)]
    for k, panel in enumerate(panels):
        assert panel.std() > 0.03
        assert all(float((panel - other).abs().mean()) > 2e-3 for other in panels[:k])
