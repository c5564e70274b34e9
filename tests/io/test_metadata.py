from typing import Any

import pytest

from torchdof.io.metadata import camera_facts

FOCAL, FILM, DISTANCE = "Exif:FocalLength", "Exif:FocalLengthIn35mmFilm", "Exif:SubjectDistance"
PLANE, UNIT, WIDTH = "Exif:FocalPlaneXResolution", "Exif:FocalPlaneResolutionUnit", "Exif:PixelXDimension"
FULL = {"sensor_width_mm": 36.0}


@pytest.mark.parametrize(
    ("tags", "facts"),
    [
        ({}, {}),
        ({FOCAL: 85.0, "FNumber": 1.4}, {"focal_length_mm": 85.0, "f_number": 1.4}),
        ({DISTANCE: 2.5}, {"focus_m": 2.5}),
        ({DISTANCE: 4294967295.0}, {"focus_m": float("inf")}),
        ({"FNumber": 0.0, FOCAL: 0.0, DISTANCE: 0.0}, {}),
        ({"FNumber": "wide"}, {}),
        ({PLANE: 6000 / 36 * 25.4, UNIT: 2}, FULL),  # 6000 pixels at 4233.333 pixels an inch are 36 mm
        ({PLANE: 6000 / 3.6, UNIT: 3}, FULL),
        ({PLANE: 6000 / 36, UNIT: 4}, FULL),
        # scaled to half its width after it was taken, and the tag of the original width kept
        ({PLANE: 12000 / 36, UNIT: 4, WIDTH: 12000}, FULL),
        # the same without that tag: the 35 mm equivalent contradicts it and wins
        ({PLANE: 12000 / 36, UNIT: 4, FOCAL: 50.0, FILM: 50}, {"focal_length_mm": 50.0, **FULL}),
        ({FOCAL: 4.2, FILM: 27}, {"focal_length_mm": 4.2, "sensor_width_mm": 5.6}),
        (
            {"focus": 3.0, "aperture": 2.0, "nominalFocalLength": 35.0},
            {"focus_m": 3.0, "f_number": 2.0, "focal_length_mm": 35.0},
        ),
    ],
)
def test_camera_facts_are_those_of_the_tags(tags: dict[str, Any], facts: dict[str, float]) -> None:
    found = camera_facts({name: (None, value) for name, value in tags.items()}, width=6000)
    assert found == pytest.approx(facts)
