"""Surfaces in layers: how much of what is behind them counts."""

import pytest
import torch

from torchdof.render.surfaces import Placed, _stacked


@pytest.mark.parametrize(("share", "known"), [(0.0, 0.0), (0.01, 0.0894), (0.03, 0.2546), (0.06, 0.06), (1.0, 1.0)])
def test_a_surface_of_which_a_hair_lies_in_a_layer_is_in_front_of_it(share: float, known: float) -> None:
    """From 6 % on the layer counts as known there, but for what has gone on in front; below, less and less."""
    one = torch.ones(1, 1, 1, 1)
    light, weight, behind = _stacked([Placed(one, one, None)], [(one * share, torch.zeros_like(one))])
    assert float(weight + behind) == pytest.approx(known, abs=1e-4)
    assert float(light) <= float(weight) + 1e-6 and float(weight) <= share + 1e-6
