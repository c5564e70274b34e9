"""Highlights: crisp discs of the right radius and energy, with shadows of the surfaces that their rays hit."""

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import BlurTable, blur_by_coc
from torchdof.reference import metrics
from torchdof.render import highlights
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.frame import HIDDEN_WEIGHT, Surface

LAMP = 3000.0


def street(coc_px: float = 14.0, post_px: float | None = None) -> tuple[Tensor, Tensor, tuple[int, int]]:
    """Image and coc of a lamp of one pixel on a dim wall with a nearer post beside it; and the place of the lamp."""
    image, coc = torch.full((1, 3, 96, 96), 0.05), torch.full((1, 1, 96, 96), coc_px)
    coc[..., :2, :2] = 0.0  # a second surface
    place = (48, 50)
    if post_px is not None:
        coc[..., :, 41:45] = post_px
    image[..., place[0], place[1]] = LAMP
    return image, coc, place


@pytest.mark.parametrize("tolerance", [0.0, 1 / 255, 4 / 255])
@pytest.mark.parametrize("coc_px", [-23.0, -9.3, 5.2, 14.0, 31.5])
def test_a_highlight_is_a_disc_of_its_radius_and_energy(coc_px: float, tolerance: float) -> None:
    image, coc, _ = street(coc_px)
    lit, unlit = (blur_by_coc(light, coc, tolerance=tolerance)[0, 0] for light in (image, image.clamp(max=0.05)))
    disc = lit - unlit
    height = LAMP / (math.pi * coc_px**2)
    assert math.sqrt(float((disc > height / 2).sum()) / math.pi) == pytest.approx(abs(coc_px), abs=0.5)
    assert float(disc.sum()) == pytest.approx(LAMP, rel=0.01)
    edge = ((disc > 0.1 * height) & (disc < 0.9 * height)).sum()
    assert edge < 1.6 * 2 * math.pi * abs(coc_px), "the edge is wider than a pixel or two"


@pytest.mark.parametrize(("coc_px", "post_px"), [(14.0, -6.0), (14.0, 4.0), (-9.0, -15.0), (22.0, 0.0)])
def test_a_post_in_front_stops_the_rays_that_hit_it(coc_px: float, post_px: float) -> None:
    image, coc, (row, column) = street(coc_px, post_px)
    got = blur_by_coc(image, coc, tolerance=0.0)[0, 0]
    kernel = BlurTable.disc().kernels(torch.tensor([coc_px]), 96)[0, 0]
    half = kernel.shape[-1] // 2
    for dx in range(-half, half + 1):  # rays along the row of the lamp
        passes_at = column + dx * (1 - post_px / coc_px)
        lands = float(got[row, column + dx])
        if 41.5 <= passes_at <= 43.5:
            assert lands < 0.2, f"the post stops the ray at {dx}"
        elif not 39.5 <= passes_at <= 45.5 and kernel[half, half + dx] > 0:
            assert lands == pytest.approx(0.05 + LAMP * float(kernel[half, half + dx]), rel=0.1), f"ray at {dx}"


