"""Derivatives of the picture, by finite differences in float64: image, depth, focus and f-number, in every way."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.render.layer_weights import from_blur_axis
from torchdof.render.plan import Plan

EVERY_WAY = pytest.mark.parametrize(
    "way",
    [
        {"method": "layered", "occlusion": True},
        {"method": "layered", "occlusion": False},
        {"method": "fold", "occlusion": True},
        {"method": "fold", "occlusion": False},
        {"method": "layered", "occlusion": False, "normalize": False},
    ],
    ids=["layered-over", "layered-sum", "fold-over", "fold-sum", "plain-sum"],
)
TABLES = {"disc": BlurTable.disc(), "sato_j15": BlurTable.load("sato_j15")}


def case() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, depth, focus and f-number of a tiny scene from in front of focus to far behind it, in float64."""
    image = torch.rand(1, 2, 3, 4, dtype=torch.float64)
    depth = torch.linspace(0.8, 6.0, 12, dtype=torch.float64).reshape(1, 1, 3, 4)
    depth[0, 0, 1] = depth[0, 0, 1].flip(0)
    focus, f_number = (torch.tensor([value], dtype=torch.float64) for value in (1.37, 2.1))
    return image, depth, focus, f_number


def renderer(way: dict[str, Any], name: str = "disc") -> Callable[..., Tensor]:
    return DepthOfField(Camera(sensor_width_mm=0.6), TABLES[name], tolerance=1 / 60, **way)


def test_the_case_has_blur_in_front_of_and_behind_focus() -> None:
    image, depth, focus, f_number = case()
    coc = Camera(f_number=f_number, focus_m=focus, sensor_width_mm=0.6).coc_px(depth, 4)
    assert float(coc.min()) < -1.5 and float(coc.max()) > 1.5
    assert not torch.equal(renderer({})(image, depth, focus, f_number), image)


@EVERY_WAY
def test_gradients_with_respect_to_the_image(way: dict[str, Any]) -> None:
    image, depth, focus, f_number = case()
    render = renderer(way)
    assert torch.autograd.gradcheck(lambda image: render(image, depth, focus, f_number), image.requires_grad_())


@EVERY_WAY
def test_gradients_with_respect_to_depth(way: dict[str, Any]) -> None:
    image, depth, focus, f_number = case()
    render = renderer(way)
    assert torch.autograd.gradcheck(lambda depth: render(image, depth, focus, f_number), depth.requires_grad_())


def test_gradients_through_a_measured_table() -> None:
    image, depth, focus, f_number = case()
    render = renderer({"occlusion": False}, "sato_j15")
    assert torch.autograd.gradcheck(lambda depth: render(image, depth, focus, f_number), depth.requires_grad_())


@EVERY_WAY
@pytest.mark.parametrize("number", ["focus_m", "f_number"])
def test_gradients_with_respect_to_the_camera(way: dict[str, Any], number: str) -> None:
    image, depth, focus, f_number = case()
    render = renderer(way)
    numbers = {"focus_m": focus, "f_number": f_number}
    leaf = numbers.pop(number).requires_grad_()
    assert torch.autograd.gradcheck(lambda value: render(image, depth, **numbers, **{number: value}), leaf)


def test_gradients_of_a_camera_that_was_built_of_leaves() -> None:
    image, depth, focus, f_number = case()

    def render(focus: Tensor, f_number: Tensor) -> Tensor:
        return DepthOfField(Camera(50.0, f_number, focus, 0.6), tolerance=1 / 60)(image, depth)

    assert torch.autograd.gradcheck(render, (focus.requires_grad_(), f_number.requires_grad_()))


@EVERY_WAY
def test_gradients_with_respect_to_the_coc(way: dict[str, Any]) -> None:
    image = torch.rand(1, 2, 3, 4, dtype=torch.float64)
    # an even slope would lie on the kinks of "nearer than half way"
    coc = torch.linspace(-2.83, 3.17, 12, dtype=torch.float64) + 0.2 * torch.rand(12, dtype=torch.float64)
    coc = coc.reshape(1, 1, 3, 4).requires_grad_()
    assert torch.autograd.gradcheck(lambda coc: blur_by_coc(image, coc, tolerance=1 / 60, **way), coc)


