"""The printed target: the page, its detection, and distances, focus and tone curve from photographs of it."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchdof import BlurTable, Camera, blur_by_coc
from torchdof.fit import FitError, FitWarning, fit_captures
from torchdof.fit.photo.photographs import read_photographs
from torchdof.fit.photo.target import DOT_MM, SQUARE_MM, Target, find_target, tone_curve, untoned, write_target
from torchdof.io import paths
from torchdof.io.images import Picture, read_image, write_image
from torchdof.reference.metrics import psnr


@pytest.mark.parametrize(("paper", "width", "height"), [("a4", 595.28, 841.89), ("letter", 612.0, 792.0)])
def test_the_page_has_its_square_dot_and_text_at_their_places(tmp_path, paper, width, height):
    write_target(tmp_path / "target.pdf", paper)
    data = (tmp_path / "target.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data)
    assert (float(box[1]), float(box[2])) == pytest.approx((width, height), abs=0.01)
    content = re.search(rb"stream\n(.*)\nendstream", data, re.S)[1]
    # in mm: the square, the dot in its centre, and lines of text on the page below the square
    x, y, *sides = map(float, re.search(rb"\n([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re f", content).groups())
    assert sides == [SQUARE_MM] * 2
    right, middle = map(float, re.search(rb"1 g ([\d.]+) ([\d.]+) m", content).groups())
    assert (right, middle) == pytest.approx((x + (SQUARE_MM + DOT_MM) / 2, y + SQUARE_MM / 2), abs=1e-3)
    lines = [float(at) for at in re.findall(rb"([\d.-]+) Td", content)]
    assert len(lines) > 8 and all(5 < line < y for line in lines)


@pytest.mark.parametrize(("name", "paper", "match"), [("a.png", "a4", r"name it .*a\.pdf"), ("a.pdf", "a3", "must be")])
def test_another_file_or_paper_is_refused(tmp_path, name, paper, match):
    with pytest.raises(FitError, match=match):
        write_target(tmp_path / name, paper)


@pytest.fixture(scope="module")
def folder(simulator, tmp_path_factory):
    folder = tmp_path_factory.mktemp("phone")
    simulator.write_photographs(folder, 0.2, [0.3, 0.5], width=640, tone=0.0, noise=0.004)
    return folder


def test_the_target_is_found_on_a_desk_and_measured(simulator, folder):
    light = read_image(folder / "img_0001.jpg").pixels[0].mean(0).double().numpy()
    target = find_target(light)
    image_px = 26 / 36 * 640 / (1 - 0.0054 / 0.2)
    assert target.side_px == pytest.approx(SQUARE_MM * image_px / 300, rel=2e-3)
    x, y = simulator.place_of_target(1, 640)
    assert (target.x, target.y) == pytest.approx((319.5 + x, 239.5 + y), abs=0.3)
    assert target.white == pytest.approx(0.8, rel=0.03) and target.elongation < 1.01
    with pytest.raises(FitError, match="no target found"):
        find_target(np.random.default_rng(0).random((200, 300)))
    rows, columns = np.indices(light.shape)
    light[np.hypot(rows - target.y, columns - target.x) < 0.2 * target.side_px] = 0.035
    with pytest.raises(FitError, match="no target found"):  # a black square without a dot is not a target
        find_target(light)


def test_distances_and_focus_are_found_from_the_photographs(folder):
    with pytest.warns(FitWarning, match="3 photographs are too few to find a tone curve"):
        found = read_photographs(folder)
    assert [q.distance_m for q in found.pictures] == pytest.approx([0.2, 0.3, 0.5], rel=3e-3)
    captures = found.captures
    assert captures.focus_m == pytest.approx(0.2, rel=3e-3) and captures.notes["sharp"] == "img_0000.jpg"
    assert [c.distance_m for c in captures.pairs] == pytest.approx([0.3, 0.5], rel=3e-3)
    assert captures.width_px == 640
    assert (captures.focal_length_mm, captures.f_number) == pytest.approx((5.4, 1.8))
    assert captures.sensor_width_mm == pytest.approx(36 * 5.4 / 26)
    assert any("five to nine" in sentence for sentence in found.advice)
    with pytest.warns(FitWarning, match="tone curve"):  # a target printed at another size scales the distances
        assert read_photographs(folder, square_mm=95.0).captures.focus_m == pytest.approx(0.19, rel=3e-3)


@pytest.mark.filterwarnings("ignore:.*too few to find a tone curve:torchdof.fit.problems.FitWarning")
def test_each_colour_of_photographs_has_its_own_kernel(folder):
    # the scene is grey, so that all colours have the same blur
    captures = read_photographs(folder, colours="each").captures
    (pair,) = [c for c in captures.pairs if c.distance_m > 0.4]
    assert pair.colours is not None and pair.colours[1].shape == (3, *pair.blurred.shape)
    np.testing.assert_allclose(pair.colours[1].mean(0), pair.blurred, atol=1e-6)
    with pytest.warns(FitWarning, match="one distance"):
        found = fit_captures(replace(captures, pairs=(pair,)), "disc")
    assert found.table.channels == 3 and list(found.colours) == ["red", "green", "blue"]
    assert [fits[0].radius for fits in found.colours.values()] == pytest.approx([found.fits[0].radius] * 3, rel=0.01)


def test_errors_of_unreadable_folders_state_the_remedy(simulator, tmp_path, monkeypatch):
    with pytest.raises(FitError, match="neither a capture.toml nor two photographs"):
        read_photographs(tmp_path)
    simulator.write_photographs(tmp_path, 0.2, [0.3], width=480, tone=0.0, exif=False)
    with pytest.raises(FitError, match="EXIF has no focal_length_mm, f_number, sensor_width_mm"):
        read_photographs(tmp_path)
    (tmp_path / "img_9.heic").write_bytes(b"")
    monkeypatch.setattr(paths, "has_pi_heif", lambda: False)
    with pytest.raises(FitError, match="heic is not read here: install its reader"):
        read_photographs(tmp_path)


def test_root_also_limits_photographs_without_a_description(tmp_path):
    (tmp_path / "photographs").mkdir()
    for number in range(2):
        write_image(tmp_path / f"{number}.png", Picture(torch.rand(1, 3, 40, 40)))
        (tmp_path / "photographs" / f"{number}.png").symlink_to(tmp_path / f"{number}.png")
    for root, message in ((tmp_path / "photographs", "lies outside of"), (tmp_path, "show the target")):
        with pytest.raises(FitError, match=message):
            read_photographs(tmp_path / "photographs", root=root)


def _photographs(simulator, tone, seed=0):
    """Dots of large photographs with five blur radii and an S-curve."""
    rng, found = np.random.default_rng(seed), []
    for radius in (0.0, 8.0, 16.0, 24.0, 32.0):
        side, size = 320.0, 321
        dot = simulator.draw_dot(size, DOT_MM / 2 * side / SQUARE_MM, oversample=4)
        dot = simulator.blur(dot, "disc", {"radius": radius}) if radius else dot
        light = simulator.Simulator(tone=tone, snr_db=50).record(0.03 + 0.75 * dot, rng)
        white = float(simulator.Simulator(tone=tone, snr_db=None).record(np.array([[0.78]]), rng)[0, 0])
        found.append((light, Target(160.0, 160.0, side, 1.0, white, 0.03)))
    return found


def left_of(simulator, tone, bend):
    """Share of a tone curve's largest error that is left when the curve `bend` is undone."""
    levels = np.linspace(0.05, 0.75, 20)[None]
    curved = simulator.Simulator(tone=tone, snr_db=None).record(levels, np.random.default_rng(0))
    # relative to the highest level: a common factor does not change a kernel
    before, after = (v / v[0, -1] - levels / levels[0, -1] for v in (curved, untoned(curved, bend)))
    return np.abs(after).max() / np.abs(before).max()


