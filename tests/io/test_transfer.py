import kornia
import pytest
import torch

from torchdof.io.transfer import decode, encode


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_curves_equal_those_of_kornia_bit_for_bit(dtype: torch.dtype) -> None:
    values = torch.linspace(0, 1, 3 * 5000, dtype=dtype).reshape(1, 3, 50, 100)
    assert torch.equal(decode(values, "srgb", False, False), kornia.color.rgb_to_linear_rgb(values))
    assert torch.equal(encode(values, "srgb", False, False), kornia.color.linear_rgb_to_rgb(values))


def test_curves_are_odd_functions_with_finite_gradients_at_black() -> None:
    values = torch.linspace(0, 2, 100).reshape(1, 1, 10, 10)
    for curve in (decode, encode):
        assert torch.equal(curve(-values, "srgb", False, False), -curve(values, "srgb", False, False))
        dark = torch.tensor([0.0, -0.0, 1e-3, 0.5], dtype=torch.float64).reshape(1, 1, 1, 4).requires_grad_()
        curve(dark, "srgb", False, False).sum().backward()
        assert dark.grad is not None and bool(torch.isfinite(dark.grad).all())
