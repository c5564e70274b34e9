"""Tolerances of comparisons by dtype. The absolute ones are for values around 1."""

from typing import Any

import torch

TOLERANCES: dict[torch.dtype, dict[str, Any]] = {
    torch.float64: {"rtol": 1e-10, "atol": 1e-12},
    torch.float32: {"rtol": 1e-5, "atol": 1e-6},
    torch.bfloat16: {"rtol": 2**-8, "atol": 1e-6},
    torch.float16: {"rtol": 2**-11, "atol": 1e-6},
}
"""Half precision holds rounded results of float32 arithmetic: half a unit in the last place."""