@pytest.mark.parametrize(("stretch", "half"), [(1.0, 9), (8.0, 40)])
def test_a_ray_is_stopped_by_every_nearer_surface_it_hits(stretch: float, half: int) -> None:
    made = torch.Generator().manual_seed(1)
    height, width = 90, 131
    coc_px = torch.full((1, 1, height, width), 9.0, dtype=torch.float64)
    coc_px[..., :50] = -2.3
    for top, left, near in ((10, 110, -6.0), (60, 70, 3.1), (20, 66, 5.0)):
        coc_px[..., top : top + 12, left : left + 12] = near
    source = torch.randint(height * width, (40,), generator=made)
    source[0] = 45 * width + 8  # far from all surfaces of its own depth
    row, column = source // width, source % width
    coc = stretch * torch.tensor([9.0, 4.5, -1.5, 1.1], dtype=torch.float64).repeat(10)
    coc_px = stretch * coc_px
    step = torch.arange(-half, half + 1)
    covers = torch.rand(coc_px.shape, dtype=torch.float64, generator=made)  # coverage of the first surface
    other_px = stretch * 3.0 + torch.zeros_like(coc_px)
    others = torch.where(covers < 0.3, 0.9 - covers, HIDDEN_WEIGHT)  # a hidden surface stops no rays
    nothing = torch.zeros_like(coc_px)
    shown = [Surface(nothing, coc_px, covers), Surface(nothing, other_px, others)]
    hiding = highlights.Occluders(highlights._obstacles(shown))
    hidden = hiding.hidden(torch.zeros_like(source), row, column, coc, step)

    wanted = torch.zeros_like(hidden)
    for k in range(int(20 * stretch)):
        parts = ((coc_px, covers), (other_px, others - HIDDEN_WEIGHT))
        layers = [part * (1.0 - (place - hiding.low - k).abs()).clamp_min(0.0) for place, part in parts]
        layer = torch.stack(layers).sum(0).expand(len(source), -1, -1, -1)
        scale = (1.0 - (hiding.low + k) / coc)[:, None]
        y, x = row[:, None] + step * scale, column[:, None] + step * scale
        y, x = (y * 2 / (height - 1) - 1)[:, :, None], (x * 2 / (width - 1) - 1)[:, None, :]
        y, x = y.expand_as(wanted), x.expand_as(wanted)
        seen = functional.grid_sample(layer, torch.stack([x, y], -1), padding_mode="border", align_corners=True)
        wanted += seen[:, 0] * (coc - 1.0 - (hiding.low + k)).clamp(0.0, 1.0)[:, None, None]
    wanted = wanted.clamp(max=1.0)
    assert 0.1 < float(wanted.mean()) < 0.9, "the scene tests nothing"
    torch.testing.assert_close(hidden, wanted, rtol=0, atol=1e-9)


def test_splatting_in_parts_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    image, coc, _ = street(14.0, -6.0)
    image[..., 20:24, 60:64] = 700.0
    whole = blur_by_coc(image, coc)
    monkeypatch.setattr(highlights, "_TAPS", 2000)
    torch.testing.assert_close(blur_by_coc(image, coc), whole, rtol=1e-5, atol=1e-5)


SENT: list[tuple[dict[str, Any], float]] = [  # changes of the scene, share of the light
    ({}, 1.0),
    *(({"nearer_px": px}, sent) for px, sent in ((1.5, 0.7), (1.0, 0.4), (-3.0, 0.4))),  # px of coc to a nearer surface
    *(({"beside_light": light}, sent) for light, sent in ((1.2, 0.7), (1.6, 0.4))),  # which must be no highlight
    ({"cover": 0.053}, 0.5265),  # the coverage, as in layers
    # pixels between the surfaces: the light is multiplied by 1.5 - 10 * 2 / 25
    *(({"between": count}, sent) for count, sent in ((1, 1.0), (2, 0.82), (4, 0.4))),
    *(({"between": 25, "share": share}, 1.0) for share in (0.05, 0.95)),  # not those near one of the surfaces
    ({"between": 3, "share": 0.125}, 0.94),  # counts half
]


@pytest.mark.parametrize(("changes", "sent"), SENT)
def test_a_partly_covered_highlight_at_a_step_sends_its_whole_light(changes: dict[str, float], sent: float) -> None:
    given = {"cover": 0.4, "nearer_px": 4.0, "beside_light": 0.1, "between": 0, "share": 0.5} | changes
    image = torch.full((1, 1, 40, 40), 0.1)
    image[..., 20, 20] = 100.0
    ones, limit = torch.ones_like(image), 0.8
    beside_px = (6.0 - given["nearer_px"]) * ones
    image_px = beside_px.clone()
    is_between = (torch.arange(25) < given["between"]).view(5, 5)
    image_px[..., 18:23, 18:23] += given["nearer_px"] * given["share"] * is_between
    beside = Surface(given["beside_light"] * ones, beside_px, (1.0 - given["cover"]) * ones)
    surface = Surface(image, 6.0 * ones, given["cover"] * ones)
    _, rays = highlights.extract(surface, highlights.threshold(image), beside=(beside, image_px))
    assert rays is not None
    assert float(rays.light) / (100.0 - limit) == pytest.approx(sent, rel=1e-5)


