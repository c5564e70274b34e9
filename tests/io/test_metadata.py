from typing import Any

import pytest

from torchdof.io.metadata import camera_facts


@pytest.mark.parametrize(
    ("tags", "facts"),
    [
        ({}, {}),
        ({"Exif:FocalLength": 85.0, "FNumber": 1.4}, {"focal_length_mm": 85.0, "f_number": 1.4}),
        ({"Exif:SubjectDistance": 2.5}, {"focus_m": 2.5}),
        ({"Exif:SubjectDistance": 4294967295.0}, {"focus_m": float("inf")}),
        ({"FNumber": 0.0, "Exif:FocalLength": 0.0, "Exif:SubjectDistance": 0.0}, {}),
        ({"FNumber": "wide"}, {}),
        # 6000 pixels at 4233.333 pixels an inch are 36 mm
        (
            {"Exif:FocalPlaneXResolution": 6000 / 36 * 25.4, "Exif:FocalPlaneResolutionUnit": 2},
            {"sensor_width_mm": 36.0},
        ),
        ({"Exif:FocalPlaneXResolution": 6000 / 3.6, "Exif:FocalPlaneResolutionUnit": 3}, {"sensor_width_mm": 36.0}),
        ({"Exif:FocalPlaneXResolution": 6000 / 36, "Exif:FocalPlaneResolutionUnit": 4}, {"sensor_width_mm": 36.0}),
        # scaled to half its width after it was taken, and the tag of the original width kept
        (
            {
                "Exif:FocalPlaneXResolution": 12000 / 36,
                "Exif:FocalPlaneResolutionUnit": 4,
                "Exif:PixelXDimension": 12000,
            },
            {"sensor_width_mm": 36.0},
        ),
        # the same without that tag: the 35 mm equivalent contradicts it and wins
        (
            {
                "Exif:FocalPlaneXResolution": 12000 / 36,
                "Exif:FocalPlaneResolutionUnit": 4,
                "Exif:FocalLength": 50.0,
                "Exif:FocalLengthIn35mmFilm": 50,
            },
            {"focal_length_mm": 50.0, "sensor_width_mm": 36.0},
        ),
        ({"Exif:FocalLength": 4.2, "Exif:FocalLengthIn35mmFilm": 27}, {"focal_length_mm": 4.2, "sensor_width_mm": 5.6}),
        (
            {"focus": 3.0, "aperture": 2.0, "nominalFocalLength": 35.0},
            {"focus_m": 3.0, "f_number": 2.0, "focal_length_mm": 35.0},
        ),
    ],
)
def test_camera_facts_are_those_of_the_tags(tags: dict[str, Any], facts: dict[str, float]) -> None:
    found = camera_facts({name: (None, value) for name, value in tags.items()}, width=6000)
    assert found == pytest.approx(facts)
