"""Repair of depth edges: exact ones stay, others move to the edges of the image; both engines agree."""

import math
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from tests.scenes import TURNS, made
from torchdof import Camera, DepthOfField, blur_by_coc, native
from torchdof.depth import repair_edges
from torchdof.options import DepthEdges
from torchdof.reference import degraded, metrics
from torchdof.reference.degraded import KINDS, degrade
from torchdof.reference.scenes import Plane, Scene, plane_scene, posts, waves
from torchdof.render.surfaces import edge_search, edges

COMPILED = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built here")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Bars and a fence of different colours in front of a wall, with exact depth."""
    planes = [
        Plane(6.0, waves(1, mean=(0.5, 0.4, 0.3))),
        Plane(2.5, waves(2, mean=(0.1, 0.2, 0.35)), posts(41.0, 14.0, 0.15)),
        Plane(1.2, waves(3, mean=(0.35, 0.1, 0.1)), posts(67.0, 9.0, -0.4, 11.0)),
    ]
    camera = Camera.from_fov(fov_x_deg=40.0, aperture_radius_m=0.02, focus_m=6.0)
    return plane_scene(planes, camera, (128, 192), samples=16)


def wrong(depth: Tensor, exact: Tensor) -> float:
    """Share of pixels whose depth is off by more than a tenth."""
    return float(((depth / exact - 1).abs() > 0.1).float().mean())


@pytest.mark.parametrize("sky", [False, True])
@pytest.mark.parametrize("kind", ["exact", "8 bit", "noise 1%"])
def test_exact_edges_stay_bit_for_bit(scene: Scene, kind: str, sky: bool) -> None:
    depth = degrade(scene.depth, kind)
    depth = torch.where(scene.depth == 6.0, math.inf, depth) if sky else depth
    assert torch.equal(repair_edges(scene.image, depth, "auto"), depth)


def compressed(depth: Tensor, quantum: float) -> Tensor:
    """Depth after JPEG compression of 1 / depth, with one quantum for all coefficients of its 8 x 8 blocks."""
    near = 1 / depth
    low, high = near.aminmax()
    places = torch.arange(8.0)
    cosines = torch.cos(math.pi / 8 * (places + 0.5) * places[:, None]) / 2
    cosines[0] *= 0.5**0.5
    blocks = ((near - low) / (high - low) * 255).unflatten(-2, (-1, 8)).unflatten(-1, (-1, 8)).transpose(-3, -2)
    rounded = quantum * (cosines @ blocks @ cosines.T / quantum).round()
    whole = (cosines.T @ rounded @ cosines).transpose(-3, -2).flatten(-4, -3).flatten(-2)
    return 1 / (whole.round().clamp(0, 255) / 255 * (high - low) + low)


@pytest.mark.parametrize("quantum", [20.0, 40.0])
def test_compression_artefacts_beside_steps_are_not_ramps(scene: Scene, quantum: float, engine: str) -> None:
    depth = compressed(scene.depth, quantum)
    assert 0.05 < float((1 / depth - 1 / scene.depth).abs().max()) < 0.3
    assert torch.equal(repair_edges(scene.image, depth, "auto"), depth)
    soft = compressed(degrade(scene.depth, "half-res"), quantum)
    assert wrong(repair_edges(scene.image, soft, "auto"), scene.depth) < 0.5 * wrong(soft, scene.depth)


def test_the_ringing_of_an_enlarged_map_is_removed(scene: Scene, engine: str) -> None:
    near = 1 / scene.depth
    low, high = near.aminmax()
    small = functional.interpolate(near, scale_factor=0.5, mode="area")
    soft = 1 / functional.interpolate(small, scale_factor=2.0, mode="bicubic")

    def ringing(depth: Tensor) -> float:
        level = (1 / depth - low) / (high - low)
        return float(((level < -0.04) | (level > 1.04)).float().mean())

    assert ringing(soft) > 0.03
    assert ringing(repair_edges(scene.image, soft, "auto")) < 0.5 * ringing(soft)


def test_levels_of_a_file_are_not_edges_however_large_the_blur(engine: str) -> None:
    levels = torch.arange(100.0).repeat_interleave(8).expand(1, 1, 32, -1)
    levels = levels + 2.0 * (torch.rand(levels.shape) < 0.1)  # compression: two levels are more than a step
    coc_px = 0.53 * levels
    image = torch.rand(1, 3, *coc_px.shape[-2:])
    assert torch.equal(edges.mended(image, coc_px, "repair"), coc_px)
    assert not edges.judged(image, coc_px)[0].any()


