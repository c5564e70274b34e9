"""Interpolation by shifted maps is exact for a plane: a map that is linear in the pixel coordinates."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchdof.export.shifting import samples


def plane(rows: int, columns: int, step: float) -> Tensor:
    """Distance of each sample from the centre, in pixels, down and right: ``[1, 2, rows, columns]``."""
    y, x = ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * step for n in (rows, columns))
    return torch.stack(torch.meshgrid(y, x, indexing="ij"))[None]


@pytest.mark.parametrize("step", [2, 4, 8])
@pytest.mark.parametrize("halves", [(0, 0), (0, 1), (1, 1)])
def test_the_mean_of_the_samples_around_each_pixel_is_linear_interpolation(halves: tuple[int, int], step: int) -> None:
    size = 16
    count = size // step + 2
    down, right = (torch.tensor(float(half), dtype=torch.float64) for half in halves)
    around, shares = samples(plane(count, count, step), (size, size), step, (down, right))
    assert_close(shares.sum(0), torch.ones(size, size, dtype=torch.float64))
    mean = (around * shares).sum(2)
    assert_close(mean, plane(size, size, 1.0) + torch.stack([down, right])[:, None, None] / 2)
