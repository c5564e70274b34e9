"""Matting: mixed pixels are split between their two surfaces."""

import math

import pytest
import torch

from tests.scenes import BLUE, RED, mixed_edge
from torchdof.render.surfaces.matting import matte


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6, 0.8])
def test_a_mixed_pixel_is_split_between_its_two_surfaces(share: float) -> None:
    image, coc = mixed_edge(share)
    own, other, other_coc, found = (t[0, ..., 24, 31] for t in matte(image, coc))
    mine, theirs = (RED, BLUE) if share >= 0.5 else (BLUE, RED)
    assert float(found) == pytest.approx(1 - max(share, 1 - share), abs=0.03)
    assert torch.allclose(own, mine, atol=0.02) and torch.allclose(other, theirs, atol=0.02)
    assert float(other_coc) == (0.0 if share >= 0.5 else -12.0)


def test_a_split_is_trusted_in_proportion_to_the_contrast_of_the_surfaces() -> None:
    """Below a contrast of 1/255 of the light around, the share is that under a Gaussian of 0.6 px."""
    beside, diagonal = math.exp(-1 / 0.72), math.exp(-2 / 0.72)
    under_gaussian = (beside + 2 * diagonal) / (1 + 4 * beside + 4 * diagonal)
    for contrast, share in ((0.1, 0.4), (1 / 255, 0.2 + 0.5 * under_gaussian), (1e-7, under_gaussian)):
        image, coc = mixed_edge(0.6)
        image, coc = torch.where(coc < 0, 1.0, 1.0 - contrast).double(), coc.double()
        image[..., 31] = 1.0 - 0.4 * contrast
        weight = matte(image, coc).other_weight[0, 0, 24, 31]
        assert float(weight) == pytest.approx(share, abs=0.01)


def test_a_soft_edge_is_split_into_the_colours_beyond_it() -> None:
    """A photograph's edge is wider than a pixel: neighbours on the other side are mixed too."""
    coc = torch.where(torch.arange(60) < 31, -6.0, 0.0).expand(1, 1, 48, -1)
    near, far = torch.tensor([0.1, 0.3, 0.2]).view(1, 3, 1, 1), torch.tensor([0.8, 0.6, 0.7]).view(1, 3, 1, 1)
    distance = torch.arange(60) - 30.5
    covered = 0.5 - 0.5 * torch.erf(distance / (0.8 * math.sqrt(2)))
    own, other, _, share = matte((covered * near + (1 - covered) * far).expand(-1, -1, 48, -1), coc)
    for x, mine, theirs, hidden in ((30, near, far, 1 - covered), (31, far, near, covered)):
        for values, wanted in ((own, mine[..., 0]), (other, theirs[..., 0]), (share, hidden[x])):
            assert torch.allclose(values[..., x], wanted, atol=0.03)


def test_a_split_conserves_light_and_stays_within_the_range_of_the_image() -> None:
    made = torch.Generator().manual_seed(3)
    for _ in range(20):
        image = 0.2 + 0.6 * torch.rand(1, 3, 40, 40, generator=made)
        coc = 20.0 * torch.rand(1, 1, 40, 40, generator=made).round(decimals=0)
        own, other, _, share = matte(image, coc)
        assert torch.allclose((1 - share) * own + share * other, image, atol=1e-5)
        for light in (own, other):
            light = light[(light != 0).all(1, keepdim=True).expand_as(light)]  # pixels with a second surface
            assert float(light.min()) >= 0.2 - 1e-5 and float(light.max()) <= 0.8 + 1e-5


@pytest.mark.parametrize(("near_px", "far_px"), [(-12.0, 0.0), (0.0, 12.0)])
def test_noise_of_a_blurred_surface_does_not_reach_a_sharper_one(engine: str, near_px: float, far_px: float) -> None:
    """Coloured noise in the light of the sharper surface would stay visible as dots along the blurred edge."""
    coc_px = torch.full((1, 1, 32, 32), far_px)
    coc_px[..., 16:] = near_px
    clean = torch.where(torch.arange(32) < 16, 0.2, 0.8).repeat(1, 3, 32, 1)
    clean[..., 15], clean[..., 16] = 0.4, 0.6  # a third of the other surface in each
    noise = 0.05 * torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    is_blurred = coc_px.abs() > 1.0
    surfaces = matte(torch.where(is_blurred, clean + noise, clean), coc_px)
    mixed = is_blurred & (surfaces.other_weight > 0.2)
    assert int(mixed.sum()) == 32
    light = surfaces.other.movedim(1, -1)[mixed[:, 0]]  # [32, 3]
    assert float(light.std(0).mean()) < 0.3 * float(noise.std())


@pytest.mark.parametrize(("near_px", "far_px", "splits"), [(-31.5, -30, False), (-31.5, -20, True), (-1.5, 0, True)])
def test_surfaces_of_hardly_another_blur_are_one(engine: str, near_px: float, far_px: float, splits: bool) -> None:
    """A split there would take the place of the hidden sample, and light from far behind would pass beside the edge."""
    image, coc = mixed_edge(0.6)
    split = matte(image, torch.where(coc < 0, near_px, far_px))
    assert bool((split.other_weight > 0).any()) == splits
