"""Warnings name unit mistakes and the option that corrects them; unusual but sensible input gives no warning."""

import math
from pathlib import Path

import pytest
import torch

from tests.refused import refuses
from torchdof import Camera
from torchdof.depth import DepthWarning, check, from_relative, read_depth
from torchdof.depth.sanity import coc_mistakes, depth_mistakes
from torchdof.reference.scenes import read_scenes

SCENES = Path(__file__).parents[1] / "data" / "scenes"
MOTORCYCLE = Path(__file__).parents[2] / "examples" / "data" / "motorcycle" / "motorcycle_disp.npz"
INF = math.inf


# a real depth map, 2.1 to 5 m
METRES = read_depth(MOTORCYCLE, "disparity", scale=0.193001 * 994.978, offset=31.086, fill="far")


def field(near_m: float, far_m: float) -> torch.Tensor:
    return from_relative(torch.rand(1, 1, 120, 160, generator=torch.Generator().manual_seed(1)), near_m, far_m)


def object_before(depth: torch.Tensor, background_m: float) -> torch.Tensor:
    depth = depth.clone()
    depth[..., 60:] = background_m
    return depth


def test_test_scenes_and_the_demo_give_no_warning() -> None:
    for scene in read_scenes(SCENES):
        check(scene.depth, scene.camera, strict=True)
    for focus_m in (2.3, 3.1, 4.6):
        check(METRES, Camera.from_fov(40.8, 0.04, focus_m), strict=True)
        check(METRES, Camera(focus_m=focus_m), strict=True)


@pytest.mark.parametrize(
    ("depth", "camera"),
    [
        pytest.param(field(0.05, 0.3), Camera(50.0, 2.8, 0.1), id="macro"),
        pytest.param(field(0.03, 0.08), Camera(20.0, 2.8, 0.05), id="within a hand's breadth"),
        pytest.param(object_before(field(0.199, 0.201), INF), Camera(100.0, 2.8, 0.2), id="life size before infinity"),
        pytest.param(object_before(field(9.8, 10.2), 200.0), Camera(600.0, 4.0, 10.0), id="a bird"),
        pytest.param(torch.full((1, 1, 8, 8), INF), Camera(2000.0, 8.0, INF), id="stars"),
        pytest.param(object_before(field(3.84e8, 3.85e8), INF), Camera(2000.0, 8.0, INF), id="the moon before stars"),
        pytest.param(field(800.0, 2e4), Camera(35.0, 8.0, INF), id="a landscape"),
        pytest.param(field(2.0, 50.0), Camera(24.0, 8.0, 5.0), id="all in focus"),
        pytest.param(field(2.0, 50.0), Camera(24.0, 16.0, 300.0), id="all in focus, focus behind"),
        pytest.param(torch.full((1, 1, 8, 8), 3.0), Camera(focus_m=3.0), id="a wall"),
        pytest.param(torch.full((1, 1, 1, 1), 3.0), Camera(focus_m=3.0), id="one pixel"),
        pytest.param(torch.full((1, 1, 8, 8), math.nan), Camera(focus_m=3.0), id="holes alone"),
        pytest.param(field(1.0, 6.0)[..., :48, :64], Camera(focus_m=2.0), id="a small map"),
        pytest.param(field(2.0, 5.0).expand(2, -1, -1, -1), Camera(focus_m=torch.tensor([3.0, INF])), id="two lenses"),
    ],
)
def test_sensible_extremes_raise_no_doubt(depth: torch.Tensor, camera: Camera) -> None:
    check(depth, camera, strict=True)


SMALL = field(1.0, 6.0)[..., :48, :64]  # too small for a blur of a pixel
SHARES = torch.linspace(0.0, 1.0, 96).expand(1, 1, 64, 96)
MISTAKES = [  # factor on the depth, focus in metres
    (1000.0, 3.0, r"nearer than all depth \(2110 to 5017 m\); is it millimetres \(--depth-scale 0.001\)"),
    (100.0, 3.0, r"is it centimetres \(--depth-scale 0.01\)"),
    (0.001, 3.0, r"1000 times too small for metres \(--depth-scale 1000\).*within a hand's breadth"),
    (1000.0, 3000.0, r"all depth is far .*nothing is blurred; is it millimetres \(--depth-scale 0.001\)"),
    (1.0, 3000.0, r"1000 times too small .*; or is the focus in millimetres \(--focus-m 3\)"),
    (1.0, 300.0, r"; or is the focus in centimetres \(--focus-m 3\)"),
    (1.0, 20.0, r"the focus at 20 m is farther than all depth \(2.11 to 5.017 m\).*--focus-at"),
    (1.0, 0.5, r"the focus at 0.5 m is nearer than all depth.*disparity \(--depth-kind disparity\)"),
    (1.0, INF, "the focus at inf m is farther than all depth"),
    (0.199, 3.0, r"relative depth from 0 to 1, --depth-kind relative --near-m METRES --far-m METRES"),
]


