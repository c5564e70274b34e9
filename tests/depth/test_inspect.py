"""What a report says of a depth map is what was put into the map."""

import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from torchdof import Camera
from torchdof.depth import inspect_depth
from torchdof.depth.inspect import EDGES, panels
from torchdof.reference.scenes import Scene, read_scenes

SCENES = [
    scene
    for scene in read_scenes(Path(__file__).parents[1] / "data" / "scenes")
    if scene.name
    != "portrait/0"  # hair thinner than a pixel looks doubtful although its depth is exact: 27 % of the edges
]


def two_surfaces(height: int = 20, width: int = 40) -> tuple[Tensor, Tensor]:
    image, depth = torch.full((1, 3, height, width), 0.1), torch.full((1, 1, height, width), 6.0)
    image[..., width // 2 :], depth[..., width // 2 :] = 0.6, 2.0
    return image, depth


def test_steps_where_the_image_has_them_are_exact() -> None:
    image, depth = two_surfaces()
    report = inspect_depth(image, depth, Camera(focus_m=2.0))
    assert report.counts == (20, 0, 0, 0) and report.doubtful == 0.0
    assert report.edges[0, 0, 3].nonzero().flatten().tolist() == [19, 20]


def test_edges_along_columns_are_found_too() -> None:
    image, depth = (x.transpose(-1, -2) for x in two_surfaces())
    assert inspect_depth(image, depth, Camera()).counts == (20, 0, 0, 0)


@pytest.mark.parametrize(
    ("damage", "kind"),
    [
        (lambda z: F.avg_pool2d(F.pad(z, (2, 2, 2, 2), mode="replicate"), 5, stride=1), "ramp"),
        (lambda z: torch.roll(z, 2, -1), "beside"),
        (lambda z: torch.roll(z, -1, -1), "beside"),
    ],
)
def test_damaged_edges_are_doubted(damage: object, kind: str) -> None:
    image, depth = two_surfaces()
    report = inspect_depth(image, damage(depth), Camera())  # type: ignore[operator]
    assert report.counts[EDGES.index(kind)] >= 20 and report.counts[0] == 0 and report.doubtful == 1.0


def test_an_edge_that_the_image_does_not_show_is_unclear() -> None:
    _, depth = two_surfaces()
    report = inspect_depth(torch.full((1, 1, 20, 40), 0.4), depth, Camera())
    assert report.counts == (0, 0, 0, 20) and report.doubtful == 0.0


def test_a_slope_is_no_edge() -> None:
    depth = 1 / torch.linspace(1.0, 0.125, 60).expand(1, 1, 20, 60)
    assert sum(inspect_depth(torch.rand(1, 3, 20, 60), depth, Camera()).counts) == 0


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_exact_depth_is_told_from_damaged(scene: Scene) -> None:
    inverse = 1 / scene.depth
    height, width = scene.depth.shape[-2:]
    half = F.interpolate(inverse, size=(height // 2, width // 2), mode="area")
    upsampled = 1 / F.interpolate(half, size=(height, width), mode="bilinear", align_corners=False)
    shifted = torch.roll(scene.depth, 1, -1)
    exact, *damaged = (
        inspect_depth(scene.image, depth, scene.camera).doubtful for depth in (scene.depth, upsampled, shifted)
    )
    assert exact < 0.25 and min(damaged) > 0.4


def test_ranges_holes_and_shares_are_those_of_the_map() -> None:
    depth = torch.full((1, 1, 10, 10), 3.0)
    depth[..., :2, :] = torch.nan
    depth[..., 2:4, :] = math.inf
    depth[..., 4, :] = 1.0
    report = inspect_depth(torch.rand(1, 3, 10, 10), depth, Camera(500.0, 2.0, 3.0))
    assert report.holes == 20
    assert report.sharp == pytest.approx(50 / 80)
    histogram = report.histogram()
    assert sum(share for _, _, share in histogram) == pytest.approx(1.0)
    assert all(low < high for low, high, _ in histogram)
    text = str(report)
    for words in ("nearest 1 ", "farthest 3", "at infinity   20.0 %", "holes 20 (20.0 %)", "in focus      62.5 %"):
        assert words in text, words


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (12, 12)])
def test_maps_of_any_size_are_inspected(size: tuple[int, int]) -> None:
    image, depth = torch.rand(1, 3, *size), torch.rand(1, 1, *size) + 1
    report = inspect_depth(image, depth, Camera())
    assert report.edges.shape == depth.shape and str(report)
    for panel in panels(image, report).values():
        assert panel.shape == (1, 3, *size) and bool(panel.isfinite().all())


def test_a_map_of_holes_alone_is_told() -> None:
    report = inspect_depth(torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 8, 8), Camera())
    assert report.holes == 64 and "holes 64 (100.0 %)" in str(report)
    assert all(bool(panel.isfinite().all()) for panel in panels(torch.rand(1, 3, 8, 8), report).values())


def test_batches_are_refused() -> None:
    with pytest.raises(ValueError, match="one image at a time, got a batch of 2"):
        inspect_depth(torch.rand(2, 3, 8, 8), torch.ones(1, 1, 8, 8), Camera())
