"""``torchdof inspect`` from the outside."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from torchdof.cli.main import app
from torchdof.io.images import Picture, read_image, write_image

HEIGHT, WIDTH = 24, 40


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with photo.png and depth.npy (2 m left, 6 m right); it is the working folder."""
    monkeypatch.chdir(tmp_path)
    image, depth = torch.full((1, 3, HEIGHT, WIDTH), 0.1), np.full((HEIGHT, WIDTH), 2.0)
    image[..., WIDTH // 2 :], depth[:, WIDTH // 2 :] = 0.6, 6.0
    write_image("photo.png", Picture(image, sample="8", transfer="srgb"))
    np.save("depth.npy", depth)
    return tmp_path


def run(*arguments: str, code: int = 0) -> tuple[str, str]:
    result = CliRunner().invoke(app, ["inspect", *arguments], catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.stdout, result.stderr


def test_it_prints_ranges_blur_focus_holes_and_edges_and_writes_a_picture(scene: Path) -> None:
    out, err = run("photo.png", "depth.npy", "--focus-m", "2", "--f-number", "1.4", "--sensor-width-mm", "4")
    for words in (
        "image         40 x 24 px, R, G, B",
        "f/1.4, focus 2 m, sensor 4 mm",
        "nearest 2 ",
        "farthest 6",
        "holes 0 (0.0 %)",
        "blur radius   +0.0 to +",
        "in focus      50.0 %",
        "####",
        "depth edges   144 pixels: 100.0 % exact",
        "picture       photo.inspect.png",
    ):
        assert words in out, words
    assert err == ""
    sheet = read_image("photo.inspect.png").pixels
    assert sheet.shape[-1] > 3 * WIDTH and sheet.shape[-2] > HEIGHT


def test_json_says_for_programs_what_is_printed(scene: Path) -> None:
    out, _ = run("photo.png", "depth.npy", "--focus-m", "2", "--f-number", "1.4", "--sensor-width-mm", "4", "--json")
    facts = json.loads(out)
    assert facts["camera"]["focus_m"] == 2.0 and facts["picture"] == "photo.inspect.png"
    assert facts["depth_m"] == {"nearest": 2.0, "1 %": 2.0, "median": 4.0, "99 %": 6.0, "farthest": 6.0}
    assert facts["holes_px"] == 0 and facts["in_focus"] == 0.5 and facts["coc_px"][0] == 0.0
    assert facts["depth_edges"] == {"exact": 144, "ramp": 0, "beside": 0, "unclear": 0}
    assert sum(part["share"] for part in facts["histogram"]) == pytest.approx(1.0)


def test_without_a_focus_it_is_at_the_median_and_that_is_said(scene: Path) -> None:
    out, _ = run("photo.png", "depth.npy", "-o", "look.png")
    assert "focus at the median depth" in out and (scene / "look.png").is_file()


def test_holes_are_counted_not_refused(scene: Path) -> None:
    depth = np.load("depth.npy")
    depth[:, 18:22] = 0
    np.save("holed.npy", depth)
    out, _ = run("photo.png", "holed.npy", "--focus-m", "2")
    assert "holes 96 (10.0 %)" in out
    out, _ = run("photo.png", "holed.npy", "--focus-m", "2", "--fill-depth", "nearest")
    assert "holes 0" in out and "filled        96 holes (10.0 %), nearest" in out


def test_unit_mistakes_are_said_and_strictness_makes_them_errors(scene: Path) -> None:
    np.save("mm.npy", np.load("depth.npy") * 1000)
    out, err = run("photo.png", "mm.npy", "--focus-m", "3", "--f-number", "1.4", "--sensor-width-mm", "4")
    assert "picture " in out and err.startswith("warning: mm.npy: nothing is in focus") and "--depth-scale 0.001" in err
    camera = ("--focus-m", "3", "--f-number", "1.4", "--sensor-width-mm", "4")
    _, err = run("photo.png", "mm.npy", *camera, "--strict", code=2)
    assert err.startswith("error: mm.npy: nothing is in focus")


def test_relative_depth_is_inspected_between_its_distances(scene: Path) -> None:
    out, _ = run("photo.png", "depth.npy", "--depth-kind", "relative", "--relative-kind", "depth", "--near-m", "1",
                 "--far-m", "3")  # fmt: skip
    assert "nearest 1 " in out and "farthest 3" in out


def test_a_range_in_focus_and_a_tilt_are_told(scene: Path) -> None:
    out, _ = run("photo.png", "depth.npy", "--focus-range", "1.5,2.2", "--tilt", "3")
    assert "focus 1.5 to 2.2 m" in out and "tilt 3 degrees" in out
