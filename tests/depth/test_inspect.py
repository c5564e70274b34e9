"""Reports on depth maps with known edges, holes and ranges."""

import math
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from torchdof import Camera, DepthOfField
from torchdof.depth import inspect_depth
from torchdof.depth.inspect import EDGES, panels

CAMERA = Camera.from_fov(fov_x_deg=40.0, aperture_radius_m=0.5, focus_m=2.0)  # 11 px between the surfaces below


def two_surfaces(height: int = 40, width: int = 64) -> tuple[Tensor, Tensor]:
    image, depth = torch.full((1, 3, height, width), 0.1), torch.full((1, 1, height, width), 6.0)
    image[..., width // 2 :], depth[..., width // 2 :] = 0.6, 2.0
    return image, depth


@pytest.mark.parametrize("turn", [lambda t: t, lambda t: t.mT.contiguous()], ids=["along rows", "along columns"])
def test_steps_at_edges_of_the_image_are_exact(turn: Callable[[Tensor], Tensor]) -> None:
    image, depth = two_surfaces()
    report = inspect_depth(turn(image), turn(depth), CAMERA)
    assert report.counts == (6 * 40, 0, 0, 0) and report.doubtful == 0.0
    assert "they are exact" in str(report)
    edge = turn(torch.ones(1, 1, 40, 64)).bool() & (report.edges > 0)
    assert turn(edge)[0, 0, 3].nonzero().flatten().tolist() == list(range(29, 35))


@pytest.mark.parametrize(
    ("damage", "kind"),
    [
        (lambda z: F.avg_pool2d(F.pad(z, (2, 2, 2, 2), mode="replicate"), 5, stride=1), "ramp"),
        (lambda z: torch.roll(z, 2, -1), "beside"),
        (lambda z: torch.roll(z, -1, -1), "beside"),
    ],
)
def test_the_report_marks_the_edges_that_rendering_repairs(damage: Callable[[Tensor], Tensor], kind: str) -> None:
    image, depth = two_surfaces()
    depth = damage(depth)
    report = inspect_depth(image, depth, CAMERA)
    assert report.counts[EDGES.index(kind)] >= 38 and report.doubtful > 0.05
    assert "they are repaired" in str(report)
    coc_px = CAMERA.coc_px(depth, 64)
    assert torch.equal((report.edges == 2) | (report.edges == 3), DepthOfField(CAMERA).coc_px(image, depth) != coc_px)


def test_the_report_knows_the_blur_of_the_near_surface() -> None:
    """Undecided pixels go to a near surface that is more blurred, in the report as in the picture."""
    ramp = ((torch.arange(64.0) - 28.5) / 6).clamp(0, 1).expand(1, 1, 64, 64)
    image = (0.2 + 0.6 * (torch.arange(64.0) >= 32) + 0.05 * torch.rand(1, 1, 64, 64)).repeat(1, 3, 1, 1)
    image[..., 8:50:8, 31] = 0.55
    depth = 1.0 / (0.5 + ramp)
    report = inspect_depth(image, depth, CAMERA)
    assert torch.equal(report.repaired_px, DepthOfField(CAMERA).coc_px(image, depth))
    assert (report.edges[0, 0, 8:50:8, 31] == 1 + EDGES.index("ramp")).all()
    assert (report.repaired_px[0, 0, 8:50:8, 31] < -10).all()


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


def test_a_map_without_depth_is_reported_and_batches_are_refused() -> None:
    assert "holes 64 (100.0 %)" in str(inspect_depth(torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 8, 8), Camera()))
    with pytest.raises(ValueError, match="one image at a time, got a batch of 2"):
        inspect_depth(torch.rand(2, 3, 8, 8), torch.ones(1, 1, 8, 8), Camera())
