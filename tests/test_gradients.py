"""Gradients of the picture: equal to finite differences, finite on hostile scenes, and usable for optimisation."""

import functools
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.scenes import CAMERA, EVERY_WAY, WAYS, halves, post_before_lamps, slope, texture, whole
from tests.traced import TRACED
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc, tensors, validation
from torchdof.depth import from_relative
from torchdof.depth.relative import RELATIVE_KINDS
from torchdof.io.highlights import expand_highlights
from torchdof.render.layers.layer_weights import from_blur_axis
from torchdof.render.layers.plan import Plan

gradcheck = functools.partial(torch.autograd.gradcheck, fast_mode=True)  # along a random direction of each input
SUMS: dict[str, dict[str, Any]] = {**WAYS, "plain sum": {"occlusion": False, "normalize": False}}
SMALL = Camera(sensor_width_mm=0.6)
NUMBERS = ("image", "depth", "focus_m", "f_number")


def case() -> dict[str, Tensor]:
    """A tiny scene from in front of focus to far behind it, in float64."""
    image = torch.rand(1, 2, 3, 4, dtype=torch.float64)
    depth = torch.linspace(0.8, 6.0, 12, dtype=torch.float64).reshape(1, 1, 3, 4)
    depth[0, 0, 1] = depth[0, 0, 1].flip(0)
    focus, f_number = (torch.tensor([value], dtype=torch.float64) for value in (1.37, 2.1))
    coc = SMALL.replace(focus_m=focus, f_number=f_number).coc_px(depth, 4)
    assert float(coc.min()) < -1.5 and float(coc.max()) > 1.5, "blur on both sides of focus"
    return dict(zip(NUMBERS, (image, depth, focus, f_number), strict=True))


@pytest.mark.parametrize("way", SUMS.values(), ids=SUMS)
def test_gradients_equal_finite_differences(way: dict[str, Any]) -> None:
    leaves = tuple(value.requires_grad_() for value in case().values())
    assert gradcheck(DepthOfField(SMALL, tolerance=1 / 60, **way), leaves)
    # noise, because an even slope would lie exactly on kinks
    coc = torch.linspace(-2.83, 3.17, 12, dtype=torch.float64) + 0.2 * torch.rand(12, dtype=torch.float64)
    coc = coc.reshape(1, 1, 3, 4).requires_grad_()
    assert gradcheck(lambda x: blur_by_coc(leaves[0].detach(), x, tolerance=1 / 60, **way), (coc,))


OPTIONS: dict[str, dict[str, Any]] = {  # of the module
    "a measured table": {"table": BlurTable.load("sato_j15"), "occlusion": False},
    "cat's eyes": {"table": BlurTable.polygon(5, vignetting=0.4)},
    "a plan, sum": {"occlusion": False},
}


@pytest.mark.parametrize("which", [*OPTIONS, "leaves of the camera", "a background", "a plan"])
def test_gradients_flow_through(which: str) -> None:
    image, depth, *lens = (value.requires_grad_() for value in case().values())
    plan = Plan.static(6.0, 1 / 60) if "plan" in which else None

    def render(image: Tensor, depth: Tensor, focus: Tensor, f_number: Tensor, *behind: Tensor) -> Tensor:
        own = Camera(50.0, f_number, focus, 0.6) if which == "leaves of the camera" else SMALL
        given = () if own is not SMALL else (focus, f_number, plan, *behind)
        return DepthOfField(own, tolerance=1 / 60, **OPTIONS.get(which, {}))(image, depth, *given)

    behind = (torch.rand_like(image), depth.detach() + 2.0) if which == "a background" else ()
    assert gradcheck(render, (image, depth, *lens, *(value.requires_grad_() for value in behind)))


@EVERY_WAY
def test_the_picture_is_the_same_with_gradients_and_their_adjoint_is_that_of_the_sum(way: dict[str, Any]) -> None:
    image, *others = case().values()
    dof = DepthOfField(SMALL, tolerance=1 / 60, **way)
    plain, seen, other = dof(image, *others), torch.rand_like(image), torch.rand_like(image)
    out = dof(image.requires_grad_(), *others)
    assert_close(out, plain, rtol=0.0, atol=0.0)
    if not way["occlusion"]:  # with occlusion the picture is not linear in the image, because matting depends on it
        (back,) = torch.autograd.grad(out, image, seen)
        assert_close((back * other).sum(), (seen * dof(other, *others)).sum(), rtol=1e-11, atol=0.0)


