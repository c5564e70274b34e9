"""Gradients are finite on hard cases and lead downhill: to the depth, focus and f-number of a blurred picture."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from torchdof import Camera, DepthOfField, blur_by_coc
from torchdof.render.plan import Plan

pytestmark = pytest.mark.hard

CAMERA = Camera(focal_length_mm=50.0, f_number=2.0, focus_m=2.0, sensor_width_mm=4.0)
WAYS: list[dict[str, Any]] = [
    {"method": method, "occlusion": occlusion} for method in ("layered", "fold") for occlusion in (True, False)
]
EVERY_WAY = pytest.mark.parametrize("way", WAYS, ids=lambda way: f"{way['method']}-{way['occlusion']}")


def grads_of(out: Tensor, leaves: Sequence[Tensor]) -> list[Tensor]:
    return list(torch.autograd.grad(out.square().sum(), leaves))


HARD_DEPTHS: dict[str, Callable[[], Tensor]] = {
    "focus plane": lambda: torch.full((1, 1, 9, 12), 2.0),
    "one pixel in focus": lambda: torch.linspace(1.3, 2.7, 108).reshape(1, 1, 9, 12),
    "infinity": lambda: torch.full((1, 1, 9, 12), math.inf),
    "infinity beside focus": lambda: torch.tensor([2.0, math.inf]).repeat(54).reshape(1, 1, 9, 12),
    "a micrometre": lambda: torch.full((1, 1, 9, 12), 1e-6),
    "a micrometre beside infinity": lambda: torch.tensor([1e-6, math.inf]).repeat(54).reshape(1, 1, 9, 12),
    "checkerboard": lambda: torch.tensor([1.2, 9.0]).repeat(54).reshape(1, 1, 9, 12),
    "noise": lambda: 2.0 * 10 ** (0.5 * torch.randn(1, 1, 9, 12)),
}


@EVERY_WAY
@pytest.mark.parametrize("name", HARD_DEPTHS)
def test_gradients_are_finite_at_hard_depths(name: str, way: dict[str, Any]) -> None:
    image, depth = torch.rand(1, 2, 9, 12, requires_grad=True), HARD_DEPTHS[name]().requires_grad_()
    focus, f_number = (torch.tensor([v], requires_grad=True) for v in (2.0, 2.0))
    out = DepthOfField(CAMERA, **way)(image, depth, focus, f_number)
    assert torch.isfinite(out).all()
    for grad in grads_of(out, [image, depth, focus, f_number]):
        assert torch.isfinite(grad).all()


@EVERY_WAY
@pytest.mark.parametrize("light", [0.0, 1e-30, 1e-40, 1e8], ids=str)
def test_gradients_are_finite_at_hard_light(way: dict[str, Any], light: float) -> None:
    image = torch.full((1, 2, 9, 12), light)
    image[..., 4, 5] = 2 * light
    coc = torch.linspace(-4, 4, 108).reshape(1, 1, 9, 12).requires_grad_()
    for grad in grads_of(blur_by_coc(image.requires_grad_(), coc, **way), [image, coc]):
        assert torch.isfinite(grad).all()


@EVERY_WAY
def test_gradients_are_finite_around_holes(way: dict[str, Any]) -> None:
    image, depth = torch.rand(1, 2, 9, 12, requires_grad=True), torch.linspace(1.2, 9.0, 108).reshape(1, 1, 9, 12)
    depth[0, 0, 3:5, 4:7] = math.nan
    depth[0, 0, 7, 2] = 0.0
    out = DepthOfField(CAMERA, check=False, **way)(image, depth.requires_grad_())
    for grad in grads_of(out, [image, depth]):
        assert torch.isfinite(grad).all()


@EVERY_WAY
def test_gradients_are_finite_on_the_nodes_of_the_layers(way: dict[str, Any]) -> None:
    nodes = torch.tensor(Plan.still(torch.tensor([[[[-4.0, 4.0]]]]), 1 / 255).coc_px)
    coc = nodes.repeat(9)[:108].reshape(1, 1, 9, 12).requires_grad_() if len(nodes) >= 12 else None
    assert coc is not None
    image = torch.rand(1, 2, 9, 12, requires_grad=True)
    for grad in grads_of(blur_by_coc(image, coc, **way), [image, coc]):
        assert torch.isfinite(grad).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_gradients_of_half_precision_light_are_finite_and_of_its_type(dtype: torch.dtype) -> None:
    image = torch.rand(1, 2, 9, 12).to(dtype).requires_grad_()
    coc = torch.linspace(-4, 4, 108).reshape(1, 1, 9, 12).requires_grad_()
    grads = torch.autograd.grad(blur_by_coc(image, coc).float().square().sum(), [image, coc])
    assert [g.dtype for g in grads] == [dtype, torch.float32]
    assert all(torch.isfinite(g).all() for g in grads)


# Depth from defocus: what made this blur?


def texture(height: int = 24, width: int = 32) -> Tensor:
    """Light with detail of every size, so that any blur shows."""
    fine = torch.rand(1, 1, height, width)
    coarse = torch.nn.functional.interpolate(torch.rand(1, 1, height // 4, width // 4), (height, width))
    return 0.1 + fine * coarse


def descend(start: Tensor, picture_of: Callable[[Tensor], Tensor], target: Tensor, steps: int, rate: float) -> Tensor:
    """Gradient descent on the squared difference of pictures."""
    unknown = start.clone().requires_grad_()
    adam = torch.optim.Adam([unknown], lr=rate, betas=(0.8, 0.9))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    for _ in range(steps):
        adam.zero_grad()
        loss = (picture_of(unknown) - target).square().mean()
        loss.backward()
        adam.step()
        schedule.step()
    return unknown.detach()


@pytest.mark.parametrize("occlusion", [True, False])
@pytest.mark.parametrize("depth_m", [1.3, 5.0])
def test_descent_finds_the_depth_of_a_plane(occlusion: bool, depth_m: float) -> None:
    image = texture()
    dof = DepthOfField(CAMERA, occlusion=occlusion)
    plane = torch.ones(1, 1, 24, 32)

    def picture_of(inverse: Tensor) -> Tensor:
        return dof(image, plane / inverse)

    target = picture_of(torch.tensor(1 / depth_m, requires_grad=True)).detach()
    start = torch.tensor(1 / 1.55 if depth_m < 2 else 1 / 2.6)
    found = 1 / float(descend(start, picture_of, target, steps=80, rate=0.02))
    assert found == pytest.approx(depth_m, rel=0.005)


def test_descent_finds_a_slope() -> None:
    image = texture()
    dof = DepthOfField(CAMERA)
    ramp = torch.linspace(0, 1, 32).expand(1, 1, 24, 32)

    def picture_of(ends: Tensor) -> Tensor:
        return dof(image, 1 / (ends[0] + (ends[1] - ends[0]) * ramp))

    truth = torch.tensor([0.33, 0.17])
    target = picture_of(truth.clone().requires_grad_()).detach()
    found = descend(torch.tensor([0.26, 0.26]), picture_of, target, steps=60, rate=0.03)
    assert torch.allclose(found, truth, rtol=0.02, atol=0.0)


@pytest.mark.parametrize(("number", "truth", "start"), [("focus_m", 1.6, 1.35), ("f_number", 2.0, 3.0)])
def test_descent_finds_focus_and_f_number(number: str, truth: float, start: float) -> None:
    image = texture()
    dof = DepthOfField(CAMERA)
    depth = torch.linspace(2.0, 8.0, 32).expand(1, 1, 24, 32)

    def picture_of(value: Tensor) -> Tensor:
        return dof(image, depth, **{number: value})

    target = picture_of(torch.tensor([truth], requires_grad=True)).detach()
    found = descend(torch.tensor([start]), picture_of, target, steps=50, rate=0.07)
    assert float(found) == pytest.approx(truth, rel=0.01)


def test_descent_finds_a_depth_for_every_pixel() -> None:
    image = texture(16, 24)
    dof = DepthOfField(CAMERA.replace(focus_m=1.0))
    smooth = torch.nn.functional.interpolate
    truth = 0.25 + 0.35 * torch.rand(1, 1, 3, 4)

    def picture_of(grid: Tensor) -> Tensor:
        return dof(image, 1 / smooth(grid.clamp(0.05, 0.95), (16, 24), mode="bilinear", align_corners=True))

    target = picture_of(truth.clone().requires_grad_()).detach()
    found = descend(torch.full_like(truth, 0.42), picture_of, target, steps=90, rate=0.03)
    assert float((found - truth).abs().mean()) < 0.02
