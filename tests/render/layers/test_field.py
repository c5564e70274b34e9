"""Kernels that depend on the place in the frame."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.scenes import slope, smooth
from torchdof import BlurTable, blur_by_coc
from torchdof.io.transfer import encode
from torchdof.optics.aperture import Aperture
from torchdof.optics.field import Field
from torchdof.optics.kernel_bank import bank_of
from torchdof.optics.placed_kernels import layer_mask, placed
from torchdof.reference.metrics import psnr
from torchdof.render.layers.field import BLOCK

CUT = Aperture(vignetting=0.4)
TABLE, STRONG = (BlurTable.disc().replace(aperture=Aperture(vignetting=share)) for share in (0.4, 0.8))


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def passed(table: BlurTable, coc_px: float, y: float, x: float, size: tuple[int, int] = (100, 100)) -> Tensor:
    """Kernel ``[C, k, k]`` at a place given in half diagonals from the middle of the frame."""
    lens = table if table.field is None else bank_of(table)
    kernel = lens.kernels(number(coc_px)[None], size[1])
    if not table.depends_on_place:
        return kernel[0]
    mask = layer_mask(table, coc_px, 1, size)
    return placed(kernel, [(mask, number(1.0))], number(y)[None], number(x)[None])[0]


def of_pixel(table: BlurTable, coc_px: float, row: int, column: int, size: tuple[int, int]) -> Tensor:
    """Kernel ``[C, k, k]`` of a pixel."""
    y, x = ((p + 0.5 - n / 2) / (0.5 * math.hypot(*size)) for p, n in zip((row, column), size, strict=True))
    return passed(table, coc_px, y, x, size)


def cats_eye(coc_px: float, y: float, x: float, half: int, front: float, rear: float) -> Tensor:
    """Kernel of a cat's eye: intersection of the disc and the rims, sampled at 15 x 15 points a pixel."""
    fine = 15
    place = (torch.arange((2 * half + 1) * fine, dtype=torch.float64) + 0.5) / fine - half - 0.5
    down, across = place[:, None], place[None, :]
    lit = torch.hypot(down, across) <= abs(coc_px)
    for shift in (2.0 * front * coc_px, -2.0 * rear * coc_px):
        lit &= torch.hypot(down + shift * y, across + shift * x) <= abs(coc_px)
    share = lit.double().reshape(2 * half + 1, fine, 2 * half + 1, fine).mean((1, 3))
    return share / share.sum()


