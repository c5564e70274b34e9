"""The page of ``examples/web``, built and used in headless Chromium; skipped where that is not installed."""

import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from filelock import FileLock

from tests.node import ENVIRONMENT, ROOT, linear, needs, pixels, run, srgb_codes
from torchdof.depth.guess import subject_m

CHROMIUM = next(filter(None, map(shutil.which, ("chromium-headless-shell", "chromium", "google-chrome"))), None)
CLICKS = {"near": (0.55, 0.6), "far": (0.2, 0.12)}  # shares of width and height, as in web.mjs

pytestmark = [
    needs("onnxruntime-web", "playwright-core"),
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium-headless-shell"),
]


@pytest.fixture(scope="module")
def used(plain: Any, shared_folder: Path) -> tuple[Path, Mapping[str, Any]]:
    """The folder with the page and its saved pictures, and the observations of ``web.mjs``."""
    folder = shared_folder / "page"
    environment = {**ENVIRONMENT, "PYTHON": sys.executable}
    with FileLock(shared_folder / "page.lock"):
        if not (folder / "results.json").exists():
            folder.mkdir(exist_ok=True)
            build = ["node", ROOT / "examples" / "web" / "build.mjs", "--out", folder / "dist"]
            run([*build, "--model", plain.path], environment)
            run(["node", Path(__file__).with_name("web.mjs"), folder / "dist", folder, CHROMIUM], environment)
    return folder, json.loads((folder / "results.json").read_text())


F_NUMBER = 2 ** (-3 / 6)


def sample_depth(folder: Path) -> np.ndarray:
    """Depth of the sample in metres, ``[H, W]``."""
    return np.round(pixels(folder / "dist" / "sample" / "motorcycle_depth.png")[..., 0] * 65535) / 1000


def distance(depth: np.ndarray, name: str) -> float:
    """Distance at one of the clicks."""
    (height, width), (u, v) = depth.shape, CLICKS[name]
    row, column = int(v * height), int(u * width)
    return float(np.median(depth[row - 2 : row + 3, column - 2 : column + 3]))


def expected(exported: Any, folder: Path, depth: np.ndarray, focus_m: float) -> np.ndarray:
    """8-bit sRGB of the file in onnxruntime for the sample's photograph."""
    encoded = pixels(folder / "dist" / "sample" / "motorcycle.png")[..., :3]
    tensors = [linear(encoded).transpose(2, 0, 1)[None], depth[None, None], [focus_m], [F_NUMBER]]
    out = exported.render(*(torch.tensor(np.asarray(x), dtype=torch.float32) for x in tensors))[0]
    return srgb_codes(out.numpy().transpose(1, 2, 0))


@pytest.mark.parametrize(("name", "other"), [("near", "far"), ("far", "near")])
def test_a_click_gives_the_picture_of_the_file_sharp_there(plain: Any, used: Any, name: str, other: str) -> None:
    folder, seen = used
    depth, (u, v) = sample_depth(folder), CLICKS[name]
    focus_m = distance(depth, name)
    picture = expected(plain, folder, depth, focus_m)
    assert seen[f"{name}Focus"] == f"{focus_m:.2f} m"
    files = (folder / "dist/sample/motorcycle.png", folder / f"{name}.png", folder / f"{other}.png")
    sharp, focused, blurred = (pixels(path)[..., :3] for path in files)
    assert focused.shape == picture.shape
    assert (np.abs(np.rint(255 * focused) - picture) > 1).mean() < 1e-4
    row, column = int(v * sharp.shape[0]), int(u * sharp.shape[1])
    window = np.s_[row - 4 : row + 5, column - 4 : column + 5]
    assert np.abs(focused - sharp)[window].mean() < 0.002
    assert np.abs(blurred - sharp)[window].mean() > 0.008


def test_the_page_opens_focused_on_the_subject_with_the_blur_of_the_command(used: Any) -> None:
    folder, seen = used
    depth = torch.from_numpy(sample_depth(folder)).float()[None, None]
    focus, blur = seen["opened"]
    assert focus == f"{subject_m(depth):.2f} m"
    assert f"up to {0.02 * depth.shape[-1]:.0f} pixels" in blur or f"up to {0.02 * depth.shape[-1] + 1:.0f} pix" in blur
    assert not seen["isAutomatic"], "the slider sets the opening"


