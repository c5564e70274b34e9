"""Tensors whose memory is unusual render as any others, and need no default device or type."""

import pytest
import torch

from tests.processes import output_of
from torchdof import Camera, DepthOfField, blur_by_coc

DOF = DepthOfField(Camera(focus_m=2.0), check=False)

ELSEWHERE = """
import contextlib
import torch
torch.set_default_device("meta")  # before the imports, so that nothing is cached on another device
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.depth import fill_holes, from_relative
random = torch.Generator("cpu").manual_seed(0)
image = torch.rand(1, 3, 24, 36, generator=random, device="cpu")
image[0, :, 12, 20] = 200.0
coc = torch.linspace(-6, 6, 36, device="cpu").expand(1, 1, 24, 36).clone()
def pictures():
    tables = [BlurTable.load("sato_j15"), BlurTable.polygon(5, 10.0, curvature=0.3, squeeze=0.7, vignetting=0.5)]
    made = [blur_by_coc(image, coc, table=table, occlusion=hides) for table, hides in zip(tables, (True, False))]
    depth = from_relative(fill_holes(coc.where(coc < 5, torch.nan), "nearest"), 1.0, 3.0).requires_grad_()
    focused = DepthOfField(Camera(focus_range_m=(1.5, 2.0), tilt_deg=3.0))(image, depth)
    focused.square().sum().backward()
    return [float(t.detach().double().sum()) for t in (*made, focused, depth.grad)]
elsewhere = pictures()
torch.set_default_device("cpu")
print(elsewhere == pictures())
from torch._subclasses.fake_tensor import FakeTensorMode
image, coc = torch.rand(1, 3, 300, 300), 9 * torch.rand(1, 1, 300, 300)
with contextlib.suppress(Exception), FakeTensorMode(allow_non_fake_inputs=True):
    blur_by_coc(image, coc)  # must not crash
torch.set_default_dtype(torch.float64)
blur_by_coc(image.requires_grad_(), coc).sum().backward()
print(image.grad.dtype)
"""


@pytest.mark.parametrize("engine", ["native", pytest.param("torch", marks=pytest.mark.sweep)], indirect=True)
def test_a_default_device_or_type_and_a_fake_mode_change_nothing_of_other_pictures(engine: str) -> None:
    assert output_of(ELSEWHERE) == "True\ntorch.float32\n"


def test_a_negated_view_renders_as_its_values(engine: str) -> None:
    """The memory of ``z.conj().imag``, with a complex ``z``, holds the numbers with the opposite sign."""
    light, coc = torch.rand(1, 3, 40, 50), torch.linspace(-4.0, 4.0, 50).expand(1, 1, 40, 50).clone()
    coc[..., 20:25] = 6.0
    views = [(-values)._neg_view() for values in (light, coc, coc.abs() + 1.0)]
    for image, radius, depth in [(views[0], coc, coc.abs() + 1.0), (light, views[1], views[2])]:
        torch.testing.assert_close(blur_by_coc(image, radius), blur_by_coc(light, coc), rtol=0, atol=0)
        torch.testing.assert_close(DOF(image, depth), DOF(light, coc.abs() + 1.0), rtol=0, atol=0)


@pytest.mark.filterwarnings("ignore:.*torch.jit.trace:DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_torch_jit_trace_is_refused() -> None:
    image, coc_px = torch.rand(1, 3, 30, 40), torch.full((1, 1, 30, 40), 3.0)
    with pytest.raises(ValueError, match=r"torch\.jit\.trace; use torch\.compile or torchdof\.export\.to_onnx"):
        torch.jit.trace(blur_by_coc, (image, coc_px))