def test_narrow_ramps_of_averaged_depth_are_repaired(scene: Scene, engine: str) -> None:
    """Depth is averaged if it was downsampled with its image, or rendered with anti-aliasing."""
    image = functional.avg_pool2d(scene.image, 2)
    depth = 1 / functional.avg_pool2d(1 / scene.depth, 2)
    nearest = -functional.max_pool2d(-scene.depth, 2), functional.max_pool2d(scene.depth, 2)
    repaired = repair_edges(image, depth, "auto")
    between = [((d > 1.1 * nearest[0]) & (d < nearest[1] / 1.1)).float().mean() for d in (depth, repaired)]
    assert between[0] > 0.05
    assert between[1] < 0.3 * between[0]


@pytest.mark.parametrize("degrees", [0.0, 7.0, 23.0, 45.0, 68.0, 90.0])
@pytest.mark.parametrize("levels", [255, None])
def test_an_antialiased_map_is_soft_at_any_angle(degrees: float, levels: int | None, engine: str) -> None:
    """A pixel's value is the mean over its area: of one pixel at each edge, at any level between both surfaces."""
    y, x = torch.meshgrid(*(torch.arange(8.0 * n) / 8 for n in (96, 128)), indexing="ij")
    angle = math.radians(degrees)
    across = (x - 61.3) * math.cos(angle) + (y - 50.7) * math.sin(angle)
    along = y * math.cos(angle) - x * math.sin(angle)
    waved = (across + 1.7 * torch.sin(along / 9.0)) % 53 < 26
    is_near = functional.avg_pool2d(waved.float()[None, None], 8)
    image = torch.tensor([0.1, 0.2, 0.3])[:, None, None] + is_near * torch.tensor([0.5, 0.3, 0.0])[:, None, None]
    written = is_near if levels is None else (levels * is_near).round() / levels
    repaired = edges.mended(image, 5 - 11 * written, "auto")
    is_mixed = (is_near > 0.1) & (is_near < 0.9)
    assert ((repaired - 5).abs().minimum((repaired + 6).abs())[is_mixed] < 0.05).float().mean() > 0.9


def test_edges_of_a_soft_map_have_no_teeth(engine: str) -> None:
    """Single pixels whose colour is undecided have their neighbours' surface; one with the near colour stays near."""
    image = two_colours()
    image[..., 8:50:8, 31], image[..., 56, 31] = 0.52, 0.8
    is_near = (torch.arange(64) >= 32).repeat(64, 1)
    is_near[56, 31] = True
    repaired = edges.mended(image, 5 - 10 * RAMP, "auto")[0, 0]  # both surfaces are equally blurred
    torch.testing.assert_close(repaired, torch.where(is_near, -5.0, 5.0), atol=1e-4, rtol=0)


def test_undecided_pixels_of_a_soft_map_show_a_more_blurred_near_surface(engine: str) -> None:
    """Light that is blurred by mistake is hardly seen; light that stays sharp by mistake is a speck.

    A sharp near surface is not torn for that: pixels of about its colour stay its own before a blurred far surface.
    """
    for far_px, colour, shown_px in ((0.0, 0.55, -10.0), (10.0, 0.65, 0.0)):
        image = two_colours()
        image[..., 8:50:8, 31] = colour
        coc_px = edges.mended(image, far_px - 10 * RAMP, "auto")[0, 0, 8:50:8, 31]
        torch.testing.assert_close(coc_px, torch.full((6,), shown_px), atol=1e-4, rtol=0)


@pytest.mark.parametrize("mixed", [0.42, 0.48])
def test_a_mixed_colour_belongs_to_a_more_blurred_near_surface(engine: str, mixed: float) -> None:
    """It is light of the near surface too; in focus with the far one it would be a sharp outline."""
    image = two_colours()
    image[..., 8:50:8, 31] = mixed
    coc_px = edges.mended(image, -10 * RAMP, "auto")[0, 0]
    torch.testing.assert_close(coc_px[8:50:8, 31], torch.full((6,), -10.0), atol=1e-4, rtol=0)
    torch.testing.assert_close(coc_px[:, 28], torch.zeros(64), atol=1e-4, rtol=0)


