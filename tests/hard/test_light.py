"""Bad numbers are refused, and very bright light does not overflow; ``tests/test_engines.py`` has more scenes."""

import math
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.scenes import CAMERA, HEIGHT, WAYS, WIDTH, halves, slope, texture, whole
from torchdof import BlurTable, DepthOfField, blur_by_coc

pytestmark = pytest.mark.hard
EVERY_WAY = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)


@pytest.mark.parametrize("name", ["depth", "image", "coc_px", "rgba"])
@pytest.mark.parametrize("bad", [0.0, -0.0, -1.0, math.nan, math.inf, -math.inf])
def test_bad_numbers_are_refused_and_counted(name: str, bad: float) -> None:
    image, depth, rgba = texture(), slope(1.2, 6.0), torch.ones(1, 2, 4, HEIGHT, WIDTH)
    {"depth": depth, "image": image, "coc_px": depth, "rgba": rgba}[name].flatten()[7:9] = bad
    calls: dict[str, Any] = {
        "depth": lambda: DepthOfField(CAMERA)(image, depth),
        "image": lambda: DepthOfField(CAMERA)(image, depth),
        "coc_px": lambda: blur_by_coc(image, depth),
        "rgba": lambda: DepthOfField(CAMERA).layers(rgba, torch.tensor([1.0, 4.0])),
    }
    message = {"depth": "depth must be > 0 .*got 2 of 768 pixels"}.get(name, f"{name} must be finite, got 2 of ")
    if bad != math.inf if name == "depth" else not math.isfinite(bad):
        with pytest.raises(ValueError, match=message):
            calls[name]()
    elif name != "rgba":
        calls[name]()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_an_unchecked_bad_coc_leaves_its_pixel_sharp(bad: float) -> None:
    image, coc = texture(), whole(4.0)
    coc[0, 0, 5, 5] = bad
    out = blur_by_coc(image, coc, check=False)
    assert torch.equal(out[0, :, 5, 5], image[0, :, 5, 5]) and torch.isfinite(out).all()


@EVERY_WAY
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_the_brightest_light_of_a_type_does_not_overflow(way: dict[str, Any], dtype: torch.dtype) -> None:
    image = torch.full((1, 1, HEIGHT, WIDTH), torch.finfo(dtype).max / 4, dtype=dtype)
    image[..., 10, 12] = torch.finfo(dtype).max
    out = blur_by_coc(image, slope(-3, 5), **way)
    assert torch.isfinite(out).all() and float(out.double().min()) >= float(image.double().min()) * (1 - 1e-5)


def test_the_ring_of_the_paper_keeps_a_highlight_inside_its_support() -> None:
    table, image = BlurTable.load("sato_j15"), torch.full((1, 1, 40, 48), 1e-4)
    image[..., 20, 24] = 6.5e4
    y, x = torch.meshgrid(torch.arange(40), torch.arange(48), indexing="ij")
    outside = torch.maximum((y - 20).abs(), (x - 24).abs()) > table.reach_px(4.0, 48) + 1
    out = blur_by_coc(image, whole(4.0, 40, 48), table=table)[..., outside]
    assert outside.any()
    assert_close(out, torch.full_like(out, 1e-4), rtol=1e-6, atol=0.0)


@EVERY_WAY
def test_gradients_do_not_depend_on_the_scale_of_the_light(way: dict[str, Any]) -> None:
    small, bright = ((texture() * k).requires_grad_() for k in (2.0**20, 2.0**90))
    grads = [torch.autograd.grad(blur_by_coc(x, halves(-6.0, 5.0), **way).mean(), x)[0] for x in (small, bright)]
    assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-9)


@EVERY_WAY
def test_the_mean_of_renderings_of_noise_is_the_rendering_of_the_mean(way: dict[str, Any]) -> None:
    flat, coc = torch.full((1, 1, 20, 24), 0.5), torch.full((1, 1, 20, 24), 3.3)
    noise = [torch.randn_like(flat) for _ in range(8)]
    total = sum(blur_by_coc(flat + n, coc, **way).double() for n in [*noise, *(-n for n in noise)])
    assert_close(total / 16, flat.double(), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("reach", [2.0, 9.0, 30.0])
def test_coverage_lies_in_0_to_1(reach: float) -> None:
    # a foreground of light 1 over a background of light 0: the picture is the foreground's coverage
    image, coc = torch.zeros(1, 1, 40, 50), torch.full((1, 1, 40, 50), reach)
    front = torch.rand(1, 1, 40, 50) < 0.2
    image[front], coc[front] = 1.0, -reach
    out = blur_by_coc(image, coc)
    assert float(out.min()) >= 0.0 and float(out.max()) <= 1.0 + 1e-6


def test_a_disc_far_larger_than_the_frame_needs_no_more_memory_than_the_frame() -> None:
    with torch.inference_mode():
        out = blur_by_coc(torch.ones(1, 1, 30, 400), torch.full((1, 1, 30, 400), 1e5))
    assert_close(out, torch.ones(1, 1, 30, 400), rtol=1e-6, atol=0.0)
