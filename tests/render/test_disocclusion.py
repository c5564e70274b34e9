"""Disocclusion: filled surfaces behind blurred ones, and the background behind all layers."""

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.testing import assert_close

from tests.scenes import BLUE, mixed_edge
from tests.traced import TRACED
from torchdof.render.composite import over
from torchdof.render.convolution import convolve
from torchdof.render.disocclusion import behind_pixels, surfaces_of_image
from torchdof.render.highlights import threshold
from torchdof.render.plan import LayerKernel
from torchdof.render.surfaces import Surface, pad_to_frame


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
    image, coc = mixed_edge(1.0, near_px=-12.0)
    image = image.clone()
    image[..., 20:28, 32:36] = 500.0
    _, (other, _, weight), behind = surfaces(image, coc, levels=5)
    assert weight is not None and float(weight[0, 0, 24, 26]) > 0
    most = float(threshold(image).max())
    assert most < 10.0, "the scene tests nothing"
    assert float(other[0, :, 24, :32].max()) <= most
    assert float(behind[0, :, 24, 20:28].max()) <= most


def test_the_background_behind_two_blurred_surfaces_is_the_farthest_one_around() -> None:
    green = torch.tensor([0.1, 0.6, 0.1])
    image, coc = mixed_edge(1.0, near_px=-18.0)
    image, coc = image.clone(), coc.clone()
    image[..., 20:28], coc[..., 20:28] = green[:, None, None], -12.0  # red in front of green, and a blue wall
    image[..., 28:], coc[..., 28:] = BLUE[:, None, None], 0.0
    _, (_, _, weight), behind = surfaces(image, coc, levels=6)
    assert weight is not None and float(weight[0, 0, 24, 16]) > 0
    assert torch.allclose(behind[0, :, 24, 16], BLUE, atol=0.02)  # the wall, not the surface in between


def sloping(behind_px: float) -> tuple[Tensor, Tensor]:
    """A red slope of 30 to 20 px in front of the focus, a green surface at ``behind_px``, a blue wall 60 px behind."""
    image, coc = (torch.empty(1, channels, 48, 96) for channels in (3, 1))
    coc[..., :40] = torch.linspace(-30.0, -20.0, 40)
    coc[..., 40:44], coc[..., 44:] = behind_px, 60.0
    image[..., :40] = torch.tensor([0.7, 0.1, 0.1])[:, None, None]
    image[..., 40:44], image[..., 44:] = torch.tensor([0.1, 0.6, 0.1])[:, None, None], BLUE[:, None, None]
    return image, coc


def test_the_surface_behind_a_slope_is_no_part_of_the_slope() -> None:
    """A mean of the slope in front of the focus and of the wall behind it would be in focus: a sharp speck."""
    image, coc = sloping(60.0)
    _, (other, other_coc, weight), _ = surfaces(image, coc, levels=6)
    assert weight is not None
    hidden = (weight > 0) & (coc < 0)
    assert int(hidden.sum()) > 500
    assert float(other_coc[hidden].min()) > 40.0
    assert float(other[:, :1][hidden].max()) < 0.25, "little of the slope's red"


def test_a_surface_between_a_slope_and_a_wall_lies_behind_the_slope() -> None:
    image, coc = sloping(-1.0)
    _, (other, other_coc, weight), _ = surfaces(image, coc, levels=6)
    assert weight is not None and float(weight[0, 0, 24, 38:40].min()) > 0
    assert torch.allclose(other_coc[0, 0, 24, 39], torch.tensor(-1.0), atol=6.0)
    assert float(other[0, 1, 24, 39]) > 0.4, "its green"


@pytest.mark.parametrize("size", [(20, 30), (150, 170), (128, 64)])
def test_a_hole_in_all_layers_shows_the_background(size: tuple[int, int]) -> None:
    cells = torch.rand(1, 3, size[0] // 4 + 3, size[1] // 4 + 2, generator=torch.Generator().manual_seed(2))
    behind = functional.interpolate(cells, scale_factor=4.0, mode="bilinear")  # same centre as the image
    top, left = ((length - part) // 2 for length, part in zip(behind.shape[-2:], size, strict=True))
    behind = behind[..., top : top + size[0], left : left + size[1]]
    coc = torch.zeros(1, 1, *size)
    blurs = [
        LayerKernel(torch.ones(1, 1, 1), 1),
        LayerKernel(torch.zeros(1, 1, 1), 1),
    ]  # the farther layer leaves a hole
    for cover in (0.0, 0.75, 1.0):
        light = torch.full((1, 3, *size), 0.2)
        surfaces = [
            Surface(light, coc, torch.full_like(coc, cover)),
            Surface(light, coc + 9.0, torch.full_like(coc, 1 - cover)),
        ]
        frame = pad_to_frame(surfaces, behind_pixels(cells, size), [(0.0, 1.0)], 0, 1, occlusion=True)
        shown = over(frame, blurs, convolve)
        torch.testing.assert_close(shown, 0.2 * cover + (1 - cover) * behind, rtol=0, atol=1e-6)


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
