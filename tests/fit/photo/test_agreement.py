"""A wrong camera number, a wrong distance or a crop shows in the blur, and is named."""

import numpy as np
import pytest
import torch

from torchdof.fit import Capture, Captures, fit_captures, read_captures
from torchdof.fit import problems as p
from torchdof.fit.photo.agreement import check_agreement, frame_width, promised_px
from torchdof.io.images import Picture, read_image, write_image

DISTANCES = (0.6, 0.7, 0.8, 1.25, 1.5, 2.0)
CAMERA = {"focal_length_mm": 50.0, "f_number": 2.8, "sensor_width_mm": 36.0}


def captures(distances=DISTANCES, width_px=2400, focus_m=1.0, **camera):
    window = np.zeros((15, 15))
    pairs = tuple(Capture(window, window, d, files=("sharp.png", f"{d}.png")) for d in distances)
    return Captures(pairs, focus_m, width_px, **{**CAMERA, **camera})


def true_radius(distances=DISTANCES, focus_m=1.0):
    """What a lens with a tenth of aberrations really does, on 2400 px of 36 mm."""
    return [1.03 * abs(r) + 0.2 for r in promised_px(captures(distances, focus_m=focus_m))]


def test_an_honest_capture_is_silent():
    check_agreement(captures(), true_radius())


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"width_px": 600}, "crop of frames about 2.{3} px wide"),
        ({"f_number": 1.4}, r"the f-number is 2\.[67]"),
        ({"sensor_width_mm": 23.5}, r"the sensor is 3[45]"),
        ({"focal_length_mm": 35.0}, "the focal length is 5"),
    ],
)
def test_a_wrong_camera_number_is_refused_and_named(wrong, said):
    with pytest.raises(p.CameraError, match=said) as caught:
        check_agreement(captures(**wrong), true_radius())
    assert caught.value.file and max(caught.value.number, 1 / caught.value.number) > 1.35


def test_distances_in_another_unit_are_named():
    in_feet = captures([3.281 * d for d in DISTANCES], focus_m=3.281)
    with pytest.raises(p.CameraError, match="the distances are in feet"):
        check_agreement(in_feet, true_radius())


@pytest.mark.parametrize("known", [True, False])
def test_a_misread_distance_is_named_with_the_one_that_fits(known):
    camera = {} if known else dict.fromkeys(CAMERA)
    misread = (0.6, 0.7, 0.9, 1.25, 1.5, 2.0)
    with pytest.raises(p.CameraError, match=r"distance of 0.9 m is misread: by its blur it stands at 0\.(79|8)"):
        check_agreement(captures(misread, **camera), true_radius())


def test_exchanged_pictures_are_named():
    radius = true_radius()
    radius[0], radius[2] = radius[2], radius[0]
    with pytest.raises(p.CameraError, match=r"pictures at 0.6 and 0.8 m are exchanged"):
        check_agreement(captures(), radius)


def test_a_lens_that_was_focused_elsewhere_is_named():
    with pytest.raises(p.CameraError, match=r"the lens was focused at 0\.9[23]. m, not at 1 m"):
        check_agreement(captures(), true_radius(focus_m=0.93))


def test_a_small_disagreement_warns():
    with pytest.warns(p.CameraWarning, match="likely") as caught:
        check_agreement(captures(f_number=3.3), true_radius())
    assert 1.15 < caught[0].message.number < 1.35


def test_blur_of_a_pixel_is_not_judged():
    check_agreement(captures((0.98, 1.02)), [1.5, 1.5])


def test_a_crop_is_told_from_a_picture_scaled_down_by_its_blur():
    cropped = Captures(captures().pairs, 1.0, 600, **CAMERA, original_width_px=2400)
    with pytest.warns(p.CameraWarning, match="taken for a crop"):
        assert frame_width(cropped, true_radius()) == 2400
    assert frame_width(cropped, [r / 4 for r in true_radius()]) == 600


@pytest.fixture
def folder(simulator, tmp_path):
    """Frames 400 px wide of a 36 mm sensor at 50 mm and f/1.543, which is a disc of 10 px a dioptre."""
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    fields = "focal_length_mm = 50.0\nf_number = 1.543\nsensor_width_mm = 36.0"
    return simulator.write_captures(
        tmp_path, camera, 0.5, [0.4], lambda d: ("disc", {"radius": 10.0 * abs(2 - 1 / d)}), camera_fields=fields
    )


