"""Weights of surfaces in a layer, and of the surfaces behind it."""

import pytest
import torch

from torchdof.render.surfaces import HIDDEN_WEIGHT, Placed, _mixed, _stacked


@pytest.mark.parametrize(("share", "known"), [(0.0, 0.0), (0.01, 0.0894), (0.03, 0.2546), (0.06, 0.06), (1.0, 1.0)])
def test_a_surface_with_a_tiny_share_in_a_layer_counts_as_in_front_of_it(share: float, known: float) -> None:
    """From a share of 6 % the layer counts as known, minus the part in front of it; below, gradually less."""
    one = torch.ones(1, 1, 1, 1)
    light, weight, behind = _stacked([Placed(one, one, None)], [(one * share, torch.zeros_like(one))])
    assert float(weight + behind) == pytest.approx(known, abs=1e-4)
    assert float(light) <= float(weight) + 1e-6 and float(weight) <= share + 1e-6


def mixed(share: float, nearer: float) -> list[float]:
    """Light, weight and weight behind of a pixel of two surfaces, in a layer that contains the farther one.

    Args:
        share: Coverage of the farther surface, which has light 1; the nearer one is dark.
        nearer: Share of the nearer surface that is in the layer.
    """
    one, none = torch.ones(1, 1, 1, 1), torch.zeros(1, 1, 1, 1)
    surfaces = [Placed(none, -one, one - share), Placed(one, one, one * share)]
    return [float(t) for t in _mixed(surfaces, [(one * nearer, none), (one, none)])]


def test_the_farther_surface_of_a_mixed_pixel_continues_behind_the_nearer_one() -> None:
    assert mixed(0.4, nearer=0.0) == pytest.approx([1.0, 1.0, 0.0])


@pytest.mark.parametrize("nearer", [0.06, 0.5, 1.0])
def test_both_surfaces_have_their_coverage_as_weight_if_the_nearer_one_is_in_the_layer(nearer: float) -> None:
    assert mixed(0.4, nearer) == pytest.approx([0.4, 0.4 + 0.6 * nearer, 0.0])


def test_hidden_surfaces_keep_their_small_weight_and_small_coverage_approaches_it() -> None:
    assert mixed(HIDDEN_WEIGHT, nearer=0.0) == pytest.approx([HIDDEN_WEIGHT, HIDDEN_WEIGHT, 0.0], abs=1e-6)
    assert mixed(HIDDEN_WEIGHT + 0.05, nearer=0.0)[1] == pytest.approx(0.053 + 0.947 * 0.5, abs=1e-6)
