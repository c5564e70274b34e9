"""Checks of measured blur against the thin lens: wrong camera numbers, distances and crops."""

import numpy as np
import pytest
import torch

from torchdof.fit import Capture, Captures, FitError, FitWarning, fit_captures, read_captures
from torchdof.fit.photo.table import check_agreement
from torchdof.io.images import Picture, read_image, write_image

DISTANCES = (0.6, 0.7, 0.8, 1.25, 1.5, 2.0)
CAMERA = {"focal_length_mm": 50.0, "f_number": 2.8, "sensor_width_mm": 36.0}


def captures(distances=DISTANCES, width_px=2400, focus_m=1.0, **camera):
    window = np.zeros((15, 15))
    pairs = tuple(Capture(window, window, d, files=("sharp.png", f"{d}.png")) for d in distances)
    return Captures(pairs, focus_m, width_px, **{**CAMERA, **camera})


def true_radius(distances=DISTANCES, focus_m=1.0):
    """Measured radii in px of a real lens: 3 % larger than the thin lens's plus 0.2 px; 2400 px of 36 mm."""
    return 1.03 * np.abs(captures(distances, focus_m=focus_m).promised_px) + 0.2


def test_a_right_capture_gives_no_warning_and_blur_below_two_pixels_is_not_checked():
    check_agreement(captures(), true_radius())
    check_agreement(captures((0.98, 1.02)), [1.5, 1.5])


TRUE, MISREAD = true_radius(), {"distances": (0.6, 0.7, 0.9, 1.25, 1.5, 2.0)}


@pytest.mark.parametrize(
    ("wrong", "radius", "message"),
    [
        ({"width_px": 600}, TRUE, "is 4.16 at 0.6 m, 4.18 at 0.7 m, .* a crop .*; without focal_length_mm"),
        ({"f_number": 1.4}, TRUE, "0.52 at 0.6 m, .* 0.52 at 2 m"),
        ({"sensor_width_mm": 23.5}, TRUE, "0.68 at 0.6 m, .* 0.68 at 2 m"),
        ({"focal_length_mm": 35.0}, TRUE, "2.1. at 0.6 m"),
        ({"distances": [3.281 * d for d in DISTANCES], "focus_m": 3.281}, TRUE, "and units"),
        (MISREAD, TRUE, "0.9.png: .*1.04 at 0.6 m, 1.04 at 0.7 m, 2.37 at 0.9 m"),
        ({**MISREAD, **dict.fromkeys(CAMERA)}, TRUE, "0.9.png: .* at 0.7 m, 2.[23]. at 0.9 m"),
        ({}, TRUE[[2, 1, 0, 3, 4, 5]], "0.8.png: .*0.40 at 0.6 m, 1.04 at 0.7 m, 2.77 at 0.8 m, 1.06 at 1.25 m"),
        ({}, true_radius(focus_m=0.93), "the focus if near and far"),
    ],
)
def test_a_wrong_number_is_refused_with_the_ratio_at_each_distance(wrong, radius, message):
    with pytest.raises(FitError, match=message) as caught:
        check_agreement(captures(**wrong), radius)
    assert caught.value.kind == "camera" and caught.value.file


def test_a_small_disagreement_warns():
    with pytest.warns(FitWarning, match="1.2. at 0.6 m") as caught:
        check_agreement(captures(f_number=3.3), true_radius())
    assert caught[0].message.kind == "camera"


@pytest.fixture
def folder(simulator, tmp_path):
    """Frames 400 px wide of a 36 mm sensor at 50 mm and f/1.543: a blur radius of 10 px per dioptre of defocus."""
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    fields = "focal_length_mm = 50.0\nf_number = 1.543\nsensor_width_mm = 36.0"
    disc = "disc", {"radius": 10.0 * (1 / 0.4 - 1 / 0.5)}
    return simulator.write_captures(tmp_path, camera, 0.5, [0.4], lambda d: disc, camera_fields=fields)


@pytest.mark.filterwarnings("ignore:.*one distance was measured:torchdof.fit.problems.FitWarning")
def test_a_crop_in_the_manifest_keeps_the_scale_and_cropped_files_are_refused(folder):
    manifest = folder / "capture.toml"
    text = manifest.read_text()
    manifest.write_text(f"crop = [130, 40, 150, 160]\n{text}")
    (inside,) = read_captures(folder)
    assert inside.width_px == 400 and inside.pairs[0].position_px == pytest.approx((0, 0), abs=1)
    assert fit_captures(inside, "disc").coc_px[0] == pytest.approx(-5.0, rel=0.01)
    manifest.write_text(f"crop = [300, 40, 150, 160]\n{text}")
    with pytest.raises(FitError, match="extends beyond the picture of 400x240"):
        read_captures(folder)
    for path in folder.glob("*.png"):
        cropped = read_image(path).pixels[..., 130:280]
        write_image(path, Picture(cropped), transfer="srgb", sample="16")
    manifest.write_text(text)
    with pytest.raises(FitError, match="2.6. at 0.4 m: .*crop"):
        fit_captures(read_captures(folder)[0], "disc")
    manifest.write_text(f"full_width_px = 400\n{text}")
    table = fit_captures(read_captures(folder)[0], "disc").table
    assert table.node_params["radius"].item() == pytest.approx(5 * 36 / 400, rel=0.01)
    manifest.write_text(f"full_width_px = 40\n{text}")
    with pytest.raises(FitError, match="full_width_px must be at least"):
        read_captures(folder)


def test_exif_supplies_missing_fields_and_a_change_of_the_lens_is_refused(folder):
    manifest = folder / "capture.toml"
    tags = {"Exif:FocalLength": ("float", 50.0), "FNumber": ("float", 1.543), "Exif:FocalLengthIn35mmFilm": ("int", 50)}
    for path in folder.glob("*.png"):
        picture = Picture(read_image(path).pixels, metadata=tags)
        write_image(path.with_suffix(".tif"), picture, transfer="srgb", sample="16")
    lines = manifest.read_text().replace(".png", ".tif").splitlines()
    manifest.write_text("\n".join(line for line in lines if not line.startswith(tuple(CAMERA))))
    (read,) = read_captures(folder)
    assert (read.focal_length_mm, read.f_number, read.sensor_width_mm) == (50.0, 1.543, 36.0)
    assert read.notes["from_exif"] == list(CAMERA)
    moved = Picture(read_image(folder / "0400mm.tif").pixels, metadata={**tags, "FNumber": ("float", 2.2)})
    write_image(folder / "0400mm.tif", moved, transfer="srgb", sample="16")
    with pytest.raises(FitError, match="taken at f_number 2.2"):
        read_captures(folder)


@pytest.mark.filterwarnings("ignore:.*one distance was measured:torchdof.fit.problems.FitWarning")
def test_dots_of_one_frame_share_a_scale_if_the_camera_is_unknown(simulator):
    def capture(radius):
        camera = simulator.Simulator(size=61, dot_radius=8.0, magnification=0.8)
        return Captures((Capture(*camera.pair("disc", {"radius": radius}), 1.25),), focus_m=1.0, width_px=600)

    centre = fit_captures(capture(8.0), "disc")
    corner = fit_captures(capture(5.3), "disc", scale_of=centre)
    shown = [t.kernels(torch.tensor([8.0], dtype=torch.float64), 600) for t in (centre.table, corner.table)]
    widths = [float((k[0, 0].sum(0) > 1e-3).sum()) for k in shown]
    assert corner.coc_px == centre.coc_px and widths[1] < 0.75 * widths[0]
