import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "examples" / "benchmarks" / "steps.py"


def test_it_prints_the_cost_of_a_step() -> None:
    run = subprocess.run(
        [sys.executable, SCRIPT, "--repeat", "1", "--row", "1"], capture_output=True, text=True, check=True
    )
    name, numbers = run.stdout[:38].strip(), [word for word in run.stdout[38:].split() if word not in ("ms", "MiB")]
    picture, step, ratio, *memory = map(float, numbers)
    assert name == "1 of 256 x 256, without occlusion"
    assert 0 < picture < step and ratio > 1
    assert 0 <= memory[0] <= memory[1] < 1000
