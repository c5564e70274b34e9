"""Layers of a scene: their number, blurs and resolutions."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torchdof
from tests.scenes import smooth
from torchdof import blur_by_coc
from torchdof.optics.blur_table import BlurTable
from torchdof.reference import metrics
from torchdof.render.layers import layer_cocs
from torchdof.render.layers.layer_cocs import spacing
from torchdof.render.layers.layer_weights import blur_axis, from_blur_axis
from torchdof.render.layers.plan import Plan

TOLERANCE = st.sampled_from([0.0, 1 / 1000, 1 / 255, 1 / 60, 1 / 20, 0.5])


def coc_map(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64).reshape(1, 1, 1, -1)


@given(st.floats(-3.0, 3.0) | st.floats(-100.0, 100.0))
def test_the_blur_axis_is_continuous_and_increasing_and_inverted_by_from_blur_axis(coc: float) -> None:
    place, beside = blur_axis(torch.tensor([coc, coc + 1e-4], dtype=torch.float64)).tolist()
    assert 0.0 <= beside - place <= 1.2e-4  # nowhere steeper than 9 / 8
    assert from_blur_axis(place) == pytest.approx(coc if place != 0 else 0.0, abs=1e-11)


def test_a_scene_in_focus_gets_the_one_sharp_layer_and_its_kernels_move_less_than_2e_4_of_the_light() -> None:
    assert Plan.for_scene(coc_map(-0.01, 0.0, 0.004, 0.009), 1 / 255, adapt=False).nodes == (0.0,)
    assert len(Plan.for_scene(coc_map(-0.01, 0.0, 0.02), 1 / 255, adapt=False).nodes) == 2
    edge = from_blur_axis(1e-12)
    assert edge == pytest.approx(0.01, rel=0.02)
    for table in (BlurTable.disc(), BlurTable.gaussian(), BlurTable.load("sato_j15")):
        kernel = table.kernels(torch.tensor([edge], dtype=torch.float64), 500)[0, 0]
        assert 1.0 - float(kernel.max()) < 2e-4


@given(st.lists(st.floats(-300.0, 300.0), min_size=1, max_size=5), TOLERANCE)
def test_layers_increase_and_span_the_scene(coc: list[float], tolerance: float) -> None:
    scene = torch.tensor(coc, dtype=torch.float64).reshape(1, 1, 1, -1).expand(1, 1, 200, -1)
    plan = Plan.for_scene(scene, tolerance, adapt=False)
    blur = blur_axis(scene[0, 0, 0]).tolist()
    assert all(low < high for low, high in itertools.pairwise(plan.nodes))
    assert plan.nodes[0] == pytest.approx(min(blur), abs=1e-9) and plan.nodes[-1] == pytest.approx(max(blur), abs=1e-9)
    if min(blur) < 0 < max(blur):
        assert 0.0 in plan.nodes  # the sharp layer


@given(st.floats(0.6, 200.0), TOLERANCE)
def test_gaps_between_layers_are_at_most_the_spacing_of_the_tolerance(reach: float, tolerance: float) -> None:
    for plan in (Plan.for_scene(coc_map(-reach, reach), tolerance, adapt=False), Plan.static(reach, tolerance)):
        for low, high in itertools.pairwise(plan.nodes):
            inner, outer = sorted((abs(low), abs(high)))
            assert high - low <= spacing(inner, tolerance) + 0.3 * spacing(outer, tolerance) + 1e-9
    assert plan.coc_px[-1] == pytest.approx(reach)  # of the plan for all scenes
    assert 0.0 in plan.nodes or tolerance == 0.5
    assert [-x for x in reversed(plan.nodes)] == list(plan.nodes)


def test_a_static_plan_is_as_exact_on_a_slope_as_the_plan_of_the_scene() -> None:
    """A static plan has denser layers, because it cannot place layers at the blurs of the frame's border."""
    y, x = torch.linspace(0.0, 1.0, 160)[:, None], torch.linspace(0.0, 1.0, 240)
    coc = (8.0 + 16.0 * (0.7 * x + 0.3 * y))[None, None]
    image = smooth(3, 160, 240)
    exact = torchdof.blur_by_coc(image, coc, tolerance=0)
    plans = Plan.static(24.0, 1 / 255), Plan.for_scene(coc, 1 / 255, adapt=False)
    every, own = (float((torchdof.blur_by_coc(image, coc, plan=p) - exact).square().mean().sqrt()) for p in plans)
    assert every < own < 0.75 / 255


