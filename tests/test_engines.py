"""Both engines and an exported file render the same picture, on hostile and on random scenes.

`pytest -s tests/test_engines.py -k error` prints the errors against closed forms, or the plain engine in float64.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.autograd import forward_ad
from torch.testing import assert_close

from tests.scenes import (
    CAMERA,
    CASES,
    EVERY_WAY,
    HEIGHT,
    TABLES,
    WIDTH,
    Case,
    Scene,
    assert_same_picture,
    halves,
    lens_with_a_field,
    made,
    random_scene,
    slope,
    texture,
    whole,
)
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc, depth_of_field, native
from torchdof.depth import repair_edges
from torchdof.export.graph import Portable
from torchdof.optics.aperture import Aperture
from torchdof.reference.lens_views import lens_views
from torchdof.reference.metrics import ssim
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.edges import repair

BY_COLOUR = BlurTable("gaussian", [1.0], {"sigma": torch.tensor([[0.4], [0.5], [0.6]])}, name="by colour")

LENSES = {
    **{str(table): table for table in (*TABLES, BY_COLOUR)},
    "triangle": BlurTable.polygon(3, 20.0, squeeze=1.6),
    "blades": BlurTable.polygon(5, 7.0, 0.4, rim=2.0),
    "image": BlurTable.from_aperture(torch.eye(9).cumsum(0)[:, :6], squeeze=1.2),
    "cat's eyes": BlurTable.disc().replace(aperture=Aperture(vignetting=0.4)),
    "squeezed cat's eyes": BlurTable.polygon(5, 10.0, squeeze=1.5, vignetting=(0.6, 0.2)),
    "cat's eyes by colour": BY_COLOUR.replace(aperture=Aperture(vignetting=0.5)),
    "spots across the field": lens_with_a_field(),
}


# Hostile scenes


@pytest.mark.parametrize(("case", "dtype"), [
    pytest.param(case, dtype, id=f"{case.name}, {dtype}", marks=[pytest.mark.sweep] if long else [])
    for case in CASES for dtype in (torch.float32, torch.float16)
    for long in [dtype == torch.float16 and "2001" in case.name]
])  # fmt: skip
def test_the_error_of_a_hostile_scene_is_within_its_limit(case: Case, dtype: torch.dtype, engine: str) -> None:
    error, limit = case.error(dtype), case.float32 if dtype == torch.float32 else case.float16
    print(f"{error:.1e} of {limit:.1e}")
    assert error <= limit


def by_file(exported: Any, image: Tensor, values: Tensor, camera: Camera | None) -> tuple[Tensor, Tensor]:
    """Pictures of an exported file, and of its module with the same layers in float64."""
    if camera is None:  # values are circles of confusion, and the file takes depth
        reach = 1.05 * float(values.max().clamp_min(1.0))  # coc at infinity
        camera = exported.dof.camera
        wide = camera.replace(f_number=1.0).coc_px(torch.full((1, 1, 1, 1), torch.inf), image.shape[-1])
        values = float(camera.focus_m) / (1.0 - values.double() / reach)
        camera = camera.replace(f_number=float(wide) / reach)
    image = image.float().expand(-1, 3, -1, -1)
    lens = [torch.full(image.shape[:1], float(number)) for number in (camera.focus_m, camera.f_number)]
    tensors = [image.contiguous(), values.float().contiguous(), *lens]
    with torch.no_grad():
        return exported.render(*tensors), Portable(exported.dof)(*(tensor.double() for tensor in tensors))


@pytest.mark.parametrize("case", [case for case in CASES if not case.options], ids=lambda case: case.name)
def test_the_error_of_a_file_is_within_1e_5(layered: Any, case: Case) -> None:
    for image, values, camera in case.pairs():
        got, truth = by_file(layered, image, values, camera)
        # relative to each pixel, or to the brightest one if negative light can cancel
        scale = truth.abs() if float(image.min()) >= 0 else truth.abs().max()
        apart = (got.double() - truth).abs() / scale.clamp_min(torch.finfo(torch.float32).tiny)
        assert float(torch.where(got == truth, 0.0, apart).max()) <= 1e-5


# Invalid light and depth


HOLE = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
HOLE[9:11, 8:10] = True
BAD = (0.0, -1.0, math.nan, -math.inf)


def assert_untouched_by_a_hole(render: Callable[[Tensor, Tensor], Tensor], bad: float) -> None:
    """A pixel with a bad depth stays sharp, and its light does not reach other pixels."""
    image, other, depth = texture(), torch.where(HOLE, 1e6, texture()), torch.where(HOLE, bad, slope(1.2, 6.0))
    out = render(image, depth)
    assert torch.equal(out[..., HOLE], image[..., HOLE]) and torch.isfinite(out).all()
    assert torch.equal(render(other, depth)[..., ~HOLE], out[..., ~HOLE])
    assert not torch.allclose(out[..., ~HOLE], image[..., ~HOLE])


def test_a_bad_depth_in_a_file_stays_sharp_and_does_not_affect_others(layered: Any) -> None:
    for bad in BAD:
        assert_untouched_by_a_hole(lambda image, depth: by_file(layered, image, depth, CAMERA)[0], bad)


@EVERY_WAY
def test_a_bad_depth_stays_sharp_and_does_not_affect_others(engine: str, way: dict[str, Any]) -> None:
    dof = DepthOfField(CAMERA, check=False, **way)
    for bad in BAD:
        assert_untouched_by_a_hole(dof, bad)
    image, flat, depth = texture(), torch.ones(1, 1, HEIGHT, WIDTH), slope(1.2, 6.0)
    assert torch.equal(dof(image, whole(math.nan)), image)
    depth[torch.rand(depth.shape) < 0.4] = math.nan
    assert_close(dof(flat, depth), flat, rtol=1e-6, atol=0.0)


@EVERY_WAY
@pytest.mark.parametrize(("bad", "coc_px"), [(math.nan, 40.0), (math.inf, 0.0), (-math.inf, -3.0), (math.nan, -3.0)])
def test_bad_light_stays_within_its_disc(engine: str, way: dict[str, Any], bad: float, coc_px: float) -> None:
    image, coc = texture(), slope(-3.0, 5.0)
    image[0, 1, 12, 16], coc[0, 0, 12, 16] = bad, coc_px
    touched = ~torch.isfinite(blur_by_coc(image, coc, check=False, **way)).all(1)[0]
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    assert int(touched.sum()) > 0
    assert not touched[torch.hypot(y - 12.0, x - 16.0) > max(abs(coc_px), 1.0) + 1].any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf], ids=str)
def test_bad_light_in_a_file_stays_in_its_pixels(layered: Any, bad: float) -> None:
    out, truth = by_file(layered, torch.where(HOLE, bad, texture()), slope(1.2, 6.0), CAMERA)
    assert torch.equal(torch.isfinite(out).all(1)[0], ~HOLE)
    assert_close(out.double()[..., ~HOLE], truth[..., ~HOLE], rtol=1e-5, atol=0.0)


# Light of any size


@EVERY_WAY
@pytest.mark.parametrize("light", [2e19, 3e38])
@pytest.mark.parametrize("post", [False, True], ids=["step", "post one pixel wide"])
def test_bright_light_at_a_step_agrees_with_float64(engine: str, way: dict[str, Any], light: float, post: bool) -> None:
    coc, image = halves(-6.0, 5.0), texture()
    if post:  # every pixel of it may be mixed
        coc = whole(5.0)
        coc[..., 14] = -4.0
    image[..., 12, 8:24] = 1.0
    image = (image * light).clamp(max=light)
    out, truth = blur_by_coc(image, coc, **way), blur_by_coc(image.double(), coc, **way)
    assert_close(out.double() / light, truth / light, rtol=1e-4, atol=1e-6)
    # the parts of a split pixel are limited for negative light too
    image = image / light
    assert_close(blur_by_coc(-image, coc, **way), -blur_by_coc(image, coc, **way), rtol=0.0, atol=5e-4)
    mixed = torch.where(coc > 0, -1.0, -3.0).expand(1, 3, -1, -1).clone()
    mixed[..., 16] = -2.0
    out = blur_by_coc(mixed, coc, **way)
    assert -3.0001 <= float(out.min()) and float(out.max()) <= -0.9999


@pytest.mark.parametrize("light", [2e19, 1e30, -1e30])
def test_bright_layers_and_backgrounds_do_not_overflow(engine: str, light: float) -> None:
    dof, depth = DepthOfField(CAMERA), halves(1.2, 2.5)
    image, far = texture(), whole(9.0)
    out, wide = (dof(i, depth, background=i * light, background_depth=far) for i in (image, image.double()))
    assert_close(out.double() / light, wide / light, rtol=1e-4, atol=1e-6)
    rgba = torch.rand(1, 2, 4, HEIGHT, WIDTH)
    rgba[:, :, -1] = torch.tensor([1e-6, 1.0])[:, None, None]  # a tiny coverage, by which light is divided
    rgba[:, :, :-1] *= light
    out, wide = (dof.layers(t, torch.tensor([1.2, 9.0])) for t in (rgba, rgba.double()))
    assert_close(out[:, :-1].double() / light, wide[:, :-1] / light, rtol=1e-4, atol=1e-6)
    assert_close(out[:, -1].double(), wide[:, -1], rtol=1e-5, atol=1e-6)


# The two engines


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """List of the items that the compiled engine renders, by kind."""
    kinds: list[str] = []

    def render(surfaces: Any, kind: Any, native_render: Any = native.render, **options: Any) -> Tensor:
        kinds.append(kind)
        return native_render(surfaces, kind, **options)

    monkeypatch.setattr(native, "render", render)
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    return kinds


@pytest.fixture
def by_both(counted: list[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Compares the pictures of both engines, to 1e-5 of the light nearby, and checks that each engine was used.

    The compiled engine renders with the instructions of any processor, then with those of this one.
    """
    best = native._instructions

    def compared(make: Callable[[], Tensor], image: Tensor, in_focus: bool = False) -> None:
        plain: Tensor | None = None
        for engine, instructions in (("torch", best), ("native", "baseline"), ("native", best)):
            monkeypatch.setenv("TORCHDOF_ENGINE", engine)
            monkeypatch.setattr(native, "_instructions", instructions)
            picture = make()
            assert bool(counted) == (engine == "native") or in_focus
            if plain is None:
                plain = picture
            assert_same_picture(plain, picture, image)

    return compared


