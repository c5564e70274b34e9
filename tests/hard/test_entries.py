"""Every public entry under hostile conditions: autocast, types that only store, plans of other scenes, lenses."""

import functools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc, depth_of_field
from torchdof.depth import depth_from_values, fill_holes, repair_edges
from torchdof.io.images import Picture, write_image
from torchdof.optics import psf
from torchdof.reference.lens_views import lens_views
from torchdof.reference.metrics import ssim
from torchdof.render.plan import Plan

pytestmark = pytest.mark.hard

EVERY_ENGINE = pytest.mark.parametrize("engine", ["torch", "native"])
CAMERA = Camera(focal_length_mm=50.0, f_number=2.0, focus_m=2.0, sensor_width_mm=4.0)
DOF = DepthOfField(CAMERA)


def light(channels: int = 3) -> Tensor:
    return torch.rand(1, channels, 24, 32, generator=torch.Generator().manual_seed(1))


def slope() -> Tensor:
    return torch.linspace(1.2, 6.0, 32).expand(1, 1, 24, 32)


def posts() -> Tensor:
    """Posts three pixels wide before a wall."""
    depth = torch.full((1, 1, 24, 32), 2.5)
    depth[..., 12:15] = depth[..., 4:16, 24:27] = 1.2
    return depth


def soft_posts() -> Tensor:
    """The same as resampling leaves it: ramps swallow part of what is thin."""
    return 1.0 / torch.nn.functional.avg_pool2d(1.0 / posts(), 3, 1, 1, count_include_pad=False)


def lit_posts() -> Tensor:
    return 0.1 * light() + (posts() < 2.0)


ENTRIES: dict[str, Callable[[], Tensor]] = {
    "repair_edges": lambda: repair_edges(lit_posts(), soft_posts()),
    "forward, edges repaired": lambda: DepthOfField(CAMERA, depth_edges="repair")(lit_posts(), soft_posts()),
    "forward, cat's eyes": lambda: DepthOfField(CAMERA, BlurTable.polygon(5, vignetting=0.4))(light(), slope()),
    "forward": lambda: DOF(light(), slope()),
    "forward with a plan": lambda: DOF(light(), slope(), plan=DOF.plan(light(), slope())),
    "forward with a background": lambda: DOF(light(), slope(), background=light(), background_depth=2 * slope()),
    "forward with attention": lambda: DOF(light(), slope(), attention=(9.0, 9.0, 3.0)),
    "layers": lambda: DOF.layers(light(4)[:, None].expand(1, 2, -1, -1, -1), torch.tensor([1.2, 9.0])),
    "layers, one item after the other": lambda: DOF.layers(light(8).reshape(1, 2, 4, 24, 32), torch.tensor([1.2, 9.0])),
    "coc_px": lambda: DOF.coc_px(light(), slope()),
    "depth_of_field": lambda: depth_of_field(light(), slope(), CAMERA, occlusion=False),
    "blur_by_coc": lambda: blur_by_coc(light(), slope(), method="fold"),
    "kernels": lambda: BlurTable.load("sato_j15").kernels(torch.tensor([-3.0, 7.0]), 640),
    "lens_views": lambda: lens_views(light(), slope(), CAMERA, views=8).image,
    "ssim": lambda: torch.as_tensor(ssim(light(), light().flip(-1))),
}


