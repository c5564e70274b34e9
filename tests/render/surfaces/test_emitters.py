"""Emitters: the light of a highlight goes to the surface of its lamp."""

import torch
from torch import Tensor

from torchdof import blur_by_coc
from torchdof.reference.scenes import Plane, camera_of, plane_scene, waves
from torchdof.render.highlights import threshold
from torchdof.render.surfaces.emitters import attribute_emitters
from torchdof.render.surfaces.matting import Matted, matte

ROWS, COLUMNS = torch.meshgrid(torch.arange(64), torch.arange(80), indexing="ij")


def colours(light: Tensor) -> Tensor:
    return light.expand(1, 3, -1, -1).clone()


def with_emitters(light: Tensor, coc: Tensor) -> Matted:
    """The matte after its emitters are attributed, which conserves light."""
    made = attribute_emitters(light, coc, threshold(light), None, matte(light, coc))
    total = (1 - made.other_weight) * made.own + made.other_weight * made.other
    torch.testing.assert_close(total, light, rtol=1e-5, atol=1e-5)
    return made


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
