import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from tests.files import store
from torchdof.io.images import Picture, read_image, read_values, write_image
from torchdof.io.metadata import camera_settings

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
        # numbers that no lens has: 0/0, micrometres for millimetres, 4294967295/1
        ({"FNumber": float("nan"), FOCAL: 4250.0, FILM: 0, DISTANCE: float("nan")}, {}),
        ({"FNumber": 4294967295.0, FOCAL: 4.0, FILM: 65535, PLANE: 1e-9, UNIT: 2}, {"focal_length_mm": 4.0}),
        ({"FNumber": 0.001, FOCAL: 1e-6, PLANE: float("nan"), UNIT: 9}, {}),
        ({PLANE: float("inf"), UNIT: 2}, {}),
        ({"FNumber": 0.0, "Exif:ApertureValue": 2.0}, {"f_number": 2.0}),
        ({FOCAL: 0.0, FILM: 26}, {"focal_length_mm": 26.0, **FULL}),  # the equivalent lens
        ({PLANE: 6000 / 36 * 25.4, UNIT: 2}, FULL),  # 6000 pixels at 4233.333 pixels an inch are 36 mm
        ({PLANE: 6000 / 3.6, UNIT: 3}, FULL),
        ({PLANE: 6000 / 36, UNIT: 4}, FULL),
        # scaled to half its width after it was taken, and the tag of the original width kept
        ({PLANE: 12000 / 36, UNIT: 4, WIDTH: 12000}, FULL),
        # the same without that tag: the 35 mm equivalent contradicts it and wins
        ({PLANE: 12000 / 36, UNIT: 4, FOCAL: 50.0, FILM: 50}, {"focal_length_mm": 50.0, **FULL}),
        ({FOCAL: 4.2, FILM: 27}, {"focal_length_mm": 4.2, "sensor_width_mm": 5.6}),
        ({"focus": 3.0, "aperture": 2.0}, {"focus_m": 3.0, "f_number": 2.0}),
        ({"nominalFocalLength": 35.0}, {"focal_length_mm": 35.0}),
    ],
)
def test_camera_facts_are_those_of_the_tags(tags: dict[str, Any], facts: dict[str, float]) -> None:
    found = camera_settings({name: (None, value) for name, value in tags.items()}, 6000, 4000)
    assert found == pytest.approx(facts)


def test_the_36_mm_of_an_equivalent_focal_length_are_the_longer_side() -> None:
    tags = {FOCAL: (None, 4.2), FILM: (None, 27)}
    assert camera_settings(tags, 3000, 4000)["sensor_width_mm"] == pytest.approx(5.6 * 3 / 4)


# EXIF 2.32, 4.6.4 A: the upright picture of a stored one
SEEN: dict[int, Any] = {
    **{1: lambda p: p, 2: lambda p: p[:, ::-1], 3: lambda p: p[::-1, ::-1], 4: lambda p: p[::-1]},
    **{5: lambda p: p.T, 6: lambda p: p[::-1].T, 7: lambda p: p[::-1, ::-1].T, 8: lambda p: p[:, ::-1].T},
}


@pytest.mark.parametrize(("suffix", "out"), [(".png", ".png"), (".tif", ".tif"), (".jpg", ".jpg"), (".jpg", ".webp")])
@pytest.mark.parametrize("orientation", SEEN)
def test_a_picture_is_upright_when_read_and_written(orientation: int, suffix: str, out: str, tmp_path: Path) -> None:
    height, width = 16, 24
    stored = np.zeros((height, width, 3), np.uint8)
    stored[0:8, 8:16] = 255
    tags = {"Orientation": orientation, FILM: 26, "Make": "A", WIDTH: width, "Exif:PixelYDimension": height}
    path, copy = tmp_path / f"stored{suffix}", tmp_path / f"copy{out}"
    attributes: dict[str, Any] = {name.replace(":", "__"): value for name, value in tags.items()}
    store(path, stored, "uint8", **attributes)
    picture = read_image(path)
    seen = SEEN[orientation](stored[..., 0] > 0)
    assert np.array_equal(picture.pixels[0, 0].numpy() > 0.5, seen)
    assert picture.orientation == orientation
    assert np.array_equal(read_values(path)[0, 0].numpy() > 127, seen)

    write_image(copy, picture)
    again = read_image(copy)
    assert np.array_equal(again.pixels[0, 0].numpy() > 0.5, seen)
    kept = {name: again.metadata[name][1] for name in ("Orientation", FILM, "Make") if name in again.metadata}
    assert kept == {"Orientation": 1, FILM: 26, "Make": "A"}
    if suffix == ".jpg" and WIDTH in again.metadata:
        assert again.metadata[WIDTH][1] == seen.shape[1]


# WebP

TAGS: dict[str, tuple[Any, Any]] = {
    **{"Make": ("string", "A"), "FNumber": ("float", 1.75), "DateTime": ("string", "2026:01:02 03:04:05")},
    **{"Exif:FocalLength": ("float", 4.25), "Exif:FocalLengthIn35mmFilm": ("uint16", 26)},
    **{"GPS:Latitude": ("float[3]", (48.0, 8.0, 14.0)), "Orientation": ("uint16", 1)},
}


def chunks(path: Path) -> dict[bytes, bytes]:
    """The chunks of a RIFF file, whose sizes must add up to its own."""
    content = path.read_bytes()
    assert content[:4] + content[8:12] == b"RIFFWEBP" and struct.unpack_from("<I", content, 4)[0] + 8 == len(content)
    start, found = 12, {}
    while start < len(content):
        name, length = struct.unpack_from("<4sI", content, start)
        found[name] = content[start + 8 : start + 8 + length]
        start += 8 + length + length % 2
    assert start == len(content)
    return found


@pytest.mark.parametrize("channels", [("R", "G", "B"), ("R", "G", "B", "A")])
def test_the_tags_are_a_chunk_after_the_picture_which_stays_as_it_is(channels: tuple[str, ...], tmp_path: Path) -> None:
    pixels = torch.rand(1, len(channels), 15, 23, generator=torch.Generator().manual_seed(0)) * 0.5
    plain, tagged = tmp_path / "plain.webp", tmp_path / "tagged.webp"
    write_image(plain, Picture(pixels, channels))
    write_image(tagged, Picture(pixels, channels, metadata=TAGS))
    parts = chunks(tagged)
    assert [*parts] == [b"VP8X", *[b"ALPH"] * (len(channels) == 4), b"VP8 ", b"EXIF"]
    assert parts[b"VP8X"] == bytes([0x18 if len(channels) == 4 else 0x08, 0, 0, 0, 22, 0, 0, 14, 0, 0])
    without, with_tags = (oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8) for path in (plain, tagged))
    np.testing.assert_array_equal(with_tags, without)
    metadata = read_image(tagged).metadata
    assert {name: metadata[name][1] for name in TAGS} == {name: value for name, (_, value) in TAGS.items()}
    assert b"EXIF" not in chunks(plain)
