"""Interpolation by shifted maps: what lies on a plane is found again at every pixel."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchdof.export.shifting import samples


def plane(rows: int, columns: int, step: float) -> Tensor:
    """Place of each sample from the middle, in pixels, down and right: ``[1, 2, rows, columns]``."""
    y, x = ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * step for n in (rows, columns))
    return torch.stack(torch.meshgrid(y, x, indexing="ij"))[None]


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("size", [(6, 8), (7, 9), (5, 16)])
def test_the_mean_of_the_samples_around_each_pixel_is_linear_interpolation(size: tuple[int, int], ratio: float) -> None:
    rows, columns = (n if ratio == 1.0 else int(n // ratio) + 2 * (ratio > 1.0) for n in size)
    around = list(samples(plane(rows, columns, ratio), size, ratio))
    shares = sum((share for _, share in around), torch.zeros(1, dtype=torch.float64))
    assert_close(shares, torch.ones_like(shares))
    mean = sum((sample * share for sample, share in around), torch.zeros(1, dtype=torch.float64))
    assert_close(mean, plane(*size, 1.0))
