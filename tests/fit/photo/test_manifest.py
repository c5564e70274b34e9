"""Folders of photographs: reading, windows, and every refusal with its file and number."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchdof.fit import Capture, Captures, fit_pair, read_captures, read_pair
from torchdof.fit import problems as p
from torchdof.io.images import Picture, read_image, write_image


def softness(distance):
    return "gaussian", {"sigma": 6.0 * abs(1 / 0.5 - 1 / distance)}


@pytest.fixture
def folder(simulator, tmp_path):
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    return simulator.write_captures(tmp_path / "lens", camera, 0.5, [0.4, 1.0], softness)


def change(folder, before, after):
    path = folder / "capture.toml"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


def test_a_folder_is_read_linear_and_cut_around_the_dot(folder):
    (captures,) = read_captures(folder)
    assert [c.distance_m for c in captures] == [0.4, 1.0] and captures.focus_m == 0.5 and captures.width_px == 400
    first = captures.pairs[0]
    assert first.sharp.shape == first.blurred.shape and first.sharp.shape[0] % 2 == 1
    assert first.sharp.max() == pytest.approx(0.72, abs=0.03)
    assert first.white == 1.0 and first.files[1].endswith("0400mm.png")
    for pair in captures:
        fit = fit_pair(pair.sharp, pair.blurred, "gaussian", magnification=0.5 / pair.distance_m, white=pair.white)
        assert fit.params["sigma"] == pytest.approx(softness(pair.distance_m)[1]["sigma"], rel=0.02)


def test_the_dark_frame_is_subtracted(folder):
    dark = torch.full((1, 3, 240, 400), 0.02)
    write_image(folder / "dark.png", Picture(dark), transfer="srgb", sample="16")
    change(folder, "focus_m = 0.5", 'focus_m = 0.5\ndark = "dark.png"')
    assert abs(np.median(read_captures(folder)[0].pairs[0].sharp)) < 2e-3


def test_transfer_is_what_the_manifest_says(folder):
    change(folder, 'transfer = "srgb"', 'transfer = "linear"')
    assert read_captures(folder)[0].pairs[0].sharp.max() == pytest.approx(0.87, abs=0.03)


def test_encoded_pictures_whose_transfer_nobody_stated_are_never_taken_in_silence(folder):
    change(folder, 'transfer = "srgb"', "")
    with pytest.warns(p.NotLinearWarning, match="how 0500mm.png and 2 more are encoded") as caught:
        (captures,) = read_captures(folder)
    assert caught[0].message.number == 3 and caught[0].message.file.endswith("capture.toml")
    assert captures.notes["transfer"] == "by file type"
    files = folder / "0500mm.png", folder / "1000mm.png"
    with pytest.warns(p.NotLinearWarning, match=r"transfer = 'linear', or 'srgb'"):
        read_pair(*files, magnification=0.5)
    for name in ("0400mm", "0500mm", "1000mm"):
        write_image(folder / f"{name}.exr", read_image(folder / f"{name}.png"))
        change(folder, f"{name}.png", f"{name}.exr")
    assert len(read_captures(folder)[0]) == 2  # floats are linear light


def test_a_grid_gives_the_centre_dot_or_each(simulator, tmp_path):
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=7.0)
    grid = [(x, y) for x in (-110, 0, 110) for y in (-80, 0, 80)]
    folder = simulator.write_captures(
        tmp_path, camera, 0.5, [0.6], lambda d: ("gaussian", {"sigma": 2.0}), grid=grid, width=480, height=340
    )
    with pytest.raises(p.SeveralDotsError, match="9 dots where one was expected") as caught:
        read_captures(folder)
    assert caught.value.number == 9
    (centre,) = read_captures(folder, dots="centre")
    assert centre.pairs[0].position_px == pytest.approx((0, 0), abs=1)
    every = read_captures(folder, dots="each")
    assert len(every) == 9
    assert sorted(round(c.pairs[0].position_px[0] / 110) for c in every) == [-1] * 3 + [0] * 3 + [1] * 3


def test_dots_closer_than_their_blur_are_refused(simulator, tmp_path):
    camera = simulator.Simulator(level=0.7, snr_db=50, dot_radius=7.0)
    grid = [(x, y) for x in (-40, 0, 40) for y in (-40, 0, 40)]
    folder = simulator.write_captures(
        tmp_path, camera, 0.5, [0.6], lambda d: ("gaussian", {"sigma": 6.0}), grid=grid, width=300, height=240
    )
    with pytest.raises(p.SeveralDotsError, match="farther apart than their blur"):
        read_captures(folder, dots="centre")


def test_a_pair_of_files_is_read(folder):
    pair = read_pair(folder / "0500mm.png", folder / "1000mm.png", magnification=0.5, transfer="srgb")
    assert pair.sharp.shape == pair.blurred.shape and pair.files[0].endswith("0500mm.png")


@pytest.mark.parametrize(
    ("before", "after", "error", "match"),
    [
        ("distance_m = 0.4", "distance_m = 1.4", p.DistanceError, "positive and increasing, got 1.4, 1 m"),
        ("distance_m = 0.4", "distance_m = 0.5", p.DistanceError, r"lies at the focus \(0.5 m\)"),
        ("distance_m = 0.4", "distance_m = -1", p.ManifestError, "distance_m must be a positive number, got -1"),
        ("distance_m = 0.4", 'distance_m = "near"', p.ManifestError, "must be a positive number, got 'near'"),
        ("focus_m = 0.5", "focus_m = nan", p.ManifestError, "focus_m must be a positive number"),
        ("focus_m = 0.5", "focus_m = 0.5\nfocal = 50", p.ManifestError, "'focal' is not a field; known are focus_m"),
        ('transfer = "srgb"', 'transfer = "gamma"', p.ManifestError, "'linear' or 'srgb', got 'gamma'"),
        (
            "focus_m = 0.5",
            'focus_m = 0.5\ndots = "two"',
            p.ManifestError,
            "'one', 'centre', 'each' or 'field', got 'two'",
        ),
        ("focus_m = 0.5", "focus_m = ", p.ManifestError, "is not TOML"),
        ("focus_m = 0.5", "focus_m = true", p.ManifestError, "positive number, got True"),
        ('file = "0400mm.png"', "", p.ManifestError, "file must be a text, got None"),
        ('sharp = "0500mm.png"', "sharp = 3", p.ManifestError, "sharp must be a text, got 3"),
    ],
)
def test_wrong_manifests_are_refused_with_the_field(folder, before, after, error, match):
    change(folder, before, after)
    with pytest.raises(error, match=match) as caught:
        read_captures(folder)
    assert caught.value.file.endswith("capture.toml")


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("focus_m = 1e-300", "focus_m"),
        ("focus_m = 1e30", "focus_m"),
        ("focal_length_mm = 1e300", "focal_length_mm"),
        ("f_number = 1e-30", "f_number"),
        ("sensor_width_mm = 5e-324", "sensor_width_mm"),
        ("exposure_s = 1e99", "exposure_s"),
    ],
)
def test_numbers_that_are_finite_but_absurd_are_refused(folder, line, name):
    lines = [old for old in (folder / "capture.toml").read_text().splitlines() if not old.startswith(name)]
    (folder / "capture.toml").write_text("\n".join([line, *lines]))
    with pytest.raises(p.ManifestError, match=rf"{name} must be a positive number, got .*; a camera's is"):
        read_captures(folder)


def test_a_root_holds_the_manifest_and_its_pictures(folder, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    assert len(read_captures(folder, root=folder)) == len(read_captures(folder, root=folder.parent)) == 1
    with pytest.raises(p.ManifestError, match="lies outside of"):
        read_captures(folder, root=outside)
    with pytest.raises(p.ManifestError, match="root must be a folder"):
        read_captures(folder, root=folder / "nowhere")
    (outside / "secret.png").write_bytes((folder / "0400mm.png").read_bytes())
    (folder / "link.png").symlink_to(outside / "secret.png")
    for name in ("link.png", f"{outside}/secret.png", f"../{outside.name}/secret.png"):
        change(folder, 'file = "0400mm.png"', f'file = "{name}"')
        assert "../" in name or len(read_captures(folder)) == 1  # without a root it is read
        with pytest.raises(p.ManifestError, match=r"secret\.png' lies outside|link\.png' lies outside"):
            read_captures(folder, root=folder)
        change(folder, f'file = "{name}"', 'file = "0400mm.png"')


def test_a_folder_without_manifest_or_shots_is_refused(tmp_path):
    with pytest.raises(p.ManifestError, match="no such manifest; write a capture.toml"):
        read_captures(tmp_path)
    (tmp_path / "capture.toml").write_text("focus_m = 0.5")
    with pytest.raises(p.ManifestError, match="at least one"):
        read_captures(tmp_path)


def test_missing_and_odd_pictures_are_refused(folder):
    write_image(folder / "1000mm.png", Picture(torch.zeros(1, 3, 100, 100)), transfer="srgb", sample="16")
    with pytest.raises(p.ManifestError, match="1000mm.png is 100x100, 0500mm.png is 400x240"):
        read_captures(folder)
    (folder / "1000mm.png").unlink()
    with pytest.raises(OSError, match="1000mm.png"):
        read_captures(folder)


def test_no_dot_names_the_file(folder):
    write_image(folder / "1000mm.png", Picture(torch.zeros(1, 3, 240, 400)), transfer="srgb", sample="16")
    with pytest.raises(p.DotNotFoundError, match="1000mm.png: no dot found") as caught:
        read_captures(folder)
    assert caught.value.file.endswith("1000mm.png") and caught.value.number < 8


def test_a_frame_that_cuts_the_blur_is_refused(simulator, tmp_path):
    camera = simulator.Simulator(level=0.7, snr_db=50, dot_radius=9.0)
    folder = simulator.write_captures(
        tmp_path, camera, 0.5, [0.6], lambda d: ("gaussian", {"sigma": 9.0}), grid=[(165, 0)]
    )
    with pytest.raises(p.WindowError) as caught:
        read_captures(folder)
    assert caught.value.file.endswith("0600mm.png")


def test_captures_from_arrays_are_checked():
    pair = Capture(np.zeros((31, 31)), np.zeros((31, 31)), 1.0)
    with pytest.raises(p.FitError, match="no pair"):
        Captures((), focus_m=0.5, width_px=100)
    with pytest.raises(p.DistanceError):
        Captures((pair, pair), focus_m=0.5, width_px=100)
    with pytest.raises(p.FitError, match="f_number must be positive, got -2"):
        Captures((pair,), focus_m=0.5, width_px=100, f_number=-2)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=200), st.text(max_size=200).map(str.encode)))
def test_any_manifest_is_read_or_refused_by_name(tmp_path, content):
    (tmp_path / "capture.toml").write_bytes(content)
    with pytest.raises((p.FitError, OSError)):
        read_captures(tmp_path)