@EVERY_ENGINE
@pytest.mark.parametrize("name", ENTRIES)
def test_autocast_changes_no_number(name: str, engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    plain = ENTRIES[name]()
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(ENTRIES[name](), plain)


IMAGE, MAP = torch.ones(1, 3, 4, 5), torch.ones(1, 1, 4, 5)
TAKES_TENSORS: dict[str, Callable[[Tensor], Any]] = {
    "image": lambda x: DOF(x.expand(1, 3, 4, 5), MAP),
    "depth": lambda x: DOF(IMAGE, x),
    "focus_m": lambda x: DOF(IMAGE, MAP, focus_m=x.flatten()[:1]),
    "background": lambda x: DOF(IMAGE, MAP, background=x.expand(1, 3, 4, 5), background_depth=MAP),
    "background_depth": lambda x: DOF(IMAGE, MAP, background=IMAGE, background_depth=x),
    "attention": lambda x: DOF(IMAGE, MAP, attention=x),
    "rgba": lambda x: DOF.layers(x[None].expand(1, 2, 4, 4, 5), torch.ones(2)),
    "depth_m": lambda x: DOF.layers(torch.ones(1, 2, 4, 4, 5), x.flatten()[:2]),
    "coc_px": lambda x: blur_by_coc(IMAGE, x),
    "f_number": lambda x: Camera(f_number=x.flatten()[:1]),
    "depth ": lambda x: CAMERA.coc_px(x, 10),
    "depth  ": lambda x: CAMERA.focus_at(x, 1, 1),
    "coc": lambda x: BlurTable("gaussian", x.flatten()[:1], {"sigma": [1.0]}),
    "sigma": lambda x: BlurTable("gaussian", [1.0], {"sigma": x.flatten()[:1]}),
    "radius": lambda x: psf.disc(x.flatten()[:1]),
    "depth values": lambda x: depth_from_values(x),
    "depth   ": lambda x: fill_holes(x, "far"),
    "pixels": lambda x: write_image("never.exr", Picture(x.expand(1, 3, 4, 5))),
}
STORED = [torch.float8_e4m3fn, torch.float8_e5m2, torch.float8_e4m3fnuz, torch.float8_e5m2fnuz, torch.float8_e8m0fnu]


@pytest.mark.parametrize("dtype", [*STORED, torch.float4_e2m1fn_x2], ids=str)
@pytest.mark.parametrize("name", TAKES_TENSORS)
def test_types_that_only_store_are_refused_by_name(name: str, dtype: torch.dtype) -> None:
    stored = torch.full((1, 1, 4, 5), 56, dtype=torch.uint8).view(dtype)
    with pytest.raises(ValueError, match=rf"{name.strip()}\b.* got .*float(8|4)"):
        TAKES_TENSORS[name](stored)


# Plans


@EVERY_ENGINE
@pytest.mark.parametrize("occlusion", [True, False])
@pytest.mark.parametrize(
    ("planned", "rendered"),
    [(0.0, 6.0), (0.0, -6.0), (-2.0, -3.0), (3.0, 20.0), (4.0, -4.0), (5.0, 0.0)],
)
def test_a_plan_of_a_plane_serves_another_plane(
    planned: float, rendered: float, occlusion: bool, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    plan = Plan.of_scene(torch.full((1, 1, 24, 32), planned), 1 / 255)
    plane = torch.full((1, 1, 24, 32), rendered)
    out = blur_by_coc(light(), plane, plan=plan, occlusion=occlusion)
    truth = blur_by_coc(light(), plane, occlusion=occlusion)
    rms = float((out - truth).square().mean().sqrt())
    assert rms < 1 / 255  # layers of 20 px are coarser


@EVERY_ENGINE
def test_a_plan_of_the_first_frame_serves_a_pull_of_focus(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    plan = DOF.plan(light(), torch.full((1, 1, 24, 32), 2.0))  # all in focus
    for focus_m in (2.0, 1.9, 1.4, 1.25, 3.0, 9.0, math.inf):
        out, truth = DOF(light(), slope(), focus_m, plan=plan), DOF(light(), slope(), focus_m)
        assert float((out - truth).square().mean().sqrt()) < 1 / 255


def test_a_plan_that_reaches_stays_as_it_is() -> None:
    plan = DOF.plan(light(), slope())
    coc = DOF.coc_px(light(), slope())
    assert plan.reaching(coc) is plan and plan.reaching(0.5 * coc) is plan
    every = Plan.all(2.0, 1 / 255)
    assert every.reaching(coc) is every  # that of a graph, which cannot look at its scene
    wider = plan.reaching(3.0 * coc)
    assert set(plan.nodes) < set(wider.nodes)
    gaps = [high - low for low, high in zip(wider.nodes, wider.nodes[1:], strict=False)]
    assert min(gaps) > 0.05 and max(gaps) < 3.0


@pytest.mark.parametrize(
    "nodes", [(), (1.0, 0.0), (0.0, 0.0), (math.nan,), (0.0, math.inf), (1e300,), 5, [0.0, 1.0], None, "ab"]
)
def test_a_plan_without_layers_in_order_is_refused(nodes: Any) -> None:
    with pytest.raises(
        ValueError, match="plan must hold layers as a tuple of strictly increasing numbers below 1e9 px"
    ):
        Plan(nodes, 0.1)


@pytest.mark.parametrize("tolerance", [math.nan, math.inf, -1, 1, 2, "final", "fine", None, True, 10**400])
def test_a_plan_without_a_tolerance_is_refused(tolerance: Any) -> None:
    with pytest.raises(ValueError, match=r"tolerance .*must be a number in \[0, 1\), such as 1/255"):
        Plan((0.0, 1.0), tolerance)


# Lenses that there are not


@pytest.mark.parametrize(
    ("camera", "depth", "named"),
    [
        (Camera(f_number=1e-42), 3.0, "f_number 1e-42"),
        (Camera(sensor_width_mm=1e-300), 3.0, "sensor_width_mm 1e-300"),
        (Camera(focal_length_mm=1e200, focus_m=1e250), 3.0, r"focal_length_mm 1e\+200"),
        (Camera(focus_m=1e-45, focus_breathing=False), 3.0, "focus_m 1e-45"),
        (Camera(focus_m=torch.tensor([1e-45]), focus_breathing=False), 3.0, "focus_m 1.4013e-45"),
        (Camera(), 1e-45, "a depth of 1.4e-45 m"),
    ],
)
def test_a_blur_beyond_numbers_names_the_lens_and_the_depth(camera: Camera, depth: float, named: str) -> None:
    image, depths, dof = light(), torch.full((1, 1, 24, 32), depth), DepthOfField(camera)
    calls: list[Callable[[], Any]] = [
        functools.partial(dof, image, depths),
        functools.partial(dof.plan, image, depths),
        functools.partial(dof.coc_px, image, depths),
        functools.partial(depth_of_field, image, depths, camera),
        functools.partial(dof.layers, torch.ones(1, 2, 4, 24, 32), torch.tensor([depth, 5.0])),
        functools.partial(dof, image, torch.full_like(depths, 1e-30 if depth > 1 else depth), background=image,
                          background_depth=depths),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(ValueError, match=f"this lens .*{named}") as refused:
            call()
        assert "coc_px" not in str(refused.value) and "check=False" not in str(refused.value)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_bad_light_in_layers_is_refused_and_counted(bad: float) -> None:
    rgba = torch.ones(1, 2, 4, 6, 7)
    rgba[0, 1, 2, 3, 4:6] = bad
    with pytest.raises(ValueError, match="rgba must be finite, got 2 of 336"):
        DOF.layers(rgba, torch.tensor([1.0, 4.0]))