def rewrite(folder, change, exif=None):
    for path in folder.glob("*.png"):
        picture = read_image(path)
        write_image(path, Picture(change(picture.pixels), metadata=exif or {}), transfer="srgb", sample="16")


@pytest.mark.filterwarnings("ignore::torchdof.fit.problems.SingleDistanceWarning")
def test_a_crop_in_the_manifest_keeps_the_scale_and_one_in_an_editor_is_refused(folder):
    manifest = folder / "capture.toml"
    text = manifest.read_text()
    manifest.write_text(f"crop = [130, 40, 150, 160]\n{text}")
    (inside,) = read_captures(folder)
    assert inside.width_px == 400 and inside.pairs[0].position_px == pytest.approx((0, 0), abs=1)
    assert fit_captures(inside, "disc").coc_px[0] == pytest.approx(-5.0, rel=0.01)
    manifest.write_text(f"crop = [300, 40, 150, 160]\n{text}")
    with pytest.raises(p.ManifestError, match="leaves the picture of 400x240"):
        read_captures(folder)
    rewrite(folder, lambda pixels: pixels[..., 130:280])
    manifest.write_text(text)
    with pytest.raises(p.CameraError, match="crop of frames about (39.|40.) px"):
        fit_captures(read_captures(folder)[0], "disc")
    manifest.write_text(f"full_width_px = 400\n{text}")
    assert fit_captures(read_captures(folder)[0], "disc").table.node_params["radius"].item() == pytest.approx(
        5 * 36 / 400, rel=0.01
    )
    manifest.write_text(f"full_width_px = 40\n{text}")
    with pytest.raises(p.ManifestError, match="full_width_px must be at least"):
        read_captures(folder)


def test_exif_fills_in_what_the_manifest_leaves_out_and_contradictions_are_said(folder):
    manifest = folder / "capture.toml"
    text = manifest.read_text()
    tags = {"Exif:FocalLength": ("float", 50.0), "FNumber": ("float", 1.543), "Exif:FocalLengthIn35mmFilm": ("int", 50)}
    for path in folder.glob("*.png"):
        picture = read_image(path)
        target = path.with_suffix(".tif")
        write_image(target, Picture(picture.pixels, metadata=tags), transfer="srgb", sample="16")
    without = [line for line in text.replace(".png", ".tif").splitlines() if not line.startswith(tuple(CAMERA))]
    manifest.write_text("\n".join(without))
    (read,) = read_captures(folder)
    assert (read.focal_length_mm, read.f_number, read.sensor_width_mm) == (50.0, 1.543, 36.0)
    assert read.notes["from_exif"] == list(CAMERA)
    manifest.write_text("f_number = 4.0\n" + "\n".join(without))
    with pytest.warns(p.CameraWarning, match="f_number is stated as 4, and EXIF says 1.543"):
        assert read_captures(folder)[0].f_number == 4.0
    moved = read_image(folder / "0400mm.tif")
    other = {**tags, "FNumber": ("float", 2.2)}
    write_image(folder / "0400mm.tif", Picture(moved.pixels, metadata=other), transfer="srgb", sample="16")
    manifest.write_text("\n".join(without))
    with pytest.raises(p.ManifestError, match="taken at f-number 2.2"):
        read_captures(folder)


@pytest.mark.filterwarnings("ignore::torchdof.fit.problems.SingleDistanceWarning")
def test_dots_of_one_frame_share_a_scale_where_the_camera_is_not_known(simulator):
    def capture(radius):
        camera = simulator.Simulator(size=61, dot_radius=8.0, magnification=0.8)
        return Captures((Capture(*camera.pair("disc", {"radius": radius}), 1.25),), focus_m=1.0, width_px=600)

    centre = fit_captures(capture(8.0), "disc")
    corner = fit_captures(capture(5.3), "disc", scale_of=centre)
    shown = [t.kernels(torch.tensor([8.0], dtype=torch.float64), 600) for t in (centre.table, corner.table)]
    widths = [float((k[0, 0].sum(0) > 1e-3).sum()) for k in shown]
    assert corner.coc_px == centre.coc_px and widths[1] < 0.75 * widths[0]
