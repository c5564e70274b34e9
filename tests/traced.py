"""What a PyTorch that cannot compile, export or transform the renderer does not run."""

import pytest

from torchdof.tensors import TRACEABLE

TRACED = pytest.mark.skipif(not TRACEABLE, reason="needs PyTorch 2.13")
