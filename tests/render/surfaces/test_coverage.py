"""Coverage from a matte: closed forms, the picture against known layers, and input that it must not change."""

from functools import partial

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.autograd import gradcheck

from tests.refused import refuses
from torchdof import Camera, DepthOfField, blur_by_coc
from torchdof.reference import metrics
from torchdof.render.highlights import threshold
from torchdof.render.surfaces.coverage import covered_by

SIZE = (96, 128)
NEAR_PX, FAR_PX = -9.0, 0.0
CAMERA = Camera()


def strands() -> Tensor:
    """Coverage ``[1, 1, H, W]`` by a figure with strands thinner than a pixel, from 4 x 4 samples a pixel."""
    y, x = torch.meshgrid(*(torch.arange(4 * n) / 4 for n in SIZE), indexing="ij")
    waves = torch.stack([40 + 9 * k + 6 * torch.sin(y / 13 + k) - x for k in range(6)])
    is_covered = (x < 42) | (waves.abs() < 0.35).any(0)
    return functional.avg_pool2d(is_covered.float()[None, None], 4)


def layers() -> tuple[Tensor, Tensor]:
    """Light of the figure, of any shade, and of the wall behind it, ``[1, 3, H, W]``."""
    generator = torch.Generator().manual_seed(2)
    shade = 0.2 + 0.6 * torch.rand(1, 1, *SIZE, generator=generator)
    wall = torch.linspace(0.3, 0.6, SIZE[1]).expand(1, 1, *SIZE)
    colours = torch.tensor([[0.5, 0.3, 0.2], [0.5, 0.5, 0.5]]).reshape(2, 1, 3, 1, 1)
    return shade * colours[0], wall * colours[1]


def displaced(values: Tensor, shift: int) -> Tensor:
    """A map whose content lies ``shift`` pixels to the right."""
    return values[..., (torch.arange(SIZE[1]) - shift).clamp(0, SIZE[1] - 1)]


