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


@pytest.mark.parametrize("transfer", ["bt709", "pq", "hlg", "gamma 1.8"])
def test_other_curves_are_inverse_to_each_other_increase_and_are_odd(transfer: str) -> None:
    values = torch.linspace(0, 1, 1001, dtype=torch.float64).reshape(1, 1, 1, -1)
    light = decode(values, transfer, False, False)
    torch.testing.assert_close(encode(light, transfer, False, False), values, rtol=0, atol=2e-4)
    assert bool((light.diff() > 0).all()) and torch.equal(decode(-values, transfer, False, False), -light)
    with pytest.raises(ValueError, match="transfer must be linear, srgb, bt709, pq, hlg, or gamma"):
        decode(values, "cineon", False, False)
