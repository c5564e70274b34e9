"""Lengths in pixels, millimetres and metres on the paper; and how far a table reaches."""

import math

import pytest

from torchdof import BlurTable, Camera
from torchdof.fit import check_reach
from torchdof.fit.photo.scale import mm_to_px, object_m_to_px, px_to_mm, px_to_object_m, signed_coc
from torchdof.fit.problems import FitError, OutsideMeasuredWarning

CAMERA = Camera(focal_length_mm=50.0, f_number=4.0, focus_m=2.0, sensor_width_mm=36.0)
MEASURED = BlurTable(
    "disc",
    [-0.1, 0.1],
    {"radius": [0.1, 0.1]},
    unit="mm",
    sensor_width_mm=36.0,
    provenance={"f_number": 4.0, "focus_m": 2.0},
)


def test_pixels_and_millimetres_are_inverse():
    assert mm_to_px(px_to_mm(7.0, 6000, 36.0), 6000, 36.0) == pytest.approx(7.0)
    assert px_to_mm(6000, 6000, 36.0) == 36.0


def test_pixels_and_metres_on_the_paper_are_inverse():
    assert object_m_to_px(px_to_object_m(7.0, 6000, CAMERA, 0.5), 6000, CAMERA, 0.5) == pytest.approx(7.0)


def test_a_length_on_the_paper_is_the_sensor_s_over_the_magnification():
    # in focus: image distance s f / (s - f), magnification f / (s - f)
    assert px_to_object_m(6000, 6000, CAMERA, 2.0) == pytest.approx(0.036 * (2.0 - 0.05) / 0.05)


def test_signed_coc_is_the_thin_lens_s():
    expected = 0.5 * (0.05 / 4) * (2 * 0.05 / 1.95) * (1 / 2 - 1 / 4) / 0.036 * 1000
    assert signed_coc(CAMERA, 4.0, 1000) == pytest.approx(expected)
    assert signed_coc(CAMERA, 1.0, 1000) < 0


def test_within_what_was_measured_nothing_is_said():
    found = check_reach(MEASURED, CAMERA, near_m=1.6, far_m=3.0)
    assert found["coc"] < 1 and found["f_number"] == 1 and found["focus_m"] == 1


def test_more_blur_than_was_measured_is_said():
    with pytest.warns(OutsideMeasuredWarning, match="times the largest that was measured"):
        found = check_reach(MEASURED, CAMERA, near_m=0.5, far_m=3.0)
    assert found["coc"] > 2


def test_a_side_that_was_not_measured_is_said():
    one_sided = BlurTable("disc", [0.5], {"radius": [0.5]}, unit="mm", sensor_width_mm=36.0)
    with pytest.warns(OutsideMeasuredWarning, match="other side of focus"):
        assert math.isinf(check_reach(one_sided, CAMERA, near_m=1.0, far_m=3.0)["coc"])


@pytest.mark.parametrize(("change", "name"), [({"f_number": 8.0}, "f_number"), ({"focus_m": 4.0}, "focus_m")])
def test_another_camera_setting_is_said(change, name):
    with pytest.warns(OutsideMeasuredWarning, match=f"measured at {name}"):
        check_reach(MEASURED, CAMERA.replace(**change), near_m=3.9, far_m=4.1)


def test_wrong_depths_are_refused():
    with pytest.raises(FitError, match="0 < near_m <= far_m, got 3 and 1"):
        check_reach(MEASURED, CAMERA, near_m=3, far_m=1)
