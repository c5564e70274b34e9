import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchdof import BlurTable
from torchdof.render.layer_weights import blur_axis, from_blur_axis


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
