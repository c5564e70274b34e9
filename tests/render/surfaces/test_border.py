"""Light outside the frame: that of the border, smoothed along it."""

import pytest
import torch
from torch.testing import assert_close

from torchdof import blur_by_coc
from torchdof.render.surfaces.border import continued


def test_continued_light_is_half_the_nearest_pixel_and_half_a_mean_along_the_border() -> None:
    light = torch.rand(2, 3, 20, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    one = torch.ones_like(light[:, :1])
    out = continued([light], one, one, (0, 0, 0, 9), 9, one, one)[0]
    assert out.shape == (2, 3, 29, 40)
    assert_close(out[..., :20, :], light)
    for distance in (1, 2, 4, 8):
        mean = light[..., -1, 20 - 4 * distance if distance < 5 else 0 : 20 + 4 * distance + 1].mean(-1)
        expected = (light[..., -1, 20] + mean) / 2
        assert_close(out[..., 19 + distance, 20], expected)
    assert_close(out[..., 19 + 3, :], (out[..., 19 + 2, :] + out[..., 19 + 4, :]) / 2)


def test_a_texture_is_averaged_outside_the_frame(engine: str) -> None:
    """Repeating the border's pixels would extend the stripes instead."""
    image = torch.tensor([0.2, 0.8, 0.8, 0.2]).repeat(24).expand(1, 3, 96, 96).clone()
    out = blur_by_coc(image, torch.full((1, 1, 96, 96), 9.0))
    assert float((out[..., 0, 30:66] - 0.5).abs().max()) < 0.02


@pytest.mark.parametrize("occlusion", [True, False])
def test_a_subject_cut_by_the_border_gives_no_light_to_its_background(engine: str, occlusion: bool) -> None:
    """A subject in focus in front of a constant background, which is blurred by 21 px."""
    image, coc = torch.full((1, 3, 120, 200), 60 / 255), torch.full((1, 1, 120, 200), 21.0)
    image[..., 50:, 80:130], coc[..., 50:, 80:130] = 220 / 255, 0.0
    out = blur_by_coc(image, coc, occlusion=occlusion)
    assert float((out[..., :78] - 60 / 255).abs().max()) < 1 / 255
    if occlusion:
        assert_close(out[..., 52:, 82:128], image[..., 52:, 82:128], atol=1 / 255, rtol=0.0)
