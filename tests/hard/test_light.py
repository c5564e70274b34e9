"""Bad depth and light that was let through with `check=False` stays where it is; what is refused is refused by name."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc

pytestmark = pytest.mark.hard

CAMERA = Camera(focal_length_mm=50.0, f_number=2.0, focus_m=2.0, sensor_width_mm=4.0)
WAYS: list[dict[str, Any]] = [
    {"method": method, "occlusion": occlusion} for method in ("layered", "fold") for occlusion in (True, False)
]
EVERY_WAY = pytest.mark.parametrize("way", WAYS, ids=lambda way: f"{way['method']}-{way['occlusion']}")
BAD = pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf], ids=str)


def slope(low: float = 1.2, high: float = 6.0) -> Tensor:
    return torch.linspace(low, high, 24).expand(1, 1, 20, 24).clone()


@pytest.mark.parametrize("bad", [0.0, -0.0, -1.0, math.nan, -math.inf])
def test_a_bad_depth_is_refused_and_counted(bad: float) -> None:
    depth = slope()
    depth[0, 0, 3, 4:7] = bad
    with pytest.raises(ValueError, match="depth must be > 0 .*got 3 of 480 pixels"):
        DepthOfField(CAMERA)(torch.rand(1, 3, 20, 24), depth)


@EVERY_WAY
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, -math.inf])
def test_a_bad_depth_passes_sharp_and_touches_nothing_else(way: dict[str, Any], bad: float) -> None:
    depth, image = slope(), torch.rand(1, 3, 20, 24)
    depth[0, 0, 9:11, 8:10] = bad
    hole = torch.zeros(20, 24, dtype=torch.bool)
    hole[9:11, 8:10] = True
    dof = DepthOfField(CAMERA, check=False, **way)
    out = dof(image, depth)
    assert torch.equal(out[..., hole], image[..., hole])
    other = image.clone()
    other[..., hole] = 1e6  # whatever is in the hole, nobody sees it
    assert torch.equal(dof(other, depth)[..., ~hole], out[..., ~hole])
    assert torch.isfinite(out).all()
    assert not torch.allclose(out[..., ~hole], image[..., ~hole])


@EVERY_WAY
def test_a_frame_of_bad_depth_alone_is_returned_as_it_is(way: dict[str, Any]) -> None:
    image = torch.rand(1, 3, 20, 24)
    out = DepthOfField(CAMERA, check=False, **way)(image, torch.full((1, 1, 20, 24), math.nan))
    assert torch.equal(out, image)


@EVERY_WAY
def test_a_constant_around_holes_stays_constant(way: dict[str, Any]) -> None:
    depth, image = slope(), torch.ones(1, 1, 20, 24)
    depth[torch.rand(1, 1, 20, 24) < 0.4] = math.nan
    out = DepthOfField(CAMERA, check=False, **way)(image, depth)
    assert_close(out, image, rtol=1e-6, atol=0.0)


@BAD
def test_bad_light_is_refused_and_counted(bad: float) -> None:
    image = torch.rand(1, 3, 20, 24)
    image[0, 1, 3, 4:6] = bad
    with pytest.raises(ValueError, match="image must be finite, got 2 of 1440 values"):
        DepthOfField(CAMERA)(image, slope())


@EVERY_WAY
@BAD
@pytest.mark.parametrize("coc", [0.0, -3.0, 40.0])
def test_bad_light_is_confined_when_it_is_not_checked(way: dict[str, Any], bad: float, coc: float) -> None:
    image, depths = torch.rand(1, 3, 20, 24), torch.linspace(-3, 5, 24).expand(1, 1, 20, 24).clone()
    depths[0, 0, 10, 12] = coc
    image[0, 1, 10, 12] = bad
    out = blur_by_coc(image, depths, check=False, **way)
    touched = ~torch.isfinite(out).all(1)[0]
    y, x = torch.meshgrid(torch.arange(20), torch.arange(24), indexing="ij")
    assert int(touched.sum()) > 0  # it is not hidden either
    assert not touched[torch.hypot(y - 10.0, x - 12.0) > max(abs(coc), 1.0) + 1].any()


@BAD
def test_a_bad_coc_passes_sharp_when_it_is_not_checked(bad: float) -> None:
    image, coc = torch.rand(1, 3, 20, 24), torch.full((1, 1, 20, 24), 4.0)
    coc[0, 0, 5, 5] = bad
    with pytest.raises(ValueError, match="coc_px must be finite, got 1 of 480"):
        blur_by_coc(image, coc)
    out = blur_by_coc(image, coc, check=False)
    assert torch.equal(out[0, :, 5, 5], image[0, :, 5, 5]) and torch.isfinite(out).all()


@EVERY_WAY
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_the_brightest_light_of_a_type_does_not_overflow(way: dict[str, Any], dtype: torch.dtype) -> None:
    image = torch.full((1, 1, 20, 24), torch.finfo(dtype).max / 4, dtype=dtype)
    image[..., 10, 12] = torch.finfo(dtype).max
    out = blur_by_coc(image, torch.linspace(-3, 5, 24).expand(1, 1, 20, 24), **way)
    assert torch.isfinite(out).all() and float(out.double().min()) >= float(image.double().min()) * (1 - 1e-5)


@EVERY_WAY
@pytest.mark.parametrize("value", [6.5e4, 1e6])
@pytest.mark.parametrize("coc", [-6.0, 2.5, 11.0])
def test_a_highlight_leaves_the_dark_outside_its_disc_untouched(way: dict[str, Any], value: float, coc: float) -> None:
    dark = torch.full((1, 1, 40, 48), 1e-4)
    lit = dark.clone()
    lit[..., 20, 24] = value
    around = torch.full((1, 1, 40, 48), 3.0)
    around[..., 18:23, 22:27] = coc
    y, x = torch.meshgrid(torch.arange(40), torch.arange(48), indexing="ij")
    # a layer at half resolution has more support: the pixels of its grid, and the interpolation between them;
    # and mixed pixels within 2 of it, which are as blurred, see it when they are split
    reach = abs(coc) + 1 + (8 if abs(coc) >= 8 else 0) + (2 * 2**0.5 if way["occlusion"] else 0)
    outside = torch.hypot(y - 20.0, x - 24.0) > reach
    out, without = (blur_by_coc(image, around, **way)[..., outside] for image in (lit, dark))
    assert_close(out, without, rtol=1e-6, atol=0.0)


def test_the_ring_of_the_paper_keeps_a_highlight_inside_its_support() -> None:
    table = BlurTable.load("sato_j15")
    dark = torch.full((1, 1, 40, 48), 1e-4)
    lit = dark.clone()
    lit[..., 20, 24] = 6.5e4
    coc = torch.full((1, 1, 40, 48), 4.0)
    y, x = torch.meshgrid(torch.arange(40), torch.arange(48), indexing="ij")
    outside = torch.maximum((y - 20).abs(), (x - 24).abs()) > table.reach_px(4.0, 48) + 1
    out, without = (blur_by_coc(image, coc, table=table)[..., outside] for image in (lit, dark))
    assert outside.any()
    assert_close(out, without, rtol=1e-6, atol=0.0)


def test_a_plane_of_nearly_the_largest_float_does_not_overflow() -> None:
    bright = torch.full((1, 1, 24, 32), 3e38)
    torch.testing.assert_close(blur_by_coc(bright, torch.full((1, 1, 24, 32), 4.0)), bright, rtol=1e-6, atol=0.0)


EVERY_ENGINE = pytest.mark.parametrize("engine", ["torch", "native"])


def step(left: float = -6.0, right: float = 5.0) -> Tensor:
    coc = torch.full((1, 1, 24, 32), left)
    coc[..., 16:] = right
    return coc


def thin_post() -> Tensor:
    """A foreground one pixel wide: none of its pixels is surely unmixed."""
    coc = torch.full((1, 1, 24, 32), 5.0)
    coc[..., 14] = -4.0
    return coc


@EVERY_ENGINE
@EVERY_WAY
@pytest.mark.parametrize("coc", [step(), thin_post()], ids=["step", "post"])
@pytest.mark.parametrize("light", [1e10, 2e19, 1e30, 3e38])
def test_light_of_any_size_beside_a_depth_step_is_as_in_float64(
    engine: str, way: dict[str, Any], coc: Tensor, light: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    image = torch.rand(1, 3, 24, 32)
    image[..., 12, 8:24] = 1.0
    image = (image * light).clamp(max=light)
    out, truth = blur_by_coc(image, coc, **way), blur_by_coc(image.double(), coc, **way)
    assert_close(out.double() / light, truth / light, rtol=1e-4, atol=1e-6)


@EVERY_ENGINE
@pytest.mark.parametrize("light", [2e19, 1e30, -1e30])
def test_bright_layers_and_backgrounds_do_not_overflow(
    engine: str, light: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    dof, depth = DepthOfField(CAMERA), torch.full((1, 1, 24, 32), 1.2)
    depth[..., 16:] = 2.5
    image, far = torch.rand(1, 3, 24, 32), torch.full((1, 1, 24, 32), 9.0)
    out = dof(image, depth, background=image * light, background_depth=far)
    wide = dof(image.double(), depth, background=image.double() * light, background_depth=far)
    assert_close(out.double() / light, wide / light, rtol=1e-4, atol=1e-6)
    rgba = torch.rand(1, 2, 4, 24, 32)
    rgba[:, :, -1] = torch.tensor([1e-6, 1.0])[:, None, None]  # light over a tiny coverage is brighter still
    rgba[:, :, :-1] *= light
    out, wide = dof.layers(rgba, torch.tensor([1.2, 9.0])), dof.layers(rgba.double(), torch.tensor([1.2, 9.0]))
    assert_close(out[:, :-1].double() / light, wide[:, :-1] / light, rtol=1e-4, atol=1e-6)
    assert_close(out[:, -1].double(), wide[:, -1], rtol=1e-5, atol=1e-6)


@EVERY_ENGINE
@EVERY_WAY
@pytest.mark.parametrize("coc", [step(), thin_post()], ids=["step", "post"])
def test_negative_light_passes_through_edges_as_it_does_elsewhere(
    engine: str, way: dict[str, Any], coc: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    image = 0.1 + torch.rand(1, 3, 24, 32)
    # a part of a split pixel may be darker than its surface, not darker than nothing
    assert_close(blur_by_coc(-image, coc, **way), -blur_by_coc(image, coc, **way), rtol=0.0, atol=5e-4)
    mixed = torch.where(coc > 0, -1.0, -3.0).expand(1, 3, -1, -1).clone()
    mixed[..., 16] = -2.0
    out = blur_by_coc(mixed, coc, **way)
    assert -3.0001 <= float(out.min()) and float(out.max()) <= -0.9999


def test_gradients_of_light_of_any_size_are_those_of_small_light() -> None:
    image, coc = torch.rand(1, 1, 24, 32, dtype=torch.float32), step()
    small, bright = ((image * k).requires_grad_() for k in (2.0**20, 2.0**90))
    for way in WAYS:
        grads = [torch.autograd.grad(blur_by_coc(x, coc, **way).mean(), x)[0] for x in (small, bright)]
        assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-9)