@pytest.mark.parametrize("coc_px", [-15.0, 15.0])
@pytest.mark.parametrize(("y", "x", "vignetting"), [(0.6, 0.8, 0.4), (-0.5, 0.1, (0.7, 0.0)), (0.6, -0.8, (0.1, 0.4))])
def test_the_kernel_of_a_place_is_that_of_disc_and_rims(coc_px: float, y: float, x: float, vignetting: Any) -> None:
    aperture = Aperture(vignetting=vignetting)
    kernel = passed(BlurTable.disc(), coc_px, y, x)
    cut = passed(BlurTable.disc().replace(aperture=aperture), coc_px, y, x)
    expected = cats_eye(coc_px, y, x, kernel.shape[-1] // 2, *aperture.rims)
    assert float(cut.sum()) == pytest.approx(1.0, abs=1e-12)
    assert (cut[0] - expected).abs().sum() < 0.04  # share of the light; errors are at the border of a rim
    assert (kernel[0] - expected).abs().sum() > 0.25
    # behind focus the front rim cuts off the side away from the middle of the frame, the rear rim the other
    front, rear = aperture.rims
    step = torch.arange(kernel.shape[-1], dtype=torch.float64) - kernel.shape[-1] // 2
    outwards = coc_px * float((cut[0] * (step[:, None] * y + step * x)).sum())
    assert outwards == pytest.approx(0.0, abs=1e-6) if front == rear else outwards * (rear - front) > 0


def lopsided(channels: int = 1) -> BlurTable:
    """A lens with coma: off the axis, spots trail outwards and are wider across than along."""
    coc, radius = torch.tensor([-0.5, -0.2, 0.0, 0.3, 0.6]), torch.tensor([0.0, 8.0, 18.0])
    size = (coc[:, None].abs() + 0.01) * (1.0 - 0.02 * radius)
    box = torch.stack([0.02 * radius * size, size, (1.0 + 0.03 * radius) * size], -1)
    u, v = torch.linspace(-1, 1, 96)[:, None], torch.linspace(0, 1, 48)
    inside = (torch.hypot(u, v) < 1.0) * (1.0 + 0.05 * radius[:, None, None] * (u + 1.0))
    light = torch.stack([inside * (1.0 + 0.3 * c * u) for c in range(channels)])[:, None].expand(-1, 5, -1, -1, -1)
    params = {"radius": coc.abs().expand(channels, -1)}
    return BlurTable("disc", coc, params, unit="mm", sensor_width_mm=36.0, field=Field(coc, radius, box, light))


def test_kernels_are_not_cut_in_the_middle_of_the_frame_or_near_focus() -> None:
    for coc in (-9.0, 0.02, 3.0):
        uncut = passed(BlurTable.gaussian(), coc, 0.6, 0.8)
        assert_close(passed(BlurTable.gaussian().replace(aperture=CUT), coc, 0.0, 0.0), uncut, rtol=1e-12, atol=0)
    assert_close(passed(TABLE, 0.3, 0.6, 0.8), passed(BlurTable.disc(), 0.3, 0.6, 0.8), rtol=1e-12, atol=0)
    for coc in (0.0, 0.02):  # spots in focus are one pixel
        kernel = passed(lopsided(), coc, 0.4, 0.7, (240, 360))[0]
        assert float(kernel[len(kernel) // 2, len(kernel) // 2]) > 1.0 - 1e-9


@pytest.mark.parametrize(("y", "x", "coc_px"), [(0.0, 9.0, 6.0), (-6.0, 8.0, 6.0), (5.0, -5.0, 6.0), (-6.0, 8.0, 1.5)])
def test_a_spot_has_the_moments_of_its_field_turned_by_the_azimuth(y: float, x: float, coc_px: float) -> None:
    table, width = lopsided(), 360
    per_mm = width / 36.0
    half_diagonal = 0.5 * math.hypot(width, 240) / per_mm
    kernel = passed(table, coc_px, y / half_diagonal, x / half_diagonal, (240, width))[0]
    step = torch.arange(len(kernel), dtype=torch.float64) - len(kernel) // 2
    distance = math.hypot(y, x)
    u, v = (step[:, None] * y + step * x) / distance, (step[:, None] * x - step * y) / distance
    assert table.field is not None
    box, light = table.field.spots(coc_px / per_mm, number(distance)[None])
    along = (box[0, 0] + box[0, 1] * ((torch.arange(96, dtype=torch.float64) + 0.5) / 48 - 1.0)) * per_mm
    across = (torch.arange(48, dtype=torch.float64) + 0.5) / 48 * box[0, 2] * per_mm
    of_u, of_v = light[0, 0].sum(-1), light[0, 0].sum(0)
    mean = float((of_u * along).sum())
    assert float(kernel.sum()) == pytest.approx(1.0, abs=1e-12)
    assert float((kernel * u).sum()) == pytest.approx(mean, abs=0.03)
    assert float((kernel * v).sum()) == pytest.approx(0.0, abs=0.03)
    cell = across[1] - across[0], along[1] - along[0]
    spread = (of_v * across**2).sum() + cell[0] ** 2 / 12, (of_u * (along - mean) ** 2).sum() + cell[1] ** 2 / 12
    assert float((kernel * v**2).sum()) == pytest.approx(float(spread[0]), rel=0.02)
    assert float((kernel * (u - mean) ** 2).sum()) == pytest.approx(float(spread[1]), rel=0.02)


@pytest.mark.parametrize("colours", [1, 3])
def test_fold_scatters_each_pixel_with_the_kernel_of_its_place(colours: int) -> None:
    height, width, coc_px, table = 48, 72, -3.3, lopsided(colours)
    image = torch.zeros(1, 3, height, width, dtype=torch.float64)
    row, column = 13, 55
    image[0, :, row, column] = torch.tensor([1.0, 2.0, 3.0])
    coc = torch.full((1, 1, height, width), coc_px, dtype=torch.float64)
    picture = blur_by_coc(image, coc, table=table, method="fold", occlusion=False, normalize=False)[0]
    kernel = of_pixel(table, coc_px, row, column, (height, width))
    half = kernel.shape[-1] // 2
    around = picture[:, row - half : row + half + 1, column - half : column + half + 1]
    assert_close(around, kernel * image[0, :, row, column, None, None], rtol=0, atol=1e-12)
    assert float(picture.sum()) == pytest.approx(6.0, abs=1e-12)


@pytest.mark.parametrize(("table", "occlusion"), [(STRONG, True), (lopsided(3), False)])
def test_layers_agree_with_fold_within_the_error_of_blocks(table: BlurTable, occlusion: bool, engine: str) -> None:
    image, coc = smooth(3, 64, 96), slope(-4.0, 2.0, 64, 96)
    options: dict[str, Any] = {"method": "fold", "occlusion": occlusion}
    literal, plain = (blur_by_coc(image, coc, table=t, **options) for t in (table, BlurTable.disc()))
    assert psnr(blur_by_coc(image, coc, table=table, occlusion=occlusion), literal) > 44.0
    assert psnr(plain, literal) < 32.0


def test_there_is_no_seam_between_blocks() -> None:
    y, x = torch.meshgrid(torch.arange(240.0), torch.arange(720.0), indexing="ij")
    image = ((x + 0.3 * y) % 61.0 - 12.5).clamp(0.0, 1.0)[None, None] * 0.8 + 0.1  # slanted bars
    picture = blur_by_coc(image, torch.full_like(image, -8.0), table=STRONG)
    shown = encode(picture, "srgb", has_alpha=False, straight=False)
    third = shown[..., 3:] - 3.0 * shown[..., 2:-1] + 3.0 * shown[..., 1:-2] - shown[..., :-3]  # twice a step
    at_border = (torch.arange(third.shape[-1]) + 2) % BLOCK[1] == 0
    seams, elsewhere = (float(third[..., part].square().mean()) for part in (at_border, ~at_border))
    assert 0.5 * math.sqrt(max(seams - elsewhere, 0.0)) < 1.5 / 255


SQUEEZED = BlurTable.polygon(5, 10.0, squeeze=1.5, vignetting=(0.6, 0.2))
MORE_SAMPLES = [(SQUEEZED, (1.0, 3.0, -4.0)), (lopsided(), (0.6447397, 0.9064583, 1.6714067))]


@pytest.mark.parametrize(("table", "radii"), MORE_SAMPLES)
def test_where_shares_get_one_more_sample_the_picture_does_not_jump(table: BlurTable, radii: Any, engine: str) -> None:
    image = torch.rand(1, 1, 48, 360, generator=torch.Generator().manual_seed(3)) + 0.05
    for radius in radii:
        cocs = (torch.full_like(image, radius * share) for share in (1 - 2e-6, 1 + 2e-6))
        assert_close(*(blur_by_coc(image, coc, table=table) for coc in cocs), rtol=1e-4, atol=0)


@pytest.mark.parametrize("table", [TABLE, lopsided()], ids=["cat's eyes", "a field"])
def test_a_highlight_has_the_kernel_of_its_radius_and_place(table: BlurTable) -> None:
    height, width, row, column, coc_px = 100, 160, 24, 131, 7.0
    image = torch.full((1, 1, height, width), 0.1, dtype=torch.float64)
    coc = torch.full_like(image, coc_px)
    coc[..., :20] = 3.0  # rays need at least two layers
    dark = blur_by_coc(image, coc, table=table, tolerance=0)
    image[..., row, column] = 200.0
    spot = (blur_by_coc(image, coc, table=table, tolerance=0) - dark)[0, 0] / 199.9
    expected = of_pixel(table, coc_px, row, column, (height, width))[0]
    half = len(expected) // 2
    spot = spot[row - half : row + half + 1, column - half : column + half + 1]
    assert float((spot - expected).abs().sum()) < 0.01  # share of the light
