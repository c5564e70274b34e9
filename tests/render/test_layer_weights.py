import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from torchdof.render.layer_weights import blur_axis, eased, from_blur_axis, weight_at_or_behind

NODES = (-4.0, -1.5, 0.0, 0.5, 2.0)


def weights(x: Tensor) -> Tensor:
    """Weight of each pixel in each layer: `[layers, ...]`."""
    behind = torch.stack([weight_at_or_behind(x, NODES, k) for k in range(len(NODES) + 1)])
    return behind[:-1] - behind[1:]


def test_blur_axis_leaves_out_half_a_pixel_around_focus() -> None:
    coc = torch.tensor([-3.0, -0.5, -0.2, 0.0, 0.5, 0.75, 100.0])
    assert blur_axis(coc).tolist() == [-2.5, 0.0, 0.0, 0.0, 0.0, 0.25, 99.5]


@given(st.floats(-100.0, 100.0))
def test_blur_axis_and_back_is_the_coc_of_what_is_blurred_and_zero_of_what_is_not(coc: float) -> None:
    there = float(blur_axis(torch.tensor(coc, dtype=torch.float64)))
    back = from_blur_axis(there)
    assert back == pytest.approx(coc if there != 0 else 0.0, abs=1e-12)


def test_a_pixel_on_a_node_belongs_to_that_layer_alone() -> None:
    assert_close(weights(torch.tensor(NODES)), torch.eye(len(NODES)), rtol=0.0, atol=0.0)


def test_a_pixel_between_nodes_is_shared_linearly() -> None:
    pixels = weights(torch.tensor([-0.75, 0.8, 1.625])).T
    assert_close(pixels[0], torch.tensor([0.0, 0.5, 0.5, 0.0, 0.0]))
    assert_close(pixels[1], torch.tensor([0.0, 0.0, 0.0, 0.8, 0.2]))
    assert_close(pixels[2], torch.tensor([0.0, 0.0, 0.0, 0.25, 0.75]))


def test_pixels_beyond_the_outermost_nodes_belong_to_these() -> None:
    assert_close(weights(torch.tensor([-9.0, 9.0])), torch.eye(len(NODES))[:, [0, -1]])


@given(st.floats(-1e6, 1e6))
def test_the_shares_of_a_pixel_are_in_0_to_1_and_sum_to_1(x: float) -> None:
    parts = weights(torch.tensor(x, dtype=torch.float64))
    assert (parts >= 0).all() and (parts <= 1).all() and int((parts > 0).sum()) <= 2
    assert_close(float(parts.sum()), 1.0, rtol=0.0, atol=1e-15)


def test_an_eased_ramp_goes_from_0_to_1_and_leaves_0_slowly() -> None:
    ramp = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)
    steps = eased(ramp).diff()
    assert float(eased(ramp)[0]) == 0.0 and float(eased(ramp)[-1]) == 1.0
    assert float(steps[0]) < 1e-2 / 2000 and (steps > 0).all() and float(steps.diff().abs().max()) < 0.02 / 2000
    assert float((eased(ramp) - ramp).abs().max()) < 0.08


@pytest.mark.parametrize("k", range(len(NODES) + 1))
def test_shares_are_differentiable_between_nodes(k: int) -> None:
    x = torch.tensor([-3.0, -0.2, 0.3, 1.0, 5.0], dtype=torch.float64, requires_grad=True)
    if k in (0, len(NODES)):
        assert not weight_at_or_behind(x, NODES, k).requires_grad  # all or nothing, whatever x
    else:
        assert torch.autograd.gradcheck(lambda x: weight_at_or_behind(x, NODES, k), x)
