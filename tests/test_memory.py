"""Memory of the process: what it holds, and whether it keeps what it frees."""

import math
import subprocess
import sys

import pytest
import torch

from torchdof.memory import keep_freed, peak_mb, reset_peak

# prints whether the C library keeps memory, and the page faults of using 48 MiB again, least of a few times
_AGAIN = """
import resource, sys, torch
from torchdof.memory import keep_freed
kept, faults = sys.argv[1] == "keep" and keep_freed(), []
for _ in range(8):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(3 * 2**22)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(kept, min(faults))
"""


def faults_again(mode: str) -> tuple[bool, int]:
    run = subprocess.run([sys.executable, "-c", _AGAIN, mode], capture_output=True, text=True, check=True)
    kept, faults = run.stdout.split()
    return kept == "True", int(faults)


@pytest.mark.skipif(sys.platform != "linux", reason="counts page faults as Linux does")
def test_what_is_kept_is_used_again_without_page_faults() -> None:
    kept, faults = faults_again("keep")
    if not kept:
        pytest.skip("this C library has no mallopt")
    _, given_back = faults_again("leave")
    assert given_back > 1000, "the C library keeps so large a block by itself, so the test shows nothing"
    assert faults < given_back / 100


def test_a_system_without_mallopt_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ctypes.CDLL", lambda name: object())
    assert not keep_freed()


@pytest.mark.skipif(math.isnan(peak_mb()), reason="this system does not tell the memory of a process")
def test_the_peak_is_of_what_was_held_since_the_reset() -> None:
    held = reset_peak()
    block = torch.ones(2**24)
    assert peak_mb() - held == pytest.approx(64.0, abs=8.0)
    del block
    assert peak_mb() - held == pytest.approx(64.0, abs=8.0), "the peak stays"
    assert reset_peak() < held + 8.0
