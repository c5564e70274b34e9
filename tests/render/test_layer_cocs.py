"""Radii of the layers of a scene: dense at the radii of the frame's border, and continuous in the scene."""

import numpy as np
import pytest
import torch

import torchdof
from torchdof.render import layer_cocs
from torchdof.render.layer_weights import from_blur_axis
from torchdof.render.plan import Plan


def coc_at(x: torch.Tensor) -> torch.Tensor:
    """Circles of confusion at places on the blur axis."""
    return torch.tensor([from_blur_axis(place) for place in x.flatten().tolist()]).reshape(x.shape)


@pytest.mark.parametrize("tolerance", [0.0, 1 / 255, 4 / 255])
def test_layers_move_smoothly_with_the_ends_of_a_scene(tolerance: float) -> None:
    """Where the number of layers changes, the new layer coincides with another one."""
    before: list[float] = []
    for far in torch.linspace(1.0, 9.0, 4001, dtype=torch.float64).tolist():
        plan = Plan.for_scene(
            torch.tensor([-2.2, far], dtype=torch.float64).reshape(1, 1, 1, 2), tolerance, adapt=False
        )
        nodes = list(plan.nodes)
        if before:  # by 2e-3 px
            farthest = max(min(abs(x - y) for y in before) for x in nodes)
            assert farthest < 0.01, f"at {far}: {before} to {nodes}"
        before = nodes
    assert len(before) > 4


@pytest.mark.parametrize("times", [1, 3], ids=["12 px", "36 px"])
def test_layers_are_dense_at_the_radii_of_the_border(times: int) -> None:
    """Surfaces continued outside the frame have the blur of the border; distant layers would be visible there."""
    height, width = 240, 320
    y = torch.linspace(0, 1, height)[:, None].expand(height, width)
    coc = torch.where(torch.arange(width) < 20, -13.0, -12.0 * y**2)[None, None] * times  # a post is nearer yet
    image = 0.5 + 0.4 * torch.sin(y * 90)[None, None].expand(1, 3, -1, -1)
    exact = torchdof.blur_by_coc(image, coc, tolerance=0)
    error = (torchdof.blur_by_coc(image, coc, tolerance=1 / 255) - exact)[..., 40:]
    assert float(error[..., -12:, :].abs().max()) < 4 / 255


def test_border_nodes_are_blurs_of_many_border_pixels() -> None:
    def nodes(x: torch.Tensor) -> list[float]:
        (spread,) = layer_cocs.spreads(coc_at(x))
        return layer_cocs.border_nodes(spread.border)

    x = torch.zeros(1, 1, 100, 100)
    x[..., -1, :] = 6.0  # a quarter of the border
    x[..., 0, :10] = -9.0  # too few
    assert nodes(x) == pytest.approx([0.0, 6.0])
    x[..., -1, :] = torch.linspace(-40, 40, 100)
    assert nodes(x) == pytest.approx([0.0])


@pytest.mark.parametrize("x", [-300.0, -20.5, -3.3, 0.0, 7.0, 20.0, 1e4])
def test_from_finest_inverts_in_finest(x: float) -> None:
    steps = float(layer_cocs._in_finest(np.array([x]))[0])
    assert layer_cocs._from_finest(steps) == pytest.approx(x)


@pytest.mark.parametrize(
    ("x", "times", "expected"),
    [
        (0.0, 1.0, 0.5),
        (0.0, 4.0, 0.758),
        (0.0, 6.0, 0.758),
        (0.0, 64.0, 2.0),
        (19.0, 0.0, 0.5),
        (40.0, 0.0, 1.0),
        (40.0, 1.0, 4.014),
    ],
)
def test_spacing_of_layers_equals_the_recorded_values(x: float, times: float, expected: float) -> None:
    """Near focus and far from it, at a tolerance of ``times``/255; speed and error depend on these numbers."""
    assert layer_cocs.spacing(x, times / 255) == pytest.approx(expected, abs=1e-3)
