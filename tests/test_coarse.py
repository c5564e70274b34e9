"""Layers averaged over blocks from their moments, against every pixel's share averaged afterwards."""

import pytest
import torch
from torch import Tensor

from torchdof.coarse import Coarse
from torchdof.frame import Frame, Sample
from torchdof.plan import Plan
from torchdof.pool import mean_of_blocks

NODES = (-3.0, -1.0, 0.0, 2.0, 5.0, 9.0)


def _samples(height: int, width: int, weighted: bool) -> list[Sample]:
    """A slope with steps and constant parts, some of it at nodes, and something behind a few of its pixels."""
    made = torch.Generator().manual_seed(4)
    y = torch.linspace(-3, 9, height, dtype=torch.float64)[:, None].expand(height, width).clone()
    y[20:50, 20:60], y[50:90, 100:130] = 2.0, 8.5
    y[70:80, 10:90] += torch.rand(10, 80, generator=made).double()
    light = torch.rand(2, 1, 3, height, width, generator=made).double()
    first = Sample(light[0], y.clamp(-3, 9)[None, None])
    if not weighted:
        return [first]
    some = (torch.rand(1, 1, height, width, generator=made) > 0.95).double()
    return [Sample(first.light, first.x, 1 - 0.25 * some), Sample(light[1], (first.x + 3).clamp(max=9), 0.25 * some)]


@pytest.mark.parametrize("scale", [2, 8])
@pytest.mark.parametrize("extend", [False, True], ids=["unknown outside", "extended"])
@pytest.mark.parametrize(("weighted", "with_room"), [(True, True), (False, True), (False, False)])
def test_blocks_are_means_of_what_their_pixels_scatter(
    scale: int, extend: bool, weighted: bool, with_room: bool
) -> None:
    half, samples, plan = 3, _samples(131, 150, weighted), Plan(NODES, 1 / 255)
    margin = 2 * scale * (half + 1)
    frame = Frame(iter(samples), margin, scale, tiled=True, extend=extend)
    layers = range(1, 5)
    coarse = Coarse(frame, scale, half, plan, layers, with_room)
    rows, columns = (n + 2 * half for n in coarse.size)
    for k in reversed(layers):
        coarse._fill(NODES, k)
        terms = torch.cat(frame.whole(scale * (half + 1)).terms(NODES, k, with_room), 1)
        wanted: Tensor = mean_of_blocks(terms, scale)[0]
        assert wanted.shape == (len(coarse.plane), rows, columns)
        torch.testing.assert_close(coarse.plane[:, :rows, :columns], wanted, rtol=0, atol=1e-12)


def test_the_brightest_light_stays_finite() -> None:
    light = torch.full((1, 3, 64, 64), 3e38)
    x = torch.linspace(0, 2, 64).expand(1, 1, 64, 64)
    frame = Frame([Sample(light, x)], 16, 4, tiled=True, extend=True)
    coarse = Coarse(frame, 4, 1, Plan((0.0, 2.0, 9.0), 1 / 255), range(3), with_room=True)
    coarse._fill((0.0, 2.0, 9.0), 1)
    assert bool(torch.isfinite(coarse.plane).all()) and float(coarse.plane.max()) > 2e38