SMOOTH = ("planes", "smooth", "noise", "slope")  # other kinds lie on thresholds, where rounding decides


@pytest.mark.parametrize("seed", range(60))
def test_engines_agree_on_random_scenes(seed: int, by_both: Any) -> None:
    scene, dice = random_scene(seed, side=120 if seed % 3 else 40, kinds=SMOOTH), torch.Generator().manual_seed(seed)
    scene.options["tolerance"] = (0.0, 1 / 255, 1 / 255, 4 / 255, 8 / 255)[(seed + 1) % 5]
    if scene.image.shape[1] == 3 and seed % 4 == 0:
        scene.options["table"] = BY_COLOUR
    if "occlusion" in scene.options:
        scene.options["normalize"] = seed % 3 > 0
    if seed % 7 == 0:  # several items, and other numbers of channels
        channels = 1 + seed % 5 if scene.image.shape[1] == 1 else 1
        scene.image, scene.coc_px = scene.image.repeat(2, channels, 1, 1), scene.coc_px.repeat(2, 1, 1, 1)
        scene.options = {k: v for k, v in scene.options.items() if not isinstance(v, Tensor) and v is not BY_COLOUR}
    if seed % 4 == 1:
        scene.options["check"] = False
        scene.coc_px[torch.rand(scene.coc_px.shape, generator=dice) < 0.03] = torch.nan
        if seed % 8 == 1:
            scene.image[torch.rand(scene.image.shape, generator=dice) < 0.01] = torch.inf
    by_both(scene.blurred, scene.image, in_focus=bool((torch.nan_to_num(scene.coc_px).abs() <= 1.0).all()))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("way", ["accumulated", "background"])