def test_gradients_of_maps_equal_finite_differences() -> None:
    values = (0.9 * torch.rand(1, 3, 6, 7, dtype=torch.float64) + 0.02).requires_grad_()
    assert gradcheck(expand_highlights, (values,))
    for kind in RELATIVE_KINDS:
        assert gradcheck(functools.partial(from_relative, near_m=1.0, far_m=5.0, kind=kind), (values[:, :1],))


# Finite gradients


# small frames have an 8th of the tolerance
NODES = torch.tensor(Plan.for_scene(torch.tensor([-4.0, 4.0]).expand(1, 1, 100, 2), 8 / 255, on_grid=True).coc_px)


def _beside(first: float, second: float) -> Tensor:
    return torch.tensor([first, second]).repeat(54).reshape(1, 1, 9, 12)


EVEN = torch.linspace(-4, 4, 108).reshape(1, 1, 9, 12)
DEPTHS: dict[str, Tensor] = {
    "focus plane": whole(2.0, 9, 12),
    "one pixel in focus": torch.linspace(1.3, 2.7, 108).reshape(1, 1, 9, 12),
    "infinity": whole(math.inf, 9, 12),
    "infinity beside focus": _beside(2.0, math.inf),
    "a micrometre": whole(1e-6, 9, 12),
    "a micrometre beside infinity": _beside(1e-6, math.inf),
    "checkerboard": _beside(1.2, 9.0),
    "noise": 2.0 * 10 ** (0.5 * torch.randn(1, 1, 9, 12, generator=torch.Generator().manual_seed(0))),
    "holes": torch.where(EVEN.abs() < 1.0, math.nan, slope(1.2, 9.0, 9, 12) * (EVEN < 3.9)),
}
COCS: dict[str, Tensor] = {
    "nodes of layers": NODES.repeat(9)[:108].reshape(1, 1, 9, 12),
    "zero": whole(0.0, 9, 12),
    "partly zero": torch.where(torch.arange(12) % 6 < 2, 0.0, EVEN),
    "end of focus": from_blur_axis(1e-12) * EVEN.sign(),
}


@EVERY_WAY
@pytest.mark.parametrize("name", [*DEPTHS, *COCS])
def test_gradients_are_finite_on_hostile_maps(name: str, way: dict[str, Any]) -> None:
    image = torch.rand(1, 2, 9, 12, requires_grad=True)
    if name in COCS:
        leaves = [image, COCS[name].clone().requires_grad_()]
        out = blur_by_coc(*leaves, **way)
    else:
        focus, f_number = (torch.tensor([v], requires_grad=True) for v in (2.0, 2.0))
        leaves = [image, DEPTHS[name].clone().requires_grad_(), focus, f_number]
        out = DepthOfField(CAMERA, check=name != "holes", **way)(*leaves)
    assert torch.isfinite(out).all()
    assert all(torch.isfinite(grad).all() for grad in torch.autograd.grad(out.square().sum(), leaves))


@EVERY_WAY
@pytest.mark.parametrize(("dtype", "light"), [
    *((torch.float32, light) for light in (0.0, 1e-30, 1e-40, 1e8)), (torch.float16, 1.0), (torch.bfloat16, 1.0)
])  # fmt: skip
def test_gradients_are_finite_at_hostile_light_and_types(way: dict[str, Any], dtype: torch.dtype, light: float) -> None:
    image = torch.full((1, 2, 9, 12), light, dtype=dtype)
    image[..., 4, 5] = 2 * light
    leaves = [image.requires_grad_(), EVEN.clone().requires_grad_()]
    grads = torch.autograd.grad(blur_by_coc(*leaves, **way).float().square().sum(), leaves)
    assert [grad.dtype for grad in grads] == [dtype, torch.float32] and all(torch.isfinite(g).all() for g in grads)


@EVERY_WAY
def test_gradients_do_not_depend_on_the_scale_of_the_light(way: dict[str, Any]) -> None:
    small, bright = ((texture() * k).requires_grad_() for k in (2.0**20, 2.0**90))
    grads = [torch.autograd.grad(blur_by_coc(x, halves(-6.0, 5.0), **way).mean(), x)[0] for x in (small, bright)]
    assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-9)


# Forward mode and torch.func


