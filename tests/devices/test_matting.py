"""Matting by kernels is that of the plain engine, forward and backward; kernels and host code run on the CPU."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from tests import on_cpu
from tests.scenes import assert_same_picture, post_before_lamps
from torchdof import blur_by_coc
from torchdof.render import rules
from torchdof.render.engines import on_gpu
from torchdof.render.surfaces import matting

Maps = dict[str, Tensor]


def patches(seed: int, channels: int, radius_px: float, *given: str, batch: int = 2) -> Maps:
    """Images of patches with a colour and a coc each, and noise; with `given`, invalid pixels or a matte's surfaces."""
    dice, (height, width) = torch.Generator().manual_seed(seed), ((30, 41), (13, 27), (41, 9))[seed // 3 % 3]

    def random(count: int) -> Tensor:
        return torch.rand(batch, count, height, width, generator=dice)

    def patched(count: int) -> Tensor:
        cells = torch.rand(batch, count, 11, 9, generator=dice).repeat_interleave(4, 2).repeat_interleave(5, 3)
        return cells[..., :height, :width].contiguous()

    light, coc_px = 0.6 * patched(channels) + 0.4 * random(channels), radius_px * (2.0 * patched(1) - 1.0)
    if seed % 2:  # else many pixels have the same coc
        coc_px = coc_px + 0.1 * radius_px * random(1)
    maps = {"light": light, "coc_px": coc_px}
    if "valid" in given:
        maps["valid"] = (random(1) > 0.1).float()
        maps |= {"light": light * maps["valid"], "coc_px": coc_px * maps["valid"]}
    if "covered" in given:
        certainty = (2.0 * random(1) - 1.0).clamp(0.0, 1.0)
        parts = random(channels), radius_px * (2.0 * random(1) - 1.0), 0.05 + 0.45 * random(1), certainty
        maps["covered"] = torch.cat(parts, 1)
    return maps


def split(matte: Callable[..., matting.Matted], maps: Maps) -> list[Tensor]:
    """Own light, other light, coc and weight of the other surface; the other light and coc times this weight."""
    own, other, coc_px, weight = matte(**maps)
    return [own, weight * other, weight * coc_px, weight]


def with_gradients(matte: Callable[..., matting.Matted], maps: Maps) -> tuple[list[Tensor], list[Tensor]]:
    """The surfaces of :func:`split`, and the gradients of a random sum over them by all maps but `valid`."""
    leaves = {name: t.clone().requires_grad_(name != "valid") for name, t in maps.items()}
    surfaces, dice = split(matte, leaves), torch.Generator().manual_seed(1)
    total = sum(((torch.rand(t.shape, generator=dice) - 0.3) * t).sum() for t in surfaces)
    assert isinstance(total, Tensor)
    wanted = [t for name, t in leaves.items() if name != "valid"]
    return [t.detach() for t in surfaces], list(torch.autograd.grad(total, wanted))


def assert_same_surfaces(found: Sequence[Tensor], expected: Sequence[Tensor], maps: Maps) -> None:
    """Lights differ by 1e-5 of the light nearby, cocs by 1e-5 of the largest, weights by 1e-5."""
    for i in range(2):
        assert_same_picture(expected[i], found[i], maps["light"])
    assert float((found[2] - expected[2]).abs().max()) <= 1e-5 * max(1.0, float(maps["coc_px"].abs().max()))
    assert float((found[3] - expected[3]).abs().max()) <= 1e-5


@pytest.fixture
def plain(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., matting.Matted]:
    """Matting by PyTorch alone, also where there is a compiled engine."""

    def split(light: Tensor, coc_px: Tensor, valid: Tensor | None = None, covered: Tensor | None = None) -> Any:
        with monkeypatch.context() as patched:
            patched.setenv("TORCHDOF_ENGINE", "torch")
            return matting.matte(light, coc_px, valid, covered=covered)

    return split


@pytest.mark.parametrize("given", [(), ("valid",), ("covered",)], ids=lambda given: next(iter(given), "image"))
@pytest.mark.parametrize("channels", range(1, 9))
def test_surfaces_and_gradients_are_the_plain_engines(
    channels: int, given: tuple[str, ...], plain: Callable[..., matting.Matted]
) -> None:
    seed = channels + len("".join(given))
    maps = patches(seed, channels, (0.7, 6.0, 60.0)[seed % 3], *given)
    (found, gradients), (expected, others) = (with_gradients(matte, maps) for matte in (on_gpu.matte, plain))
    assert_same_surfaces(found, expected, maps)
    assert int((found[3] > 0).sum()) > 20
    for gradient, other in zip(gradients, others, strict=True):
        assert float((gradient - other).norm()) <= 1e-4 * float(other.norm())


HOSTILE: dict[str, Callable[[Maps], Any]] = {
    "huge light": lambda maps: maps["light"].mul_(1e30),
    "light of 1e-36": lambda maps: maps["light"].mul_(1e-36),
    "one huge lamp": lambda maps: maps["light"][:, :, 7, 5].fill_(1e30),
    "black": lambda maps: maps["light"].zero_(),
    "huge coc": lambda maps: maps["coc_px"].mul_(1e6),
    "all left out": lambda maps: maps["valid"].zero_(),
    "one row": lambda maps: maps.update({name: t[..., 4:5, :] for name, t in maps.items()}),
    "one column": lambda maps: maps.update({name: t[..., 4:5] for name, t in maps.items()}),
    "one pixel": lambda maps: maps.update({name: t[..., 4:5, 4:5] for name, t in maps.items()}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_surfaces_of_hostile_images_are_the_plain_engines(name: str, plain: Callable[..., matting.Matted]) -> None:
    maps = patches(1, 3, 9.0, "valid")
    HOSTILE[name](maps)
    (found, gradients), (expected, _) = (with_gradients(matte, maps) for matte in (on_gpu.matte, plain))
    assert_same_surfaces(found, expected, maps)
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)


def test_a_batch_is_split_as_its_items_are_alone_with_the_same_bits_each_time(launched: list[str]) -> None:
    """Whatever new memory contains."""
    maps = patches(4, 3, 9.0, "valid", "covered", batch=3)
    surfaces, gradients = with_gradients(on_gpu.matte, maps)
    with on_cpu.new_memory_of_nan():
        again = with_gradients(on_gpu.matte, maps)
    assert all(map(torch.equal, [*surfaces, *gradients], [*again[0], *again[1]]))
    for item in range(3):
        alone = split(on_gpu.matte, {name: t[item : item + 1] for name, t in maps.items()})
        assert all(torch.equal(one, together[item : item + 1]) for one, together in zip(alone, surfaces, strict=True))


FORWARD = {"find_edges", "find_clean", "split"}
BACKWARD = {f"{kernel}_back" for kernel in FORWARD} | {"gather", "sum_rows"}


@pytest.mark.parametrize("way", ["image", "background", "matte"])
def test_pictures_are_split_by_kernels_and_are_the_plain_engines(
    way: str, launched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    light, coc_px = (t[..., :40, 30:70].clone() for t in post_before_lamps())
    options: dict[str, Any] = {}
    if way == "background":
        options = {"background": torch.full_like(light, 0.3), "background_coc_px": torch.full_like(coc_px, 15.0)}
    if way == "matte":
        options = {"matte": (0.5 + 0.3 * (torch.arange(40) - 19.5)).clamp(0.0, 1.0).expand_as(coc_px).contiguous()}
    leaf = light.clone().requires_grad_()
    found = blur_by_coc(leaf, coc_px, **options)
    assert {*launched} >= FORWARD
    (gradient,) = torch.autograd.grad(found.sum(), leaf)
    assert {*launched} >= BACKWARD
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    expected = blur_by_coc(leaf, coc_px, **options)
    assert_same_picture(expected.detach(), found.detach(), light)
    (other,) = torch.autograd.grad(expected.sum(), leaf)
    assert float((gradient - other).norm()) <= 1e-4 * float(other.norm())


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # raised inside PyTorch for tangents
def test_where_kernels_do_not_split_pixels_the_plain_engine_does(launched: list[str]) -> None:
    maps = patches(4, 3, 9.0)
    light, coc_px = maps.values()
    with rules.without(["mixed_neighbours"]):
        on_gpu.matte(light, coc_px)
    on_gpu.matte(light.double(), coc_px)
    on_gpu.matte(light.repeat(1, 3, 1, 1), coc_px)
    with forward_ad.dual_level():
        on_gpu.matte(forward_ad.make_dual(light, light), coc_px)
    assert not launched
    on_gpu.matte(light, coc_px)
    assert launched