def test_a_tone_curve_is_found_from_the_total_light_of_the_dot_and_undone(simulator):
    assert tone_curve(_photographs(simulator, 0.0), SQUARE_MM)[0].tolist() == [0.0, 0.0, 0.0]
    assert left_of(simulator, 0.5, tone_curve(_photographs(simulator, 0.5), SQUARE_MM)[0]) < 0.4


def test_no_tone_curve_is_found_in_photographs_without_one(simulator, tmp_path):
    simulator.write_photographs(tmp_path, 0.2, [0.28, 0.4, 0.6], width=640, tone=0.0)
    assert read_photographs(tmp_path).captures.notes["tone_curve"] == [0.0, 0.0, 0.0]


def scene(width):
    """A desk from 0.2 m to 0.8 m with stripes and lights `[1, 3, H, W]`, and its depth in metres `[1, 1, H, W]`."""
    height = width * 3 // 4
    stripes = 0.2 + 0.3 * ((torch.arange(width) // (width // 40)) % 2)
    image = stripes.expand(height, width).clone()
    image[height // 2 :] = 0.05
    image[height * 3 // 4 :: height // 12, width // 20 :: width // 10] = 60.0
    tint = torch.tensor([1.0, 0.8, 0.6])[:, None, None]
    return (image * tint)[None], torch.linspace(0.2, 0.8, width).expand(1, 1, height, width).clone()


@pytest.mark.sweep  # the curve alone, and tables of pictures without one, have tests of their own
def test_a_table_of_photographs_with_an_unknown_tone_curve_renders_the_true_lens_s_picture(simulator, tmp_path):
    simulator.write_photographs(tmp_path, 0.2, [0.28, 0.4, 0.6])
    found = read_photographs(tmp_path)
    # these dots are too small to use their total light
    assert "the edges of the square" in " ".join(found.advice)
    assert left_of(simulator, 0.5, found.captures.notes["tone_curve"]) < 0.5
    table = fit_captures(found.captures, "disc").table
    image, depth = scene(800)
    coc_px = Camera(5.4, 1.8, 0.2, 36 * 5.4 / 26).coc_px(depth, width=800)
    rendered, true = (blur_by_coc(image, coc_px, table=each) for each in (table, BlurTable.disc()))
    shown = [light.clamp(0, 1) ** (1 / 2.2) for light in (rendered, image, true)]
    of_table, of_sharp = psnr(shown[0], shown[2]), psnr(shown[1], shown[2])
    assert of_table > 42 and of_table > of_sharp + 12, (of_table, of_sharp)
