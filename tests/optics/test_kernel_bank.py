"""Kernels from templates equal those of the PSF, in both engines, at any size."""

import pytest
import torch

from torchdof import BlurTable, native
from torchdof.optics import psf
from torchdof.optics.kernel_bank import bank_of

TABLES = {
    "disc": BlurTable.disc(),
    "gaussian": BlurTable.gaussian(),
    "polygon": BlurTable.polygon(5, 11.0),
    "squeezed": BlurTable.polygon(3, 20.0, squeeze=1.6, rim=0.7),
    "wide": BlurTable.polygon(6, squeeze=0.6),
    "colours": BlurTable("disc", [-1.0, 1.0], {"radius": [[0.7, 1.0], [0.8, 1.1], [0.9, 1.2]]}),
    "sato_j15": BlurTable.load("sato_j15"),
    "lens": BlurTable.load("double_gauss_50mm_f2").replace(field=None),
    "blurred in focus": BlurTable("gaussian", [-0.02, 0.0, 0.02], {"sigma": [0.01, 0.001, 0.01]}, unit="fraction"),
}
ALL = pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
SMALL = torch.tensor([-5.1, -2.4, -0.7, -0.02, 0.0, 0.3, 1.0, 3.6], dtype=torch.float64)
LARGE = torch.tensor([-61.0, -25.3, 13.1, 17.5, 45.9], dtype=torch.float64)


def of_psf(table: BlurTable, coc_px: torch.Tensor) -> torch.Tensor:
    """Kernels from the PSF itself, in an image 400 pixels wide."""
    kernels = psf.pixel_kernels(table.family, table.params(coc_px, 400), aperture=table.aperture).transpose(0, 1)
    kernels = torch.where((coc_px >= 0)[:, None, None, None], kernels, kernels.flip(-2, -1))
    if table.is_sharp_in_focus:
        return kernels
    fade = (4.0 * coc_px.square()[:, None] / table.moved_in_focus(400)).clamp(max=1.0)[:, :, None, None]
    centre = torch.zeros_like(kernels)
    centre[..., kernels.shape[-1] // 2, kernels.shape[-1] // 2] = 1.0
    return torch.lerp(centre, kernels, fade)


def moments(kernel: torch.Tensor) -> torch.Tensor:
    """Centroid and second moments along both axes of kernels ``[n, C, k, k]``: ``[4, n, C]``."""
    step = torch.arange(kernel.shape[-1], dtype=kernel.dtype) - kernel.shape[-1] // 2
    down, across = kernel.sum(-1), kernel.sum(-2)
    return torch.stack([(line * step**power).sum(-1) for line in (down, across) for power in (1, 2)])


@ALL
def test_small_kernels_are_those_of_the_psf(table: BlurTable) -> None:
    coc = SMALL / (1.0 if table.family in ("disc", "softm", "radial") else 3.0)  # other families have tails
    kernels, expected = bank_of(table).kernels(coc, 400), of_psf(table, coc)
    assert kernels.shape == expected.shape
    # between two nodes the bank interpolates the profile, the table the parameters
    torch.testing.assert_close(kernels, expected, rtol=0.0, atol=1e-6 if len(table.coc) < 3 else 1e-3)


@ALL
def test_large_kernels_have_the_moments_of_the_psf(table: BlurTable) -> None:
    kernels, expected = bank_of(table).kernels(LARGE, 400), of_psf(table, LARGE)
    torch.testing.assert_close(kernels.sum((-2, -1)), torch.ones(len(LARGE), table.channels, dtype=torch.float64))
    assert bool((kernels >= 0).all())
    torch.testing.assert_close(moments(kernels), moments(expected), rtol=2e-3, atol=5e-3)
    error = (kernels - expected).square().sum((-2, -1)).sqrt() / expected.square().sum((-2, -1)).sqrt()
    assert float(error.max()) < (0.15 if table is TABLES["lens"] else 0.04)  # a template has smaller cells than a pixel


@ALL
@pytest.mark.parametrize("longest", [None, 9])
def test_both_engines_make_the_same_kernels(table: BlurTable, longest: int | None) -> None:
    if not native.chosen():
        pytest.skip("the compiled engine is not built")
    bank, scale = bank_of(table), [1.0, 2.0, 4.0, 1.0, 16.0]
    for coc, scales in ((SMALL, []), (LARGE, scale)):
        spots = bank.spots(coc, 400, scales, [longest] * len(coc) if longest else [])
        plain = bank.of_spots(spots)
        made = native.kernels(*spots[:-1], squeeze=bank.squeeze, is_round=table.is_round, is_even=bank.is_even)
        for kernel, other, half in zip(made, plain, spots.half, strict=True):
            spare = other.shape[-1] // 2 - half
            expected = other[:, spare : other.shape[-1] - spare, spare : other.shape[-1] - spare].float()
            torch.testing.assert_close(kernel, expected, rtol=0.0, atol=3e-6 * float(expected.max()))


@ALL
def test_kernels_change_continuously_with_the_radius(table: BlurTable) -> None:
    # with the radii at which templates have cells of a pixel: 16 and 32 px for a disc
    coc = torch.cat([torch.arange(2.0, 17.5, 0.5), torch.arange(18.0, 41.0, 2.0)]).double()
    step = torch.tensor(1e-6, dtype=torch.float64)
    for radius in coc.split(5):
        one, other = (bank_of(table).kernels(radius * factor, 400) for factor in (1.0, 1.0 + step))
        spare = (other.shape[-1] - one.shape[-1]) // 2
        assert float((torch.nn.functional.pad(one, (spare,) * 4) - other).abs().sum((-2, -1)).max()) < 1e-3


def test_a_kernel_far_larger_than_the_frame_is_constant() -> None:
    (kernel,) = bank_of(TABLES["disc"]).kernels(torch.tensor([5000.0], dtype=torch.float64), 400, longest=[30])
    assert kernel.shape == (1, 59, 59)
    torch.testing.assert_close(kernel, torch.full_like(kernel, 1.0 / (torch.pi * 5000.0**2)), rtol=2e-3, atol=0.0)
