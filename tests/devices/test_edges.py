"""Edges by kernels are those of the plain engine; kernels and host code run on the CPU."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from tests import on_cpu
from torchdof import blur_by_coc, native
from torchdof.kernels import edges as kernels
from torchdof.render import rules
from torchdof.render.surfaces import edges
from torchdof.render.surfaces.windows import mean_around

pytestmark = pytest.mark.usefixtures("no_compiled_engine")


@pytest.fixture
def no_compiled_engine(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """It would repair the edges of maps on the CPU; those of a device it does not read."""
    monkeypatch.setattr(native, "_library", lambda: (None, "switched off"))


class Scene(NamedTuple):
    light: Tensor  # [B, C, H, W]
    coc_px: Tensor  # [B, 1, H, W]


def scene(seed: int, channels: int = 3, radius_px: float = 8.0, batch: int = 2) -> Scene:
    """Patches with a colour and a coc each, and noise; edges are those of the image, a pixel off, or ramps, or both."""
    dice, (height, width) = torch.Generator().manual_seed(seed), ((48, 61), (70, 33))[seed % 2]

    def patched(count: int) -> Tensor:
        cells = torch.rand(batch, count, 8, 8, generator=dice).repeat_interleave(9, 2).repeat_interleave(8, 3)
        return cells[..., :height, :width].contiguous()

    light, coc_px = patched(channels), radius_px * (2.0 * patched(1) - 1.0)
    light = (light + 0.05 * torch.rand(light.shape, generator=dice)).square()
    if seed % 3:
        coc_px = coc_px.roll(1, 3)
    if seed % 4 > 1:
        coc_px = mean_around(coc_px, 1 + seed % 2)
    return Scene(light, coc_px)


def repaired(given: Scene, step: Any = edges.STEP_PX, auto: bool = True) -> list[Tensor]:
    """What the search finds, with directions at edges alone; then what the repair returns."""
    found = edges._Map.of(given.light, -given.coc_px, torch.as_tensor(step), True).edges
    found = found._replace(direction=found.direction * found.is_edge)
    return [*found, *edges._repair(given.light, given.coc_px, torch.as_tensor(step), auto, True)]


def assert_same_edges(given: Scene, monkeypatch: pytest.MonkeyPatch, **options: Any) -> list[Tensor]:
    """Decisions are the same, surfaces to 1e-5 of the largest coc, the repaired map, where evidence counts, to 1e-4."""
    found = repaired(given, **options)
    with monkeypatch.context() as patched:
        patched.setenv("TORCHDOF_ENGINE", "torch")
        expected = repaired(given, **options)
    valid = given.coc_px.abs() <= 1e15
    largest = max(1.0, float(given.coc_px[valid].abs().max()) if valid.any() else 1.0)
    for i, (values, others) in enumerate(zip(found, expected, strict=True)):
        assert values.dtype == others.dtype
        tolerance = (1e-4 if i >= len(found) - 3 else 1e-5) * largest
        torch.testing.assert_close(values, others, atol=tolerance, rtol=1e-5, equal_nan=True)
    return found


@pytest.mark.parametrize("channels", range(1, 9))
def test_edges_are_the_plain_engines(channels: int, launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in (channels, channels + 8, channels + 16):
        given = scene(seed, channels, (2.0, 8.0, 64.0)[seed % 3])
        for auto in (True, False):
            found = assert_same_edges(given, monkeypatch, auto=auto)
        assert int(found[4].sum()) > 500
        assert bool((found[-3] != given.coc_px).any()) or not seed % 3
    assert {*launched} == KERNELS


SEARCH = {"find_slopes", "smooth_slopes", "find_ramps", "climb_ramps", "find_surfaces"}
KERNELS = {*SEARCH, "judge", "decide", "fit"}


def test_a_step_of_each_pixel_is_the_plain_engines(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    given = scene(6)
    found = assert_same_edges(given, monkeypatch, step=torch.linspace(0.5, 8.0, 48)[:, None].expand(2, 1, 48, 61))
    assert 0 < int(found[4][..., 24:, :].sum()) < int(found[4][..., :24, :].sum())
    assert launched


HOSTILE: dict[str, Callable[[Scene], Any]] = {
    "huge light": lambda given: given.light.mul_(1e30),
    "light of 1e-36": lambda given: given.light.mul_(1e-36),
    "invalid light": lambda given: given.light[:, 0, 5:9, 10:30].fill_(torch.nan),
    "black": lambda given: given.light.zero_(),
    "huge coc": lambda given: given.coc_px.mul_(1e6),
    "invalid coc": lambda given: given.coc_px[..., 20:29, 8:40].fill_(torch.nan),
    "infinite coc": lambda given: given.coc_px[..., 20:29, 8:40].fill_(-torch.inf),
    "all invalid": lambda given: given.coc_px.fill_(torch.nan),
    "flat": lambda given: given.coc_px.fill_(3.0),
}
THIN: dict[str, Callable[[Tensor], Tensor]] = {
    "one row": lambda values: values[..., 4:5, :],
    "one column": lambda values: values[..., 4:5],
    "one pixel": lambda values: values[..., 4:5, 4:5],
}


@pytest.mark.parametrize("name", [*HOSTILE, *THIN])
def test_edges_of_hostile_maps_are_the_plain_engines(
    name: str, launched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in (1, 3):
        given = scene(seed)
        if name in HOSTILE:
            HOSTILE[name](given)
        else:
            given = Scene(*(THIN[name](values).contiguous() for values in given))
        assert_same_edges(given, monkeypatch)
    assert launched


def test_a_batch_is_repaired_as_its_items_are_alone_with_the_same_bits_each_time(launched: list[str]) -> None:
    """Whatever new memory contains."""
    given = scene(2, batch=3)
    together = repaired(given)
    with on_cpu.new_memory_of_nan():
        again = repaired(given)
    assert all(map(torch.equal, together, again))
    for item in range(3):
        alone = repaired(Scene(*(values[item : item + 1] for values in given)))
        for one, of_all in zip(alone, together, strict=True):
            torch.testing.assert_close(one, of_all[item : item + 1], atol=1e-5, rtol=1e-5)
    assert launched


def test_where_kernels_do_not_find_edges_the_plain_engine_does(launched: list[str]) -> None:
    given = scene(2)
    with rules.without(["mixtures"]):
        repaired(given)
    repaired(Scene(*(values.double() for values in given)))
    repaired(Scene(given.light.repeat(1, 3, 1, 1), given.coc_px))
    assert not launched
    repaired(given)
    assert launched


@pytest.mark.parametrize("wrong", sorted(KERNELS - {"smooth_slopes"}))
def test_kernels_that_find_other_edges_are_not_used(
    wrong: str, launched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels, "module", on_cpu.without(wrong, kernels.module))
    monkeypatch.setenv("TORCHDOF_ENGINE", "auto")
    given = scene(2)
    with pytest.warns(RuntimeWarning, match=on_cpu.OTHER_PICTURE), on_cpu.new_memory_of_nan():
        blur_by_coc(*given)
    launched.clear()
    blur_by_coc(*given)
    assert launched and not KERNELS & {*launched}