@TRACED
@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # raised inside PyTorch for tangents
@pytest.mark.parametrize("way", [{"occlusion": True}, {"method": "fold", "occlusion": False}], ids=["over", "paper"])
@pytest.mark.parametrize("which", [*NUMBERS, "rotation", "squeeze"])
def test_forward_mode_and_torch_func_agree_with_autograd(way: dict[str, Any], which: str) -> None:
    numbers = {name: torch.tensor(value, dtype=torch.float64) for name, value in (("rotation", 25.0), ("squeeze", 1.3))}
    inputs = case() | numbers
    seen, step = torch.rand_like(inputs["image"]), torch.rand_like(inputs[which])

    def shown(value: Tensor) -> Tensor:
        image, depth, focus, f_number, rotation, squeeze = {**inputs, which: value}.values()
        table = BlurTable.polygon(5, rotation_deg=rotation, squeeze=squeeze)
        return (DepthOfField(SMALL, table, tolerance=1 / 60, **way)(image, depth, focus, f_number) * seen).sum()

    leaf = inputs[which].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(shown(leaf), leaf)
    assert gradient.abs().max() > 0
    assert_close(torch.func.grad(shown)(inputs[which]), gradient, rtol=1e-12, atol=0.0)
    (again,) = torch.autograd.grad(shown(leaf), leaf)  # torch.func leaves no wrapped tensors in caches
    assert torch.equal(again, gradient)
    with torch.no_grad():
        tangent = torch.func.jvp(shown, (inputs[which],), (step,))[1]
    assert_close(tangent, (gradient * step).sum(), rtol=1e-9, atol=1e-12)


@TRACED
def test_kernels_cached_inside_torch_func_are_usable_outside() -> None:
    image, depth = torch.rand(1, 3, 20, 30), torch.linspace(0.7, 6.3, 600).reshape(1, 1, 20, 30)
    dof = DepthOfField(Camera(f_number=1.337, sensor_width_mm=3.0), BlurTable.polygon(7, rotation_deg=12.34))
    torch.func.grad(lambda image: dof(image, depth).sum())(image)
    plain = dof(image, depth)
    assert not torch._C._functorch.is_functorch_wrapped_tensor(plain)
    twin = DepthOfField(dof.camera, BlurTable.polygon(7, rotation_deg=12.34))
    assert_close(twin(image, depth), plain, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("which", ["image", "depth", "focus_m"])
def test_torch_func_of_an_old_pytorch_is_refused_by_name(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "TRACEABLE", False)
    given = {"image": torch.rand(1, 3, 8, 9), "depth": 1 + torch.rand(1, 1, 8, 9), "focus_m": torch.tensor([1.5])}
    dof = DepthOfField(Camera())
    with pytest.raises(ValueError, match=r"comes from torch\.func, for which torchdof needs PyTorch 2\.13"):
        torch.func.grad(lambda value: dof(**{**given, which: value}).sum())(given[which])


@pytest.mark.parametrize(("occlusion", "frames"), [(True, 150), (False, 40)])
def test_autograd_keeps_few_frames(occlusion: bool, frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers, hidden surfaces and rays are computed again in the backward pass."""
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    light, coc_px = post_before_lamps()
    kept: dict[int, torch.UntypedStorage] = {}  # by their address, and alive, so that no address is used twice

    def keep(values: Tensor) -> Tensor:
        kept[values.untyped_storage().data_ptr()] = values.untyped_storage()
        return values

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda values: values):
        picture = blur_by_coc(light.requires_grad_(), coc_px.requires_grad_(), occlusion=occlusion)
    assert sum(storage.nbytes() for storage in kept.values()) < frames * light.nbytes
    torch.autograd.grad(picture.sum(), (light, coc_px))


def test_a_recomputed_function_has_its_gradients_again_and_to_any_order() -> None:
    values = torch.rand(5, dtype=torch.float64, requires_grad=True)
    calls: list[int] = []

    def function() -> Tensor:
        calls.append(len(calls))
        return values.sin().exp() * values * values

    (expected,) = torch.autograd.grad(function().sum(), values)
    result = tensors.recomputed(function).sum()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        gradients = [torch.autograd.grad(result, values, retain_graph=True)[0] for _ in range(2)]
    assert all(torch.equal(gradient, expected) for gradient in gradients)
    assert len(calls) == 4  # twice forward, once in each backward pass
    assert torch.autograd.gradgradcheck(lambda x: tensors.recomputed(lambda: x.sin().exp() * x * x), values)
