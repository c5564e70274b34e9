"""Cat's eyes towards the corners of the frame."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.optics.aperture import Aperture
from torchdof.render.vignetting import passed

CUT = Aperture(vignetting=0.4)
TABLE = BlurTable.disc().with_aperture(CUT)


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def cats_eye(coc_px: float, y: float, x: float, half: int, front: float, rear: float) -> Tensor:
    """Share of each pixel that lies in the disc and in those of the rims, by 15 x 15 points."""
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
def test_the_kernel_of_a_place_is_what_disc_and_rim_leave_open(
    coc_px: float, y: float, x: float, vignetting: Any
) -> None:
    aperture = Aperture(vignetting=vignetting)
    kernel = BlurTable.disc().kernels(number(coc_px)[None], 100)[0]
    cut = passed(kernel, aperture, number(coc_px), number(y), number(x))
    expected = cats_eye(coc_px, y, x, kernel.shape[-1] // 2, *aperture.rims)
    assert float(cut.sum()) == pytest.approx(1.0, abs=1e-12)
    assert (cut[0] - expected).abs().sum() < 0.04  # of the light, within a pixel of the rim's border
    assert (kernel[0] - expected).abs().sum() > 0.25
    # behind focus the front rim cuts off the side away from the middle of the frame, the rear rim the other
    front, rear = aperture.rims
    step = torch.arange(kernel.shape[-1], dtype=torch.float64) - kernel.shape[-1] // 2
    outwards = float((cut[0] * (step[:, None] * y + step * x)).sum())
    assert (
        outwards * coc_px == pytest.approx(0.0, abs=1e-6) if front == rear else outwards * coc_px * (rear - front) > 0
    )


def test_in_the_middle_of_the_frame_and_near_focus_nothing_is_cut() -> None:
    for coc in (-9.0, 0.02, 3.0):
        kernel = BlurTable.gaussian().kernels(number(coc)[None], 100)[0]
        assert_close(passed(kernel, CUT, number(coc), number(0.0), number(0.0)), kernel, rtol=1e-12, atol=0)
    kernel = BlurTable.disc().kernels(number(0.3)[None], 100)[0]
    assert_close(passed(kernel, CUT, number(0.3), number(0.6), number(0.8)), kernel, rtol=1e-12, atol=0)


def test_blur_across_the_frame_is_each_pixels_own_within_a_hundredth() -> None:
    height, width, coc_px = 120, 200, 5.0
    image = torch.rand(1, 1, height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    coc = torch.full_like(image, coc_px)
    picture = blur_by_coc(image, coc, table=TABLE, occlusion=False)
    kernel = BlurTable.disc().kernels(coc[0, 0, 0, :1], width)[0]
    half, diagonal = kernel.shape[-1] // 2, 0.5 * math.hypot(height, width)
    for row, column in ((6, 9), (61, 97), (17, 190), (110, 24), (64, 160)):
        y, x = (number((p + 0.5 - n / 2) / diagonal) for p, n in ((row, height), (column, width)))
        own = passed(kernel, CUT, number(coc_px), y, x)[0]
        around = image[0, 0, row - half : row + half + 1, column - half : column + half + 1]
        expected = float((around * own.flip(-2, -1)).sum())
        assert float(picture[0, 0, row, column]) == pytest.approx(expected, abs=0.01)


def test_even_light_stays_even_and_coarse_layers_agree_with_fine_ones() -> None:
    coc = torch.linspace(-12.0, 14.0, 90).expand(1, 1, 60, 90).contiguous()
    even = blur_by_coc(torch.full((1, 3, 60, 90), 0.3), coc, table=TABLE)
    assert_close(even, torch.full_like(even, 0.3), rtol=0, atol=1e-5)
    image = torch.rand(1, 1, 45, 68, generator=torch.Generator().manual_seed(4))
    image = torch.nn.functional.interpolate(image, (180, 270), mode="bicubic").clamp_min(0.0)
    coc = torch.linspace(-12.0, 14.0, 270).expand(1, 1, 180, 270).contiguous()
    draft, exact = (blur_by_coc(image, coc, table=TABLE, tolerance=t) for t in (1 / 255, 0))
    assert float((draft - exact).square().mean().sqrt()) < 1 / 255


def test_a_picture_with_cats_eyes_has_gradients() -> None:
    image = torch.rand(1, 1, 8, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    coc = torch.linspace(-2.2, 3.1, 12, dtype=torch.float64).expand(1, 1, 8, 12).clone()

    def picture(image: Tensor, coc: Tensor) -> Tensor:
        return blur_by_coc(image, coc, table=TABLE, tolerance=0)

    given = (image.requires_grad_(), coc.requires_grad_())
    assert torch.autograd.gradcheck(picture, given, atol=1e-5, fast_mode=True)


def test_what_has_one_kernel_a_layer_refuses_cats_eyes() -> None:
    image, coc = torch.rand(1, 3, 8, 12), torch.full((1, 1, 8, 12), 2.0)
    with pytest.raises(ValueError, match="method='fold' has one kernel a blur radius"):
        blur_by_coc(image, coc, table=TABLE, method="fold")
    with pytest.raises(ValueError, match="take a table without vignetting"):
        blur_by_coc(image, coc, table=TABLE, attention=(4.0, 4.0, 2.0))
    dof = DepthOfField(Camera(), TABLE, check=False, depth_edges="as given")
    with pytest.raises(Exception, match="take a table without vignetting"):
        torch.export.export(dof, (image, torch.ones(1, 1, 8, 12)), strict=False)
    with pytest.raises(ValueError, match="vignetting must be a number from 0 to 1, got 1.5"):
        BlurTable.polygon(5, vignetting=1.5)


def test_vignetting_is_kept_in_the_table(tmp_path: Any) -> None:
    table = BlurTable.polygon(5, vignetting=(0.3, 0.1))
    table.save(tmp_path / "lens.json")
    loaded = BlurTable.load(tmp_path / "lens.json")
    assert loaded.aperture is not None and loaded.aperture.rims == (0.3, 0.1)
    assert loaded.fingerprint() == table.fingerprint() != BlurTable.polygon(5).fingerprint()
