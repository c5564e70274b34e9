"""Disocclusion: filled surfaces behind blurred ones, and the background behind all layers."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad
from torch.testing import assert_close

from tests.scenes import BLUE, mixed_edge, overshoots, slope
from tests.traced import TRACED
from torchdof import blur_by_coc
from torchdof.reference.scenes import Plane, camera_of, plane_scene, waves
from torchdof.render.highlights import threshold
from torchdof.render.surfaces.disocclusion import behind_pixels, surfaces_of_image
from torchdof.render.surfaces.frame import Surface


def surfaces(image: Tensor, coc: Tensor, levels: int) -> tuple[Surface, Surface, Tensor]:
    """The visible and the hidden surface of each pixel, and the background behind both."""
    (own, other), behind = surfaces_of_image(image, coc, None, threshold(image), [levels])
    return own, other, behind_pixels(behind, (image.shape[-2], image.shape[-1]))


def test_hidden_surfaces_have_the_colour_and_depth_of_their_surroundings_within_the_blur() -> None:
    image, coc = mixed_edge(1.0, near_px=-12.0)
    (own, _, _), (other, other_coc, weight), behind = surfaces(image, coc, levels=5)
    assert weight is not None
    reached = (weight[0, 0, 24] > 0).nonzero()[:, 0]
    assert 12 <= 32 - int(reached.min()) <= 32 and int(reached.max()) == 31  # the wall hides nothing
    assert torch.equal(own, image)
    assert torch.allclose(other[0, :, 24, 20:31], BLUE[:, None].expand(3, 11), atol=1e-5)
    assert float(other_coc[0, 0, 24, 20:31].abs().max()) < 1e-5
    assert torch.allclose(behind[0, :, 24, 20:28], BLUE[:, None].expand(3, 8), atol=1e-5)


def test_a_highlight_is_not_copied_into_the_hidden_surface_beside_it() -> None:
    image, coc = (t.clone() for t in mixed_edge(1.0, near_px=-12.0))
    image[..., 20:28, 32:36] = 500.0
    _, (other, _, weight), behind = surfaces(image, coc, levels=5)
    assert weight is not None and float(weight[0, 0, 24, 26]) > 0
    most = float(threshold(image).max())
    assert max(float(other[0, :, 24, :32].max()), float(behind[0, :, 24, 20:28].max())) <= most < 10.0


def test_the_background_behind_two_blurred_surfaces_is_the_farthest_one_around() -> None:
    green = torch.tensor([0.1, 0.6, 0.1])
    image, coc = (t.clone() for t in mixed_edge(1.0, near_px=-18.0))
    image[..., 20:28], coc[..., 20:28] = green[:, None, None], -12.0  # red in front of green, and a blue wall
    image[..., 28:], coc[..., 28:] = BLUE[:, None, None], 0.0
    _, (_, _, weight), behind = surfaces(image, coc, levels=6)
    assert weight is not None and float(weight[0, 0, 24, 16]) > 0
    assert torch.allclose(behind[0, :, 24, 16], BLUE, atol=0.02)  # the wall, not the surface in between


def test_what_lies_behind_the_next_surface_is_not_the_background_of_a_foreground_beside_it() -> None:
    """The coarsest level reads some of the wall, 40 px from the foreground, but hardly trusts it."""
    coc = torch.full((1, 1, 96, 160), -17.0)
    coc[..., 64:104], coc[..., 104:] = -11.0, 9.0
    *_, behind = surfaces(torch.where(coc > 0, 1.0, 0.1).expand(1, 3, -1, -1), coc, levels=6)
    assert float(behind[0, :, 48, :60].max()) < 0.12


@pytest.mark.parametrize(
    ("wall_m", "wall_light", "strip_m", "strip_light", "half_px", "aperture_radius_m"),
    [
        pytest.param(4.0, (0.6, 0.3, 0.4), 1.4, 0.2, 5.3, 0.06, id="textured"),  # 0.05 without the rule small_shares
        pytest.param(5.0, (0.6, 0.6, 0.8), 2.6, 0.012, 9.3, 0.03, id="barely blurred"),  # 0.14 without it
    ],
)
def test_a_background_has_no_specks_behind_the_edge_of_a_foreground(
    wall_m: float,
    wall_light: tuple[float, ...],
    strip_m: float,
    strip_light: float,
    half_px: float,
    aperture_radius_m: float,
    engine: str,
) -> None:
    """A pixel of the edge shows little of the wall, or hardly anything: its light measures that of the wall badly."""

    def wall(x: Tensor, _: Tensor) -> Tensor:
        return torch.tensor(wall_light, dtype=x.dtype)[:, None, None].expand(3, *x.shape)

    def strip(x: Tensor, y: Tensor) -> Tensor:
        return (0.94 * (x - 48.0) + 0.34 * (y - 32.0)).abs() < half_px

    camera = camera_of(400.0, 96, aperture_radius_m, focus_m=4.0)
    front = Plane(strip_m, waves(0, (strip_light,) * 3, contrast=0.9, shortest_px=4.0), strip)
    scene = plane_scene([Plane(wall_m, wall), front], camera, (64, 96), samples=512)
    off = (blur_by_coc(scene.image, scene.coc_px) - scene.truth).abs()
    assert float(off[..., 16:-16, 16:-16].max()) < 0.025


def test_gaps_in_a_sloping_foreground_show_no_specks(engine: str) -> None:
    """Nothing is in focus, so the picture is smooth; with means of a slope and a wall as hidden samples it is not."""
    height, width = 160, 240
    is_gap = (torch.arange(width) % 60 >= 44).expand(1, 1, height, width)
    coc = torch.where(is_gap, 20.0, slope(-24.0, -8.0, width, height).mT)
    light = torch.where(is_gap, 0.6, 0.06)
    picture = blur_by_coc(light, coc)
    assert roughness(picture) < 0.01  # 0.095 without the rules one_side and own_slope


@pytest.mark.parametrize("ends_px", [(-40.0, -5.0), (-20.0, -5.0), (-60.0, -30.0)])
def test_a_slope_in_front_of_a_wall_is_not_its_own_background(ends_px: tuple[float, float], engine: str) -> None:
    """At its blurred edge the wall shows as if it were known."""
    coc = slope(*ends_px, 64, 260)
    is_wall = torch.arange(260) < 40
    light, coc = torch.where(is_wall, 1.0, 0.05).expand_as(coc), torch.where(is_wall, 0.0, coc)
    known = blur_by_coc(light, coc, background=torch.ones_like(light), background_coc_px=torch.zeros_like(coc))
    assert_close(blur_by_coc(light, coc), known, rtol=0, atol=0.006)  # 0.012 to 0.035 without the rule own_slope


def test_overshoots_of_depth_show_no_specks(engine: str) -> None:
    """Too near pixels of a dark foreground do not take the mean of this surface and a wall for a hidden surface."""
    assert roughness(blur_by_coc(*overshoots(), depth_edges="as given")) < 0.004  # 0.029 without the rule one_side


def roughness(picture: Tensor) -> float:
    """Largest difference of a pixel from the mean of 3 x 3 pixels around it."""
    means = avg_pool2d(pad(picture, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return float((picture - means).abs().max())


@TRACED
def test_gradients_of_a_compiled_graph_are_those_of_eager_code() -> None:
    image, coc = mixed_edge(0.7, near_px=-4.0, far_px=2.0)
    limit = threshold(image)

    def hidden_light(light: Tensor) -> Tensor:
        (own, other), behind = surfaces_of_image(light, coc, None, limit, [3])
        return torch.cat([own.light, other.light], 1).square().sum() + behind.square().sum()

    gradients = []
    for function in (hidden_light, torch.compile(hidden_light, backend="aot_eager", fullgraph=True)):
        light = image.clone().requires_grad_()
        function(light).backward()
        gradients.append(light.grad)
    assert gradients[0] is not None and float(gradients[0].abs().max()) > 0.0
    assert_close(*gradients)
