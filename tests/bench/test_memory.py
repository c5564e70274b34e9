"""Memory of the process: what it holds."""

import math

import pytest
import torch

from torchdof.bench.memory import peak_mb, reset_peak


@pytest.mark.skipif(math.isnan(peak_mb()), reason="this system does not tell the memory of a process")
def test_the_peak_is_of_what_was_held_since_the_reset() -> None:
    held = reset_peak()
    block = torch.ones(2**24)
    assert peak_mb() - held == pytest.approx(64.0, abs=8.0)
    del block
    assert peak_mb() - held == pytest.approx(64.0, abs=8.0), "the peak stays"
    assert reset_peak() < held + 8.0
