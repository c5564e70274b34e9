"""Folders with a capture.toml: reading, windows around dots, and errors with file and number."""

import functools
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.files import store
from tests.refused import refuses
from torchdof.fit import Capture, Captures, FitError, FitWarning, fit_pair, read_captures
from torchdof.fit.photo.captures import read_picture
from torchdof.io.images import Picture, read_image, write_image


def softness(distance):
    return "gaussian", {"sigma": 6.0 * abs(1 / 0.5 - 1 / distance)}


@pytest.fixture(scope="module")
def written(simulator, tmp_path_factory):
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    return simulator.write_captures(tmp_path_factory.mktemp("lens"), camera, 0.5, [0.4, 1.0], softness)


@pytest.fixture
def folder(written, tmp_path):
    """A copy that a test may change."""
    return Path(shutil.copytree(written, tmp_path / "lens"))


def change(folder, before, after):
    path = folder / "capture.toml"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


def picture(folder, name, value, size=(240, 400)):
    write_image(folder / name, Picture(torch.full((1, 3, *size), value)), transfer="srgb", sample="16")


def test_pictures_are_decoded_to_linear_light_and_cropped_around_the_dot(folder):
    (captures,) = read_captures(folder)
    assert [c.distance_m for c in captures.pairs] == [0.4, 1.0] and captures.focus_m == 0.5 and captures.width_px == 400
    first = captures.pairs[0]
    assert first.sharp.shape == first.blurred.shape and first.sharp.shape[0] % 2 == 1
    assert first.sharp.max() == pytest.approx(0.72, abs=0.03)
    assert first.white == 1.0 and first.files[1].endswith("0400mm.png")
    for pair in captures.pairs:
        fit = fit_pair(pair.sharp, pair.blurred, "gaussian", magnification=0.5 / pair.distance_m, white=pair.white)
        assert fit.params["sigma"] == pytest.approx(softness(pair.distance_m)[1]["sigma"], rel=0.02)


def test_the_dark_frame_is_subtracted_and_the_manifests_transfer_is_used(folder):
    picture(folder, "dark.png", 0.02)
    change(folder, "focus_m = 0.5", 'focus_m = 0.5\ndark = "dark.png"')
    assert abs(np.median(read_captures(folder)[0].pairs[0].sharp)) < 2e-3
    change(folder, 'transfer = "srgb"', 'transfer = "linear"')
    change(folder, 'dark = "dark.png"', "")
    assert read_captures(folder)[0].pairs[0].sharp.max() == pytest.approx(0.87, abs=0.03)


def test_encoded_pictures_without_a_stated_transfer_give_a_warning(folder):
    change(folder, 'transfer = "srgb"', "")
    with pytest.warns(FitWarning, match="the encoding of 0500mm.png and 2 more is not stated") as caught:
        (captures,) = read_captures(folder)
    warning = caught[0].message
    assert warning.kind == "not linear" and warning.file.endswith("capture.toml")
    assert captures.notes["transfer"] == "by file type"
    for name in ("0400mm", "0500mm", "1000mm"):
        write_image(folder / f"{name}.exr", read_image(folder / f"{name}.png"))
        change(folder, f"{name}.png", f"{name}.exr")
    assert len(read_captures(folder)[0].pairs) == 2  # floats are linear light


def test_distances_in_millimetres_give_a_warning(folder):
    for name, metres in (("focus_m", 0.5), ("distance_m", 0.4), ("distance_m", 1.0)):
        change(folder, f"{name} = {metres}", f"{name} = {1000 * metres:g}")
    with pytest.warns(FitWarning, match="all distances are at least 400 m; divide millimetres"):
        assert [pair.distance_m for pair in read_captures(folder)[0].pairs] == [400, 1000]


def test_a_grid_gives_the_dot_in_the_centre_or_every_dot(simulator, tmp_path):
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=7.0)
    grid = [(x, y) for x in (-110, 0, 110) for y in (-80, 0, 80)]
    folder = simulator.write_captures(
        tmp_path, camera, 0.5, [0.6], lambda d: ("gaussian", {"sigma": 2.0}), grid=grid, width=480, height=340
    )
    with pytest.raises(FitError, match="9 dots where one was expected"):
        read_captures(folder)
    (centre,) = read_captures(folder, dots="centre")
    assert centre.pairs[0].position_px == pytest.approx((0, 0), abs=1)
    every = read_captures(folder, dots="each")
    assert sorted(round(c.pairs[0].position_px[0] / 110) for c in every) == [-1] * 3 + [0] * 3 + [1] * 3


CROWDED = [(x, y) for x in (-40, 0, 40) for y in (-40, 0, 40)]