def test_with_shift_all_between_two_points_is_sharp(plain: Any, used: Any) -> None:
    folder, seen = used
    depth = sample_depth(folder)
    near_m, far_m = distance(depth, "near"), distance(depth, "far")
    assert seen["bothFocus"] == f"{near_m:.2f} m to {far_m:.2f} m" and seen["bothMarks"] == 2
    assert seen["bothName"] == f"motorcycle_f0.7_{near_m:.2f}-{far_m:.2f}m.png"
    moved = np.where(depth < near_m, depth, 1 / (1 / np.maximum(depth, far_m) + 1 / near_m - 1 / far_m))
    saved = np.rint(255 * pixels(folder / "both.png")[..., :3])
    assert (np.abs(saved - expected(plain, folder, moved, near_m)) > 1).mean() < 1e-3


def test_a_saved_file_has_the_size_of_the_photograph_or_that_of_the_screen(plain: Any, used: Any) -> None:
    folder, seen = used
    depth = sample_depth(folder)
    focus_m = distance(depth, "near")
    picture = expected(plain, folder, depth, focus_m)
    assert seen["shownSize"] == [640, 432] and seen["fullFocus"] == f"{focus_m:.2f} m"
    full = np.rint(255 * pixels(folder / "full.png")[..., :3])
    assert full.shape == picture.shape, "in tiles, whose borders are not visible"
    assert (np.abs(full - picture) > 2).mean() < 1e-4
    names = [Path(seen[f"{name}Name"]).suffix for name in ("full", "jpeg", "webp")]
    assert names == [".png", ".jpg", ".webp"]
    for name, of_file in (("small.jpg", "jpeg"), ("small.webp", "webp")):
        buffer = oiio.ImageBuf(str(folder / name))
        assert (buffer.file_format_name, buffer.spec().width, buffer.spec().height) == (of_file, 640, 432)


def test_the_page_works_alone_with_the_keyboard_and_on_a_phone(used: Any) -> None:
    _, seen = used
    assert seen["elsewhere"] == [] and seen["console"] == [], "nothing is fetched from other hosts"
    assert seen["nearName"] == f"motorcycle_f0.7_{seen['nearFocus'].removesuffix(' m')}m.png"
    sizes = [message["size"] for message in seen["dragAsked"] if message["type"] == "render"]
    assert sizes[0] == "half" and sizes[-1] == "shown", "half the size while a control moves, the whole at rest"
    assert [m["size"] for m in seen["nearAsked"] if m["type"] == "render"][-1] == "shown"
    assert seen["aperture"] == ["f/0.7", "f/1.4"]
    assert seen["keyboardFocus"][0] != seen["keyboardFocus"][1]
    assert seen["divider"] == "80" and seen["depthIsShown"]
    assert seen["unnamed"] == []
    assert all(seen[f"{name}_overflow"] == 0 for name in ("desktop_light", "phone_light", "phone_dark"))


def test_relative_depth_and_bad_files_are_explained(used: Any) -> None:
    _, seen = used
    assert seen["ownKind"] == "disparity"
    assert float(seen["ownNear"].removesuffix(" m")) < 1.1 and float(seen["ownTurned"].removesuffix(" m")) > 7.5
    problems = seen["problems"]
    assert "notes.jpg: this browser cannot open it" in problems["photo"] and "JPEG or PNG" in problems["photo"]
    assert "in colour" in problems["depth"] and "shades of grey" in problems["depth"]
    assert "one value everywhere" in problems["flat"]
    assert "cut_depth.png" in problems["damaged"] and "damaged" in problems["damaged"]
    assert seen["slowPair"][0] == "slow_depth.png", "it belongs to the photo that was still being read"
    assert "1.1 %" in seen["slowPair"][1], "maps of nearly the photo's shape are stretched"
    assert "90 × 60" in problems["frame"] and "60 × 90: turned by 90 degrees it fits" in problems["frame"]
    assert "50.0 %; it is stretched to the photo" in seen["squareNote"]


def test_a_mask_of_the_subject_is_rendered_with_its_photograph_alone(used: Any) -> None:
    _, seen = used
    (width, height, values), *_ = seen["matte"]
    assert (width, height) == (45, 30) and seen["matteName"] == "own.png"
    rows = np.reshape(values, (height, width))
    assert rows[:, 0].max() < 0.05 and rows[:, -1].min() > 0.95, "white is the subject"
    assert "its mask 60 × 60: it must have the shape of the photo" in seen["problems"]["matte"]
    assert seen["photoOfPair"] == "choose or drop a file"
    assert seen["matteLeftOut"].startswith("optional") and seen["matteOfSample"].startswith("optional")
