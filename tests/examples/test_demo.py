"""``examples/demo.py`` on stereo depth: how many pixels of blurred regions differ from their surroundings."""

import json
import math
import runpy
import sys
from pathlib import Path

import pytest
import torch.nn.functional as functional

from torchdof.depth.reading import read_depth
from torchdof.io.images import read_image
from torchdof.optics.camera import Camera
from torchdof.reference.metrics import display

ROOT = Path(__file__).parents[2]
DATA = ROOT / "examples" / "data" / "motorcycle"
MAX_OUTLIERS = {"near": 680, "middle": 1070, "far": 390}
"""Largest number of pixels with a blur radius above 2 px that differ from the median of their 3 x 3 by over 8/255."""


def test_few_pixels_differ_from_their_blurred_surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["demo.py", "--data", str(DATA), "--out", str(tmp_path)])
    demo = runpy.run_path(str(ROOT / "examples" / "demo.py"), run_name="__main__")
    known = json.loads((DATA / "camera.json").read_text())
    depth = read_depth(DATA / "motorcycle_disp.npz", **known["depth"])
    width = depth.shape[-1]
    fov_x_deg = math.degrees(2 * math.atan(width / 2 / known["focal_length_px"]))
    for name, focus_m in demo["FOCUS_M"].items():
        shown = display(read_image(tmp_path / f"{name}.png").pixels).mean(1, keepdim=True)
        around = functional.unfold(functional.pad(shown, (1,) * 4, mode="replicate"), 3)
        median = around.median(1).values.view_as(shown)
        coc_px = Camera.from_fov(fov_x_deg, demo["APERTURE_RADIUS_M"], focus_m).coc_px(depth, width)
        outliers = int((((shown - median).abs() > 8 / 255) & (coc_px.abs() > 2)).sum())
        assert outliers <= MAX_OUTLIERS[name], f"{name}: {outliers}"