@pytest.mark.parametrize("cover", [0.0, HIDDEN_WEIGHT])
def test_a_surface_that_is_not_visible_has_no_rays(cover: float) -> None:
    # behind a few far lamps all hidden surfaces may be as bright as highlights: a hundred rays for each lamp
    image, coc, _ = street()
    surface = Surface(image, coc, torch.full_like(coc, cover))
    left, rays = highlights.extract(surface, highlights.threshold(image))
    assert rays is None
    assert left.light is image


def test_fewer_highlights_are_rays_if_kernels_reach_farther() -> None:
    plan, coc = Plan((0.0, 10.0), 1 / 255), torch.full((1, 1, 32, 32), 10.0)
    reach = [plan.reach(table, 32) for table in (BlurTable.disc(), BlurTable.gaussian())]
    assert reach == pytest.approx([1.0, 2.5])
    disc, wide = (highlights.affordable_taps(coc, [each]) for each in reach)
    assert float(disc) == 16 * 32 * 32 and float(wide) == pytest.approx(float(disc) / 6.25)


def test_fewer_highlights_are_rays_in_noisy_depth_where_each_meets_more_surfaces() -> None:
    stripes = torch.arange(32) % 2 * torch.ones(1, 1, 32, 1)  # neighbours along one of both axes differ by 1 px
    even, rough, rougher = (float(highlights.affordable_taps(change * stripes, [1.0])) for change in (0.0, 4.0, 8.0))
    assert even == 16 * 32 * 32 and rough < even / 4 and rougher == pytest.approx(rough / 2)


@pytest.mark.parametrize("range_of_light", [0.0, 1.0])
def test_rays_above_the_limit_fade_into_the_layers(range_of_light: float) -> None:
    generator = torch.Generator().manual_seed(2)
    image = torch.full((1, 1, 64, 64), 0.01)
    image[..., ::5, ::5] = 1.0 + range_of_light * torch.rand(1, 1, 13, 13, generator=generator)
    limit, light = highlights.threshold(image), []
    for coc_px in torch.linspace(9.0, 15.0, 600).tolist():
        _, rays = highlights.extract(Surface(image, torch.full_like(image, coc_px)), limit)
        light.append(0.0 if rays is None else float(rays.light.sum()))
    steps = torch.tensor(light).diff()
    assert light[0] > 1.3 * light[-1], "the scene tests nothing"
    assert float(steps.abs().max()) < 0.02 * light[0]


def test_rays_are_differentiable_in_light_and_coc() -> None:
    image, coc, _ = street(6.13, -2.9)  # no ray hits the centre of a pixel
    target = torch.rand(1, 3, 96, 96, generator=torch.Generator().manual_seed(3))
    lamp = (image[:, :1] == LAMP).double()

    def seen(light: Tensor, radius: Tensor) -> Tensor:
        return (blur_by_coc(image + light * lamp, coc + radius * lamp) * target).sum()

    leaves = [torch.zeros((), dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(seen, leaves, eps=1e-4, atol=0.0, rtol=1e-3)


@pytest.mark.parametrize("normalize", [True, False])
def test_lamps_keep_the_tolerance_without_occlusion(normalize: bool) -> None:
    image = torch.full((1, 3, 200, 240), 0.02)
    for row, column in ((30, 40), (100, 120), (150, 60), (3, 180), (120, 238)):  # the last two beside the border
        image[..., row : row + 2, column : column + 2] = 200.0
    coc_px = torch.linspace(12.0, 20.0, 240).expand(1, 1, 200, 240).contiguous()
    coc_px[..., 80:110, 50:60] = -14.0
    options: dict[str, Any] = {"occlusion": False, "normalize": normalize}
    out, exact = (metrics.display(blur_by_coc(image, coc_px, tolerance=t, **options)) for t in (1 / 255, 0))
    error = (out - exact).abs().amax(1)
    assert float(exact.amax()) > 0.5, "the scene tests nothing"
    # dense layers are half a pixel apart, which already softens the rims of discs
    assert float(torch.quantile(error, 0.999)) < 8.5 / 255
    assert float(error.square().mean().sqrt()) < 1 / 255