def test_colours_need_to_agree_with_one_side_only(engine: str) -> None:
    """Beside a foreground that is too thin, what the map calls background has the colour of the foreground."""
    ramp = ((torch.arange(64.0) - 32.5) / 3).clamp(0, 1).expand(1, 1, 256, 64)  # 2 px to the right of the image's edge
    coc_px = edges.mended(two_colours().repeat(1, 1, 4, 1), -10 * ramp, "auto")[0, 0]
    torch.testing.assert_close(coc_px[:, 33:], torch.full((256, 31), -10.0), atol=1e-4, rtol=0)


RAMP = ((torch.arange(64.0) - 28.5) / 6).clamp(0, 1).expand(1, 1, 64, 64)


def two_colours() -> Tensor:
    """Dark left and bright right of column 32, with noise."""
    noise = torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(3))
    return (0.2 + 0.6 * (torch.arange(64.0) >= 32) + 0.05 * noise).repeat(1, 3, 1, 1)


def test_ramps_of_a_soft_map_end_where_both_surfaces_look_alike(engine: str) -> None:
    """A depth between two blurred surfaces may be in focus. A lamp there, which resembles neither, keeps it."""
    generator, columns = torch.Generator().manual_seed(3), torch.arange(64.0)
    image = 0.2 + 0.6 * (columns >= 32) + 0.05 * torch.randn(1, 1, 64, 64, generator=generator)
    image[..., 40:, :] = torch.rand(24, 64, generator=generator)
    image[..., 18:23, 29:34] = 100.0
    coc_px = 10 - 20 * ((columns - 28.5) / 6).clamp(0, 1).expand(1, 1, 64, 64)
    repaired = edges.mended(image.repeat(1, 3, 1, 1), coc_px, "auto")[0, 0]
    assert float(repaired[44:].abs().min()) > 9.999
    assert float(repaired[20, 31] - coc_px[0, 0, 20, 31]) == pytest.approx(0.0, abs=1e-4)


LEFT = {"half-res": 0.2, "quarter-res": 0.4, "blur 1.5": 0.3, "displaced": 0.6, "shift 1px": 0.6}
LEFT |= dict.fromkeys(("near -1px", "near -2px", "near +1px"), 0.25)


@pytest.mark.parametrize("kind", LEFT)
@pytest.mark.parametrize("how", ["auto", "repair"])
def test_edges_move_to_those_of_the_image(scene: Scene, kind: str, how: DepthEdges) -> None:
    depth = degrade(scene.depth, kind)
    assert wrong(repair_edges(scene.image, depth, how), scene.depth) < LEFT[kind] * wrong(depth, scene.depth)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"exact"}))
def test_depth_with_an_unrelated_image_is_unchanged(scene: Scene, kind: str) -> None:
    depth = degrade(scene.depth, kind)
    assert torch.equal(repair_edges(torch.rand_like(scene.image), depth, "auto"), depth)


def test_items_of_a_batch_are_repaired_independently(scene: Scene) -> None:
    images, depth = torch.cat([scene.image, torch.rand_like(scene.image)]), degrade(scene.depth, "half-res")
    together = repair_edges(images, depth, "auto")
    assert torch.equal(together[:1], repair_edges(images[:1], depth, "auto"))
    assert torch.equal(together[1:], depth)


def test_noise_is_not_an_edge_and_edges_in_noise_are_repaired(scene: Scene, engine: str) -> None:
    for shape in ((1, 1, 128, 1), (1, 1, 1, 192)):  # along rows and along columns
        noise = (2.0 * torch.randn(shape, generator=torch.Generator().manual_seed(0))).expand(scene.depth.shape)
        assert torch.equal(edges.repair(scene.image, noise.contiguous(), edges.STEP_PX, False)[0], noise)
    exact, thin = (-8.0 * scene.camera.coc_px(degrade(scene.depth, kind), 192) for kind in ("exact", "near -1px"))
    noise = 0.3 * torch.randn(exact.shape)  # its range within five pixels is as large as a step
    assert torch.equal(edges.repair(scene.image, exact + noise, 1.0, True)[0], exact + noise)
    left = (edges.repair(scene.image, thin + noise, 1.0, True)[0] - exact).abs() > 10.0
    assert float(left.float().mean()) < 0.25 * float(((thin - exact).abs() > 10.0).float().mean())


