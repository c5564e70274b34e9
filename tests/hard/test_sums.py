"""Order of summation, threads, batches and tiles make no difference."""

import subprocess
import sys
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchdof import BlurTable, blur_by_coc
from torchdof.optics import psf
from torchdof.render.plan import Plan

pytestmark = pytest.mark.hard

WAYS: list[dict[str, Any]] = [
    {"method": method, "occlusion": occlusion} for method in ("layered", "fold") for occlusion in (True, False)
]
EVERY_WAY = pytest.mark.parametrize("way", WAYS, ids=lambda way: f"{way['method']}-{way['occlusion']}")


def scene(height: int, width: int, reach: float, batch: int = 1) -> tuple[Tensor, Tensor]:
    image = 3 * torch.rand(batch, 3, height, width) ** 3
    coc = torch.linspace(-reach, reach, width).expand(batch, 1, height, width).clone()
    coc[..., height // 3 : height // 2, :] = -0.8 * reach
    return image, coc


@EVERY_WAY
def test_repeated_runs_agree_bit_for_bit(way: dict[str, Any]) -> None:
    image, coc = scene(48, 64, 6.0)
    first = blur_by_coc(image, coc, **way)
    for _ in range(2):
        assert torch.equal(blur_by_coc(image, coc, **way), first)


@EVERY_WAY
def test_one_thread_and_two_agree(way: dict[str, Any]) -> None:
    image, coc = scene(48, 64, 6.0)
    threads = torch.get_num_threads()
    try:
        out = []
        for count in (1, 2):
            torch.set_num_threads(count)
            out.append(blur_by_coc(image, coc, **way))
    finally:
        torch.set_num_threads(threads)
    assert_close(out[0], out[1], rtol=1e-6, atol=0.0)


@EVERY_WAY
def test_an_item_of_a_batch_equals_the_item_alone(way: dict[str, Any]) -> None:
    image, coc = scene(24, 32, 3.0, batch=3)
    coc = coc * torch.tensor([0.1, 1.0, 3.0]).reshape(3, 1, 1, 1)
    together = blur_by_coc(image, coc, **way)
    for i in range(3):
        alone = blur_by_coc(image[i : i + 1], coc[i : i + 1], **way)
        assert_close(together[i : i + 1], alone, rtol=1e-6, atol=1e-7)


@EVERY_WAY
def test_an_item_of_a_batch_equals_the_item_alone_with_one_plan_for_all(way: dict[str, Any]) -> None:
    image, coc = scene(40, 50, 5.0, batch=3)
    plan = Plan.of_scene(coc, 1 / 255)
    together = blur_by_coc(image, coc, plan=plan, **way)
    for i in range(3):
        alone = blur_by_coc(image[i : i + 1], coc[i : i + 1], plan=plan, **way)
        assert_close(together[i : i + 1], alone, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("occlusion", [True, False])
@pytest.mark.parametrize("size", [(64, 64), (150, 200), (65, 129)])
@pytest.mark.parametrize("reach", [3.0, 14.0, 40.0])
def test_tiles_leave_no_seam(occlusion: bool, size: tuple[int, int], reach: float) -> None:
    # while gradients are recorded the plain engine renders the frame whole, otherwise the compiled one renders tiles
    image, coc = scene(*size, reach)
    plan = Plan.of_scene(coc, 1 / 255)
    tiled = blur_by_coc(image, coc, plan=plan, occlusion=occlusion)
    whole = blur_by_coc(image.clone().requires_grad_(), coc, plan=plan, occlusion=occlusion)
    whole = whole.detach()
    assert_close(tiled, whole, rtol=1e-5, atol=1e-5)  # as engines agree anywhere
    beside = [torch.tensor([min(n % 64, 64 - n % 64) <= 4 and 4 < n < side - 4 for n in range(side)]) for side in size]
    where = beside[0][:, None] | beside[1]  # a tile has 64 pixels a side
    assert_close(tiled[..., where], whole[..., where], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("method", ["layered", "fold"])
def test_a_user_s_own_tiles_with_a_halo_leave_no_seam(method: Any) -> None:
    image, coc = scene(40, 200, 6.0)
    options: dict[str, Any] = {"plan": Plan.of_scene(coc, 1 / 255), "occlusion": False, "method": method}
    whole = blur_by_coc(image, coc, **options)
    halo = 8 + 4 * 8  # beyond the frame light is a mean along the border, four times as wide as the place is far
    for left in range(0, 200, 40):
        start, stop = max(0, left - halo), min(200, left + 40 + halo)
        tile = blur_by_coc(image[..., start:stop], coc[..., start:stop], **options)[..., left - start :][..., :40]
        assert_close(tile, whole[..., left : left + 40], rtol=1e-6, atol=1e-6)


@EVERY_WAY
def test_the_plain_average_of_many_renderings_of_noise_is_the_rendering_of_its_mean(way: dict[str, Any]) -> None:
    flat, coc = torch.full((1, 1, 20, 24), 0.5), torch.full((1, 1, 20, 24), 3.3)
    noise = [torch.randn_like(flat) for _ in range(8)]
    total = sum(blur_by_coc(flat + n, coc, **way).double() for n in [*noise, *(-n for n in noise)])
    assert_close(total / 16, flat.double(), rtol=1e-6, atol=0.0)


def test_coverage_lies_between_none_and_all() -> None:
    # light 1 on top of light 0: the picture is the coverage of what is in front
    for reach in (2.0, 9.0, 30.0):
        image, coc = torch.zeros(1, 1, 40, 50), torch.full((1, 1, 40, 50), reach)
        front = torch.rand(1, 1, 40, 50) < 0.2
        image[front], coc[front] = 1.0, -reach
        out = blur_by_coc(image, coc)
        assert float(out.min()) >= 0.0 and float(out.max()) <= 1.0 + 1e-6


def test_kernels_of_every_family_sum_to_one_in_single_precision() -> None:
    for table in (BlurTable.disc(), BlurTable.gaussian(), BlurTable.load("sato_j15")):
        kernels = table.kernels(torch.tensor([0.51, 3.0, 60.0]), 100).float()
        assert_close(kernels.sum((-2, -1)), torch.ones(3, 1), rtol=1e-6, atol=0.0)


SOAK = """
import gc, resource, torch, torchdof
image = torch.rand(1, 3, 24, 32)
dof = torchdof.DepthOfField(torchdof.Camera(sensor_width_mm=6.0))
def rss():
    gc.collect()
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()
def shoot(count):
    for i in range(count):
        dof(image, 1.0 + 0.01 * i + torch.rand(1, 1, 24, 32))
shoot(60)
early = rss()
shoot(440)
print(early, rss())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_500_frames_in_one_process_do_not_grow() -> None:
    done = subprocess.run([sys.executable, "-c", SOAK], capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    early, late = (int(x) for x in done.stdout.split())
    assert late < 1.05 * early


def test_a_disc_far_larger_than_the_frame_needs_no_more_memory_than_the_frame() -> None:
    with torch.inference_mode():
        out = blur_by_coc(torch.ones(1, 1, 30, 400), torch.full((1, 1, 30, 400), 1e5))
    assert_close(out, torch.ones(1, 1, 30, 400), rtol=1e-6, atol=0.0)
    assert psf.disc(900.0, size=61).shape == (61, 61)
