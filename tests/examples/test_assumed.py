"""The page of ``examples/web`` assumes what ``torchdof render`` does: kind of depth, subject, opening of the lens."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from tests.node import NEEDS_NODE, ROOT, pixels, run
from torchdof import Camera
from torchdof.cli.main import app
from torchdof.io.images import Picture, write_image

SIZE = (240, 330)
NOTES: dict[tuple[object, float], str] = {  # of the command, for a kind and a scale of the page
    ("disparity", 1): "taken for relative depth (else --depth-kind), larger is nearer",
    ("depth", 1): "taken for relative depth (else --depth-kind), larger is farther",
    ("metres", 1): "taken for metres (",
    ("metres", 0.001): "taken for millimetres (",
    ("metres", 1 / 256): "taken for metres * 256,",
}


def person(seed: int) -> np.ndarray:
    """Nearness in [0, 1] with a wall, the ground and a person at random places; above 65,536 pixels, so sampled."""
    random = np.random.default_rng(seed)
    nearness = np.linspace(0.0, 1.0, SIZE[0])[:, None].repeat(SIZE[1], 1)
    nearness[:120] *= random.uniform(0.1, 1)
    left, near = random.integers(60, 160), random.uniform(0.2, 0.9)
    nearness[40:200, left : left + 100] = near
    nearness += random.uniform(0.0, 0.02, SIZE)
    return (nearness - nearness.min()) / np.ptp(nearness)


def maps() -> dict[str, np.ndarray]:
    """Maps of all kinds, and their negatives."""
    maps = {}
    for seed in range(4):
        near = person(seed)
        maps[f"estimate {seed}"], maps[f"negative {seed}"] = near, 1 - near
        maps[f"bytes {seed}"], maps[f"negative bytes {seed}"] = ((255 * x).astype(np.uint8) for x in (near, 1 - near))
        maps[f"words {seed}"] = (65535 * (1 - near)).astype(np.uint16)
        maps[f"metres {seed}"] = 1 / (near + 0.1 * (1 - near))
        maps[f"millimetres {seed}"] = (1000 * maps[f"metres {seed}"]).astype(np.uint16)
    depth = pixels(ROOT / "examples" / "data" / "portrait" / "depth.png")[..., 0]
    maps["portrait"], maps["negative portrait"] = ((255 * x).round().astype(np.uint8) for x in (depth, 1 - depth))
    for name, (person_at, wall_at) in {"person nearer": (0.8, 0.2), "person smaller": (0.2, 0.8)}.items():
        values = np.linspace(wall_at, wall_at + 0.05, SIZE[1])[None].repeat(SIZE[0], 0)
        values[60:, 110:220] = np.linspace(person_at, person_at + 0.02, 110)
        maps[name] = (values - values.min()) / np.ptp(values)
    ground = np.linspace(70.0, 5.0, SIZE[0])[:, None].repeat(SIZE[1], 1)
    maps["shape of KITTI"] = (256 * ground[::3]).astype(np.uint16)[:, :280]
    maps["lidar"] = np.where(np.arange(SIZE[1]) % 3 == 0, 256 * ground, 0).astype(np.uint16)
    maps["whole floats"] = (1000 * ground).round()
    maps["close-up"] = np.linspace(0.9, 0.2, SIZE[0])[:, None].repeat(SIZE[1], 1)
    maps["close-up"][0, 0] = 0.0
    for marked, value in (("millimetres 0", 65535), ("metres 2", 1e10), ("estimate 3", 65504.0)):
        maps[f"{marked} with sentinels"] = maps[marked].copy()
        maps[f"{marked} with sentinels"][100:120, 5:9] = value
    maps["whole floats with two sentinels"] = maps["whole floats"].copy()
    maps["whole floats with two sentinels"].flat[:90] = np.repeat([1e10, -1.0, 3e12], 30)
    maps["whole floats with more sentinels"] = maps["whole floats"].copy()
    maps["whole floats with more sentinels"].flat[:90] = np.repeat([1e10, -1.0, -2.0], 30)
    maps["words with a block of sentinels"] = maps["millimetres 2"].copy()
    maps["words with a block of sentinels"].flat[:90] = np.repeat([65535, 65534, 65001], 30)
    maps["millimetres as floats"] = 1000.5 * maps["metres 1"]
    maps["thousands"] = 100.5 + 2000 * maps["person nearer"]
    maps["sky"] = np.where(person(1) > 0.5, 2.0, np.inf)
    maps["sky"][0, 0] = 9.0
    return maps


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, dict[str, float]]]:
    """A folder with the maps, and what the page assumes about each."""
    folder = tmp_path_factory.mktemp("maps")
    for name, values in maps().items():
        np.save(folder / f"{name}.npy", values.astype(np.float32) if values.dtype == np.float64 else values)
    return folder, json.loads(run(["node", Path(__file__).with_name("assumed.mjs"), folder]))


@NEEDS_NODE
@pytest.mark.parametrize("name", maps())
def test_the_page_assumes_what_the_command_assumes(page: tuple[Path, dict[str, dict[str, float]]], name: str) -> None:
    folder, assumed = page
    found, path = assumed[f"{name}.npy"], folder / f"{name}.npy"
    height, width = np.load(path).shape
    image = folder / f"{name}.png"
    write_image(image, Picture(torch.rand(1, 3, height, width), sample="8", transfer="srgb"))
    call = ["render", str(image), str(path), "-o", str(folder / "out.png"), "--json", "--depth-edges", "as-given"]
    result = CliRunner().invoke(app, call, catch_exceptions=False)
    told = json.loads(result.stdout)
    assert NOTES[found["kind"], found["scale"]] in result.stderr
    assert found["distanceM"] == pytest.approx(told["camera"]["focus_m"], rel=1e-4)
    assert found["shownM"] == pytest.approx(found["distanceM"], rel=0.1)
    # the f-number at which the largest radius is 2 % of the width; the command's lens breathes
    breathing = 1 - 0.05 / told["camera"]["focus_m"]
    assert found["fNumber"] == pytest.approx(told["camera"]["f_number"] * breathing, rel=1e-3)


@NEEDS_NODE
def test_a_range_in_focus_blurs_as_the_camera_of_the_module(page: tuple[Path, dict[str, list[list[float]]]]) -> None:
    _, assumed = page
    camera = Camera(50.0, 2.0, focus_range_m=(2.0, 3.0), focus_breathing=False)
    depth = torch.tensor([1.0, 2.0, 3.0, 4.0, math.inf]).reshape(1, 1, 1, 5)
    expected = camera.coc_px(depth, 100).flatten().tolist()
    for radii in zip(*assumed["range"], strict=True):
        assert radii == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert assumed["unmoved"]