def test_a_frame_is_planned_for_less_where_it_is_blurred_much_not_where_a_few_pixels_are(engine: str) -> None:
    coc = torch.full((1, 1, 480, 640), 3.0)
    coc[..., 200:202, 300:302] = -1e5
    assert Plan.for_scene(coc, 1 / 255).tolerance == 1 / 255
    assert Plan.for_scene(coc, 1 / 255, on_grid=True).tolerance == 1 / 255
    for blurred in (torch.full_like(coc, 500.0), torch.cat([torch.full_like(coc, 500.0), coc])):
        assert Plan.for_scene(blurred, 1 / 255).tolerance == pytest.approx(480 / (3 * 500) / 255)


def test_a_rough_frame_is_planned_for_more_and_keeps_its_tolerance(engine: str) -> None:
    image, noise = smooth(3, 96, 128), torch.rand(1, 1, 96, 128) - 0.5
    change = float(layer_cocs.mean_change(40.0 * noise))
    rough = Plan.for_scene(40.0 * noise, 1 / 255)
    assert rough.tolerance == pytest.approx(math.sqrt(change / 8) / 255) and change > 20
    assert Plan.for_scene(40.0 * noise, 1 / 255, on_grid=True).tolerance == 1 / 255
    exact = torchdof.blur_by_coc(image, 40.0 * noise, plan=Plan.for_scene(40.0 * noise, 0.1 / 255, adapt=False))
    error = torchdof.blur_by_coc(image, 40.0 * noise, plan=rough) - exact
    assert float(error.square().mean().sqrt()) < 1 / 255
    # ordinary frames, one surface of two, and loose tolerances are planned as they are
    for calm in (5.0 * noise, torch.cat([40.0 * noise, 0.0 * noise])):
        assert Plan.for_scene(calm, 1 / 255).tolerance == 1 / 255
    assert Plan.for_scene(40.0 * noise, 5 / 255).tolerance == 5 / 255
    wide = 600.0 * torch.rand(1, 1, 1000, 1000) - 300.0
    wide[0, 0, 0, 0] = math.nan
    assert Plan.for_scene(wide, 1 / 255).tolerance == pytest.approx(4 / 255)


def test_layers_for_gradients_do_not_depend_on_small_changes_of_the_scene() -> None:
    frames = (coc_map(-3.0, reach).repeat(1, 1, 20, 10) for reach in (5.1, 5.1001))
    first, second = (Plan.for_scene(coc, 1 / 255, on_grid=True) for coc in frames)
    assert first.nodes == second.nodes
    assert first.nodes[0] <= -2.5 and first.nodes[-1] >= 4.6


def test_nan_and_infinite_coc_add_no_layers() -> None:
    assert Plan.for_scene(coc_map(math.nan, 3.0, 3.0), 1 / 255, adapt=False).coc_px[-1] == pytest.approx(3.0)
    reaching = Plan.for_scene(coc_map(-math.inf, math.inf), 1 / 20, adapt=False)
    assert all(math.isfinite(x) for x in reaching.nodes)
    coc = torch.zeros(2, 1, 40, 50)
    coc[..., :10], coc[0, 0, 0, 0] = -6.0, torch.nan
    pixels = Plan((-5.5, 0.0), 1 / 255).with_pixels(coc).pixels
    assert pixels is not None and pixels[0] == pytest.approx(799 / 4000), "a NaN counts as in focus"


@pytest.mark.parametrize("tolerance", [1 / 255, 4 / 255])
def test_highlights_become_rays_at_all_radii_of_coarse_layers(tolerance: float) -> None:
    plan = Plan.for_scene(coc_map(-40.0, 0.0, 30.0).expand(1, 1, 100, 3), tolerance, adapt=False)
    blurs = plan.layer_kernels(BlurTable.disc(), (100, 100), torch.float32, torch.device("cpu"), coarse=True)
    for k, (_, coc) in enumerate(zip(blurs, plan.coc_px, strict=True)):
        beside = [b.scale for b in blurs[max(0, k - 1) : k + 2]]
        assert max(beside) == 1 or abs(coc) >= plan.crisp_px or plan.nodes[k] == 0.0
    assert any(abs(c) < plan.crisp_px for c in plan.coc_px if c) and any(blur.scale > 1 for blur in blurs)


