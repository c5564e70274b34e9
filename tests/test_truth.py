"""Rendering against path-traced truth, on small crops of ray-traced scenes."""

from pathlib import Path

import pytest
import torch

from torchdof import DepthOfField
from torchdof.reference import metrics
from torchdof.reference.scenes import Scene, read_scenes

SCENES = {scene.name: scene for scene in read_scenes(Path(__file__).parent / "data" / "scenes")}
MEASURED_DB = {
    "highlights/0": (20.327, 32.902),
    "planes/0": (31.400, 30.281),
    "portrait/0": (25.157, 23.540),
    "room/1": (40.849, 48.230),
}
"""Recorded PSNR of the whole crop and inside its margin, at a tolerance of 1/255.

A change of the renderer that changes the accuracy must record the new values here.
"""
WITHIN_DB = 0.002


def psnr(image: torch.Tensor, scene: Scene, *, inner: bool = True) -> float:
    return metrics.psnr(metrics.display(image), metrics.display(scene.truth), scene.inner if inner else None)


def rendered(scene: Scene, tolerance: float = 1 / 255) -> torch.Tensor:
    return DepthOfField(scene.camera, tolerance=tolerance)(scene.image, scene.depth)


@pytest.mark.parametrize("name", MEASURED_DB)
def test_psnr_equals_the_recorded_values(name: str, engine: str) -> None:
    picture, scene = rendered(SCENES[name]), SCENES[name]
    assert (psnr(picture, scene, inner=False), psnr(picture, scene)) == pytest.approx(MEASURED_DB[name], abs=WITHIN_DB)


@pytest.mark.parametrize("name", ["planes/0", "room/1", "highlights/0"])
@pytest.mark.parametrize("tolerance", [1 / 255, 4 / 255])
def test_rms_error_against_exact_layers_stays_below_the_tolerance(name: str, tolerance: float) -> None:
    error = metrics.display(rendered(SCENES[name], tolerance)) - metrics.display(rendered(SCENES[name], 0))
    assert 0 < float(error.square().mean().sqrt()) < tolerance
