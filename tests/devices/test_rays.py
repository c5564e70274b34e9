"""Rays that a kernel blocks are those of the plain engine; kernel and host code run on the CPU."""

from typing import Any

import pytest
import torch

from tests import on_cpu
from tests.scenes import assert_same_picture, post_before_lamps
from torchdof import blur_by_coc, native
from torchdof.kernels import rays
from torchdof.render import highlights
from torchdof.render.engines import on_gpu


def random_rays(seed: int) -> tuple[Any, ...]:
    """Highlights anywhere in frames of one or two items, and surfaces in bins; many rays leave the frame."""
    dice = torch.Generator().manual_seed(seed)
    count, bins, surfaces, items = (int(torch.randint(1, most, (), generator=dice)) for most in (9, 7, 4, 3))
    height, width, side = ((17, 23, 9), (1, 12, 41), (30, 1, 1), (8, 40, 65))[seed % 4]
    at = [torch.randint(0, most, (count,), generator=dice) for most in (items, height, width)]
    scale = 4.0 * torch.rand(count, bins, generator=dice) - 2.0
    fades, wanted = torch.rand(count, bins, generator=dice), torch.rand(count, bins, generator=dice) > 0.3
    place = (bins + 1.0) * torch.rand(surfaces, items, height, width, generator=dice)
    step = torch.arange(-(side // 2), side // 2 + 1)
    return scale, fades, wanted, at, step, [place, torch.rand(place.shape, generator=dice)]


@pytest.mark.parametrize("seed", range(12))
def test_blocked_rays_are_the_plain_engines(seed: int, launched: list[str]) -> None:
    given = random_rays(seed)
    found = on_gpu.blocked(highlights._blocked, *given)
    assert "block_rays" in launched
    torch.testing.assert_close(found, highlights._blocked(*given), atol=1e-6, rtol=1e-5)
    assert torch.equal(found, on_gpu.blocked(highlights._blocked, *given))


def test_without_highlights_nothing_is_launched(launched: list[str]) -> None:
    scale, fades, wanted, at, step, shown = random_rays(0)
    on_gpu.blocked(highlights._blocked, scale, fades, wanted, at, step, shown)  # the trial
    launched.clear()
    scale, fades, wanted, *at = (t[:0] for t in (scale, fades, wanted, *at))
    found = on_gpu.blocked(highlights._blocked, scale, fades, wanted, at, step, shown)
    assert found.shape == (0, len(step), len(step))
    assert not launched


@pytest.mark.parametrize("wrong", [None, "block_rays"])
def test_pictures_have_the_plain_engines_rays(
    wrong: str | None, launched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the kernel fails in the trial; with gradients PyTorch blocks them."""
    monkeypatch.setattr(native, "_library", lambda: (None, "switched off"))
    light, coc_px = post_before_lamps(2)
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    expected = blur_by_coc(light, coc_px)
    monkeypatch.setenv("TORCHDOF_ENGINE", "auto" if wrong else "gpu")
    if wrong:
        monkeypatch.setattr(rays, "module", on_cpu.without(wrong, rays.module))
        with pytest.warns(RuntimeWarning, match=on_cpu.OTHER_PICTURE), on_cpu.new_memory_of_nan():
            found = blur_by_coc(light, coc_px)
    else:
        found = blur_by_coc(light, coc_px)
    assert ("block_rays" in launched) != bool(wrong)
    assert_same_picture(expected, found, light)
    launched.clear()
    blur_by_coc(light, coc_px.clone().requires_grad_())
    assert launched and "block_rays" not in launched
