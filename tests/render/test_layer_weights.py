import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from torchdof import BlurTable
from torchdof.render.layer_weights import blur_axis, from_blur_axis, ramps, weights_at_or_behind

NODES = (-4.0, -1.5, 0.0, 0.5, 2.0)


def weights(x: Tensor) -> Tensor:
    """Weight of each pixel in each layer: `[layers, ...]`."""
    behind = weights_at_or_behind(x.reshape(1, 1, -1), ramps([NODES], x)).reshape(-1, *x.shape)
    return behind[:-1] - behind[1:]


def test_blur_axis_is_the_square_of_the_coc_near_focus_and_the_coc_far_from_it() -> None:
    coc = torch.tensor([-3.0, -0.01, 0.0, 0.009, 0.5, 100.0], dtype=torch.float64)
    expected = torch.tensor([-9.0 / 3.5 + 2e-4, 0.0, 0.0, 0.0, 0.25 - 2e-4, 1e4 / 100.5 - 2e-4], dtype=torch.float64)
    assert_close(blur_axis(coc), expected, rtol=0.0, atol=1e-12)
    assert float(blur_axis(torch.tensor(0.05))) == pytest.approx(0.0025 / 0.55 - 2e-4, rel=1e-4)


@given(st.floats(-3.0, 3.0) | st.floats(-100.0, 100.0))
def test_the_blur_axis_is_continuous_and_increasing_and_inverted_by_from_blur_axis(coc: float) -> None:
    place, beside = blur_axis(torch.tensor([coc, coc + 1e-4], dtype=torch.float64)).tolist()
    assert 0.0 <= beside - place <= 1.2e-4  # nowhere steeper than 9 / 8
    assert from_blur_axis(place) == pytest.approx(coc if place != 0 else 0.0, abs=1e-11)


def test_kernels_that_count_as_in_focus_move_less_than_2e_4_of_the_light() -> None:
    edge = from_blur_axis(1e-12)
    assert edge == pytest.approx(0.01, rel=0.02)
    for table in (BlurTable.disc(), BlurTable.gaussian(), BlurTable.load("sato_j15")):
        kernel = table.kernels(torch.tensor([edge], dtype=torch.float64), 500)[0, 0]
        assert 1.0 - float(kernel.max()) < 2e-4


def test_weights_are_linear_between_neighbouring_layers() -> None:
    assert_close(weights(torch.tensor([*NODES, -9.0, 9.0])), torch.eye(len(NODES))[:, [0, 1, 2, 3, 4, 0, -1]])
    pixels = weights(torch.tensor([-0.75, 0.8, 1.625])).T
    assert_close(
        pixels, torch.tensor([[0.0, 0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.0, 0.8, 0.2], [0.0, 0.0, 0.0, 0.25, 0.75]])
    )


@given(st.floats(-1e6, 1e6))
def test_weights_of_a_pixel_are_in_0_to_1_and_sum_to_1(x: float) -> None:
    parts = weights(torch.tensor(x, dtype=torch.float64))
    assert (parts >= 0).all() and (parts <= 1).all() and int((parts > 0).sum()) <= 2
    assert_close(float(parts.sum()), 1.0, rtol=0.0, atol=1e-15)
