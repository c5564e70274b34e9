import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as functional

from torchdof.optics.blur_table import BlurTable
from torchdof.reference import metrics
from torchdof.reference.lens_views import lens_views
from torchdof.reference.scenes import Scene, read_scenes, waves

DATA = Path(__file__).parents[1] / "data" / "scenes"


@pytest.fixture(scope="module")
def crops() -> dict[str, Scene]:
    return {scene.name: scene for scene in read_scenes(DATA)}


def shown_psnr(image: torch.Tensor, scene: Scene, mask: torch.Tensor | None = None) -> float:
    return metrics.psnr(metrics.display(image), metrics.display(scene.truth), mask)


def test_an_image_in_focus_is_returned_bit_exact() -> None:
    image = torch.rand(2, 3, 20, 30)
    image[0, :, 7, 9] = 300.0
    out, known = lens_views(image, torch.zeros(1, 1, 20, 30), views=16)
    assert torch.equal(out, image)
    assert torch.equal(known, torch.ones(2, 1, 20, 30))


@pytest.mark.parametrize("coc", [-6.0, 4.0])
def test_a_plane_is_the_convolution_with_a_disc(coc: float) -> None:
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(80.0), indexing="ij")
    image = waves(5, shortest_px=4.0)(x.double(), y.double()).float()[None]
    out = lens_views(image, torch.full((1, 1, 64, 80), coc), views=512).image
    kernel = BlurTable.disc().kernels(torch.tensor([coc]), width=80)[0].float()
    half = kernel.shape[-1] // 2
    blurred = functional.conv2d(image.transpose(0, 1), kernel[None].flip(-1, -2)).transpose(0, 1)
    inner = out[..., half:-half, half:-half]
    assert metrics.psnr(image[..., half:-half, half:-half], blurred) < 32
    assert metrics.psnr(inner, blurred) > 58


@pytest.mark.parametrize("radius", [-15.0, 11.25])
def test_a_highlight_is_a_disc_of_the_right_radius_and_energy(radius: float) -> None:
    image = torch.full((1, 1, 81, 81), 0.01)
    image[..., 40, 40] = 500.0
    disc = lens_views(image, torch.full((1, 1, 81, 81), radius), views=256).image - 0.01
    radius = abs(radius)
    y, x = torch.meshgrid(torch.arange(81.0) - 40, torch.arange(81.0) - 40, indexing="ij")
    level = 500.0 / (math.pi * radius**2)
    assert float(disc.sum()) == pytest.approx(500.0, rel=0.01)
    assert math.sqrt(float((disc > level / 2).sum()) / math.pi) == pytest.approx(radius, abs=0.5)
    r = torch.hypot(x, y)
    assert float(disc[0, 0][r > radius + 1.5].abs().max()) < 0.02 * level
    assert float(disc[0, 0][r < radius - 1.5].std()) < 0.2 * level


def test_it_matches_the_ray_traced_room_where_no_hidden_surface_appears(crops: dict[str, Scene]) -> None:
    scene = crops["room/1"]
    out, known = lens_views(scene.image, scene.coc_px)
    assert shown_psnr(scene.image, scene, scene.inner) < 28
    assert shown_psnr(out, scene, scene.inner & (known == 1)) > 47
    assert 0.3 < float((known[scene.inner] == 1).float().mean()) < 0.95


def test_a_steep_surface_has_no_gaps() -> None:
    coc = torch.linspace(0.0, 40.0, 60).expand(1, 1, 50, 60)  # grows by 0.7 px a pixel
    out, known = lens_views(torch.ones(1, 1, 50, 60), coc, views=64)
    torch.testing.assert_close(out, torch.ones_like(out))
    assert float(known[..., 15:35, 10:18].min()) == 1.0
    near = lens_views(torch.full((1, 1, 20, 20), 0.7), torch.full((1, 1, 20, 20), -8.0), views=64).image
    torch.testing.assert_close(near, torch.full_like(near, 0.7))  # not darker towards the frame