def test_gradients_with_respect_to_the_light_alone_render_the_same_picture() -> None:
    image, depth, focus, f_number = case()
    plain = renderer({})(image, depth, focus, f_number)
    assert_close(renderer({})(image.requires_grad_(), depth, focus, f_number), plain, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("way", [{"occlusion": True}, {"occlusion": False}], ids=["over", "sum"])
def test_gradients_with_a_plan_of_the_user(way: dict[str, Any]) -> None:
    image, depth, focus, f_number = case()
    plan = Plan.all(6.0, 1 / 60)
    dof = DepthOfField(Camera(sensor_width_mm=0.6), **way)
    depth.requires_grad_()
    assert torch.autograd.gradcheck(lambda d: dof(image, d, focus, f_number, plan), depth)


@EVERY_WAY
@pytest.mark.parametrize("where", ["focus plane", "layer nodes", "in focus", "end of focus", "infinity"])
def test_gradients_are_finite_where_the_picture_has_a_kink(way: dict[str, Any], where: str) -> None:
    image = torch.rand(1, 1, 5, 6, dtype=torch.float32, requires_grad=True)
    coc = torch.linspace(-3, 3, 30).reshape(1, 1, 5, 6)
    if where == "focus plane":
        coc[..., 2:4] = 0.0
    elif where == "layer nodes":
        nodes = Plan.still(coc, 1 / 255).coc_px
        coc = torch.tensor(nodes).repeat(30)[:30].reshape(1, 1, 5, 6)
    elif where == "in focus":
        coc = torch.zeros(1, 1, 5, 6)
    elif where == "end of focus":
        coc = from_blur_axis(1e-12) * coc.sign()
    if where == "infinity":
        depth = torch.full((1, 1, 5, 6), math.inf)
        depth[..., 3:] = 2.0
        focus = torch.tensor([2.0], requires_grad=True)
        leaves = [image, depth.requires_grad_(), focus]
        out = DepthOfField(Camera(sensor_width_mm=0.5), **way)(image, depth, focus)
    else:
        leaves = [image, coc.requires_grad_()]
        out = blur_by_coc(image, coc, **way)
    for grad in torch.autograd.grad(out.square().sum(), leaves):
        assert torch.isfinite(grad).all()


@pytest.mark.parametrize("method", ["layered", "fold"])
def test_the_gradient_of_the_image_is_the_adjoint_of_the_paper_s_sum(method: str) -> None:
    # with occlusion the picture is not linear in the image: mixed pixels are told by what they show
    way = {"method": method, "occlusion": False}
    image, depth, focus, f_number = case()
    render = renderer(way)
    seen = torch.rand_like(image)
    out = render(image.requires_grad_(), depth, focus, f_number)
    (back,) = torch.autograd.grad(out, image, seen)
    other = torch.rand_like(image)
    forward = render(other, depth, focus, f_number)
    assert_close((back * other).sum(), (seen * forward).sum(), rtol=1e-11, atol=0.0)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # by PyTorch, for tangents
@pytest.mark.parametrize("way", [{"occlusion": True}, {"method": "fold", "occlusion": False}], ids=["over", "paper"])
@pytest.mark.parametrize("which", ["image", "depth", "focus", "f-number", "rotation", "squeeze"])
def test_derivatives_forwards_and_by_transforms_are_those_of_autograd(way: dict[str, Any], which: str) -> None:
    numbers = [torch.tensor(value, dtype=torch.float64) for value in (25.0, 1.3)]
    inputs = dict(zip(["image", "depth", "focus", "f-number", "rotation", "squeeze"], [*case(), *numbers], strict=True))
    seen, step = torch.rand_like(inputs["image"]), torch.rand_like(inputs[which])

    def shown(value: Tensor) -> Tensor:
        image, depth, focus, f_number, rotation, squeeze = {**inputs, which: value}.values()
        table = BlurTable.polygon(5, rotation_deg=rotation, squeeze=squeeze)
        dof = DepthOfField(Camera(sensor_width_mm=0.6), table, tolerance=1 / 60, **way)
        return (dof(image, depth, focus, f_number) * seen).sum()

    leaf = inputs[which].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(shown(leaf), leaf)
    assert gradient.abs().max() > 0
    assert_close(torch.func.grad(shown)(inputs[which]), gradient, rtol=1e-12, atol=0.0)
    (again,) = torch.autograd.grad(shown(leaf), leaf)  # what transforms left in caches is not theirs
    assert torch.equal(again, gradient)
    with torch.no_grad():
        tangent = torch.func.jvp(shown, (inputs[which],), (step,))[1]
    assert_close(tangent, (gradient * step).sum(), rtol=1e-9, atol=1e-12)


def test_transforms_leave_kernels_in_the_cache_that_serve_without_them() -> None:
    image, depth = torch.rand(1, 3, 20, 30), torch.linspace(0.7, 6.3, 600).reshape(1, 1, 20, 30)
    dof = DepthOfField(Camera(f_number=1.337, sensor_width_mm=3.0), BlurTable.polygon(7, rotation_deg=12.34))
    torch.func.grad(lambda image: dof(image, depth).sum())(image)
    plain = dof(image, depth)
    assert not torch._C._functorch.is_functorch_wrapped_tensor(plain)
    twin = DepthOfField(dof.camera, BlurTable.polygon(7, rotation_deg=12.34))
    assert_close(twin(image, depth), plain, rtol=0.0, atol=0.0)
