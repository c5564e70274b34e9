"""Weights of surfaces in a layer, and of the surfaces behind it."""

import pytest
import torch

from torchdof.render.surfaces import HIDDEN_WEIGHT, PaddedSurface, _mixed, _stacked


@pytest.mark.parametrize(("share", "known"), [(0.0, 0.0), (0.01, 0.0894), (0.03, 0.2546), (0.06, 0.06), (1.0, 1.0)])
def test_a_surface_with_a_tiny_share_in_a_layer_counts_as_in_front_of_it(share: float, known: float) -> None:
    """From a share of 6 % the layer counts as known, minus the part in front of it; below, gradually less."""
    one = torch.ones(1, 1, 1, 1)
    light, weight, behind = _stacked([PaddedSurface(one, one, None)], [(one * share, torch.zeros_like(one))])
    assert float(weight + behind) == pytest.approx(known, abs=1e-4)
    assert float(light) <= float(weight) + 1e-6 and float(weight) <= share + 1e-6


def mixed(share: float, nearer: float) -> list[float]:
    """Light, weight and weight behind of a pixel of two surfaces, in a layer that contains the farther one.

    Args:
        share: Coverage of the farther surface, which has light 1; the nearer one is dark.
        nearer: Share of the nearer surface that is in the layer.
    """
    one, none = torch.ones(1, 1, 1, 1), torch.zeros(1, 1, 1, 1)
    surfaces = [PaddedSurface(none, -one, one - share), PaddedSurface(one, one, one * share)]
    return [float(t) for t in _mixed(surfaces, [(one * nearer, none), (one, none)])]


@pytest.mark.parametrize(
    ("share", "nearer", "expected"),
    [
        (0.4, 0.0, [1.0, 1.0, 0.0]),  # the farther surface continues behind the nearer one
        *((0.4, nearer, [0.4, 0.4 + 0.6 * nearer, 0.0]) for nearer in (0.06, 0.5, 1.0)),  # both in the layer
        (HIDDEN_WEIGHT, 0.0, [HIDDEN_WEIGHT, HIDDEN_WEIGHT, 0.0]),  # hidden surfaces keep their small weight
        (HIDDEN_WEIGHT + 0.05, 0.0, [0.053 + 0.947 * 0.5, 0.053 + 0.947 * 0.5, 0.0]),  # small coverage approaches it
    ],
)
def test_surfaces_of_a_mixed_pixel_have_their_coverage_and_the_farther_one_continues_behind_the_nearer_one(
    share: float, nearer: float, expected: list[float]
) -> None:
    assert mixed(share, nearer) == pytest.approx(expected, abs=1e-6)
