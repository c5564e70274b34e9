"""Rendering against path-traced truth, on small crops of ray-traced scenes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.scenes import furry_post, wavy_post
from torchdof import DepthOfField, blur_by_coc, native
from torchdof.reference import metrics
from torchdof.reference.degraded import degrade
from torchdof.reference.scenes import Scene, read_scenes
from torchdof.render.surfaces.edges import mended

SCENES = {scene.name: scene for scene in read_scenes(Path(__file__).parent / "data" / "scenes")}
MEASURED_DB = {
    "highlights/0": (20.335, 32.848),
    "planes/0": (31.409, 30.245),
    "portrait/0": (25.159, 23.541),
    "room/1": (40.946, 49.041),
}
"""Recorded PSNR of the whole crop and inside its margin, at a tolerance of 1/255.

A change of the renderer that changes the accuracy must record the new values here.
"""
KINDS = ("half-res", "quarter-res", "shift 1px", "near -1px", "displaced")
DEGRADED_DB = {
    "highlights/0": (31.351, 31.248, 32.848, 31.293, 31.082),
    "planes/0": (29.183, 27.938, 30.244, 27.981, 27.956),
    "portrait/0": (17.551, 16.943, 15.131, 22.650, 20.441),
    "room/1": (48.617, 47.221, 49.041, 49.041, 42.852),
}
"""The same inside the margin with degraded depth, whose edges are repaired."""
FIGURES_DB: tuple[tuple[Callable[..., Any], dict[str, float], float], ...] = (
    (furry_post, {}, 47.462),
    (furry_post, {"background": 0.16, "noise": 0.2}, 39.566),
    (wavy_post, {}, 46.173),
)
"""Recorded PSNR against the exact map, of maps that miss hair, fully and in part, and that the image contradicts."""
WITHIN_DB = 0.002


def psnr(image: torch.Tensor, scene: Scene, *, inner: bool = True) -> float:
    return metrics.psnr(metrics.display(image), metrics.display(scene.truth), scene.inner if inner else None)


def rendered(scene: Scene, tolerance: float = 1 / 255) -> torch.Tensor:
    return DepthOfField(scene.camera, tolerance=tolerance)(scene.image, scene.depth)


@pytest.mark.parametrize("name", MEASURED_DB)
def test_psnr_equals_the_recorded_values(name: str, engine: str) -> None:
    picture, scene = rendered(SCENES[name]), SCENES[name]
    assert (psnr(picture, scene, inner=False), psnr(picture, scene)) == pytest.approx(MEASURED_DB[name], abs=WITHIN_DB)


@pytest.mark.parametrize("name", DEGRADED_DB)
def test_psnr_with_degraded_depth_equals_the_recorded_values(name: str, engine: str) -> None:
    scene = SCENES[name]
    pictures = [DepthOfField(scene.camera)(scene.image, degrade(scene.depth, kind)) for kind in KINDS]
    assert [psnr(picture, scene) for picture in pictures] == pytest.approx(DEGRADED_DB[name], abs=WITHIN_DB)


@pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built here")
@pytest.mark.parametrize("name", DEGRADED_DB)
def test_engines_repair_soft_depth_alike(name: str) -> None:
    scene = SCENES[name]
    coc_px = scene.camera.coc_px(degrade(scene.depth, "half-res"), scene.image.shape[-1])
    compiled = mended(scene.image, coc_px, "auto")
    with native.engine_off():
        plain = mended(scene.image, coc_px, "auto")
    assert not compiled.equal(coc_px)
    torch.testing.assert_close(compiled, plain, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("figure", "numbers", "recorded"), FIGURES_DB)
def test_psnr_of_figures_equals_the_recorded_values(
    figure: Callable[..., tuple[Tensor, Tensor, Tensor]], numbers: dict[str, float], recorded: float, engine: str
) -> None:
    image, given, exact = figure(**numbers)
    pictures = blur_by_coc(image, given), blur_by_coc(image, exact, depth_edges="as given")
    assert metrics.psnr(*map(metrics.display, pictures)) == pytest.approx(recorded, abs=WITHIN_DB)


@pytest.mark.parametrize("name", ["planes/0", "room/1", "highlights/0"])
@pytest.mark.parametrize("tolerance", [1 / 255, 4 / 255])
def test_rms_error_against_exact_layers_stays_below_the_tolerance(name: str, tolerance: float) -> None:
    error = metrics.display(rendered(SCENES[name], tolerance)) - metrics.display(rendered(SCENES[name], 0))
    assert 0 < float(error.square().mean().sqrt()) < tolerance
