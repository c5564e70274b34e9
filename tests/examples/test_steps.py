import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "examples" / "benchmarks" / "steps.py"


def test_it_prints_the_cost_of_a_step() -> None:
    run = subprocess.run(
        [sys.executable, SCRIPT, "--repeat", "1", "--row", "1"], capture_output=True, text=True, check=True
    )
    name, numbers = run.stdout[:32].strip(), [word for word in run.stdout[32:].split() if word not in ("ms", "MiB")]
    batch, picture, step, ratio, _ = numbers
    assert name == "256 x 256, without occlusion" and batch == "1"
    assert 0 < float(picture) < float(step) and float(ratio) > 1
