"""Matting: mixed pixels are split between their two surfaces."""

import math

import pytest
import torch
from torch import Tensor

from tests.scenes import BLUE, RED, mixed_edge
from torchdof import blur_by_coc
from torchdof.reference.scenes import Plane, camera_of, plane_scene, waves
from torchdof.render.highlights import threshold
from torchdof.render.matting import attribute_emitters, matte


def random_scene() -> tuple[Tensor, Tensor]:
    made = torch.Generator().manual_seed(5)
    image, coc = torch.rand(1, 3, 150, 170, generator=made), torch.full((1, 1, 150, 170), 3.0)
    coc[..., 20:70, 30:90], coc[..., 90:140, 60:160] = -14.0, -6.0
    image[..., 30:40, 30:60] *= 40.0
    return image, coc


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
    for x, mine, theirs in ((30, near, far), (31, far, near)):
        assert torch.allclose(own[..., x], mine[..., 0], atol=0.03) and torch.allclose(
            other[..., x], theirs[..., 0], atol=0.03
        )
        assert torch.allclose(share[..., x], (1 - covered if x == 30 else covered)[x], atol=0.03)


def test_a_split_conserves_light() -> None:
    image, coc = random_scene()
    own, other, _, share = matte(image, coc)
    assert torch.allclose((1 - share) * own + share * other, image, atol=1e-5)


def strands_before_a_lamp() -> tuple[Tensor, Tensor, Tensor]:
    """Dark strands one pixel wide, every third column, in focus before a lamp; depth has two thirds of each."""
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(80), indexing="ij")
    is_strand = columns % 3 == 0
    lamp = ((rows - 30) ** 2 + (columns - 40) ** 2 <= 16) * 50.0
    light = torch.where(is_strand, 0.05 + 0.4 * lamp, 0.2 + lamp).expand(1, 3, -1, -1)
    coc = torch.where(is_strand & (rows % 3 > 0), 0.0, 12.0).expand(1, 1, -1, -1)
    return light, coc, is_strand & (lamp > 0) & (rows % 3 > 0)


def test_a_lamp_beside_a_strand_before_it_keeps_its_light() -> None:
    rows, columns = torch.meshgrid(torch.arange(40), torch.arange(41), indexing="ij")
    lamp = 30.0 * torch.exp(-((rows - 20) ** 2 + (columns - 20) ** 2) / 4.0)
    is_strand = columns == 20
    light, coc = (
        t.expand(1, 3, -1, -1)
        for t in (0.1 + torch.where(is_strand, 0.8 * lamp, lamp), torch.where(is_strand, -7.0, 0.0))
    )
    coc = coc[:, :1]
    surfaces = attribute_emitters(light, coc, threshold(light), None, matte(light, coc))
    of_the_strand = torch.where(
        is_strand, (1 - surfaces.other_weight) * surfaces.own, surfaces.other_weight * surfaces.other
    )
    assert float(of_the_strand.sum()) < 0.05 * float(light.sum())


def test_light_of_a_lamp_seen_through_strands_is_assigned_to_the_lamp() -> None:
    light, coc, shone_through = strands_before_a_lamp()
    own, other, other_coc, weight = attribute_emitters(light, coc, threshold(light), None, matte(light, coc))
    inner = shone_through
    assert int(inner.sum()) > 5
    assert torch.allclose(weight[0, 0][inner], torch.tensor(0.4), atol=0.05)
    assert torch.allclose(other_coc[0, 0][inner], torch.tensor(12.0), atol=0.1)
    assert float(own[..., inner].max()) < 1.0 and float(other[..., inner].min()) > 45.0
    torch.testing.assert_close((1 - weight) * own + weight * other, light, rtol=1e-5, atol=1e-5)
    sharp = blur_by_coc(light, coc)[0, 0]
    assert float(sharp.max()) < 8.0, "the lamp, 20 or more, must not stay in focus"


def test_the_rim_of_a_lamp_is_not_assigned_to_dim_hair_beside_it() -> None:
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(80), indexing="ij")
    across = (columns - 40).abs() <= 2
    is_rim, is_hair = across & ((rows == 29) | (rows == 34)), columns == 40
    light = torch.where(is_rim, 16.0, torch.where(across & (rows >= 30) & (rows < 34), 50.0, 0.1))
    light = torch.where(is_hair, 0.5 * light + 0.02, light).expand(1, 3, -1, -1).clone()
    coc = torch.where(is_hair, 1.0, 12.0).expand(1, 1, -1, -1)
    found = matte(light, coc)
    beside_hair = is_rim & ((columns - 40).abs() == 1)
    assert float(found.other_weight[0, 0][beside_hair].min()) > 0.03
    assert float(found.other[..., beside_hair].min()) > 2.0, "the matte alone makes the hair, 0.02, too bright"
    own, other, _, weight = attribute_emitters(light, coc, threshold(light), None, found)
    assert float(weight[0, 0][beside_hair].max()) < 1e-6
    torch.testing.assert_close((1 - weight) * own + weight * other, light, rtol=1e-5, atol=1e-5)
    # hair that is as bright as the lamp keeps its part
    beside_hair = (rows >= 29) & (rows < 35) & ((columns - 40).abs() == 1)
    light[..., 28:36, 40] = 50.0
    found = matte(light, coc)
    assert float(found.other_weight[0, 0][beside_hair].max()) > 0.03
    for before, after in zip(found, attribute_emitters(light, coc, threshold(light), None, found), strict=True):
        torch.testing.assert_close(before[..., beside_hair], after[..., beside_hair], rtol=1e-6, atol=1e-6)


def test_a_lamp_on_a_near_surface_stays_there_with_its_rim() -> None:
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(80), indexing="ij")
    is_post = (columns >= 30) & (columns < 42)
    lamp = (rows >= 30) & (rows < 32) & (columns >= 40) & (columns < 42)
    light = torch.where(lamp, 50.0, torch.where(is_post, 0.05, 0.2)).expand(1, 3, -1, -1).clone()
    light[..., 30:32, 42] = 20.0  # the rim of the lamp, in pixels whose centre shows the wall
    coc = torch.where(is_post, 0.0, 12.0).expand(1, 1, -1, -1)
    surfaces = attribute_emitters(light, coc, threshold(light), None, matte(light, coc))
    own, other, other_coc, weight = (t[0, 0] for t in surfaces)
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


def test_split_light_stays_within_the_range_of_the_image() -> None:
    made = torch.Generator().manual_seed(3)
    for _ in range(20):
        image = 0.2 + 0.6 * torch.rand(1, 3, 40, 40, generator=made)
        coc = 20.0 * torch.rand(1, 1, 40, 40, generator=made).round(decimals=0)
        for light in matte(image, coc)[:2]:
            light = light[(light != 0).all(1, keepdim=True).expand_as(light)]  # pixels with a second surface
            assert float(light.min()) >= 0.2 - 1e-5 and float(light.max()) <= 0.8 + 1e-5
