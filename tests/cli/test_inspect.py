"""``torchdof inspect``: facts about image, depth and lens, as text, as JSON and as a picture."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdof.io.images import Picture, read_image, write_image

LENS = "--focus-m 2 --f-number 1.4 --sensor-width-mm 4"
FACTS = ["image         40 x 24 px, R, G, B", "f/1.4, focus 2 m, sensor 4 mm", "nearest 2 ", "farthest 6"]
FACTS += ["holes 0 (0.0 %)", "blur radius   +0.0 to +", "in focus      50.0 %", "####"]
FACTS += ["depth edges   144 pixels: 100.0 % exact", "picture       photo.inspect.png"]


@pytest.fixture
def photo(scene: Path) -> Path:
    """A folder with photo.png of 40 x 24 pixels, and near.npy: 2 m left, 6 m right, with the picture's edge."""
    image, depth = torch.full((1, 3, 24, 40), 0.1), np.full((24, 40), 2.0)
    image[..., 20:], depth[:, 20:] = 0.6, 6.0
    write_image("photo.png", Picture(image, sample="8", transfer="srgb"))
    np.save("near.npy", depth)
    depth[:, 18:22] = 0
    np.save("holed.npy", depth)
    return scene


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (f"near.npy {LENS}", FACTS),
        ("near.npy", ["[focus on what is nearest the middle, focal length assumed, f-number for a blur of 2% of"]),
        ("near.npy --focus-range 1.5,2.2 --tilt 3", ["focus 1.5 to 2.2 m", "tilt 3 degrees"]),
        ("near.npy --depth-kind relative --near-m 1 --far-m 3 --relative-kind depth", ["nearest 1 ", "farthest 3"]),
        ("near.npy --far-m 4 --relative-kind depth", ["nearest 0.5 ", "farthest 4"]),
        ("near.npy --depth-kind relative", ["nearest 1 ", "farthest 8"]),
        ("holed.npy --focus-m 2", ["holes 96 (10.0 %)"]),
        ("holed.npy --focus-m 2 --fill-depth nearest", ["holes 0", "filled        96 holes (10.0 %), nearest"]),
    ],
)
def test_text_states_lens_depth_blur(photo: Path, run: Callable[..., str], arguments: str, words: list[str]) -> None:
    output = run(f"inspect photo.png {arguments}")
    assert all(part in output for part in words), output
    sheet = read_image("photo.inspect.png").pixels
    assert sheet.shape[-1] > 3 * 40 and sheet.shape[-2] > 24


def test_json_has_the_printed_facts(photo: Path, run: Callable[..., str]) -> None:
    facts = json.loads(run(f"inspect photo.png near.npy -o look.png {LENS} --json"))
    assert facts["camera"]["focus_m"] == 2.0 and facts["picture"] == "look.png" and Path("look.png").is_file()
    assert facts["depth_m"] == {"nearest": 2.0, "1 %": 2.0, "median": 4.0, "99 %": 6.0, "farthest": 6.0}
    assert facts["holes_px"] == 0 and facts["in_focus"] == 0.5 and facts["coc_px"][0] == 0.0
    assert facts["depth_edges"] == {"exact": 144, "ramp": 0, "beside": 0, "unclear": 0}
    assert sum(part["share"] for part in facts["histogram"]) == pytest.approx(1.0)
