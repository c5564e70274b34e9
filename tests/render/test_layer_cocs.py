"""Radii of the layers of a scene: dense at the radii of the frame's border, and continuous in the scene."""

import pytest
import torch

import torchdof
from torchdof.render.plan import Plan


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