def test_engines_agree_exactly_on_thresholds(way: str, seed: int, by_both: Any) -> None:
    scene = random_scene(seed, [way], lamps=way == "accumulated", side=90, kinds=["quarters"])
    by_both(scene.blurred, scene.image, in_focus=bool((scene.coc_px.abs() <= 1.0).all()))


def _few_coarse(near_px: float, far_px: float, **options: Any) -> Scene:
    scene = made("smooth", 270, 390, 2.5, **options)
    scene.coc_px[..., 20:60, 30:75] = near_px + torch.rand(40, 45)
    scene.coc_px[..., 200:, 310:] = far_px + torch.rand(70, 80)
    return scene


def _background(lamps: float, check: bool) -> Scene:
    scene = made("planes", 70, 90, 9.0, items=2, lamps=lamps, check=check)
    behind, behind_coc = torch.rand(2, 3, 70, 90), scene.coc_px + 7.0 * torch.rand(2, 1, 70, 90)
    if not check:
        behind[0, 1, 10:20, 30:50], behind_coc[1, :, 40:50, 30:50] = torch.nan, torch.inf
    scene.options |= {"background": behind, "background_coc_px": behind_coc}
    return scene


def _matted(lamps: float, behind: bool, check: bool = True) -> Scene:
    scene = _background(lamps, check) if behind else made("planes", 70, 90, 9.0, items=2, lamps=lamps, check=check)
    edges = functional.avg_pool2d(scene.coc_px, 3, 1, 1)
    ends = edges.amin((2, 3), keepdim=True), edges.amax((2, 3), keepdim=True)
    scene.options["matte"] = ((ends[1] - edges) / (ends[1] - ends[0])).roll(1, -1) ** 2
    return scene


