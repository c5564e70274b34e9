import functools
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.refused import refuses
from torchdof import Camera


def depth_of(*metres: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(metres, dtype=dtype).reshape(1, 1, 1, -1)


def coc_in_millimetres(focal_mm: float, f_number: float, focus_m: float, z_m: float) -> float:
    """Textbook formula: image distance of z behind the lens, and radius of its cone of light on the sensor."""
    focal = focal_mm / 1000.0
    sensor = focal if math.isinf(focus_m) else focus_m * focal / (focus_m - focal)
    image = focal if math.isinf(z_m) else z_m * focal / (z_m - focal)
    return 1000.0 * (focal / f_number / 2) * (sensor - image) / image


@pytest.mark.parametrize("focus_m", [0.3, 2.0, 50.0, math.inf])
@pytest.mark.parametrize("z_m", [0.1, 0.5, 1.99, 2.5, 1e3, 1e12, math.inf])
def test_coc_is_the_cone_of_light_on_the_sensor(focus_m: float, z_m: float) -> None:
    for focal_mm, f_number, sensor_mm, width in ((50.0, 1.8, 36.0, 1920), (35.0, 5.6, 24.0, 640)):
        coc = float(Camera(focal_mm, f_number, focus_m, sensor_mm).coc_px(depth_of(z_m), width))
        expected = coc_in_millimetres(focal_mm, f_number, focus_m, z_m) * width / sensor_mm
        assert_close(coc, expected, rtol=1e-11, atol=1e-11)
        assert coc != 0.0 or z_m == focus_m


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coc_next_to_the_focus_plane_does_not_cancel_and_half_precision_counts_in_single(dtype: torch.dtype) -> None:
    half = depth_of(1.0, 3.0, dtype=torch.float16)
    assert_close(Camera().coc_px(half, 1920), Camera().coc_px(half.float(), 1920), rtol=0.0, atol=0.0)
    focus = torch.tensor([1.7], dtype=dtype)
    beyond = torch.nextafter(focus, focus.new_tensor([9.0]))
    nearer = torch.nextafter(focus, focus.new_tensor([0.0]))
    camera = Camera(focus_m=focus)
    near, on, far = camera.coc_px(torch.cat([nearer, focus, beyond]).reshape(1, 1, 1, 3), 1920).flatten()
    step = float(beyond.double() - focus.double())
    slope = camera.aperture_radius_m * float(camera.focal_px(1920)) / 1.7**2
    assert float(on) == 0.0
    assert_close(float(far), slope * step, rtol=1e-5, atol=0.0)
    assert_close(float(near), -slope * step, rtol=1e-5, atol=0.0)


def test_rendering_convention_keeps_the_field_of_view_at_any_focus() -> None:
    focal_px = 384.0 / math.tan(math.radians(20.0))
    for focus_m in (0.1, 2.0, math.inf):
        camera = Camera.from_fov(fov_x_deg=40.0, aperture_radius_m=0.012, focus_m=focus_m)
        assert camera.focal_px(768) == pytest.approx(focal_px, rel=1e-14)
        assert camera.aperture_radius_m == pytest.approx(0.012, rel=1e-14)
        expected = 0.012 * focal_px * (1 / focus_m - 1 / 3.0)
        assert float(camera.coc_px(depth_of(3.0), 768)) == pytest.approx(expected, rel=1e-13)
    fov = torch.tensor([40.0, 75.0], dtype=torch.float64)
    each = [Camera.from_fov(float(f), 0.012, 2.0).focal_px(768) for f in fov]
    assert_close(Camera.from_fov(fov, 0.012, 2.0).focal_px(768), torch.tensor(each, dtype=torch.float64))


def test_a_batch_of_cameras_equals_each_camera_alone() -> None:
    depth = 0.5 + 5 * torch.rand(3, 1, 4, 5, dtype=torch.float64)
    numbers: dict[str, Any] = {
        "focal_length_mm": torch.tensor([24.0, 50.0, 85.0], dtype=torch.float64),
        "f_number": torch.tensor([1.4, 2.8, 8.0], dtype=torch.float64),
        "focus_m": torch.tensor([0.6, 2.0, math.inf], dtype=torch.float64),
        "sensor_width_mm": torch.tensor([36.0, 23.5, 17.3], dtype=torch.float64),
    }
    together = Camera(**numbers).coc_px(depth, 640)
    for i in range(3):
        one: dict[str, Any] = {name: float(value[i]) for name, value in numbers.items()}
        alone = Camera(**one)
        assert_close(together[i : i + 1], alone.coc_px(depth[i : i + 1], 640))
    assert Camera(**numbers).coc_px(depth[:1], 640).shape == (3, 1, 4, 5)


NUMBERS = {"focal_length_mm": 50.0, "f_number": 2.8, "sensor_width_mm": 36.0}


@pytest.mark.parametrize(
    "others", [{"focus_m": 2.0}, {}, {"near": 1.2, "far": 2.0, "tilt_deg": 3.0, "swing_deg": -2.0}], ids=str
)
def test_coc_is_differentiable_in_depth_and_in_every_number_of_the_camera(others: dict[str, float]) -> None:
    depth = depth_of(0.7, 1.9, 2.3, 5.0).reshape(1, 1, 2, 2).requires_grad_()
    leaves = {k: torch.tensor([v], dtype=torch.float64, requires_grad=True) for k, v in {**NUMBERS, **others}.items()}

    def coc(depth: Tensor, *values: Tensor) -> Tensor:
        given: dict[str, Any] = {"focus_m": math.inf, **dict(zip(leaves, values, strict=True))}
        if "near" in given:
            given |= {"focus_m": None, "focus_range_m": (given.pop("near"), given.pop("far"))}
        return Camera(**given).coc_px(depth, 100)

    assert torch.autograd.gradcheck(coc, (depth, *leaves.values()))


def test_gradients_at_infinity_are_zero_and_invalid_depths_have_a_nan_coc_and_finite_gradients() -> None:
    depth = depth_of(1.0, 0.0, -2.0, math.nan, math.inf).requires_grad_()
    focus = torch.tensor([2.0], dtype=torch.float64, requires_grad=True)
    for camera, leaves in ((Camera(focus_m=focus), (depth, focus)), (Camera(focus_m=math.inf), (depth,))):
        coc = camera.coc_px(depth, 100)
        assert torch.isnan(coc).flatten().tolist() == [False, True, True, True, False]
        slopes = torch.autograd.grad(torch.nan_to_num(coc).sum(), leaves)
        assert all(torch.isfinite(slope).all() for slope in slopes) and float(slopes[0][..., 4]) == 0.0


def test_focus_at_takes_the_median_of_a_patch_and_ignores_bad_depth() -> None:
    depth = torch.full((1, 1, 9, 9), 7.0)
    depth[0, 0, 3:6, 3:6] = 3.0
    depth[0, 0, 4, 4] = math.nan
    depth[0, 0, 3, 3] = 0.0
    depth[0, 0, 5, 5] = -1.0
    assert Camera().focus_at(depth, x=4.5, y=4.2, patch=3).focus_m == 3.0
    assert Camera().focus_at(depth, x=0.0, y=8.9, patch=3).focus_m == 7.0
    depth[0, 0, 1, 6] = 5.0  # columns are counted by x, rows by y
    assert Camera().focus_at(depth, x=6.5, y=1.5, patch=1).focus_m == 5.0
    tilted = Camera(focal_length_mm=80.0, tilt_deg=3.0, swing_deg=-1.0).focus_at(depth, 6.5, 1.5, patch=1)
    assert abs(float(tilted.coc_px(depth, 9)[0, 0, 1, 6])) < 1e-5
    items = torch.tensor([1.0, math.inf]).reshape(2, 1, 1, 1).expand(2, 1, 3, 3)
    assert torch.as_tensor(Camera().focus_at(items, 1, 1).focus_m).tolist() == [1.0, math.inf]


def test_a_range_in_focus_spans_the_surfaces_at_its_points() -> None:
    depth = torch.tensor([2.0, 3.0, 5.0, math.inf]).reshape(1, 1, 1, 4)
    points = [(2, 0), (0, 0), (1, 0)]
    assert Camera().focus_range_at(depth, points, patch=1).focus_range_m == (2.0, 5.0)
    assert Camera(focus_range_m=(1.0, 9.0)).focus_range_at(depth, [(1, 0)], patch=1).focus_range_m == (3.0, 3.0)
    assert Camera().focus_range_at(depth, [(1, 0), (3, 0)], patch=1).focus_range_m == (3.0, math.inf)
    tilted = Camera(80.0, focus_breathing=False, swing_deg=2.0).focus_range_at(depth, points, patch=1)
    assert tilted.coc_px(depth, 4).flatten()[:3].abs().max() < 1e-5
    near, far = Camera().focus_range_at(torch.cat([depth, 2 * depth]), points, patch=1).focus_range_m or (0, 0)
    assert torch.as_tensor(near).tolist() == [2.0, 4.0] and torch.as_tensor(far).tolist() == [5.0, 10.0]


@pytest.mark.parametrize("name", ["focal_length_mm", "f_number", "focus_m", "sensor_width_mm"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, torch.tensor([2.0, 0.0]), "2.8", True, torch.ones(1, 1)])
def test_a_bad_number_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name} must be"):
        Camera().replace(**{name: value})