def scene(shift: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, coc displaced by ``shift`` pixels, coverage, and the picture of the layers blurred one by one."""
    cover, (figure, wall) = strands(), layers()
    image = cover * figure + (1.0 - cover) * wall
    coc = torch.where(cover >= 0.5, NEAR_PX, FAR_PX)
    coc = displaced(coc, shift)
    rgba = torch.stack([torch.cat([cover * figure, cover], 1), torch.cat([wall, torch.ones_like(cover)], 1)], 1)
    camera = CAMERA.replace(focus_m=2.0, f_number=1.0)
    in_front, behind = camera.replace(f_number=0.5), torch.full((1, 1, 1, 1), 2.0)
    nearer = torch.linspace(0.1, 1.99, 4000).reshape(1, 1, 1, -1)
    place = (in_front.coc_px(nearer, SIZE[1]) - NEAR_PX).abs().argmin()
    depths = torch.stack([nearer[0, 0, 0, place], behind[0, 0, 0, 0]])
    truth = DepthOfField(in_front, tolerance=0).layers(rgba, depths)[:, :3]
    return image, coc, cover, truth


def uneven_scene() -> tuple[Tensor, Tensor, Tensor]:
    """Image, coc and coverage: surfaces that slope and meet, in part soft, displaced by 2 px, with a third one."""
    cover, (figure, wall) = strands(), layers()
    y, x = torch.meshgrid(*(torch.arange(float(n)) for n in SIZE), indexing="ij")
    far = torch.where(y > 56, 6.0, 0.03 * (x - 40.0) + 0.02 * y)
    coc = torch.where(displaced(cover, 2) >= 0.5, 0.18 * x - 9.0, far)
    soft = functional.avg_pool2d(functional.pad(coc, (2, 2, 2, 2), mode="replicate"), 5, 1)
    coc = torch.where(y % 48 < 24, coc, soft)
    coc = torch.where((x - 90).abs() + (y - 30).abs() < 9, -16.0, coc)
    return cover * figure + (1.0 - cover) * wall, coc, cover


def test_both_surfaces_of_an_uneven_scene_have_the_recorded_coc() -> None:
    """A change of the rules that changes these maps must record the new means here."""
    moved, covered = covered_by(*uneven_scene(), threshold)
    assert covered is not None
    means = [float(values.double().mean()) for values in (moved, covered[:, 3], covered[:, 5])]
    assert means == pytest.approx([0.23652, -1.19772, 0.18584], abs=2e-5)


@pytest.mark.parametrize(("shift", "gain_db"), [(0, 6.0), (2, 2.0), (-2, 14.0)])
def test_true_coverage_renders_strands_before_a_wall_in_focus(shift: int, gain_db: float, engine: str) -> None:
    """A strand may have the colour of the wall, and a displaced map has strands in other places."""
    image, coc, cover, truth = scene(shift)
    inner = torch.zeros(1, 1, *SIZE, dtype=torch.bool)
    inner[..., 12:-12, 12:-12] = True
    pictures = (blur_by_coc(image, coc, matte=matte) for matte in (None, cover))
    alone, known = (metrics.psnr(metrics.display(p), metrics.display(truth), inner) for p in pictures)
    assert known > alone + gain_db and known > 62.0, (alone, known)


def test_light_of_both_surfaces_is_exact_where_each_has_one_colour() -> None:
    cover, figure, wall = (4 * strands()).round() / 4, torch.tensor([0.6, 0.2, 0.1]), torch.tensor([0.2, 0.5, 0.9])
    image = cover * figure[:, None, None] + (1 - cover) * wall[:, None, None]
    coc = torch.where(cover > 0.5, 8.0, 2.0)  # the subject is behind: the sides are symmetric
    moved, covered = covered_by(image, displaced(coc, 1), cover, threshold)
    assert covered is not None
    share, other, weight, certainty = covered.split([3, 1, 1, 1], 1)
    mixed = ((cover > 0.02) & (cover < 0.98)).squeeze(1)
    assert float(certainty.squeeze(1)[mixed].min()) == 1.0
    torch.testing.assert_close(moved, torch.where(cover >= 0.5, 8.0, 2.0), rtol=0, atol=1e-3)
    torch.testing.assert_close(other.squeeze(1)[mixed], torch.where(cover >= 0.5, 2.0, 8.0).squeeze(1)[mixed])
    is_subject = cover >= 0.5
    torch.testing.assert_close(weight, torch.where(is_subject, 1 - cover, cover))
    colour = torch.where(is_subject, (1 - cover) * wall[:, None, None], cover * figure[:, None, None])
    errors = (share * image - colour).abs().amax(1)
    assert float(errors[mixed].max()) < 1e-3


def test_a_matte_without_an_edge_of_depth_changes_nothing(engine: str) -> None:
    image, coc, cover, _ = scene()
    plain = blur_by_coc(image, coc)
    assert torch.equal(blur_by_coc(image, coc, matte=torch.ones_like(cover)), plain)
    assert torch.equal(blur_by_coc(image, coc, matte=cover.flip(-1).roll(40, -1) * 0.0), plain)
    slope = torch.linspace(3.0, 5.0, SIZE[1]).expand_as(coc).contiguous()
    assert torch.equal(blur_by_coc(image, slope, matte=cover), blur_by_coc(image, slope))


def test_a_nearer_surface_outside_the_matte_keeps_its_depth() -> None:
    """A table in front of the subject has coverage 0, as the wall behind it has."""
    cover = torch.zeros(1, 1, *SIZE)
    cover[..., 20:60, 40:80] = 1.0
    coc = torch.where(cover > 0, 0.0, 6.0)
    coc[..., 60:, :] = -8.0
    moved, _ = covered_by(torch.rand(1, 3, *SIZE), coc, cover, threshold)
    away_from_corners = torch.ones_like(coc, dtype=torch.bool)
    away_from_corners[..., 50:64, 32:44] = away_from_corners[..., 50:64, 76:88] = False  # all three surfaces meet there
    assert torch.equal(moved[away_from_corners], coc[away_from_corners])


def test_a_hole_of_the_depth_does_not_spread() -> None:
    image, coc, cover, _ = scene()
    with_hole = coc.clone()
    with_hole[..., 30:34, 40:44] = torch.nan
    out = blur_by_coc(image, with_hole, matte=cover, check=False)
    assert torch.equal(out[..., 30:34, 40:44], image[..., 30:34, 40:44])
    difference = (out - blur_by_coc(image, coc, matte=cover)).abs().amax(1)
    assert bool(torch.isfinite(out).all()) and float(difference[..., 70:, :].max()) < 1e-5


def test_attention_uses_the_matte() -> None:
    image, coc, cover, _ = scene()
    whole = blur_by_coc(image, coc, matte=cover, attention=(64.0, 48.0, 1000.0))
    assert torch.equal(whole, blur_by_coc(image, coc, matte=cover))
    both = blur_by_coc(*(t.repeat(2, 1, 1, 1) for t in (image, coc)), matte=cover, attention=(40.0, 48.0, 8.0))
    one = blur_by_coc(image, coc, matte=cover, attention=(40.0, 48.0, 8.0))
    torch.testing.assert_close(both, one.repeat(2, 1, 1, 1))


def test_gradients_flow_to_the_matte() -> None:
    generator = torch.Generator().manual_seed(3)
    draw = partial(torch.rand, generator=generator, dtype=torch.float64)
    image, coc = 0.2 + 0.6 * draw(1, 3, 6, 7), torch.full((1, 1, 6, 7), 2.2, dtype=torch.float64)
    coc[..., :3] = -1.7
    matte = torch.full((1, 1, 6, 7), 0.05, dtype=torch.float64)
    matte[..., :3], matte[..., 3] = 0.96, 0.3
    matte = (matte + 0.03 * draw(1, 1, 6, 7)).requires_grad_()

    def render(image: Tensor, coc: Tensor, matte: Tensor) -> Tensor:
        return blur_by_coc(image, coc, matte=matte, depth_edges="as given", tolerance=1 / 60)

    coc = coc + 0.05 * draw(1, 1, 6, 7)
    seen, leaves = draw(1, 3, 6, 7) - 0.5, (image.requires_grad_(), coc.requires_grad_(), matte)
    assert gradcheck(
        lambda *given: (render(*given) * seen).sum(), leaves, fast_mode=True
    )  # along a random direction of each input
    (gradient,) = torch.autograd.grad(render(image, coc, matte).square().sum(), matte)
    assert float(gradient[..., 3].abs().min()) > 0


IMAGE, DEPTH, MATTE = torch.rand(1, 3, 8, 12), torch.ones(1, 1, 8, 12), torch.full((1, 1, 8, 12), 0.5)
over = partial(DepthOfField(CAMERA), IMAGE, DEPTH)

test_a_matte_that_does_not_fit_is_refused = refuses(
    (partial(over, matte=MATTE[0]), r"matte must be \[1, 1, 8, 12\] of coverage in \[0, 1\] beside this image, got"),
    (partial(over, matte=MATTE[..., :6]), r"matte must be \[1, 1, 8, 12\]"),
    (partial(over, matte=MATTE.expand(1, 3, 8, 12)), r"matte must be \[1, 1, 8, 12\]"),
    (partial(over, matte=MATTE > 0), "matte must be .* floating point"),
    (partial(over, matte=255 * MATTE), r"matte must be coverage in \[0, 1\], got 127.5 to 127.5; divide by 255"),
    (partial(over, matte=MATTE - 1), r"got -0.5 to -0.5; clamp it"),
    (partial(over, matte=MATTE * torch.nan), "got nan to nan; clamp it, and fill in NaN"),
    (partial(DepthOfField(CAMERA, occlusion=False), IMAGE, DEPTH, matte=MATTE), "a matte needs occlusion=True"),
)
