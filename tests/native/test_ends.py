"""Minimum and maximum of whole frames, computed by the compiled engine with its own threads."""

import math
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchdof import blur_by_coc, native

SIZES = (1, 7, 8, 9, 2**16 - 1, 2**16, 2**16 + 1, 3 * 2**16 + 5)


@pytest.mark.parametrize("size", SIZES)
def test_ends_are_minimum_and_maximum(size: int) -> None:
    values = torch.randn(size, generator=torch.Generator().manual_seed(size))
    assert native.ends(values) == (float(values.min()), float(values.max()))
    assert native.ends(values.repeat(2, 1).T) == (float(values.min()), float(values.max()))


@pytest.mark.parametrize("place", [0, 0.5, 1])
@pytest.mark.parametrize("size", SIZES)
def test_a_single_nan_or_infinity_is_found(size: int, place: float) -> None:
    values = torch.zeros(size)
    values[int(place * (size - 1))] = -math.inf
    assert native.ends(values)[0] == -math.inf
    values[int(place * (size - 1))] = math.nan
    assert all(map(math.isnan, native.ends(values)))


class LargeReads(TorchDispatchMode):
    """Records PyTorch's operators that read tensors large enough for several threads."""

    names: list[str]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        reads = not func.is_view and func is not torch.ops.aten.empty_like.default
        if reads and any(isinstance(a, torch.Tensor) and a.numel() >= 2**15 for a in args):
            self.names.append(str(func))
        return result


@pytest.mark.parametrize("occlusion", [True, False])
def test_no_operator_of_pytorch_reads_a_whole_frame(occlusion: bool) -> None:
    """PyTorch's threads would spin afterwards and compete with those of the engine."""
    image, coc = torch.rand(1, 3, 256, 256), torch.linspace(-6.0, 9.0, 256).expand(1, 1, 256, -1).contiguous()
    reads = LargeReads()
    reads.names = []
    with torch.inference_mode(), reads:
        blur_by_coc(image, coc, occlusion=occlusion)
    assert reads.names == []
