"""Kernels at a coarser resolution: averaging, convolution and interpolation together approximate the full kernel."""

import functools

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import BlurTable
from torchdof.optics.kernel_bank import bank_of
from torchdof.render.layers import downsampling
from torchdof.render.layers.downsampling import downsampled, upsampled

TABLES = {"disc": BlurTable.disc(), "gaussian": BlurTable.gaussian()}


@functools.cache
def photograph(size: int = 256) -> Tensor:
    """Noise with the spectrum of photographs, amplitude 1/f: ``[1, 1, size, size]``."""
    frequency = torch.fft.fftfreq(size, dtype=torch.float64)
    distance = (frequency[:, None] ** 2 + frequency**2).sqrt()
    white = torch.randn(size, size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return torch.fft.ifft2(torch.fft.fft2(white) / distance.clamp_min(0.5 / size)).real[None, None]


@functools.cache
def coarse(scale: int) -> Tensor:
    """The photograph at a fraction of its resolution."""
    return downsampled(photograph(), scale)


@functools.cache
def spread(image: Tensor, table: BlurTable, coc_px: float) -> Tensor:
    """Circular convolution with the kernel of a coc."""
    kernel = table.kernels(torch.tensor([coc_px], dtype=torch.float64), 256)[0, 0]
    half, size = kernel.shape[-1] // 2, image.shape[-1]
    area = functional.pad(kernel, (0, size - 2 * half - 1) * 2).roll((-half, -half), (0, 1))
    return torch.fft.irfft2(torch.fft.rfft2(image) * torch.fft.rfft2(area), s=(size, size))


def error(table: BlurTable, coc_px: float, scale: int, factor: float | None = None) -> float:
    """RMS difference between the coarse chain, with the kernel scaled by ``factor``, and the full kernel."""
    image = photograph()
    factor = downsampling.shrink(bank_of(table), coc_px, 256.0, scale) if factor is None else factor
    fine = upsampled(spread(coarse(scale), table, coc_px / scale * factor), scale)
    inner = (..., slice(64, -64), slice(64, -64))  # interpolation does not wrap around
    return float((fine - spread(image, table, coc_px))[inner].square().mean().sqrt())


@pytest.mark.parametrize("sigma_per_coc", [0.1, 0.5, 1.0])
@pytest.mark.parametrize(("scale", "radius_px"), [(2, 7.2), (4, 18.0), (8, 36.0)])
def test_a_gaussian_is_as_exact_at_a_coarser_resolution_as_its_finest_disc(
    sigma_per_coc: float, scale: int, radius_px: float
) -> None:
    table = BlurTable.gaussian(sigma_per_coc)
    ratio = error(table, radius_px / table.finest_px(1.0, 256.0), scale) / error(TABLES["disc"], radius_px, scale)
    assert 0.7 < ratio < 1.25


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("coc_px", [1.8, 2.3, 3.6, 4.6, 7.1])
@pytest.mark.parametrize("name", TABLES)
def test_the_scale_of_the_coarse_kernel_is_near_the_best(name: str, coc_px: float, scale: int) -> None:
    table, meant = TABLES[name], coc_px * scale
    best = min(error(table, meant, scale, 0.5 + 0.04 * step) for step in range(14))
    assert error(table, meant, scale) < 1.1 * best
    assert error(table, meant, scale, 1.0) > 1.05 * best or coc_px > 3.0, "the test cannot detect a wrong scale"