@pytest.mark.parametrize(
    ("depth", "camera", "message"),
    [
        *((factor * METRES, Camera(focus_m=focus_m), message) for factor, focus_m, message in MISTAKES),
        (1000.0 * SMALL, Camera(focus_m=2.0), "millimetres"),
        (100.0 * SMALL, Camera(focus_m=2.0), "centimetres"),
        (0.001 * SMALL, Camera(focus_m=2.0), "1000 times too small"),
        ((3000.0 * SMALL).round(), Camera(focus_m=INF), "millimetres"),
        (torch.cat([SMALL, 1000.0 * SMALL]), Camera(focus_m=3.0), "millimetres"),  # in one item of a batch
        (field(2.0, 5.0), Camera(0.05, 1.8, 3.0), "focal length of 0.05 mm on a sensor of 36 mm .* take millimetres"),
        (object_before(0 * field(1.0, 2.0) + 1.0, 9.0), Camera(85.0, 1.4, 3.0), r"no pixel lies near the focus at 3 m"),
        *((depth, camera, "more than a lens makes.*on a sensor of .*which is in another unit")
          for depth, camera in (
              (field(0.002, 0.005), Camera.from_fov(40.0, 0.01, 0.003)),  # depth and focus scaled, the opening not
              (field(2.0, 5.0), Camera.from_fov(40.0, 12.0, 3.0)),  # the opening in millimetres
              (field(2.0, 5.0), Camera(50.0, 0.01, 3.0)),
              (field(2.0, 5.0), Camera(50.0, 1.8, 3.0, sensor_width_mm=0.036)))),
    ],
)  # fmt: skip
def test_other_units_and_impossible_lenses_give_a_warning(depth: torch.Tensor, camera: Camera, message: str) -> None:
    with pytest.warns(DepthWarning, match=message):
        check(depth, camera)
    with pytest.raises(ValueError, match=message):
        check(depth, camera, strict=True)


def test_relative_depth_of_8_bits_gives_a_warning() -> None:
    relative = (255 * (1 / METRES - 1 / METRES.max()) / (1 / METRES.min() - 1 / METRES.max())).round().clamp(min=1)
    for focus_m, message in ((3.0, "files of 8 bits hold"), (0.4, "nothing is in focus.*8 bits")):
        with pytest.warns(DepthWarning, match=f"{message}.*--depth-kind relative"):
            check(relative, Camera(focus_m=focus_m))


@pytest.mark.parametrize("focus_m", [0.2, 0.9])
def test_values_from_0_to_1_give_a_warning_wherever_the_focus_lies(focus_m: float) -> None:
    camera = Camera(focal_length_mm=5.0, sensor_width_mm=6.0, focus_m=focus_m)
    (mistake,) = depth_mistakes(SHARES, camera)
    assert mistake.name == "bits" and "between 0 and 1 (" in mistake.message and "relative" in mistake.message
    assert depth_mistakes(SHARES, camera, "relative") == []
    assert depth_mistakes(0.3 + 0.6 * SHARES, camera) == []  # a close-up


def test_the_advice_depends_on_the_kind_and_the_scale() -> None:
    (mistake,) = depth_mistakes(METRES / 192.03, Camera(focus_m=3.0), "inverse")
    assert "the baseline in metres times the focal length in pixels (--depth-scale, not given)" in mistake.message
    assert "--depth-kind relative" in mistake.message
    (mistake,) = depth_mistakes(METRES / 1000, Camera(focus_m=3.0), "z", 0.001)
    assert "leave --depth-scale out" in mistake.message
    assert coc_mistakes(torch.linspace(-30, 30, 96).expand(1, 1, 8, 96)) == []
    (mistake,) = coc_mistakes(torch.linspace(800, 5000, 96).expand(1, 1, 8, 96))  # depths in place of coc
    assert "--depth-kind" in mistake.message


test_a_tensor_that_is_not_a_depth_map_is_refused = refuses(
    (lambda: check(torch.ones(8, 8), Camera()), r"depth must be \[B, 1, H, W\] in metres .*got \[8, 8\]"),
    (lambda: check(torch.ones(1, 1, 8, 8, dtype=torch.int32), Camera()), "floating point"),
)