FRAME, TWO = torch.ones(1, 1, 4, 8), Camera(focus_m=torch.tensor([1.0, 2.0]))
partial: Any = functools.partial
test_invalid_arguments_are_refused_by_name = refuses(
    *((partial(Camera().replace, **{name: math.inf}), f"^{name} must be positive and finite")
      for name in ("focal_length_mm", "f_number", "sensor_width_mm")),
    (lambda: Camera(focus_m=0.05), r"focus_m must be longer than the focal length \(50 mm\), got 0.05 m"),
    (lambda: Camera.from_fov(180.0, 0.01, 1.0), "^fov_x_deg must be"),
    *((partial(Camera().coc_px, depth, 100), "depth must be a tensor in metres, floating point")
      for depth in (torch.ones(1, 1, 2, 2, dtype=torch.int32), 2.0, None)),
    (lambda: TWO.coc_px(torch.ones(3, 1, 4, 4), 100), "number of the camera must .*each of the 3 .* got 2"),
    *((partial(Camera, focus_range_m=value), "^focus_range_m must")
      for value in ((2.0, 1.0), (0.0, 1.0), (1.0,), 3.0, (1.0, "far"), (math.nan, 2.0))),
    *((partial(Camera, **{name: angle}), f"^{name} must be")
      for name in ("tilt_deg", "swing_deg") for angle in (90.0, math.nan, "3", torch.tensor([95.0]), True)),
    *((partial(Camera().focus_at, FRAME, *place), "must lie in the frame of 8 x 4 pixels")
      for place in ((8.0, 0.0), (0.0, 4.0), (-0.1, 0.0), (0.0, -1.0))),
    (lambda: Camera().focus_at(FRAME, math.nan, 0.0), "x of the focus point must be a number"),
    (lambda: Camera().focus_at(0 * FRAME, 2, 2), "no valid depth"),
    *((partial(Camera().focus_range_at, FRAME, bad), "^points must be") for bad in ([(1.0,)], 3.0, (1.0, 2.0), "here")),
    (lambda: Camera().focus_range_at(FRAME, []), "^points must be pixels"),
    (lambda: Camera().focus_range_at(FRAME, [(2, 2), (8, 0)]), "must lie in the frame of 8 x 4 pixels"),
)  # fmt: skip