@pytest.mark.parametrize("steepness", [0.02, 0.3, 1.0])
@pytest.mark.parametrize("how", ["auto", "repair"])
def test_a_slope_is_unchanged(steepness: float, how: DepthEdges) -> None:
    x, y = torch.meshgrid(torch.arange(96.0), torch.arange(64.0), indexing="xy")
    coc = (steepness * (x + 0.3 * y))[None, None]
    image = waves(5)(x.double(), y.double()).float()[None]
    assert torch.equal(-edges.repair(image, -coc, torch.tensor(1.0), how == "auto")[0], coc)


def test_a_thin_structure_of_a_soft_map_comes_no_nearer_than_the_map(scene: Scene) -> None:
    planes = [
        Plane(6.0, waves(1, mean=(0.5, 0.5, 0.5), contrast=0.3)),
        Plane(1.5, waves(2, mean=(0.1, 0.1, 0.05)), posts(23.0, 2.0, 0.2)),
    ]
    thin = plane_scene(planes, scene.camera, (96, 160), samples=16)
    given = degrade(thin.depth, "half-res")
    nearness, repaired = 1 / given, 1 / repair_edges(thin.image, given, "auto")
    assert not torch.equal(repaired, nearness)
    assert bool((repaired <= functional.max_pool2d(nearness, 11, 1, 5) + 1e-6).all())


def test_the_averaged_depth_of_a_lamp_is_restored_and_does_not_come_nearer_than_it_was() -> None:
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    square_px = ((rows % 24 - 12) ** 2 + (columns % 26 - 12) ** 2).where(columns < 116, torch.inf)
    lamps = square_px < 5.0
    image = torch.where(lamps, 200.0, 0.2 + 0.02 * torch.rand(1, 3, 96, 128))
    given = degrade(torch.where(lamps, 2.0, 8.0)[None, None], "blur 1.5")
    assert float((1 / given)[..., lamps].mean()) < 0.33
    assert 0.39 < float((1 / repair_edges(image, given, "auto"))[..., lamps].mean()) < 0.6
    # larger in the map than in the image, so that no depth was lost
    given = degraded._blurred(torch.where(square_px < 14.0, 2.0, 8.0)[None, None], 1.5)
    assert float((1 / repair_edges(image, given, "auto")).max()) < 0.6


