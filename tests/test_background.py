"""Mixed pixels and hidden surfaces: the second surface of each pixel, and that the order of work does not show."""

import pytest
import torch
from torch import Tensor

from torchdof import background, pool
from torchdof.frame import Frame, Sample
from torchdof.highlights import ordinary

RED, BLUE = torch.tensor([0.7, 0.2, 0.1]), torch.tensor([0.1, 0.3, 0.8])


def edge(share: float, near_px: float = -12.0, far_px: float = 0.0) -> tuple[Tensor, Tensor]:
    """Red in front of blue; column 31 is red by a share but has the depth of red if that is at least a half."""
    red = (torch.arange(64) < 31).float()
    red[31] = share
    image = (red * RED[:, None] + (1 - red) * BLUE[:, None])[None, :, None].expand(1, 3, 48, 64)
    coc = torch.where(red >= 0.5, near_px, far_px).expand(1, 1, 48, 64)
    return image, coc


def random_scene() -> tuple[Tensor, Tensor]:
    made = torch.Generator().manual_seed(5)
    image, coc = torch.rand(1, 3, 150, 170, generator=made), torch.full((1, 1, 150, 170), 3.0)
    coc[..., 20:70, 30:90], coc[..., 90:140, 60:160] = -14.0, -6.0
    image[..., 30:40, 30:60] *= 40.0
    return image, coc


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6, 0.8])
def test_a_mixed_pixel_is_split_between_its_two_surfaces(share: float) -> None:
    image, coc = edge(share)
    own, other, other_coc, found = (t[0, ..., 24, 31] for t in background.split_mixed(image, coc))
    mine, theirs = (RED, BLUE) if share >= 0.5 else (BLUE, RED)
    assert float(found) == pytest.approx(1 - max(share, 1 - share), abs=0.03)
    assert torch.allclose(own, mine, atol=0.02) and torch.allclose(other, theirs, atol=0.02)
    assert float(other_coc) == (0.0 if share >= 0.5 else -12.0)


def test_no_light_is_lost_in_a_split() -> None:
    image, coc = random_scene()
    own, other, _, share = background.split_mixed(image, coc)
    assert torch.allclose((1 - share) * own + share * other, image, atol=1e-5)


def test_what_is_hidden_is_what_is_seen_around_as_far_as_the_blur_reaches() -> None:
    image, coc = edge(1.0, near_px=-12.0)
    own, _, other, other_coc, share, behind = background.surfaces(image, coc, None, ordinary(image), levels=5)
    reached = (share[0, 0, 24] > 0).nonzero()[:, 0]
    assert 12 <= 32 - int(reached.min()) <= 32 and int(reached.max()) == 31  # nothing is behind the wall
    assert torch.equal(own, image)
    assert torch.allclose(other[0, :, 24, 20:31], BLUE[:, None].expand(3, 11), atol=1e-5)
    assert float(other_coc[0, 0, 24, 20:31].abs().max()) < 1e-5
    assert torch.allclose(behind[0, :, 24 // 4, 5:7], BLUE[:, None].expand(3, 2), atol=1e-5)


def test_a_highlight_beside_what_is_hidden_is_not_hidden_there_too() -> None:
    image, coc = edge(1.0, near_px=-12.0)
    image = image.clone()
    image[..., 20:28, 32:36] = 500.0
    *_, other, _, share, behind = background.surfaces(image, coc, None, ordinary(image), levels=5)
    assert float(share[0, 0, 24, 26]) > 0
    most = float(ordinary(image).max())
    assert most < 10.0, "the scene tests nothing"
    assert float(other[0, :, 24, :32].max()) <= most
    assert float(behind[0, :, 24 // 4, 5:7].max()) <= most


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("levels", [2, 3, 5])
def test_bands_and_parts_change_nothing(known: bool, levels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    image, coc = random_scene()
    valid = None if known else (torch.rand(coc.shape, generator=torch.Generator().manual_seed(6)) > 0.1).float()
    whole = background.surfaces(image, coc, valid, ordinary(image, valid), levels)
    monkeypatch.setattr(pool, "_PIXELS", 1)
    monkeypatch.setattr(background, "_AT_ONCE", 100)
    monkeypatch.setattr(background, "_SPLIT_AT_ONCE", 77)
    for got, expected in zip(
        background.surfaces(image, coc, valid, ordinary(image, valid), levels), whole, strict=True
    ):
        assert torch.allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_behind_two_blurred_surfaces_lies_the_farthest_around() -> None:
    green = torch.tensor([0.1, 0.6, 0.1])
    image, coc = edge(1.0, near_px=-18.0)
    image, coc = image.clone(), coc.clone()
    image[..., 24:40], coc[..., 24:40] = green[:, None, None], -12.0  # red in front of green, and a blue wall
    image[..., 40:], coc[..., 40:] = BLUE[:, None, None], 0.0
    *_, share, behind = background.surfaces(image, coc, None, ordinary(image), levels=6)
    assert float(share[0, 0, 24, 20]) > 0
    assert torch.allclose(behind[0, :, 24 // 4, 20 // 4], BLUE, atol=0.02), "the wall, not the surface in between"


@pytest.mark.parametrize("size", [(20, 30), (150, 170), (128, 64)])
def test_a_hole_between_all_layers_shows_what_is_behind_them(size: tuple[int, int]) -> None:
    cells = torch.rand(1, 3, size[0] // 4 + 3, size[1] // 4 + 2, generator=torch.Generator().manual_seed(2))
    light = torch.nn.functional.interpolate(cells, scale_factor=4.0, mode="bilinear")[..., : size[0], : size[1]]
    x = torch.full((1, 1, *size), 3.0)
    for tiled in (False, True):
        frame = Frame([Sample(torch.zeros_like(light), x)], 4, 1, tiled, extend=False, behind=cells)
        assert frame.behind is not None
        for cover in (0.0, 0.75, 1.0):
            canvas = torch.full_like(frame.canvas(1), 0.2)
            canvas[:, 3:] = cover
            shown = frame.image(frame.over_behind(canvas, frame.behind))
            torch.testing.assert_close(shown, 0.2 + (1 - cover) * light, rtol=0, atol=1e-6)
