"""Where the layers of a scene are laid: at its planes, and close together where it meets the frame's border."""

import pytest
import torch

import torchdof
from torchdof.render import layer_cocs
from torchdof.render.layer_weights import from_blur_axis
from torchdof.render.plan import Plan

WIDE = 2.7 / 255  # a tolerance for which layers lie 2 px apart where these planes are


def coc_at(x: torch.Tensor) -> torch.Tensor:
    """Coc of places on the blur axis."""
    return torch.tensor([from_blur_axis(place) for place in x.flatten().tolist()]).reshape(x.shape)


def test_planes_are_found_where_they_lie_and_slopes_are_none() -> None:
    x = torch.linspace(-10, 10, 256).repeat(1, 1, 256, 1)  # a slope: no place holds more than others
    assert layer_cocs.plane_nodes(coc_at(x), WIDE) == []
    x[..., 20:60] = 3.3
    x[..., 100:180] = -7.77
    assert layer_cocs.plane_nodes(coc_at(x), WIDE) == pytest.approx([-7.77, 3.3])  # the larger one first


def test_a_plane_that_is_no_flatter_than_what_is_around_it_is_none() -> None:
    x = torch.full((1, 1, 64, 64), 5.0)
    x[..., ::2, :] += torch.linspace(-0.9, 0.9, 64)  # half of the pixels, spread over the spacing
    assert layer_cocs.plane_nodes(coc_at(x), WIDE) == pytest.approx([5.0])
    assert layer_cocs.plane_nodes(coc_at(x[..., 1:, :][..., ::2, :]), WIDE) == pytest.approx([5.0])
    assert layer_cocs.plane_nodes(coc_at(x[..., ::2, :]), WIDE) == []


def test_a_plane_at_a_layer_is_exact() -> None:
    image = torch.rand(1, 3, 96, 128, generator=torch.Generator().manual_seed(0))
    coc = torch.zeros(1, 1, 96, 128)
    coc[..., 8:88, 20:60] = 5.123  # between layers, were they laid by the spacing alone
    coc[..., 8:88, 80:110] = -8.7
    coc[..., 40:48, 112:120], coc[..., 40:48, 2:10] = 11.0, -11.0
    plan = Plan.of_scene(coc, 1 / 255)
    assert {5.123, -8.7} <= {round(c, 3) for c in plan.coc_px}
    exact = torchdof.blur_by_coc(image, coc, tolerance=0)
    loose = torchdof.blur_by_coc(image, coc, tolerance=1 / 255)
    torch.testing.assert_close(loose[..., 30:50, 10:110], exact[..., 30:50, 10:110], rtol=0, atol=4 / 255)


@pytest.mark.parametrize("times", [1, 3], ids=["12 px", "36 px"])
def test_layers_lie_close_where_a_slope_leaves_the_frame(times: int) -> None:
    """What is beyond the frame is as blurred as the border: layers far from these blurs would show."""
    height, width = 240, 320
    y = torch.linspace(0, 1, height)[:, None].expand(height, width)
    coc = torch.where(torch.arange(width) < 20, -13.0, -12.0 * y**2)[None, None] * times  # a post is nearer yet
    image = 0.5 + 0.4 * torch.sin(y * 90)[None, None].expand(1, 3, -1, -1)
    exact = torchdof.blur_by_coc(image, coc, tolerance=0)
    error = (torchdof.blur_by_coc(image, coc, tolerance=1 / 255) - exact)[..., 40:]
    assert float(error[..., -12:, :].abs().max()) < 4 / 255


def test_places_at_the_border_are_those_of_many_pixels() -> None:
    x = torch.zeros(1, 1, 100, 100)
    x[..., -1, :] = 6.0  # a quarter of the border
    x[..., 0, :10] = -9.0  # too few
    assert layer_cocs.border_nodes(coc_at(x)) == pytest.approx([0.0, 6.0])
    x[..., -1, :] = torch.linspace(-40, 40, 100)
    assert layer_cocs.border_nodes(coc_at(x)) == pytest.approx([0.0])


@pytest.mark.parametrize("x", [-300.0, -20.5, -3.3, 0.0, 7.0, 20.0, 1e4])
def test_finest_distances_count_there_and_back(x: float) -> None:
    steps = float(layer_cocs._in_finest(torch.tensor(x).double()))
    assert layer_cocs._from_finest(steps) == pytest.approx(x)