@pytest.mark.parametrize("tolerance", [0.0, 1 / 255, 4 / 255])
def test_layers_move_smoothly_with_the_ends_of_a_scene(tolerance: float) -> None:
    """Where the number of layers changes, the new layer coincides with another one."""
    reaches = torch.linspace(1.0, 9.0, 4001, dtype=torch.float64).tolist()
    nodes = [Plan.for_scene(coc_map(-2.2, far), tolerance, adapt=False).nodes for far in reaches]  # steps of 2e-3 px
    for before, after in itertools.pairwise(nodes):
        assert max(min(abs(x - y) for y in before) for x in after) < 0.01, f"{before} to {after}"
    assert len(nodes[-1]) > 4


@pytest.mark.parametrize("times", [1, 3], ids=["12 px", "36 px"])
def test_layers_are_dense_at_the_radii_of_the_border(times: int) -> None:
    """Surfaces continued outside the frame have the blur of the border; distant layers would be visible there."""
    y = torch.linspace(0, 1, 240)[:, None].expand(240, 320)
    coc = torch.where(torch.arange(320) < 20, -13.0, -12.0 * y**2)[None, None] * times  # a post is nearer yet
    image = 0.5 + 0.4 * torch.sin(y * 90)[None, None].expand(1, 3, -1, -1)
    exact, close = (torchdof.blur_by_coc(image, coc, tolerance=tolerance) for tolerance in (0, 1 / 255))
    assert float((close - exact)[..., -12:, 40:].abs().max()) < 4 / 255


def test_a_printed_plan_shows_resolution_and_share_of_the_pixels_of_each_layer() -> None:
    dof = torchdof.DepthOfField(torchdof.Camera(focus_m=2.0, f_number=1.0, sensor_width_mm=6.0), tolerance="preview")
    image = torch.rand(1, 3, 128, 256)
    depth = torch.where(torch.arange(256) < 128, 1.2, 2.0).expand(1, 1, 128, 256)
    plan = dof.plan(image, depth)
    lines = str(plan).splitlines()
    assert lines[0] == f"{len(plan.nodes)} layers, near to far, tolerance 4/255"
    assert len(lines) == 2 + len(plan.nodes)
    assert "50.0%" in lines[2] and "1/" in lines[2] and "50.0%" in lines[-1] and "full" in lines[-1]
    assert plan.pixels is not None and sum(plan.pixels) == pytest.approx(1.0)
    assert torch.equal(dof(image, depth, plan=plan), dof(image, depth))
    assert "%" not in str(Plan(plan.nodes, plan.tolerance))


def test_with_gradients_the_error_is_the_stated_one_for_small_blurs_and_at_tolerance_0() -> None:
    """The layers are then fixed; noise on patches of constant depth is the worst case."""
    for seed in (11, 47, 118, 59, *range(12)):
        generator = torch.Generator().manual_seed(seed)
        image, px = torch.rand(1, 3, 64, 64, generator=generator), (8, 16, 32, 64)[seed % 4]
        reach = 0.5 + 4.0 * float(torch.rand(1, generator=generator))
        levels = (2.0 * torch.rand(1, 1, 64 // px, 64 // px, generator=generator) - 1.0) * reach
        coc = levels.repeat_interleave(px, 2).repeat_interleave(px, 3)
        if px == 64:  # two planes
            coc = torch.where(torch.arange(64) > 32, reach, -0.7 * reach).expand(1, 1, 64, 64).contiguous()
        exact, radius = blur_by_coc(image, coc, tolerance=0), float(coc.abs().max())
        for tolerance in (4 / 255, 1 / 255, 0):
            stated = max(tolerance, (2.5 if radius < 2.0 else 1.5 if radius < 4.0 else 1.0) / 255)
            out = blur_by_coc(image, coc.clone().requires_grad_(), tolerance=tolerance).detach()
            difference = metrics.display(out) - metrics.display(exact)
            assert float(difference.square().mean().sqrt()) <= stated, (seed, radius, tolerance)
