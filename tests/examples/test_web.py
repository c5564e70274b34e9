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


def expected(exported: Any, folder: Path, u: float, v: float, f_number: float) -> tuple[np.ndarray, float]:
    """8-bit sRGB of the file in onnxruntime, focused on a point of the sample, and the distance of that point."""
    sample = folder / "dist" / "sample"
    encoded = pixels(sample / "motorcycle.png")[..., :3]
    depth = np.round(pixels(sample / "motorcycle_depth.png")[..., 0] * 65535) / 1000
    height, width = depth.shape
    row, column = int(v * height), int(u * width)
    focus_m = float(np.median(depth[row - 2 : row + 3, column - 2 : column + 3]))
    tensors = [linear(encoded).transpose(2, 0, 1)[None], depth[None, None], [focus_m], [f_number]]
    out = exported.render(*(torch.tensor(np.asarray(x), dtype=torch.float32) for x in tensors))[0]
    return srgb_codes(out.numpy().transpose(1, 2, 0)), focus_m


@pytest.mark.parametrize(("name", "other"), [("near", "far"), ("far", "near")])
def test_a_click_gives_the_picture_of_the_file_sharp_there(plain: Any, used: Any, name: str, other: str) -> None:
    folder, seen = used
    u, v = CLICKS[name]
    picture, focus_m = expected(plain, folder, u, v, 2 ** (-3 / 6))
    assert seen[f"{name}Focus"] == f"{focus_m:.2f} m"
    files = (folder / "dist/sample/motorcycle.png", folder / f"{name}.png", folder / f"{other}.png")
    sharp, focused, blurred = (pixels(path)[..., :3] for path in files)
    assert focused.shape == picture.shape
    assert (np.abs(np.rint(255 * focused) - picture) > 1).mean() < 1e-4
    row, column = int(v * sharp.shape[0]), int(u * sharp.shape[1])
    window = np.s_[row - 4 : row + 5, column - 4 : column + 5]
    assert np.abs(focused - sharp)[window].mean() < 0.002
    assert np.abs(blurred - sharp)[window].mean() > 0.008


def test_a_saved_file_has_the_size_of_the_photograph_or_that_of_the_screen(plain: Any, used: Any) -> None:
    folder, seen = used
    picture, focus_m = expected(plain, folder, *CLICKS["near"], 2 ** (-3 / 6))
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
    assert "90 × 60" in problems["frame"] and "40 × 60" in problems["frame"]
