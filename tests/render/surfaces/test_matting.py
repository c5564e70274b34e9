"""Matting: mixed pixels are split between their two surfaces."""

import math

import pytest
import torch
from torch import Tensor

from tests.scenes import BLUE, RED, mixed_edge
from torchdof import blur_by_coc
from torchdof.reference.scenes import Plane, camera_of, plane_scene, waves
from torchdof.render.highlights import threshold
from torchdof.render.surfaces.matting import Matted, attribute_emitters, matte

ROWS, COLUMNS = torch.meshgrid(torch.arange(64), torch.arange(80), indexing="ij")


def colours(light: Tensor) -> Tensor:
    return light.expand(1, 3, -1, -1).clone()


def with_emitters(light: Tensor, coc: Tensor) -> Matted:
    """The matte after its emitters are attributed, which conserves light."""
    made = attribute_emitters(light, coc, threshold(light), None, matte(light, coc))
    total = (1 - made.other_weight) * made.own + made.other_weight * made.other
    torch.testing.assert_close(total, light, rtol=1e-5, atol=1e-5)
    return made


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


def test_a_lamp_beside_a_strand_before_it_keeps_its_light() -> None:
    lamp = 30.0 * torch.exp(-((ROWS - 20) ** 2 + (COLUMNS - 20) ** 2) / 4.0)
    is_strand = COLUMNS == 20
    light = colours(0.1 + torch.where(is_strand, 0.8 * lamp, lamp))
    made = with_emitters(light, torch.where(is_strand, -7.0, 0.0)[None, None])
    share = torch.where(is_strand, 1 - made.other_weight, made.other_weight)
    of_the_strand = share * torch.where(is_strand, made.own, made.other)
    assert float(of_the_strand.sum()) < 0.05 * float(light[..., :40, :41].sum())


def test_light_of_a_lamp_seen_through_strands_is_assigned_to_the_lamp() -> None:
    """Dark strands one pixel wide, every third column, in focus before a lamp; depth has two thirds of each."""
    is_strand = COLUMNS % 3 == 0
    lamp = ((ROWS - 30) ** 2 + (COLUMNS - 40) ** 2 <= 16) * 50.0
    light = colours(torch.where(is_strand, 0.05 + 0.4 * lamp, 0.2 + lamp))
    in_focus = is_strand & (ROWS % 3 > 0)
    coc = torch.where(in_focus, 0.0, 12.0)[None, None]
    own, other, other_coc, weight = (t[..., in_focus & (lamp > 0)] for t in with_emitters(light, coc))
    assert weight.numel() > 5
    assert torch.allclose(weight, torch.tensor(0.4), atol=0.05)
    assert torch.allclose(other_coc, torch.tensor(12.0), atol=0.1)
    assert float(own.max()) < 1.0 and float(other.min()) > 45.0
    assert float(blur_by_coc(light, coc).max()) < 8.0, "the lamp, 20 or more, must not stay in focus"


def test_the_rim_of_a_lamp_is_not_assigned_to_dim_hair_beside_it() -> None:
    across = (COLUMNS - 40).abs() <= 2
    is_rim, is_hair = across & ((ROWS == 29) | (ROWS == 34)), COLUMNS == 40
    light = torch.where(is_rim, 16.0, torch.where(across & (ROWS >= 30) & (ROWS < 34), 50.0, 0.1))
    light = colours(torch.where(is_hair, 0.5 * light + 0.02, light))
    coc = torch.where(is_hair, 1.0, 12.0)[None, None]
    beside_hair = is_rim & ((COLUMNS - 40).abs() == 1)
    found = matte(light, coc)
    assert float(found.other_weight[..., beside_hair].min()) > 0.03
    assert float(found.other[..., beside_hair].min()) > 2.0, "the matte alone makes the hair, 0.02, too bright"
    assert float(with_emitters(light, coc).other_weight[..., beside_hair].max()) < 1e-6
    # hair that is as bright as the lamp keeps its part
    beside_hair = (ROWS >= 29) & (ROWS < 35) & ((COLUMNS - 40).abs() == 1)
    light[..., 28:36, 40] = 50.0
    found = matte(light, coc)
    assert float(found.other_weight[..., beside_hair].max()) > 0.03
    for before, after in zip(found, with_emitters(light, coc), strict=True):
        torch.testing.assert_close(before[..., beside_hair], after[..., beside_hair], rtol=1e-6, atol=1e-6)


def test_a_lamp_on_a_near_surface_stays_there_with_its_rim() -> None:
    is_post = (COLUMNS >= 30) & (COLUMNS < 42)
    lamp = (ROWS >= 30) & (ROWS < 32) & (COLUMNS >= 40) & (COLUMNS < 42)
    light = colours(torch.where(lamp, 50.0, torch.where(is_post, 0.05, 0.2)))
    light[..., 30:32, 42] = 20.0  # the rim of the lamp, in pixels whose centre shows the wall
    own, other, other_coc, weight = (t[0, 0] for t in with_emitters(light, torch.where(is_post, 0.0, 12.0)[None, None]))
    torch.testing.assert_close(((1 - weight) * own)[lamp], torch.full((4,), 50.0))
    torch.testing.assert_close((weight * other)[30:32, 42], torch.full((2,), 20.0 - 0.6 * 0.2), rtol=0.01, atol=0.0)
    torch.testing.assert_close(own[30:32, 42], torch.full((2,), 0.2))
    assert float(other_coc[30:32, 42].abs().max()) == 0.0


def test_lamps_in_focus_leave_no_halo_on_the_blurred_wall_behind_them() -> None:
    lamps = ((20.3, 20.6, 0.8), (44.8, 40.1, 1.7), (72.2, 30.5, 3.2))

    def distance(x: Tensor, y: Tensor) -> Tensor:
        return torch.stack([torch.hypot(x - cx, y - cy) - radius for cx, cy, radius in lamps]).amin(0)

    camera = camera_of(200.0, 96, aperture_radius_m=0.05, focus_m=1.0)
    near = Plane(1.0, lambda x, y: torch.full((3, *x.shape), 100.0), lambda x, y: distance(x, y) < 0.0)
    scene = plane_scene([near, Plane(4.0, waves(3, mean=(0.02, 0.02, 0.02)))], camera, (64, 96), samples=256)
    made = blur_by_coc(scene.image, scene.coc_px)[0]
    y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    around = (distance(x, y) > 1.5) & (distance(x, y) < 8.0)
    assert float((made - scene.truth[0])[:, around].abs().max()) < 0.02  # 0.18 with mean colours alone


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
