import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "examples" / "benchmarks" / "per_pixel.py"


def test_it_prints_a_row_for_each_radius() -> None:
    run = subprocess.run([sys.executable, SCRIPT, "--side", "12"], capture_output=True, text=True, check=True)
    rows = [line.split() for line in run.stdout.splitlines()]
    assert rows[0] == ["radius", "splat", "step", "layered"] and [row[0] for row in rows[1:]] == ["4", "8", "16"]