def test_repr_shows_the_numbers_of_the_camera() -> None:
    assert repr(Camera(35.0, 1.4, 0.8, 23.5)) == "Camera(35 mm, f/1.4, focus 0.8 m, sensor 23.5 mm)"
    assert "fixed field of view" in repr(Camera.from_fov(40.0, 0.01, 2.0))
    assert "focus [1, 2] m" in repr(Camera(focus_m=torch.tensor([1.0, 2.0])))


def test_a_range_is_in_focus_from_end_to_end_and_blur_grows_from_its_ends() -> None:
    camera = Camera(focal_length_mm=50.0, f_number=2.0, focus_range_m=(1.5, 2.2))
    depth = depth_of(0.7, 1.2, 1.5, 1.8, 2.2, 2.5, math.inf)
    scale = camera.aperture_radius_m * camera.focal_px(1920)
    expected = [1 / 1.5 - 1 / 0.7, 1 / 1.5 - 1 / 1.2, 0.0, 0.0, 0.0, 1 / 2.2 - 1 / 2.5, 1 / 2.2]
    coc = camera.coc_px(depth, 1920).flatten()
    assert_close(coc, scale * torch.tensor(expected, dtype=coc.dtype), rtol=1e-12, atol=0)
    assert coc[2:5].eq(0.0).all()
    assert camera.focus_m == pytest.approx(2 / (1 / 1.5 + 1 / 2.2), rel=1e-12)


