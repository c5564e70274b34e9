import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from tests import loops
from tests.kernels import kernel_of
from tests.tolerances import TOLERANCES
from torchdof.render.layers import scatter as literal
from torchdof.render.layers.convolution import convolve
from torchdof.render.layers.scatter import fold

Spread = Callable[[Tensor, Tensor], Tensor]
BOTH = pytest.mark.parametrize("scatter", [fold, convolve], ids=["fold", "convolve"])
REAL = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def bank(*radii: float, size: int | None = None, dtype: torch.dtype = torch.float64) -> Tensor:
    """One soft disc a channel: `[C, k, k]`."""
    radius = torch.tensor(radii, dtype=torch.float64)
    return kernel_of("softm", radius, radius / 10, b=0.7, m=2.0, size=size).to(dtype)


def test_fold_with_a_kernel_of_its_own_for_every_pixel_equals_a_plain_loop() -> None:
    light = torch.rand(2, 3, 5, 6, dtype=torch.float64)
    kernels = kernel_of("disc", torch.tensor([0.0, 1.3, 2.4]), size=5).unsqueeze(1)
    weights = torch.rand(2, 3, 5, 6, dtype=torch.float64)

    def blended(item: int, row: int, column: int) -> Tensor:
        return (weights[item, :, row, column, None, None, None] * kernels).sum(0)

    assert_close(fold(light, kernels, weights=weights), loops.scatter(light, blended), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_strips_agree_with_the_whole_frame_and_are_differentiable(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    light, kernels = torch.rand(1, 2, 13, 6, dtype=torch.float64), torch.rand(2, 1, 7, 7, dtype=torch.float64)
    weights = torch.rand(1, 2, 13, 6, dtype=torch.float64)
    calls = [lambda: fold(light, bank(1.2, 2.1, size=7)), lambda: fold(light, kernels, weights=weights)]
    whole = [call() for call in calls]
    strips = []

    def counted(*arguments: Any, fold: Any = functional.fold) -> Tensor:
        strips.append(arguments)
        return fold(*arguments)

    monkeypatch.setattr(functional, "fold", counted)
    monkeypatch.setattr(literal, "_COLUMN_BYTES", rows * light[:, :, 0].numel() * 49 * 8)
    assert_close([call() for call in calls], whole, rtol=1e-13, atol=1e-15)
    assert len(strips) == 2 * math.ceil(13 / rows)
    leaves = [t.clone().requires_grad_() for t in (light[..., :4], kernels[..., 2:5, 2:5], weights[..., :4])]
    assert torch.autograd.gradcheck(lambda a, k, w: fold(a, k, weights=w), leaves, fast_mode=True)


@BOTH
@REAL
@given(st.tuples(*(st.integers(1, most) for most in (2, 4, 9, 9))), st.floats(0.0, 12.0), st.booleans())
@example((1, 2, 20, 60), 25.0, False)  # convolved by FFT
def test_scatter_of_any_shape_and_stride_equals_a_direct_sum(
    scatter: Spread, dtype: torch.dtype, shape: tuple[int, int, int, int], radius: float, strided: bool
) -> None:
    light = torch.rand(shape, dtype=dtype)
    if strided:
        light = light.mT.contiguous(memory_format=torch.channels_last).mT[:, :, :: 2 if shape[2] > 1 else 1]
    kernels = bank(*(radius * (1 + 0.1 * c) for c in range(shape[1])), dtype=dtype)
    out = scatter(light, kernels)
    assert out.shape == light.shape
    wide = kernels.double()[:, None]  # symmetric
    direct = functional.conv2d(light.double().contiguous(), wide, padding=kernels.shape[-1] // 2, groups=shape[1])
    assert_close(out, direct.to(dtype), **TOLERANCES[dtype])


@pytest.mark.parametrize("items", [1, 2, 7])
@pytest.mark.parametrize("channels", [1, 3, 4, 5, 8, 9])
@pytest.mark.parametrize("rows", [1, 2, 13])
@pytest.mark.parametrize("radius", [1.6, 12.0])
def test_the_halo_is_used_for_any_kernel_and_channels(radius: float, rows: int, channels: int, items: int) -> None:
    half = math.ceil(radius) + 1
    bank = torch.stack([kernel_of("disc", radius + 0.2 * c, size=2 * half + 1) for c in range(channels)])
    light = torch.rand(items, channels, rows + 2 * half, 17 + 2 * half, dtype=torch.float64)
    for halo in (1, half):
        wanted = functional.conv2d(light, bank[:, None], padding=half - halo, groups=channels)
        assert_close(convolve(light, bank, halo), wanted, rtol=0, atol=1e-12)
