"""Phone portraits: the photograph, its depth in metres, its matte and its lens, from one file."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.phones import apple, dynamic_depth, gdepth, jpeg, multi_picture, png
from torchdof.depth import from_relative, read_depth
from torchdof.io.images import Picture, read_image
from torchdof.io.metadata import camera_settings

HEIC = Path(__file__).parents[1] / "data/portrait/portrait.heic"  # made by make.py beside it
PHOTOGRAPH = np.full((24, 32, 3), 128, np.uint8)
STEPS = np.repeat(np.array([0, 64, 128, 255], np.uint8), 8)[None].repeat(24, 0)  # [24, 32], four columns of 8 px
LINEAR_M = [2.0, 2.0 + 4.0 * 64 / 255, 2.0 + 4.0 * 128 / 255, 6.0]
INVERSE_M = [1 / (1 / 2 - n / 255 * (1 / 2 - 1 / 6)) for n in (0, 64, 128, 255)]  # 0 is the nearest
FARTHEST_FIRST_M = [1 / (1 / 6 + n / 255 * (1 / 2 - 1 / 6)) for n in (0, 64, 128, 255)]
NEAR_FAR: dict[str, Any] = {"Format": "RangeInverse", "Near": 2.0, "Far": 6.0, "Units": "m"}


def stored(folder: Path, content: bytes) -> Path:
    path = folder / "a.jpg"
    path.write_bytes(content)
    return path


def metres(picture: Picture) -> torch.Tensor:
    """``[H, W]``."""
    assert picture.depth is not None
    return from_relative(picture.depth, **picture.depth_meaning)[0, 0]


def columns(depth: torch.Tensor) -> list[float]:
    """The four distances of ``STEPS``."""
    return depth[12, 4::8].tolist()


@pytest.mark.skipif(not HEIC.exists(), reason="only in the repository")
def test_an_iphone_portrait_is_read_with_its_disparity_matte_and_lens_all_upright() -> None:
    picture = read_image(HEIC)
    assert picture.pixels.shape == (1, 3, 192, 128) and picture.sample == "8" and picture.transfer == "srgb"
    light = [((level / 255 + 0.055) / 1.055) ** 2.4 for level in (40, 27, 90)]  # of row 27, column 40 before the turn
    assert picture.pixels[0, :, 40, 100].tolist() == pytest.approx(light, rel=1e-4)
    depth = metres(picture)
    assert depth.shape == (96, 64)
    assert float(depth[60, 32]) == pytest.approx(0.5)  # the subject at d_max = 2 per metre
    assert float(depth[10, 2]) == pytest.approx(1 / (0.25 + 20 / 255 * 1.75), rel=1e-3)
    assert picture.matte is not None and picture.matte.shape == (1, 1, 192, 128)
    assert picture.matte[0, 0, 100, 64] == 1.0 and picture.matte[0, 0, 10, 64] == 0.0
    settings = camera_settings(picture.metadata, 128, 192)
    assert settings == pytest.approx(
        {"focal_length_mm": 5.7, "f_number": 1.5, "sensor_width_mm": 36 * 5.7 / 26 * 128 / 192}
    )
    assert torch.equal(read_depth(HEIC)[0, 0], depth)


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize(
    ("properties", "expected"),
    [
        (NEAR_FAR, INVERSE_M),
        ({**NEAR_FAR, "Near": 2000, "Far": 6000, "Units": "mm"}, INVERSE_M),
        ({**NEAR_FAR, "Format": "RangeLinear"}, LINEAR_M),
        ({**NEAR_FAR, "Near": 1 / 2, "Far": 1 / 6, "Units": "Diopters"}, INVERSE_M),
        ({**NEAR_FAR, "Near": 1 / 6, "Far": 1 / 2, "Units": "Diopters"}, FARTHEST_FIRST_M),
    ],
)
def test_gdepth_becomes_metres_by_its_stated_range(
    tmp_path: Path, extended: bool, properties: Any, expected: list[float]
) -> None:
    depth = np.random.default_rng(0).integers(0, 256, (300, 400)).astype(np.uint8) if extended else STEPS
    content = gdepth(jpeg(PHOTOGRAPH), png(depth), extended, **properties)
    picture = read_image(stored(tmp_path, content))
    if extended:
        assert len(content) > 150_000 and picture.depth is not None and picture.depth.shape == (1, 1, 300, 400)
        levels = picture.depth[0, 0].numpy()
        assert np.array_equal(levels, depth) or np.array_equal(levels, 255 - depth)
    else:
        assert columns(metres(picture)) == pytest.approx(expected, rel=1e-4)
        assert columns(read_depth(tmp_path / "a.jpg")[0, 0]) == pytest.approx(expected, rel=1e-4)


def test_depth_of_16_bits_keeps_them(tmp_path: Path) -> None:
    levels = np.array([[0, 20_000, 65_535, 40_001]], np.uint16).repeat(3, 0)
    picture = read_image(
        stored(tmp_path, gdepth(jpeg(PHOTOGRAPH), png(levels), **{**NEAR_FAR, "Format": "RangeLinear"}))
    )
    assert metres(picture)[1].tolist() == pytest.approx([2 + 4 * n / 65_535 for n in (0, 20_000, 65_535, 40_001)])


def test_a_map_is_turned_with_the_photograph(tmp_path: Path) -> None:
    content = gdepth(jpeg(PHOTOGRAPH, Orientation=6), png(STEPS), **NEAR_FAR)  # a quarter turn clockwise
    picture = read_image(stored(tmp_path, content))
    assert picture.pixels.shape == (1, 3, 32, 24)
    assert metres(picture)[4::8, 12].tolist() == pytest.approx(INVERSE_M, rel=1e-4)


def test_a_blurred_portrait_gives_its_sharp_original(tmp_path: Path) -> None:
    sharp = jpeg(np.full_like(PHOTOGRAPH, 255))
    for content in (
        gdepth(jpeg(PHOTOGRAPH), png(STEPS), original=sharp, **NEAR_FAR),
        dynamic_depth(jpeg(PHOTOGRAPH), ("Original", sharp), ("Depth", png(STEPS)), **NEAR_FAR),
    ):
        picture = read_image(stored(tmp_path, content))
        assert float(picture.pixels.min()) == 1.0
        assert columns(metres(picture)) == pytest.approx(INVERSE_M, rel=1e-4)


@pytest.mark.parametrize("gap", [b"", b"unlisted"])
@pytest.mark.parametrize("padding", [0, 10])
@pytest.mark.parametrize("name", ["Depth", "android/depthmap"])
def test_dynamic_depth_is_found_behind_the_photograph(tmp_path: Path, name: str, padding: int, gap: bytes) -> None:
    others = [("Confidence", jpeg(STEPS[..., None])), (name, png(STEPS)), ("MotionPhoto", b"film")]
    uri = {"DepthURI": name} if "/" in name else {}
    content = dynamic_depth(jpeg(PHOTOGRAPH), *others, gap=gap, padding=padding, **NEAR_FAR, **uri)
    assert columns(metres(read_image(stored(tmp_path, content)))) == pytest.approx(INVERSE_M, rel=1e-4)


def test_the_second_picture_of_a_file_is_depth_or_matte_as_it_states(tmp_path: Path) -> None:
    grey, gain_map = jpeg(STEPS), apple(jpeg(255 - STEPS), "urn:com:apple:photo:2020:aux:hdrgainmap")
    matte = apple(jpeg(STEPS[:12, :16]), "urn:com:apple:photo:2018:aux:portraiteffectsmatte")
    disparity = apple(grey, "disparity", (0.5, 2.0))
    picture = read_image(stored(tmp_path, multi_picture(jpeg(PHOTOGRAPH), gain_map, disparity, matte)))
    expected = [1 / (0.5 + 1.5 * n / 255) for n in (0, 64, 128, 255)]
    assert columns(metres(picture)) == pytest.approx(expected, rel=0.02)  # within a level of the JPEG
    assert picture.matte is not None and picture.matte.shape == (1, 1, 24, 32)
    assert float(picture.matte[0, 0, 12, 2]) < 0.01

    for kind, ends, meaning in (("disparity", (-0.1, 2.0), math.inf), ("depth", (0.5, 4.0), 4.0)):
        picture = read_image(stored(tmp_path, multi_picture(jpeg(PHOTOGRAPH), apple(grey, kind, ends))))
        assert picture.depth_meaning["far_m"] == meaning
    assert float(metres(picture)[12, 4]) == pytest.approx(0.5, abs=0.03)


def test_a_grey_second_picture_that_states_nothing_is_depth_and_a_gain_map_is_not(tmp_path: Path) -> None:
    picture = read_image(stored(tmp_path, multi_picture(jpeg(PHOTOGRAPH), jpeg(STEPS))))
    assert picture.depth is not None and not picture.depth_meaning
    for other in (apple(jpeg(STEPS), "urn:com:apple:photo:2020:aux:hdrgainmap"), jpeg(PHOTOGRAPH)):
        assert read_image(stored(tmp_path, multi_picture(jpeg(PHOTOGRAPH), other))).depth is None


@pytest.mark.parametrize(
    ("depth", "properties", "message"),
    [
        (
            png(STEPS),
            {**NEAR_FAR, "Near": 7.0, "Far": 7.0},
            r"cannot be used: it has no .* \(Near 7.0, Far 7.0, Units m\)",
        ),
        (png(STEPS), {**NEAR_FAR, "Units": "feet"}, "no sensible range .*Units feet"),
        (png(STEPS), {"Format": "RangeInverse"}, "no sensible range .*Near None"),
        (b"text", NEAR_FAR, "its depth cannot be used: it is neither a JPEG nor a PNG picture"),
        (png(STEPS)[:60], NEAR_FAR, "its depth cannot be used: cannot be read"),
    ],
    ids=["ends", "unit", "no ends", "no picture", "cut short"],
)
def test_unusable_depth_is_reported_where_it_is_needed_and_the_photograph_is_read(
    tmp_path: Path, depth: bytes, properties: Any, message: str
) -> None:
    path = stored(tmp_path, gdepth(jpeg(PHOTOGRAPH), depth, **properties))
    picture = read_image(path)
    assert picture.pixels.shape == (1, 3, 24, 32) and picture.depth is None
    with pytest.raises(ValueError, match=f"a.jpg: .*{message}"):
        read_depth(path)


def test_depth_along_the_ray_needs_the_field_of_view(tmp_path: Path) -> None:
    flat = png(np.full((24, 32), 255, np.uint8))
    path = stored(tmp_path, gdepth(jpeg(PHOTOGRAPH), flat, MeasureType="OpticRay", **NEAR_FAR))
    with pytest.raises(ValueError, match="needs the horizontal field of view"):
        read_depth(path)
    depth = read_depth(path, fov_x_deg=90.0)[0, 0]
    assert float(depth[12, 16]) == pytest.approx(6.0, rel=0.01)
    assert float(depth[12, 31]) == pytest.approx(6.0 / math.hypot(1, 15.5 / 16), rel=0.01)


def test_avif_photographs_are_read_upright_with_their_lens(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    exif = image.Exif()
    exif[0x0112], exif.get_ifd(0x8769)[0xA405] = 6, 28
    values = PHOTOGRAPH.copy()
    values[:12] = 0  # the upper half, which is right after a quarter turn clockwise
    image.fromarray(values).save(tmp_path / "a.avif", exif=exif.tobytes(), quality=100)
    picture = read_image(tmp_path / "a.avif")
    assert picture.pixels.shape == (1, 3, 32, 24)
    assert float(picture.pixels[..., 14:].max()) < 0.01 < float(picture.pixels[..., :10].min())
    assert camera_settings(picture.metadata, 24, 32)["focal_length_mm"] == 28.0