def test_a_range_may_be_empty_or_end_at_infinity_and_excludes_a_focus_distance() -> None:
    depth = depth_of(0.7, 2.0, 9.0, math.inf)
    one, none = Camera(focus_m=2.0), Camera(focus_range_m=(2.0, 2.0))
    assert_close(none.coc_px(depth, 100), one.coc_px(depth, 100), rtol=1e-12, atol=0)
    assert Camera(focus_range_m=(2.0, math.inf)).coc_px(depth, 100).flatten().tolist()[1:] == [0.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="focus_m is given by the camera's focus_range_m"):
        none.replace(focus_m=3.0)
    assert none.replace(focus_range_m=None, focus_m=3.0).focus_m == 3.0
    assert none.replace(f_number=2.0).focus_range_m == (2.0, 2.0)


def plane_in_focus(camera: Camera, x: float, y: float, size: tuple[int, int]) -> float:
    """Depth in focus at a pixel: where its ray meets the plane of focus through the hinge."""
    height, width = size
    focal = float(camera.focal_length_mm) / 1000.0
    tilt, swing = math.radians(float(camera.tilt_deg)), math.radians(float(camera.swing_deg))
    normal = (math.sin(swing) * math.cos(tilt), math.sin(tilt))
    slope_x, slope_y = ((v - n / 2) / float(camera.focal_px(width)) for v, n in ((x, width), (y, height)))
    # the plane Z / s + (n_x X + n_y Y) / f = 1; at Z = 0 it contains the hinge, f / sin(tilt) from the lens
    return 1.0 / (1.0 / float(camera.focus_m) + (normal[0] * slope_x + normal[1] * slope_y) / focal)


@pytest.mark.parametrize(("tilt", "swing"), [(3.0, 0.0), (0.0, -2.0), (4.0, 1.5)])
def test_a_tilted_lens_is_in_focus_on_the_plane_through_its_hinge(tilt: float, swing: float) -> None:
    camera = Camera(focal_length_mm=80.0, focus_m=3.0, tilt_deg=tilt, swing_deg=swing)
    height, width = 6, 9
    places = [(column + 0.5, row + 0.5) for row in range(height) for column in range(width)]
    depth = depth_of(*(plane_in_focus(camera, x, y, (height, width)) for x, y in places)).reshape(1, 1, height, width)
    assert_close(camera.coc_px(depth, width), torch.zeros_like(depth), rtol=0, atol=1e-12)
    scale = camera.aperture_radius_m * camera.focal_px(width)
    behind = camera.coc_px(1.2 * depth, width)
    assert_close(behind, scale * (1 / depth - 1 / (1.2 * depth)), rtol=1e-9, atol=0)
    # a map at twice the resolution sees the same plane
    fine = camera.coc_px(torch.full((1, 1, 2 * height, 2 * width), 2.0, dtype=torch.float64), width)
    coarse = camera.coc_px(torch.full((1, 1, height, width), 2.0, dtype=torch.float64), width)
    assert_close(torch.nn.functional.avg_pool2d(fine, 2), coarse, rtol=1e-9, atol=1e-12)
