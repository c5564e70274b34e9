"""Mark of tests that need a PyTorch which compiles, exports and transforms the renderer."""

import pytest

from torchdof.tensors import TRACEABLE

TRACED = pytest.mark.skipif(not TRACEABLE, reason="needs PyTorch 2.13")
