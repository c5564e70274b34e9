"""Edges of a depth map: exact ones stay, others go to where the image has them, in both engines alike."""

import math
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import Camera, DepthOfField, blur_by_coc, native
from torchdof.depth import repair_edges
from torchdof.options import DepthEdges
from torchdof.reference import degraded
from torchdof.reference.degraded import KINDS, degrade
from torchdof.reference.scenes import Plane, Scene, plane_scene, posts, waves
from torchdof.render import edges

compiled = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built here")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Bars and a fence of different colours before a wall; the depth is exact."""
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


@pytest.mark.parametrize("kind", ["exact", "8 bit", "noise 1%"])
def test_exact_edges_stay_bit_for_bit(scene: Scene, kind: str) -> None:
    depth = degrade(scene.depth, kind)
    assert torch.equal(repair_edges(scene.image, depth, "auto"), depth)


def compressed(depth: Tensor, quantum: float) -> Tensor:
    """As a JPEG of 1 / depth is, all of whose coefficients are rounded alike; its blocks are of 8 x 8 pixels."""
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
@pytest.mark.parametrize("engine", ["torch", pytest.param("native", marks=compiled)])
def test_what_compression_leaves_beside_steps_is_no_ramp(
    scene: Scene, quantum: float, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    depth = compressed(scene.depth, quantum)
    assert 0.05 < float((1 / depth - 1 / scene.depth).abs().max()) < 0.3
    assert torch.equal(repair_edges(scene.image, depth, "auto"), depth)
    soft = compressed(degrade(scene.depth, "half-res"), quantum)
    assert wrong(repair_edges(scene.image, soft, "auto"), scene.depth) < 0.5 * wrong(soft, scene.depth)


@pytest.mark.parametrize("engine", ["torch", pytest.param("native", marks=compiled)])
def test_means_over_edges_are_ramps_though_they_are_narrow(
    scene: Scene, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As depth is that was made smaller with its image, or rendered with smooth edges."""
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    image = functional.avg_pool2d(scene.image, 2)
    depth = 1 / functional.avg_pool2d(1 / scene.depth, 2)
    nearest = -functional.max_pool2d(-scene.depth, 2), functional.max_pool2d(scene.depth, 2)
    repaired = repair_edges(image, depth, "auto")
    between = [((d > 1.1 * nearest[0]) & (d < nearest[1] / 1.1)).float().mean() for d in (depth, repaired)]
    assert between[0] > 0.05
    assert between[1] < 0.3 * between[0]


@pytest.mark.parametrize(
    ("kind", "left"),
    [
        ("half-res", 0.2),
        ("quarter-res", 0.4),
        ("shift 1px", 0.6),
        ("near -1px", 0.25),
        ("near -2px", 0.25),
        ("near +1px", 0.25),
        ("displaced", 0.6),
        ("blur 1.5", 0.3),
    ],
)
@pytest.mark.parametrize("how", ["auto", "repair"])
def test_edges_go_to_where_the_image_has_them(scene: Scene, kind: str, left: float, how: DepthEdges) -> None:
    depth = degrade(scene.depth, kind)
    assert wrong(repair_edges(scene.image, depth, how), scene.depth) < left * wrong(depth, scene.depth)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"exact"}))
def test_a_depth_map_that_the_image_knows_nothing_of_is_left_alone(scene: Scene, kind: str) -> None:
    depth = degrade(scene.depth, kind)
    assert torch.equal(repair_edges(torch.rand_like(scene.image), depth, "auto"), depth)


def test_noise_is_no_edge_and_edges_in_noise_are(scene: Scene) -> None:
    exact, thin = (-8.0 * scene.camera.coc_px(degrade(scene.depth, kind), 192) for kind in ("exact", "near -1px"))
    noise = 0.3 * torch.randn(exact.shape)  # a step high within five pixels
    assert torch.equal(edges.repair(scene.image, exact + noise, 1.0, True), exact + noise)
    left = (edges.repair(scene.image, thin + noise, 1.0, True) - exact).abs() > 10.0
    assert float(left.float().mean()) < 0.25 * float(((thin - exact).abs() > 10.0).float().mean())


@pytest.mark.parametrize("steepness", [0.02, 0.3, 1.0])
@pytest.mark.parametrize("how", ["auto", "repair"])
def test_a_slope_stays_a_slope(steepness: float, how: DepthEdges) -> None:
    x, y = torch.meshgrid(torch.arange(96.0), torch.arange(64.0), indexing="xy")
    coc = (steepness * (x + 0.3 * y))[None, None]
    image = waves(5)(x.double(), y.double()).float()[None]
    assert torch.equal(-edges.repair(image, -coc, torch.tensor(1.0), how == "auto"), coc)


def test_a_thin_structure_keeps_its_depth(scene: Scene) -> None:
    fence = posts(23.0, 2.0, 0.2)
    planes = [
        Plane(6.0, waves(1, mean=(0.5, 0.5, 0.5), contrast=0.3)),
        Plane(1.5, waves(2, mean=(0.1, 0.1, 0.05)), fence),
    ]
    thin = plane_scene(planes, scene.camera, (96, 160), samples=16)
    bars = thin.depth < 3
    given = degrade(thin.depth, "half-res")
    mended = repair_edges(thin.image, given, "auto")
    assert float((1 / given)[bars].mean()) < 0.48  # 1 / 1.5 m, spread over what is behind
    assert 0.55 < float((1 / mended)[bars].mean()) < 0.7


def test_a_lamp_whose_depth_was_averaged_away_gets_it_back() -> None:
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    image, depth = 0.2 + 0.02 * torch.rand(1, 3, 96, 128), torch.full((1, 1, 96, 128), 8.0)
    for row in range(12, 96, 24):
        for column in range(12, 128, 26):
            lamp = (rows - row) ** 2 + (columns - column) ** 2 < 5
            image[..., lamp], depth[..., lamp] = 200.0, 2.0
    given = degrade(depth, "blur 1.5")
    lamps = depth < 3
    assert float((1 / given)[lamps].mean()) < 0.33
    assert 0.4 < float((1 / repair_edges(image, given, "auto"))[lamps].mean()) < 0.6


def test_the_pixels_of_a_lamp_get_one_depth_though_some_are_brighter() -> None:
    generator = torch.Generator().manual_seed(0)
    image, depth = 0.2 + 0.02 * torch.rand(1, 3, 96, 128, generator=generator), torch.full((1, 1, 96, 128), 8.0)
    lamps = [(..., slice(row, row + 3), slice(row // 3 + 4, row // 3 + 7)) for row in range(12, 90, 16)]
    for lamp in lamps:
        image[lamp], depth[lamp] = 50.0 + 150.0 * torch.rand(1, 3, 3, 3, generator=generator), 2.0
    mended = 1 / repair_edges(image, degrade(depth, "half-res"), "auto")
    assert max(float(mended[lamp].max() - mended[lamp].min()) for lamp in lamps) < 0.005


@pytest.mark.parametrize("times", [2.0**-10, 2.0**20])
def test_the_brightness_of_the_image_changes_nothing(scene: Scene, times: float) -> None:
    depth = degrade(scene.depth, "half-res")
    torch.testing.assert_close(repair_edges(scene.image, depth), repair_edges(times * scene.image, depth))


TURNS: dict[str, Callable[[Tensor], Tensor]] = {
    "left-right": lambda t: t.flip(-1),
    "top-bottom": lambda t: t.flip(-2),
    "diagonal": lambda t: t.mT,
    "quarter": lambda t: t.rot90(1, (-2, -1)),
}


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
@pytest.mark.parametrize("kind", ["near -1px", "half-res"])
@pytest.mark.parametrize(
    ("engine", "times"),
    [("torch", (1, 1)), pytest.param("native", (3, 3), marks=compiled)]
    + [pytest.param("native", (7, 6), marks=compiled)],  # of a frame that large a sample is looked at alone
)
def test_a_turned_map_is_repaired_as_it_is_unturned(
    scene: Scene,
    kind: str,
    turn: Callable[[Tensor], Tensor],
    engine: str,
    times: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its sizes are odd; a sample that is not turned with it meets other damage and noise."""
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    monkeypatch.setattr(edges, "_SAMPLED", 2**12)  # else the plain engine looks at all of a small frame
    image = scene.image.repeat(1, 1, *times)[..., :-1, :-3]
    exact, damaged = (
        scene.camera.coc_px(degrade(scene.depth, k), 192).repeat(1, 1, *times)[..., :-1, :-3] for k in ("exact", kind)
    )
    height, width = exact.shape[-2:]
    coc = torch.where(torch.arange(width) + torch.arange(height)[:, None] < 0.9 * width, damaged, exact)
    coc = coc + 0.01 * torch.randn(height, 1, generator=torch.Generator().manual_seed(0))
    mended = edges.repair(image, -coc, edges.STEP_PX, True)
    assert not torch.equal(mended, -coc)
    turned = edges.repair(turn(image).contiguous(), turn(-coc).contiguous(), edges.STEP_PX, True)
    torch.testing.assert_close(turned, turn(mended), rtol=0, atol=1e-3)


@pytest.mark.parametrize("engine", ["torch", pytest.param("native", marks=compiled)])
def test_noise_from_row_to_row_counts_as_noise_from_column_to_column(
    scene: Scene, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    for shape in ((1, 1, 128, 1), (1, 1, 1, 192)):
        noise = (2.0 * torch.randn(shape, generator=torch.Generator().manual_seed(0))).expand(scene.depth.shape)
        assert torch.equal(edges.repair(scene.image, noise.contiguous(), edges.STEP_PX, False), noise)


@pytest.mark.parametrize("marked", [0.0, -3.0])
def test_values_of_pixels_without_depth_stay_and_touch_nothing(scene: Scene, marked: float) -> None:
    depth, holes = degrade(scene.depth, "near -1px"), torch.zeros_like(scene.depth, dtype=torch.bool)
    holes[..., 40:60, :30] = True
    mended, same = (repair_edges(scene.image, torch.where(holes, value, depth)) for value in (torch.nan, marked))
    assert bool(mended.isnan()[holes].all()) and bool((same[holes] == marked).all())
    assert torch.equal(mended[~holes], same[~holes])


def test_a_hole_within_a_surface_changes_nothing_else(scene: Scene) -> None:
    depth, holes = torch.full((1, 1, 128, 192), 4.0), torch.zeros(1, 1, 128, 192, dtype=torch.bool)
    depth[..., 101:], holes[..., 40:60, 20:60] = 2.0, True
    image = scene.image * torch.where(torch.arange(192) < 100, 0.3, 1.0)
    whole = repair_edges(image, depth)
    assert bool((whole != depth).any())
    assert torch.equal(repair_edges(image, torch.where(holes, torch.nan, depth))[~holes], whole[~holes])


def test_pixels_without_depth_stay_and_touch_nothing(scene: Scene) -> None:
    depth = degrade(scene.depth, "near -1px")
    holes = torch.zeros_like(depth, dtype=torch.bool)
    holes[..., 40:60, :30] = True
    mended = repair_edges(scene.image, torch.where(holes, torch.nan, depth))
    assert bool(mended.isnan()[holes].all())
    assert not bool(mended.isnan()[~holes].any())
    whole = repair_edges(scene.image, depth)
    # what is learnt from the frame is learnt from fewer pixels: one whose surfaces are equally likely may change sides
    assert float((mended / whole - 1)[..., 60:, :].abs().gt(1e-5).float().mean()) < 2e-4


def test_a_lamp_gets_no_more_nearness_than_it_lost() -> None:
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    image, inverse = 0.2 + 0.02 * torch.rand(1, 3, 96, 128), torch.full((1, 1, 96, 128), 0.125)
    for row in range(12, 96, 24):
        for column in range(12, 128, 26):
            apart = (rows - row) ** 2 + (columns - column) ** 2
            image[..., apart < 5] = 200.0
            inverse[..., apart < 14] = 0.5  # the map's lamps are larger than the image's: nothing is lost
    given = degraded._blurred(1 / inverse, 1.5)
    assert float((1 / repair_edges(image, given, "auto")).max()) < 0.6


@pytest.mark.parametrize("kind", ["half-res", "near -1px"])
@pytest.mark.parametrize("engine", ["torch", pytest.param("native", marks=compiled)])
def test_what_differs_by_less_than_half_a_step_has_no_edge(
    scene: Scene, kind: str, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)  # the renderer does not ask for a repair then
    nearness = 1.0 / degrade(scene.depth, kind)
    image = scene.image.clone()
    image[..., 60:62, 90:92] = 500.0
    nearness[..., 60:62, 90:92] = nearness.max()
    low, high = nearness.aminmax()
    assert not torch.equal(edges.repair(image, nearness, 0.5 * float(high - low), False), nearness)
    assert torch.equal(edges.repair(image, nearness, 2.001 * float(high - low), False), nearness)


@pytest.mark.parametrize("moved", [1e-4, -1e-4])
def test_a_hair_decides_no_direction(moved: float) -> None:
    """Where four blocks meet, the near surface lies as much beside a pixel as below it."""
    blocks = 3.0 * torch.randint(0, 4, (1, 1, 6, 8)).repeat_interleave(8, -1).repeat_interleave(8, -2) + 0.1
    found, again = (edges._find(n, n.isfinite(), torch.tensor(1.0)) for n in (blocks, blocks + moved))
    assert bool(found.is_edge.any())
    assert torch.equal(found.direction[found.is_edge], again.direction[found.is_edge])


def test_infinite_depth_is_a_surface(scene: Scene) -> None:
    depth = torch.where(scene.depth == 6.0, math.inf, scene.depth)
    assert torch.equal(repair_edges(scene.image, depth, "auto"), depth)
    given = degrade(depth, "near -1px")
    mended = repair_edges(scene.image, given, "auto")
    assert float((mended.isinf() != depth.isinf()).float().mean()) < 0.3 * float(
        (given.isinf() != depth.isinf()).float().mean()
    )


def test_gradients_flow_to_what_is_not_repaired(scene: Scene) -> None:
    depth = degrade(scene.depth, "near -1px").requires_grad_()
    mended = repair_edges(scene.image, depth)
    (gradient,) = torch.autograd.grad(mended.sum(), depth)
    assert torch.equal(gradient, (mended == depth).float())


def test_an_item_of_a_batch_is_repaired_as_it_is_alone(scene: Scene) -> None:
    images = torch.cat([scene.image, torch.rand_like(scene.image)])
    depth = degrade(scene.depth, "half-res")
    together = repair_edges(images, depth, "auto")
    assert torch.equal(together[:1], repair_edges(images[:1], depth, "auto"))
    assert torch.equal(together[1:], depth)


def test_the_renderer_repairs_as_its_option_says(scene: Scene) -> None:
    depth = degrade(scene.depth, "half-res")
    coc = scene.camera.coc_px(depth, 192)
    mended = -edges.repair(scene.image, -coc, torch.tensor(1.0), True)
    as_given = DepthOfField(scene.camera, depth_edges="as given")
    assert torch.equal(as_given.coc_px(scene.image, depth), coc)
    assert torch.equal(DepthOfField(scene.camera).coc_px(scene.image, depth), mended)
    expected = blur_by_coc(scene.image, mended, depth_edges="as given")
    assert torch.equal(DepthOfField(scene.camera)(scene.image, depth), expected)
    assert torch.equal(blur_by_coc(scene.image, coc), expected)
    assert not torch.equal(as_given(scene.image, depth), expected)


@pytest.mark.parametrize("value", ["Auto", None, True, 1])
def test_another_treatment_is_refused(scene: Scene, value: DepthEdges) -> None:
    refused = "must be 'auto', 'repair' or 'as given', got"
    for call in (
        lambda: repair_edges(scene.image, scene.depth, value),
        lambda: DepthOfField(scene.camera, depth_edges=value),
    ):
        with pytest.raises(ValueError, match=refused):
            call()


@compiled
@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize("auto", [True, False])
def test_engines_agree(scene: Scene, kind: str, auto: bool) -> None:
    nearness = -scene.camera.coc_px(degrade(scene.depth, kind), 192)
    nearness[..., 50:55, 60:70] = torch.nan
    plain = edges._repair(scene.image, nearness, torch.tensor(1.0), auto)
    fast = native.repair_edges(scene.image[0], nearness[0, 0], torch.tensor(1.0), auto)
    same = torch.isclose(fast, plain[0, 0], rtol=1e-3, atol=1e-3, equal_nan=True)
    assert float(same.float().mean()) > 0.999  # where both surfaces are equally likely, rounding may decide
    coc = native.repair_edges(scene.image[0], -nearness[0, 0], torch.tensor(1.0), auto, of_coc=True)
    torch.testing.assert_close(coc, -fast, rtol=0, atol=0, equal_nan=True)


@compiled
@pytest.mark.parametrize(("kind", "is_exact"), [("exact", True), ("shift 1px", False), ("half-res", False)])
def test_engines_agree_on_frames_of_which_a_part_decides(scene: Scene, kind: str, is_exact: bool) -> None:
    image = scene.image.repeat(1, 1, 6, 5)
    nearness = -scene.camera.coc_px(degrade(scene.depth, kind), 192).repeat(1, 1, 6, 5)
    assert nearness[0, 0].numel() > 4 * edges._SAMPLED
    plain = edges._repair(image, nearness, torch.tensor(1.0), True)[0, 0]
    fast = native.repair_edges(image[0], nearness[0, 0], torch.tensor(1.0), True)
    assert torch.equal(fast, nearness[0, 0]) == torch.equal(plain, nearness[0, 0]) == is_exact
    assert float(torch.isclose(fast, plain, rtol=1e-3, atol=1e-3).float().mean()) > 0.999


@compiled
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 3), (65, 130)])
def test_engines_agree_on_frames_of_any_size(size: tuple[int, int]) -> None:
    blocks = 9 * torch.rand(1, 1, 1 + size[0] // 5, 1 + size[1] // 5)  # values beside each other are no noise
    nearness = blocks.repeat_interleave(5, -2).repeat_interleave(5, -1)[..., : size[0], : size[1]].contiguous()
    image = torch.rand(1, 2, *size)
    plain = edges._repair(image, nearness, torch.full_like(nearness, 0.5), False)
    fast = native.repair_edges(image[0], nearness[0, 0], torch.full(size, 0.5), False)
    same = torch.isclose(fast, plain[0, 0], rtol=1e-3, atol=1e-3)
    assert float(same.float().mean()) > 0.99


@compiled
def test_any_number_of_threads_gives_the_same_bits(scene: Scene) -> None:
    nearness = -scene.camera.coc_px(degrade(scene.depth, "half-res"), 192)[0, 0]
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            results.append(native.repair_edges(scene.image[0], nearness, torch.tensor(1.0), True))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_a_compiled_graph_holds_it_as_one_operator(scene: Scene) -> None:
    coc = scene.camera.coc_px(degrade(scene.depth, "half-res"), 192)

    @torch.compile(backend="eager", fullgraph=True)
    def mend(image: Tensor, nearness: Tensor) -> Tensor:
        return edges.repair(image, nearness, 1.0, True)

    function: Callable[[Tensor, Tensor], Tensor] = mend
    torch.testing.assert_close(function(scene.image, -coc), edges._repair(scene.image, -coc, torch.tensor(1.0), True))
