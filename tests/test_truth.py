"""Rendering against path-traced truth, on small crops of ray-traced scenes."""

from pathlib import Path

import pytest
import torch

from torchdof import DepthOfField
from torchdof.bench.accuracy import ikoma
from torchdof.reference import metrics
from torchdof.reference.scenes import Scene, read_scenes

SCENES = {scene.name: scene for scene in read_scenes(Path(__file__).parent / "data" / "scenes")}
GAIN_DB = {"planes/0": 3.5, "room/1": 4.0, "highlights/0": 0.3}
"""How much nearer the truth than Ikoma's formula: floors a little below what was measured (4.6, 7.9 and 0.5 dB)."""


def psnr(image: torch.Tensor, scene: Scene) -> float:
    return metrics.psnr(metrics.display(image), metrics.display(scene.truth), scene.inner)


@pytest.mark.parametrize("name", GAIN_DB)
def test_layered_rendering_is_nearer_the_truth_than_plain_layers(name: str) -> None:
    scene = SCENES[name]
    ours = psnr(DepthOfField(scene.camera)(scene.image, scene.depth), scene)
    assert ours > psnr(ikoma(scene), scene) + GAIN_DB[name]


@pytest.mark.parametrize("name", GAIN_DB)
@pytest.mark.parametrize("tolerance", [1 / 255, 4 / 255])
def test_rms_error_against_exact_layers_stays_below_the_tolerance(name: str, tolerance: float) -> None:
    scene = SCENES[name]
    exact = DepthOfField(scene.camera, tolerance=0)(scene.image, scene.depth)
    fast = DepthOfField(scene.camera, tolerance=tolerance)(scene.image, scene.depth)
    error = metrics.display(fast) - metrics.display(exact)
    assert 0 < float(error.square().mean().sqrt()) < tolerance
