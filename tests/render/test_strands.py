"""Strands thinner than a pixel, of which depth shows dashes."""

import math

import pytest
import torch
from torch import Tensor

from torchdof import blur_by_coc
from torchdof.render import strands
from torchdof.render.highlights import threshold
from torchdof.render.matting import Matted, matte
from torchdof.render.strands import strands_joined

WIRE, WALL = torch.tensor([0.1, 0.2, 0.05]).double(), torch.tensor([0.6, 0.4, 0.5]).double()
FAR_PX = 9.0


def wire(width_px: float = 0.25, height: int = 40) -> tuple[Tensor, Tensor, Tensor]:
    """A slanted wire in focus before an inclined wall; the last is how much of each pixel it covers."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(30).double(), indexing="ij")
    aside = (0.985 * (x - 12.3) - 0.174 * (y - 0.4 * height)).abs()
    cover = (0.5 * (width_px + 1.0) - aside).clamp(0.0, width_px)
    wall = WALL[:, None, None] * (1.0 + 0.01 * x + 0.005 * y)
    light = wall + cover * (WIRE[:, None, None] - wall)
    return light[None], torch.where(aside < 0.5 * width_px, 0.0, FAR_PX).double()[None, None], cover


def joined(light: Tensor, coc: Tensor, valid: Tensor | None = None) -> tuple[Matted, Matted]:
    """Surfaces before and after."""
    surfaces = matte(light, coc, valid)
    return surfaces, strands_joined(light, coc, threshold(light, valid), valid, surfaces)[0]


def covered(coc: Tensor, surfaces: Matted) -> Tensor:
    """How much of each row of pixels is the wire's."""
    of_dashes = torch.where(coc < 1.0, 1.0 - surfaces.other_weight, 0.0)
    between = torch.where((coc > 1.0) & (surfaces.other_coc_px < 1.0), surfaces.other_weight, 0.0)
    return (of_dashes + between)[0, 0].sum(1)


def test_a_wire_is_joined_between_its_dashes() -> None:
    light, coc, cover = wire()
    before, after = joined(light, coc)
    gaps = covered(coc, before) < 0.01
    gaps[:4] = gaps[-4:] = False
    joined_in_gaps = covered(coc, after)[gaps]
    assert len(joined_in_gaps) > 10 and 0.2 < float(joined_in_gaps.min()) < float(joined_in_gaps.max()) < 0.4
    changed = (after.other_weight - before.other_weight)[0, 0] > 0.1
    assert float(after.other_coc_px[0, 0][changed].abs().max()) < 0.05
    assert float(cover[changed].min()) > 0.05


def test_no_light_is_lost_and_the_strand_covers_no_more_than_it_may() -> None:
    light, coc, _ = wire()
    _, (own, other, _, weight) = joined(light, coc)
    torch.testing.assert_close((1.0 - weight) * own + weight * other, light)
    assert 0.3 < float(weight.max()) <= 0.6


NUMBERS = ["_REACH", "_WIDTH", "_NARROW", "_LEVEL", "_SEEN", "_LEAST_COVERED", "_MOST_COVERED"]


def joined_part() -> float:
    """Mean part of pixels that is joined where three wires cross before a wall of waves."""
    y, x = torch.meshgrid(torch.arange(40).double(), torch.arange(30).double(), indexing="ij")
    light = WALL[:, None, None] * (1.0 + 0.1 * torch.sin(0.9 * x + 0.5 * y) + 0.01 * x)
    coc = torch.full_like(x, FAR_PX)
    for angle, across, width_px in ((0.17, 12.3, 0.3), (-0.5, 22.0, 0.5), (1.2, 26.0, 0.4)):
        aside = ((x - across) * math.cos(angle) - (y - 16.0) * math.sin(angle)).abs()
        cover = (0.5 * (width_px + 1.0) - aside).clamp(0.0, width_px)
        light = light + cover * (WIRE[:, None, None] - light)
        coc = torch.where(aside < 0.5 * width_px, 0.0, coc)
    before, after = joined(light[None], coc[None, None])
    return float((after.other_weight - before.other_weight).clamp_min(0.0).mean())


def test_as_much_is_joined_as_recorded() -> None:
    assert joined_part() == pytest.approx(7.094e-3, rel=1e-3)


@pytest.mark.parametrize("name", NUMBERS)
def test_twice_a_number_joins_something_else(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(strands, name, 2 * getattr(strands, name))
    assert joined_part() != pytest.approx(7.094e-3, rel=2e-3)


@pytest.mark.parametrize("what", ["thick", "no depth", "left out"])
def test_what_is_no_strand_stays_as_it_is(what: str) -> None:
    light, coc, cover = wire()
    valid = None
    if what == "thick":
        coc = torch.full_like(coc, FAR_PX)
        coc[..., 10:14] = 0.0
    elif what == "no depth":
        coc = torch.full_like(coc, FAR_PX)
    else:
        valid = (coc > 1.0).double()
    for before, after in zip(*joined(light, coc, valid), strict=True):
        torch.testing.assert_close(before, after, atol=1e-12, rtol=0.0)


def test_a_lamp_that_shines_through_a_strand_keeps_its_light() -> None:
    light, coc, _ = wire()
    before, after = joined(light, coc)
    row, column = divmod(int((after.other_weight - before.other_weight).argmax()), light.shape[-1])
    light[..., row, column] = 50.0
    before = matte(light, coc)
    after, _ = strands_joined(light, coc, torch.full_like(coc, 50.0 / 2.1), None, before)
    for a, b in zip(before, after, strict=True):
        assert torch.equal(a[..., row, column], b[..., row, column])


def test_a_known_background_has_strands_joined_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    light, coc, _ = wire()
    wall, far = light[..., 20:21].expand_as(light), torch.full_like(coc, FAR_PX)
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    picture = blur_by_coc(light, coc, background=wall, background_coc_px=far)[0].mean(0)
    depth_of_wire = picture[6:-6].amax(1) - picture[6:-6].amin(1)
    assert float(depth_of_wire.min()) > 0.07


def test_gradients_with_respect_to_the_light_and_the_coc_of_a_strand() -> None:
    light, coc, cover = wire(height=9)
    light, is_wire = light[..., 7:18], coc[..., 7:18] < 1.0

    def rendered(brightness: Tensor, coc_px: Tensor) -> Tensor:
        lit = light + cover[:, 7:18] * brightness * WIRE[:, None, None]
        coc = torch.where(is_wire, coc_px, FAR_PX)
        surfaces, _ = strands_joined(lit, coc, threshold(light), None, matte(lit, coc))
        return torch.cat(surfaces, 1)

    leaves = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.3, 0.2)]
    assert torch.autograd.gradcheck(rendered, leaves)