@pytest.mark.parametrize(("grid", "dots", "kind", "match"), [
    (CROWDED, "centre", "several dots", "apart than"),
    ([(165, 0)], None, "window", "0600mm.png: the frame cuts the blur"),
])  # fmt: skip
def test_dots_without_room_for_their_blur_are_refused(simulator, tmp_path, grid, dots, kind, match):
    camera = simulator.Simulator(level=0.7, snr_db=50, dot_radius=8.0)
    folder = simulator.write_captures(tmp_path, camera, 0.5, [0.6], lambda d: ("gaussian", {"sigma": 9.0}), grid=grid)
    with pytest.raises(FitError, match=match) as caught:
        read_captures(folder, dots=dots)
    assert caught.value.kind == kind


FOCUS, SHOT = "focus_m = 0.5", "distance_m = 0.4"
WRONG = [
    (SHOT, "distance_m = 1.4", "distance", r"positive and increasing, got \[1.4, 1.0\] m"),
    (SHOT, "distance_m = 0.5", "distance", r"lies at the focus \(0.5 m\)"),
    (SHOT, "distance_m = -1", "manifest", "distance_m must be a number > 1e-05 and < 1e.06, got -1"),
    (FOCUS, "focus_m = ", "manifest", "is not TOML"),
    (FOCUS, f"{FOCUS}\nf_number = 1e-30", "manifest", "f_number must be a number > "),
    (FOCUS, f"{FOCUS}\nfocal = 50", "manifest", "have the fields focus_m, sharp, .*'focal' is not one of"),
    ('transfer = "srgb"', 'transfer = "gamma"', "manifest", "transfer must be one of linear, srgb, got 'gamma'"),
    (FOCUS, f'{FOCUS}\nbayer = "RGBG"', "manifest", "bayer must be one of RGGB, BGGR"),
    (FOCUS, f'{FOCUS}\nbayer = "RGGB"', "manifest", "is for pictures with one colour a pixel, got 3 colours"),
    (FOCUS, f"{FOCUS}\ncrop = [1, 2, 3]", "manifest", r"crop must be \[left, top, width, height\]"),
    ('file = "0400mm.png"', "", "manifest", r"\[\[shot\]\] must have the fields file, .* file is missing"),
    ('file = "0400mm.png"', 'file = "small.png"', "manifest", "small.png: is 100x100, 0500mm.png is 400x240"),
    ('file = "0400mm.png"', 'file = "black.png"', "no dot", "black.png: no dot found"),
]  # fmt: skip


@pytest.mark.parametrize(("before", "after", "kind", "match"), WRONG)
def test_wrong_manifests_and_pictures_are_refused_with_the_field(folder, before, after, kind, match):
    picture(folder, "small.png", 0.0, (100, 100))
    picture(folder, "black.png", 0.0)
    change(folder, before, after)
    with pytest.raises(FitError, match=match) as caught:
        read_captures(folder)
    assert caught.value.kind == kind and caught.value.file.endswith(("capture.toml", ".png"))


def test_manifest_and_pictures_must_lie_below_root(folder, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    assert len(read_captures(folder, root=folder)) == len(read_captures(folder, root=folder.parent)) == 1
    with pytest.raises(FitError, match="lies outside of"):
        read_captures(folder, root=outside)
    with pytest.raises(FitError, match="root must be a folder"):
        read_captures(folder, root=folder / "nowhere")
    (outside / "secret.png").write_bytes((folder / "0400mm.png").read_bytes())
    (folder / "link.png").symlink_to(outside / "secret.png")
    for name in ("link.png", f"{outside}/secret.png", f"../{outside.name}/secret.png"):
        change(folder, 'file = "0400mm.png"', f'file = "{name}"')
        assert "../" in name or len(read_captures(folder)) == 1  # allowed without a root
        with pytest.raises(FitError, match=r"secret\.png' lies outside|link\.png' lies outside"):
            read_captures(folder, root=folder)
        change(folder, f'file = "{name}"', 'file = "0400mm.png"')


def test_missing_files_are_named(folder, tmp_path):
    (folder / "1000mm.png").unlink()
    with pytest.raises(OSError, match="1000mm.png"):
        read_captures(folder)
    with pytest.raises(FitError, match="no such manifest; write a capture.toml"):
        read_captures(tmp_path)
    (tmp_path / "capture.toml").write_text("focus_m = 0.5")
    with pytest.raises(FitError, match="at least one"):
        read_captures(tmp_path)


PAIR = Capture(np.zeros((31, 31)), np.zeros((31, 31)), 1.0)
test_captures_from_arrays_are_checked = refuses(
    *((functools.partial(Captures, pairs, 0.5, 100, f_number=f_number), match)
      for pairs, f_number, match in (((), 2, "one or more"), ((PAIR,) * 2, 2, "increasing"), ((PAIR,), -2, "-2"))),
    errors=FitError,
)  # fmt: skip


def test_a_mosaic_with_an_orientation_tag_is_refused(tmp_path: Path) -> None:
    """Rotation would change the colours of the pattern's upper left pixels."""
    store(tmp_path / "mosaic.tif", np.ones((6, 8, 1), np.uint16), "uint16", Orientation=6)
    with pytest.raises(FitError, match="got EXIF orientation 6; remove the tag"):
        read_picture(tmp_path / "mosaic.tif", "linear", bayer="RGGB")
