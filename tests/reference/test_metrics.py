import math

import kornia
import pytest
import torch

from tests.refused import refuses
from torchdof.reference import metrics

IMAGE = torch.zeros(1, 3, 8, 8)
BAD = IMAGE.clone()
BAD[0, 0, 2, 3] = math.nan


def test_display_is_kornias_srgb_curve_and_clips() -> None:
    light = torch.linspace(0, 1, 999, dtype=torch.float64).reshape(1, 3, 9, 37)
    torch.testing.assert_close(metrics.display(light), kornia.color.linear_rgb_to_rgb(light), rtol=1e-9, atol=1e-9)
    assert metrics.display(torch.tensor([-3.0, 60.0])).tolist() == [0.0, pytest.approx(1.0, abs=1e-6)]


def test_psnr_of_a_known_error_counts_only_the_masked_pixels() -> None:
    truth = torch.rand(1, 3, 20, 30, dtype=torch.float64)
    assert metrics.psnr(truth + 0.01, truth) == pytest.approx(40.0, abs=1e-9)
    assert metrics.psnr(truth, truth) == math.inf
    truth = torch.zeros(2, 3, 8, 8)
    image = truth.clone()
    image[..., :4] = 0.1
    mask = torch.zeros(1, 1, 8, 8, dtype=torch.bool)
    mask[..., :4] = True
    assert metrics.psnr(image, truth, mask) == pytest.approx(20.0, abs=1e-5)
    assert metrics.psnr(image, truth) == pytest.approx(20.0 + 10 * math.log10(2), abs=1e-5)
    assert metrics.psnr(BAD, IMAGE, torch.isfinite(BAD).all(1, keepdim=True)) == math.inf


def test_ssim_is_one_for_equal_images_and_falls_with_noise() -> None:
    truth = torch.rand(1, 3, 32, 32)
    assert metrics.ssim(truth, truth) == pytest.approx(1.0, abs=1e-9)
    little, much = (metrics.ssim((truth + s * torch.randn_like(truth)).clamp(0, 1), truth) for s in (0.02, 0.2))
    assert 1 > little > 0.97 > much


test_errors_name_the_argument = refuses(
    (lambda: metrics.display(3.0), "linear must be a tensor of linear light.*got 3.0"),  # type: ignore[arg-type]
    (lambda: metrics.psnr(IMAGE[0], IMAGE[0]), r"image and truth must be \[B, C, H, W\] .*got \[3, 8, 8\]"),
    (lambda: metrics.psnr(BAD, IMAGE), "psnr needs finite pixels.* got 63 of 64 finite"),
    (lambda: metrics.psnr(IMAGE, IMAGE, IMAGE[:, :1]), "mask must be bool .* torch.float32"),
    (lambda: metrics.psnr(IMAGE, IMAGE, IMAGE[0] > 0), r"mask must be bool \[B or 1, 1, 8, 8\], got .*\[3, 8, 8\]"),
    (lambda: metrics.psnr(IMAGE, IMAGE, IMAGE[:, :1] > 1), "at least one in the mask, got 0 of 0"),
    (lambda: metrics.ssim(IMAGE[..., :5], IMAGE[..., :5]), "SSIM needs at least 6 pixels a side"),
    (lambda: metrics.ssim(IMAGE, IMAGE[..., :7]), r"same shape and device, got \[1, 3, 8, 8\] on cpu and \[1, 3, 8"),
)
