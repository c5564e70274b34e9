"""Measurements of ``torchdof bench``: a new camera, the same camera again, a reference beside; and the report."""

import functools
import itertools
import math
import time

import pytest
import torch
from torch import Tensor

from torchdof import Camera
from torchdof.bench.measurement import BenchScene, Seconds, measure, peak_mb, peak_of, shipped

SCENE = shipped(36, 64)


def test_a_row_has_the_times_of_the_first_picture_the_second_and_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = itertools.chain([0.0, 4.0, 10.0, 11.0, 20.0, 22.0], itertools.repeat(0.0))
    monkeypatch.setattr(time, "perf_counter", lambda: next(ticks))
    calls: list[Tensor] = []

    def blur(image: Tensor, coc_px: Tensor) -> Tensor:
        calls.append(coc_px)
        return image

    picture, row = measure(blur, SCENE)
    assert picture is SCENE.image and len(calls) == 2
    assert (row["new_ms"], row["again_ms"], row["beside_ms"]) == (4000.0, 1000.0, 2000.0)
    assert "again_ms" not in measure(lambda image, _: (image, 1.0), SCENE, again=False)[1]


def test_ratios_are_of_cpu_time_and_a_tool_may_time_itself() -> None:
    taken = iter([Seconds(9.0, 6.0), Seconds(1.0, 2.0), 5.0])
    _, row = measure(lambda image, _: (image, next(taken)), SCENE)
    assert (row["cpu_ms"], row["over_again"]) == (6000.0, 3.0) and row["over_beside"] > 0.0
    _, row = measure(lambda image, _: (image, next(taken)), SCENE, again=False)
    assert row["new_ms"] == 5000.0 and math.isnan(row["over_beside"])  # the tool gives wall time only


def test_a_picture_that_is_not_finite_is_not_timed() -> None:
    with pytest.raises(RuntimeError, match="slope with posts: the picture is not finite"):
        measure(lambda image, _: image / 0.0, SCENE)


@pytest.mark.skipif(math.isnan(peak_mb()), reason="this system does not report the memory of a process")
def test_peak_memory_is_of_one_call_and_includes_freed_memory() -> None:
    def allocate(mib: int) -> float:
        return float(torch.ones(mib * 2**18).sum())

    for mib in (96, 64):  # above 32 MiB memory is taken from the system each time
        total, grown_mb = peak_of(functools.partial(allocate, mib))
        assert total == mib * 2**18 and grown_mb == pytest.approx(mib, rel=0.25, abs=4.0)


def test_a_new_camera_is_a_thin_lens_with_another_focus() -> None:
    depth = torch.linspace(1.0, 5.0, 64).expand(1, 1, 36, 64)
    given = Camera(50.0, 2.0, focus_m=2.0, focus_breathing=False).coc_px(depth, 64)
    scene = BenchScene("x", SCENE.image, given)
    focused = Camera(50.0, 2.0, focus_m=3.0, focus_breathing=False).coc_px(depth, 64)
    share = 2 * float((given - focused).mean() / (given.max() - given.min()))
    assert share > 0  # farther
    torch.testing.assert_close(scene.seen(share, float(focused.abs().max())).coc_px, focused, rtol=1e-4, atol=1e-5)


def test_cameras_differ_from_each_other_and_a_seed_repeats_them() -> None:
    cameras, widest = SCENE.cameras(8, "a"), float(SCENE.coc_px.abs().max())
    radii = [float(camera.coc_px.abs().max()) for camera in cameras]
    assert len({*radii, widest}) == 9 and all(0.7 * widest <= radius <= widest for radius in radii)
    assert all(torch.equal(a.coc_px, b.coc_px) for a, b in zip(cameras, SCENE.cameras(8, "a"), strict=True))
    assert not torch.equal(cameras[0].coc_px, SCENE.cameras(1, "b")[0].coc_px)
    flat = BenchScene("flat", SCENE.image, torch.full_like(SCENE.coc_px, 3.0))
    assert torch.equal(flat.seen(0.4, 3.0).coc_px, flat.coc_px), "one plane stays blurred"
    assert not SCENE.seen(0.0, 0.0).seen(0.4, 0.0).coc_px.any()
