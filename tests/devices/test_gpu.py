"""Pictures and gradients on a GPU equal those of the CPU. Without a GPU these tests are skipped."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.scenes import assert_same_picture, post_before_lamps, random_scene
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.functional import splat

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
OCCLUSION = pytest.mark.parametrize("occlusion", [True, False])


def on_gpu(value: Any) -> Any:
    return value.cuda() if isinstance(value, Tensor) else value


@pytest.mark.parametrize("seed", range(12))
def test_a_random_scene_is_the_same_picture(seed: int) -> None:
    random = random_scene(seed)
    image, coc_px = random.image.float(), random.coc_px.float()
    for occlusion in (True, False):
        expected = blur_by_coc(image, coc_px, occlusion=occlusion)
        picture = blur_by_coc(image.cuda(), coc_px.cuda(), occlusion=occlusion)
        assert picture.device.type == "cuda"
        assert_same_picture(expected, picture.cpu(), image)


OPTIONS: list[dict[str, Any]] = [
    *({}, {"occlusion": False}, {"check": False}, {"method": "fold", "occlusion": False}),
    *({"table": BlurTable.load("double_gauss_50mm_f2")}, {"attention": (40.0, 30.0, 25.0)}),
    {"background": torch.full((3, 3, 96, 128), 0.3), "background_coc_px": torch.full((3, 1, 96, 128), 15.0)},
]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: next(iter(options), "defaults"))
def test_a_batch_is_the_same_picture_with_any_option(options: dict[str, Any]) -> None:
    light, coc_px = post_before_lamps(3)
    if options.get("check") is False:
        light[1, :, 5:9, 5:9], coc_px[2, :, 20:, 40:] = torch.nan, torch.nan
    expected = blur_by_coc(light, coc_px, **options)
    picture = blur_by_coc(light.cuda(), coc_px.cuda(), **{name: on_gpu(value) for name, value in options.items()})
    assert_same_picture(expected, picture.cpu(), torch.nan_to_num(light))


def with_gradients(device: str, batch: int, occlusion: bool) -> list[Tensor]:
    leaves = [t.to(device).requires_grad_() for t in post_before_lamps(batch)]
    picture = blur_by_coc(*leaves, occlusion=occlusion)
    weight = torch.linspace(0.0, 1.0, 128, device=device)
    return [t.detach().cpu() for t in (picture, *torch.autograd.grad((picture * weight).sum(), leaves))]


@OCCLUSION
def test_gradients_are_the_same(occlusion: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    found = (with_gradients(device, 2, occlusion)[1:] for device in ("cpu", "cuda"))
    for expected, gradient in zip(*found, strict=True):
        assert float((gradient - expected).norm()) <= 1e-3 * float(expected.norm())


@pytest.mark.parametrize("batch", [1, 3])
def test_kernels_render_the_plain_engines_picture_and_gradients(batch: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a stream of the caller's too."""
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    expected, *of_plain = with_gradients("cuda", batch, True)
    monkeypatch.setenv("TORCHDOF_ENGINE", "gpu")
    for stream in (torch.cuda.current_stream(), torch.cuda.Stream()):
        with torch.cuda.stream(stream):
            picture, *of_kernels = with_gradients("cuda", batch, True)
        assert_same_picture(expected, picture, expected)
        for plain, gradient in zip(of_plain, of_kernels, strict=True):
            assert float((gradient - plain).norm()) <= 1e-3 * float(plain.norm())


@OCCLUSION
def test_deterministic_algorithms_give_the_same_bits(occlusion: bool) -> None:
    torch.use_deterministic_algorithms(True)
    try:
        first, second = (with_gradients("cuda", 3, occlusion) for _ in range(2))
    finally:
        torch.use_deterministic_algorithms(False)
    assert all(map(torch.equal, first, second))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_and_autocast_round_only_the_result(dtype: torch.dtype) -> None:
    light, coc_px = (t.cuda() for t in post_before_lamps(3))
    expected = blur_by_coc(light.to(dtype).float(), coc_px)
    torch.testing.assert_close(blur_by_coc(light.to(dtype), coc_px), expected.to(dtype))
    leaf = light.clone().requires_grad_()
    with torch.autocast("cuda", dtype=dtype):
        picture = blur_by_coc(leaf, coc_px)
        (gradient,) = torch.autograd.grad(picture.sum(), leaf)
    torch.testing.assert_close(picture.detach(), blur_by_coc(light, coc_px))
    (expected,) = torch.autograd.grad(blur_by_coc(leaf, coc_px).sum(), leaf)
    torch.testing.assert_close(gradient, expected)


def test_a_module_a_stack_and_splat_work_on_the_gpu() -> None:
    light, coc_px = post_before_lamps(2)
    dof = DepthOfField(Camera(focal_length_mm=50.0, f_number=2.0, focus_m=2.0, sensor_width_mm=6.0))
    depth = torch.linspace(1.0, 6.0, 128).expand(2, 1, 96, 128).contiguous()
    assert_same_picture(dof(light, depth), dof.cuda()(light.cuda(), depth.cuda()).cpu(), light)
    stack = torch.rand(2, 3, 4, 24, 32), torch.tensor([1.0, 2.0, 5.0])
    calls: list[tuple[Any, tuple[Tensor, Tensor]]] = [(dof.layers, stack), (splat, (light, coc_px))]
    for call, given in calls:
        torch.testing.assert_close(call(*given), call(*map(on_gpu, given)).cpu(), atol=1e-5, rtol=1e-4)


def test_memory_of_a_step_is_bounded() -> None:
    light, coc_px = (t.cuda().requires_grad_() for t in post_before_lamps(4))
    for _ in range(2):  # the first step fills caches
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        torch.autograd.grad(blur_by_coc(light, coc_px).sum(), (light, coc_px))
    assert torch.cuda.max_memory_allocated() - before < 400 * light.nbytes
