"""A barely blurred surface is closed: no light from far behind passes through a step in its depth."""

import pytest
import torch
from torch import Tensor

from torchdof import blur_by_coc

BRIGHT, DARK, REACH = 1.0, 0.01, 60.0
LEAK = 0.1 * DARK  # light from behind that may pass; without stand-ins 1.7 to 9.7 times as much as the surface has


def before_a_bright_wall(coc_px: Tensor) -> Tensor:
    """Renders a dark surface ``[H, W]`` whose left 30 columns show a bright wall far behind it."""
    coc = coc_px.clone()[None, None]
    coc[..., :30] = REACH
    light = torch.where(coc == REACH, BRIGHT, DARK).expand(1, 3, -1, -1).contiguous()
    return blur_by_coc(light, coc, depth_edges="as given")[0, 0]


@pytest.mark.parametrize("engine", ["compiled", "torch"])
@pytest.mark.parametrize(("nearer", "farther"), [(-1.9, -1.6), (-1.7, -1.3), (-1.0, -0.5), (-0.9, -0.6), (-0.5, 0.0)])
def test_nothing_shines_through_a_step_of_a_surface(
    nearer: float, farther: float, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if engine == "torch":
        monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    coc = torch.full((48, 140), nearer)
    plane = before_a_bright_wall(coc)
    coc[:, 66:] = farther
    stepped = before_a_bright_wall(coc)
    assert float((stepped - plane)[8:-8, 40:].max()) < LEAK


@pytest.mark.parametrize("level", [0.1, 0.24, 0.5])
def test_a_map_of_few_levels_has_no_contour_lines(level: float) -> None:
    slope = ((torch.arange(160.0) - 60.0) / 20.0 - 2.0).expand(48, -1)
    lines = before_a_bright_wall((slope / level).round() * level) - before_a_bright_wall(slope)
    assert float(lines[8:-8, 46:].abs().max()) < 3.0 * LEAK  # 35 times without stand-ins, at half a pixel


def test_a_surface_behind_it_is_still_seen() -> None:
    """The wall shows in the blurred edge of the dark surface."""
    edge = before_a_bright_wall(torch.full((48, 140), -1.0))[24, 26:34]
    assert float(edge[3]) > 0.5 * BRIGHT
    assert float(edge[4]) > 0.05 * BRIGHT