def test_pixels_of_a_lamp_of_uneven_brightness_get_one_depth() -> None:
    generator = torch.Generator().manual_seed(0)
    image, depth = 0.2 + 0.02 * torch.rand(1, 3, 96, 128, generator=generator), torch.full((1, 1, 96, 128), 8.0)
    lamps = [(..., slice(row, row + 3), slice(row // 3 + 4, row // 3 + 7)) for row in range(12, 90, 16)]
    for lamp in lamps:
        image[lamp], depth[lamp] = 50.0 + 150.0 * torch.rand(1, 3, 3, 3, generator=generator), 2.0
    repaired = 1 / repair_edges(image, degrade(depth, "half-res"), "auto")
    assert max(float(repaired[lamp].max() - repaired[lamp].min()) for lamp in lamps) < 0.005


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
@pytest.mark.parametrize("kind", ["near -1px", "half-res"])
def test_repair_commutes_with_flips_and_turns(
    scene: Scene, kind: str, turn: Callable[[Tensor], Tensor], engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sizes are odd and damage and noise uneven, so that a sample that is not turned with the frame is detected."""
    monkeypatch.setattr(edges, "_SAMPLED", 2**12)  # makes the plain engine sample a small frame
    times = (1, 1) if engine == "torch" else (7, 6)  # a frame large enough to be sampled
    image = scene.image.repeat(1, 1, *times)[..., :-1, :-3]
    exact, damaged = (
        scene.camera.coc_px(degrade(scene.depth, k), 192).repeat(1, 1, *times)[..., :-1, :-3] for k in ("exact", kind)
    )
    height, width = exact.shape[-2:]
    coc = torch.where(torch.arange(width) + torch.arange(height)[:, None] < 0.9 * width, damaged, exact)
    coc = coc + 0.01 * torch.randn(height, 1, generator=torch.Generator().manual_seed(0))
    repaired = edges.repair(image, -coc, edges.STEP_PX, True)[0]
    assert not torch.equal(repaired, -coc)
    turned = edges.repair(turn(image).contiguous(), turn(-coc).contiguous(), edges.STEP_PX, True)[0]
    torch.testing.assert_close(turned, turn(repaired), rtol=0, atol=1e-3)


def test_markers_of_holes_are_kept_and_act_like_nan(scene: Scene) -> None:
    depth, holes = degrade(scene.depth, "near -1px"), torch.zeros_like(scene.depth, dtype=torch.bool)
    holes[..., 40:60, :30] = True
    repaired, *same = (repair_edges(scene.image, depth.where(~holes, marked)) for marked in (torch.nan, 0.0, -3.0))
    assert bool(repaired[holes].isnan().all()) and [set(s[holes].tolist()) for s in same] == [{0.0}, {-3.0}]
    assert all(torch.equal(repaired[~holes], s[~holes]) for s in same)


def test_a_hole_within_a_surface_changes_no_other_pixel(scene: Scene) -> None:
    depth, holes = torch.full((1, 1, 128, 192), 4.0), torch.zeros(1, 1, 128, 192, dtype=torch.bool)
    depth[..., 101:], holes[..., 40:60, 20:60] = 2.0, True
    image = scene.image * torch.where(torch.arange(192) < 100, 0.3, 1.0)
    whole = repair_edges(image, depth)
    assert bool((whole != depth).any())
    assert torch.equal(repair_edges(image, torch.where(holes, torch.nan, depth))[~holes], whole[~holes])


@pytest.mark.parametrize("kind", ["half-res", "near -1px"])
def test_differences_below_half_a_step_are_not_edges(scene: Scene, kind: str, engine: str) -> None:
    nearness = 1.0 / degrade(scene.depth, kind)
    image = scene.image.clone()
    image[..., 60:62, 90:92] = 500.0
    nearness[..., 60:62, 90:92] = nearness.max()
    low, high = nearness.aminmax()
    assert not torch.equal(edges.repair(image, nearness, 0.5 * float(high - low), False)[0], nearness)
    assert torch.equal(edges.repair(image, nearness, 2.001 * float(high - low), False)[0], nearness)


@pytest.mark.parametrize("moved", [1e-4, -1e-4])
def test_the_direction_of_an_edge_does_not_depend_on_rounding(moved: float) -> None:
    """Where four blocks meet, the near surface is equally beside and below a pixel."""
    blocks = 3.0 * torch.randint(0, 4, (1, 1, 6, 8)).repeat_interleave(8, -1).repeat_interleave(8, -2) + 0.1
    found, again = (edge_search.find(n, n.isfinite(), torch.tensor(1.0)) for n in (blocks, blocks + moved))
    assert bool(found.is_edge.any())
    assert torch.equal(found.direction[found.is_edge], again.direction[found.is_edge])


def levels_of_a_file(count: int) -> Tensor:
    """Hills of whole numbers up to a count: differences and means of neighbours are simple fractions of each other."""
    hills = torch.rand(1, 1, 16, 24, generator=torch.Generator().manual_seed(0))
    return (count * functional.interpolate(hills, size=(96, 144), mode="bicubic")).round()


@pytest.mark.parametrize("moved", [0.1, -7.0])
@pytest.mark.parametrize("count", [40, 120])
def test_edges_between_levels_of_a_file_do_not_depend_on_rounding(count: int, moved: float) -> None:
    levels = levels_of_a_file(count)
    found, again = (
        edge_search.find(n, n.isfinite(), step)
        for n, step in ((levels, torch.tensor(1.0)), (levels / 3 + moved, torch.tensor(1 / 3)))
    )
    assert int(found.is_ramp.sum()) > 1000
    for name in ("is_edge", "is_ramp", "ring"):
        assert torch.equal(getattr(found, name), getattr(again, name)), name


@COMPILED
@pytest.mark.parametrize("of_coc", [True, False])
@pytest.mark.parametrize("count", [16, 40, 255])
def test_engines_agree_at_every_pixel_of_a_map_of_levels(count: int, of_coc: bool) -> None:
    levels = levels_of_a_file(count)
    light = levels / count + 0.2 * torch.rand(1, 3, 96, 144)
    given = (-1.0 if of_coc else 1.0) * (0.3 * levels - 7.0)
    plain = edges._repair(light, given, torch.tensor(1.0), False, of_coc)[0]
    fast, _ = edges.repair(light, given, torch.tensor(1.0), False, of_coc)
    assert float((fast != given).float().mean()) > 0.5
    torch.testing.assert_close(fast, plain, rtol=0, atol=1e-3)


def test_infinite_depth_is_a_surface(scene: Scene) -> None:
    depth = torch.where(scene.depth == 6.0, math.inf, scene.depth)
    given = degrade(depth, "near -1px")
    errors = [(d.isinf() != depth.isinf()).float().mean() for d in (repair_edges(scene.image, given, "auto"), given)]
    assert float(errors[0]) < 0.3 * float(errors[1])


def test_gradients_flow_to_pixels_that_are_not_repaired(scene: Scene) -> None:
    depth = degrade(scene.depth, "near -1px").requires_grad_()
    repaired = repair_edges(scene.image, depth)
    (gradient,) = torch.autograd.grad(repaired.sum(), depth)
    assert torch.equal(gradient, (repaired == depth).float())


def test_the_renderer_repairs_by_its_option_depth_edges(scene: Scene) -> None:
    depth = degrade(scene.depth, "half-res")
    coc = scene.camera.coc_px(depth, 192)
    repaired = edges.repair(scene.image, coc, torch.tensor(1.0), True, of_coc=True)[0]
    as_given = DepthOfField(scene.camera, depth_edges="as given")
    assert torch.equal(as_given.coc_px(scene.image, depth), coc)
    assert torch.equal(DepthOfField(scene.camera).coc_px(scene.image, depth), repaired)
    expected = DepthOfField(scene.camera)(scene.image, depth)
    assert torch.equal(blur_by_coc(scene.image, coc), expected)
    # with the repaired map the picture differs only at edges that the repair made of ramps: there `expected` is soft
    crisp = blur_by_coc(scene.image, repaired, depth_edges="as given")
    assert metrics.psnr(crisp, expected) > metrics.psnr(as_given(scene.image, depth), expected) + 5


def assert_engines_agree(image: Tensor, nearness: Tensor, step: Tensor, auto: bool) -> None:
    for given, of_coc in ((nearness, False), (-nearness, True)):
        plain = edges._repair(image, given, step, auto, of_coc)[0][0, 0]
        fast = native.repair_edges(image[0], given[0, 0], step.squeeze(), auto, of_coc=of_coc)[0]
        same = torch.isclose(fast, plain, rtol=1e-3, atol=1e-3, equal_nan=True)
        assert float(same.float().mean()) > 0.999  # rounding may decide if both surfaces are equally likely
        unchanged = [torch.allclose(n, given[0, 0], rtol=0, atol=0, equal_nan=True) for n in (plain, fast)]
        assert unchanged[0] == unchanged[1]


@COMPILED
@pytest.mark.parametrize("auto", [True, False])
@pytest.mark.parametrize(("kind", "times"), [*((kind, 1) for kind in KINDS), ("exact", 3), ("half-res", 3)])
def test_engines_agree(scene: Scene, kind: str, times: int, auto: bool) -> None:
    nearness = -scene.camera.coc_px(degrade(scene.depth, kind), 192).repeat(1, 1, times, times)
    nearness[..., 50:55, 60:70] = torch.nan
    assert times == 1 or nearness.numel() > 4 * edges._SAMPLED
    assert_engines_agree(scene.image.repeat(1, 1, times, times), nearness, torch.tensor(1.0), auto)


@COMPILED
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 3), (65, 130)])
def test_engines_agree_on_frames_of_any_size(size: tuple[int, int]) -> None:
    blocks = 9 * torch.rand(1, 1, 1 + size[0] // 5, 1 + size[1] // 5)  # blocks, because noise would not be repaired
    nearness = blocks.repeat_interleave(5, -2).repeat_interleave(5, -1)[..., : size[0], : size[1]].contiguous()
    assert_engines_agree(torch.rand(1, 2, *size), nearness, torch.full_like(nearness, 0.5), False)


@COMPILED
def test_any_number_of_threads_gives_the_same_bits(scene: Scene) -> None:
    nearness = -scene.camera.coc_px(degrade(scene.depth, "half-res"), 192)[0, 0]
    threads, results = torch.get_num_threads(), []
    for count in (1, 2, 5, threads):
        torch.set_num_threads(count)
        results.append(native.repair_edges(scene.image[0], nearness, torch.tensor(1.0), True)[0])
    assert all(torch.equal(result, results[0]) for result in results)


def test_repair_compiles_without_graph_breaks(scene: Scene) -> None:
    coc = scene.camera.coc_px(degrade(scene.depth, "half-res"), 192)
    compiled = torch.compile(edges.repair, backend="eager", fullgraph=True)
    plain = edges._repair(scene.image, -coc, torch.tensor(1.0), True)[0]
    torch.testing.assert_close(compiled(scene.image, -coc, 1.0, True)[0], plain)


@pytest.mark.parametrize("auto", [True, False])
@pytest.mark.parametrize(
    ("near", "far", "light"),
    [(3e38, 1.0, 1.0), (1e16, -1e16, 1.0), (1e14, -1e14, 1.0), (3e38, -3e38, 1.0), (math.nan, 1.0, 1.0),
     (4.0, 1.0, 3e38), (4.0, 1.0, 1e-45)],
)  # fmt: skip
def test_repairs_of_all_maps_are_finite(near: float, far: float, light: float, engine: str, auto: bool) -> None:
    nearness = torch.full((1, 1, 24, 32), far)
    nearness[..., 6:18, 9:21] = near  # one pixel right of the image's square
    image = torch.full((1, 3, 24, 32), 0.1 * light)
    image[..., 6:18, 8:20] = light
    repaired = edges.repair(image, nearness, torch.tensor(1.0), auto)[0]
    known = torch.isfinite(nearness)
    assert torch.equal(torch.isfinite(repaired), known)
    assert float(repaired[known].abs().max()) <= 1.001 * float(nearness[known].abs().max())
    too_large = nearness.abs() > 1e15
    assert torch.equal(repaired[too_large], nearness[too_large])


def enlarged(height: int = 193, width: int = 262) -> tuple[Tensor, Tensor, Tensor]:
    """An image, a map of its coc enlarged from an eighth of its size, and the exact map."""
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    is_near = ((x + 6.0 * torch.sin(y / 21.0)) % 90 < 42).float()[None, None]
    colours = torch.tensor([[0.1, 0.2, 0.3], [0.6, 0.5, 0.3]]).view(2, 3, 1, 1)
    image = torch.lerp(colours[0], colours[1], is_near) * (0.9 + 0.2 * torch.rand(1, 3, height, width))
    small = functional.interpolate(is_near, (height // 8, width // 8), mode="area")
    return image, 5 - 11 * functional.interpolate(small, (height, width), mode="bilinear"), 5 - 11 * is_near


def test_a_map_that_was_enlarged_gets_the_edges_of_the_image(engine: str) -> None:
    image, given, exact = enlarged()
    shares = [float(((m - exact).abs() > 1).float().mean()) for m in (given, edges.mended(image, given, "auto"))]
    assert shares[0] > 0.1
    assert shares[1] < 0.02


def test_an_enlarged_map_is_narrowed_alike_by_both_engines_and_beside_other_items(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image, given, exact = enlarged(141, 203)
    given[..., 40:43, 60:64], given[..., 0, 0] = torch.nan, torch.inf
    images, maps = torch.cat([image, image.flip(1)]), torch.cat([given, exact])
    results = {}
    for engine in ("torch", "native") if native.chosen() else ("torch",):
        monkeypatch.setenv("TORCHDOF_ENGINE", engine)
        results[engine] = edges.mended(images, maps, "auto")
        alone = [edges.mended(i[None], m[None], "auto") for i, m in zip(images, maps, strict=True)]
        torch.testing.assert_close(results[engine], torch.cat(alone), rtol=0, atol=0, equal_nan=True)
        assert torch.equal(results[engine][1:], exact)
        assert torch.equal(results[engine].isfinite(), maps.isfinite())
    for result in results.values():
        torch.testing.assert_close(result, results["torch"], rtol=0, atol=1e-4, equal_nan=True)


def test_a_smooth_map_stays(engine: str) -> None:
    """However wide its slopes are: the image shows no edges there."""
    scene = made("smooth", 140, 170, 14.0)
    assert torch.equal(edges.mended(scene.image, scene.coc_px, "auto"), scene.coc_px)