def _planned(reach_px: float) -> Scene:
    plan = Plan.for_scene(made("smooth", 50, 50, reach_px).coc_px, 1 / 255, adapt=False)
    return made("planes", 60, 75, 9.0, items=3, lamps=300.0, plan=plan)


SCENES: dict[str, Callable[[], Scene]] = {
    "attention": lambda: made("smooth", 120, 150, 4.0, attention=(40, 50, 20)),
    **{f"{size}": functools.partial(made, "smooth", *size, 6.0)
       for size in ((1, 1), (1, 7), (9, 1), (2, 3), (16, 16), (17, 33), (64, 5))},
    **{f"background, lamps {lamps:g}, check {check}": functools.partial(_background, lamps, check)
       for lamps in (1.0, 50.0) for check in (True, False)},
    **{f"matte, lamps {lamps:g}, background {behind}": functools.partial(_matted, lamps, behind)
       for lamps in (1.0, 50.0) for behind in (True, False)},
    "matte with holes": functools.partial(_matted, 1.0, True, False),
    **{f"the plan of {reach:g} px": functools.partial(_planned, reach) for reach in (2.3, 31.0)},
    **{f"few coarse layers, {ends}, {occlusion}": functools.partial(_few_coarse, *ends, occlusion=occlusion)
       for ends in ((-9.0, 11.0), (-24.0, 30.0)) for occlusion in (True, False)},
    **{f"{kind}, {name}, {occlusion}": functools.partial(
           made, kind, 60, 80, radius, lamps=1000.0, table=table, occlusion=occlusion)
       for i, (name, table) in enumerate(LENSES.items())
       for kind, radius, occlusion in (("smooth", 13.0, i % 2 > 0), ("planes", 5.0, i % 2 == 0))},
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_engines_agree_on_scenes_of_every_kind(name: str, by_both: Any) -> None:
    scene = SCENES[name]()
    by_both(scene.blurred, scene.image)


@pytest.mark.parametrize(("radius", "seed"), [(8.0, 58), (24.0, 4)])
def test_noise_as_depth_with_many_lamps_is_rendered_as_in_float64(radius: float, seed: int, by_both: Any) -> None:
    """Hardly any pixel lies on an emitter's surface there; a ratio of such small peaks would depend on rounding."""
    generator = torch.Generator().manual_seed(seed)
    image, coc, lamps = (torch.rand(1, n, 48, 83, generator=generator) for n in (3, 1, 1))
    image, coc = torch.where(lamps < 0.1, 50.0, 0.1) * image, radius * (2.0 * coc - 1.0)
    plan = Plan.for_scene(coc, 1 / 255)
    by_both(lambda: blur_by_coc(image, coc, plan=plan), image)
    exact = blur_by_coc(image.double(), coc.double(), plan=plan)
    assert_same_picture(exact.float(), blur_by_coc(image, coc, plan=plan), image)


@pytest.mark.parametrize("name", ["triangle", "blades", "image"])
@pytest.mark.parametrize("occlusion", [True, False])
def test_engines_and_fold_agree_on_asymmetric_kernels(name: str, occlusion: bool) -> None:
    scene = made("planes", 40, 50, 6.0, table=LENSES[name], occlusion=occlusion, tolerance=0)
    assert_same_picture(scene.blurred(method="fold"), scene.blurred(), scene.image)


@pytest.mark.parametrize("seed", range(8))
def test_engines_agree_on_stacks(seed: int, by_both: Any) -> None:
    items, count, channels = 1 + seed % 2, 1 + seed % 5, 1 + seed % 4
    size = (40 + 7 * seed, 61 + 5 * seed)
    cover = torch.rand(items, count, 1, *size)
    cover = torch.where(torch.rand(cover.shape) < 0.3, torch.where(cover < 0.5, 0.0, 1.0), cover)
    rgba = torch.cat([torch.rand(items, count, channels, *size) * cover, cover], 2)
    depth = 0.5 + 5.0 * torch.rand(items, count, 1, *(size if seed % 2 else (1, 1)))
    dof = DepthOfField(Camera(focus_m=1.7, f_number=1.4, sensor_width_mm=8.0), check=seed != 3)
    if seed == 3:
        rgba[0, 0, 0, 3, 5], depth[0, 0, :, 20:25] = torch.nan, torch.nan
    by_both(lambda: dof.layers(rgba, depth), torch.zeros_like(rgba[:, 0]))


SIZES = torch.tensor([0.0, 1e-45, 1e-38, 1.0, 2e9, 2e19, 1e30, 3.4e38, -1.0, -1e30, math.inf, math.nan])


@pytest.mark.hard
@pytest.mark.parametrize("seed", [*range(20), *(pytest.param(n, marks=pytest.mark.sweep) for n in range(20, 400))])
def test_engines_agree_on_numbers_of_any_size(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, dice = random_scene(seed, ["filled", "accumulated"], side=32), torch.Generator().manual_seed(seed)
    image, coc = scene.image.float(), scene.coc_px.float()
    for values in (image, coc):
        strange = SIZES[torch.randint(len(SIZES), values.shape, generator=dice)]
        values.copy_(torch.where(torch.rand(values.shape, generator=dice) < 0.05, strange, values))
    known = torch.isfinite(image).all(1, keepdim=True) & torch.isfinite(coc)
    light, span = (float(t.where(known, 0.0).abs().max()) for t in (image, coc))
    pictures, maps = [], []
    for engine in ("torch", "native"):
        monkeypatch.setenv("TORCHDOF_ENGINE", engine)
        pictures.append(blur_by_coc(image, coc, check=False, depth_edges="as given", **scene.options).where(known, 0.0))
        maps.append(repair(image, -coc, torch.tensor(2.0), seed % 2 > 0)[0])
    for picture, repaired in zip(pictures, maps, strict=True):
        assert float(picture.abs().max()) <= 1.5 * light
        assert torch.equal(repaired.isfinite(), coc.isfinite())
        assert float(repaired.abs().where(coc.isfinite(), 0.0).max()) <= 10.0 * span
    assert float((pictures[0].double() - pictures[1]).abs().max()) <= 1e-3 * light + 1e-37


# Dtypes and contexts


@EVERY_WAY
def test_the_picture_does_not_depend_on_half_precision(engine: str, way: dict[str, Any]) -> None:
    scene = made("smooth", 18, 22, 3.0, items=2, lamps=100.0)
    scene.coc_px[0] *= 0.1
    for dtype in (torch.float16, torch.bfloat16):
        image = scene.image.to(dtype)
        expected = blur_by_coc(image.float(), scene.coc_px, **way).to(dtype)
        assert torch.equal(blur_by_coc(image, scene.coc_px, **way), expected)
        coc = scene.coc_px.to(dtype)
        assert_close(blur_by_coc(image, coc, **way), blur_by_coc(image, coc.float(), **way), rtol=1e-2, atol=1e-3)


def posts(soft: bool = False) -> Tensor:
    """Depth of posts three pixels wide in front of a wall; ``soft`` averages it as resampling does."""
    depth = whole(2.5)
    depth[..., 12:15] = depth[..., 4:16, 24:27] = 1.2
    return 1.0 / functional.avg_pool2d(1.0 / depth, 3, 1, 1, count_include_pad=False) if soft else depth


DOF, REPAIRING = DepthOfField(CAMERA), DepthOfField(CAMERA, depth_edges="repair")
PLANE_DEPTHS = torch.tensor([1.2, 9.0])
ENTRIES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "repair_edges": lambda image, _: repair_edges(0.1 * image + (posts() < 2.0), posts(soft=True)),
    "edges repaired": lambda i, _: REPAIRING(0.1 * i + (posts() < 2.0), posts(soft=True)),
    "cat's eyes": DepthOfField(CAMERA, BlurTable.polygon(5, vignetting=0.4)),
    "depth": DOF,
    "fold": DepthOfField(CAMERA, method="fold"),
    "a plan": lambda image, depth: DOF(image, depth, plan=DOF.plan(image, depth)),
    "a background": lambda image, depth: DOF(image, depth, background=image, background_depth=2 * depth),
    "attention": lambda image, depth: DOF(image, depth, attention=(9.0, 9.0, 3.0)),
    "layers": lambda *_: DOF.layers(texture(channels=4)[:, None].expand(1, 2, -1, -1, -1), PLANE_DEPTHS),
    "layers, one after the other": lambda *_: DOF.layers(texture(channels=8).unflatten(1, (2, 4)), PLANE_DEPTHS),
    "coc_px": DOF.coc_px,
    "depth_of_field": lambda image, depth: depth_of_field(image, depth, CAMERA, occlusion=False),
    "kernels": lambda *_: BlurTable.load("sato_j15").kernels(torch.tensor([-3.0, 7.0]), 640),
    "lens_views": lambda image, depth: lens_views(image, CAMERA.coc_px(depth, image.shape[-1]), views=8).image,
    "ssim": lambda image, _: torch.as_tensor(ssim(image, image.flip(-1))),
}  # fmt: skip


@pytest.mark.parametrize("name", ENTRIES)
def test_contexts_change_neither_picture_nor_input_of(name: str, engine: str) -> None:
    image, depth = texture(), slope(1.2, 6.0)
    plain = ENTRIES[name](image, depth)
    for context in (torch.no_grad(), torch.inference_mode(), torch.autocast("cpu", torch.bfloat16)):
        with context:
            assert torch.equal(ENTRIES[name](image, depth), plain)
    assert torch.equal(image, texture()) and torch.equal(depth, slope(1.2, 6.0))


@pytest.mark.parametrize("method", ["layered", "fold"])
def test_tiles_rendered_separately_with_a_halo_leave_no_seam(method: Any) -> None:
    image, coc = 3 * torch.rand(1, 3, 40, 200) ** 3, slope(-6.0, 6.0, 40, 200)
    coc[..., 13:20, :] = -4.8
    options: dict[str, Any] = {"plan": Plan.for_scene(coc, 1 / 255, adapt=False), "occlusion": False, "method": method}
    picture = blur_by_coc(image, coc, **options)
    halo = 8 + 4 * 8  # outside the frame, light is a mean along the border, four times as wide as the distance
    for left in range(0, 200, 40):
        start, stop = max(0, left - halo), min(200, left + 40 + halo)
        tile = blur_by_coc(image[..., start:stop], coc[..., start:stop], **options)[..., left - start :][..., :40]
        assert_close(tile, picture[..., left : left + 40], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("occlusion", [True, False])
def test_a_plan_of_one_plane_renders_another(engine: str, occlusion: bool) -> None:
    for planned, shown in ((0.0, 6.0), (0.0, -6.0), (-2.0, -3.0), (3.0, 20.0), (4.0, -4.0), (5.0, 0.0)):
        plan, plane = Plan.for_scene(whole(planned), 1 / 255, adapt=False), whole(shown)
        out, truth = (blur_by_coc(texture(), plane, occlusion=occlusion, plan=p) for p in (plan, None))
        assert float((out - truth).square().mean().sqrt()) < 1 / 255  # layers of 20 px are coarser


# Which engine renders


@pytest.mark.parametrize(("wanted", "served"), [("native", 3), ("auto", 3), ("torch", 0)])
def test_the_environment_chooses(wanted: str, served: int, counted: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", wanted)
    scene = made("smooth", 30, 40, 3.0, items=3)
    out = scene.blurred()
    assert counted == served * ["image"] and out.data_ptr() != scene.image.data_ptr() and not out.requires_grad


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # raised inside PyTorch for tangents
def test_the_plain_engine_renders_calls_that_the_compiled_one_does_not_support(counted: list[str]) -> None:
    scene = made("smooth", 30, 40, 3.0)
    image, coc = scene.image, scene.coc_px
    assert blur_by_coc(image.clone().requires_grad_(), coc).requires_grad
    assert blur_by_coc(image, coc.clone().requires_grad_()).requires_grad
    with forward_ad.dual_level():
        out = blur_by_coc(forward_ad.make_dual(image, torch.ones_like(image)), coc, occlusion=False)
        assert forward_ad.unpack_dual(out).tangent is not None
    assert blur_by_coc(image.double(), coc).dtype == torch.float64
    blur_by_coc(image, coc.double())
    blur_by_coc(image, coc, method="fold")
    wide = image[..., :2, :].repeat(1, 1, 1, 18)
    blur_by_coc(wide, torch.full((1, 1, 2, 720), 400.0))  # a kernel convolved by FFT
    assert torch.equal(blur_by_coc(image, 0.0 * coc), image)
    assert counted == []
