"""Files of random modules pass their own verification. `pytest -s -m "sweep or not sweep"` prints a table of them."""

import random
import time
from pathlib import Path
from typing import Any

import pytest

from torchdof import BlurTable, Camera, DepthOfField
from torchdof.export import to_onnx
from torchdof.export.graph import Layout

FAMILIES = {
    "disc": BlurTable.disc(),
    "gaussian": BlurTable.gaussian(),
    "ring": BlurTable.load("sato_j15"),
    "softm": BlurTable("softm", [1.0], {"radius": [1.0], "sigma": [0.08], "b": [0.6], "m": [4.0]}),
    "radial": BlurTable("radial", [1.0], {"values": [[0.5, 0.7, 1.0, 1.3, 0.4]], "radius": [1.1]}),
    "polygon": BlurTable.polygon(5, 7.0, 0.4, rim=2.0),
    "lens": BlurTable.load("double_gauss_50mm_f4"),
}


def written(folder: Path, radius: float, family: str, tolerance: float, layout: Layout, occlusion: bool) -> None:
    """Writes and verifies a file, and prints a row of the table."""
    table = FAMILIES[family]
    options: dict[str, Any] = {"tolerance": tolerance / 255.0, "max_coc_px": radius, "occlusion": occlusion}
    start = time.perf_counter()
    report = to_onnx(
        DepthOfField(Camera(), table, **options),
        folder / "dof.onnx",
        layout=layout,
        width=None if table.unit == "relative" else 640,
    )
    how = f"{radius:6.2f} px {family:9} {tolerance:3g}/255 {layout:6} {'with' if occlusion else 'without'} occlusion"
    print(f"{how}: {report.max_error:.1e}, {time.perf_counter() - start:.0f} s")
    assert report.passed


@pytest.mark.parametrize(("radius", "family", "tolerance", "layout"), [
    (64.0, "gaussian", 16, "tiles"),  # the radius of the files of the web page
    pytest.param(11.7, "gaussian", 8, "tiles", marks=pytest.mark.sweep),
    pytest.param(33.0, "lens", 16, "whole", marks=pytest.mark.sweep),
    pytest.param(29.3, "softm", 24, "tiles", marks=pytest.mark.sweep),
    pytest.param(57.1, "disc", 48, "tiles", marks=pytest.mark.sweep),
])  # fmt: skip
def test_a_file_of_wide_kernels_is_verified(
    tmp_path: Path, radius: float, family: str, tolerance: float, layout: Layout
) -> None:
    written(tmp_path, radius, family, tolerance, layout, occlusion=False)


@pytest.mark.sweep  # the files of the web page are wider still: examples/test_web_files.py
def test_a_file_of_wide_kernels_with_occlusion_is_verified(tmp_path: Path) -> None:
    """At this radius the lamps of a case need more rays than are affordable."""
    written(tmp_path, 40.0, "disc", 128, "tiles", occlusion=True)


@pytest.mark.sweep
@pytest.mark.parametrize("seed", range(40))
def test_the_file_of_a_random_module_is_verified(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    layouts: list[Layout] = ["tiles", "tiles", "whole"]
    radius, family, layout = 64.0 ** draw.random(), draw.choice([*FAMILIES]), draw.choice(layouts)
    written(tmp_path, radius, family, draw.choice([1, 4, 8]), layout, occlusion=draw.random() < 0.6)
