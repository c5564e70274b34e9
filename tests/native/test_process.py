"""The compiled engine in a process: threads, interrupts, instruction sets; its convolution and its choice."""

import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch

from tests import loops
from tests.processes import output_of
from tests.scenes import Scene, assert_same_picture, made
from torchdof import blur_by_coc, native


@pytest.fixture(autouse=True)
def _by_the_compiled_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")


def scenes() -> list[Scene]:
    """With and without occlusion, masked pixels, a background; all with highlights."""
    scene = made("smooth", 140, 170, 14.0, lamps=1000.0)
    masked = torch.where(torch.rand(scene.coc_px.shape) < 0.02, torch.nan, scene.coc_px)
    background = {"background": scene.image.flip(3), "background_coc_px": scene.coc_px + 3.3}
    options: list[dict[str, Any]] = [{}, {"occlusion": False}, background]
    return [Scene(scene.image, masked, {"check": False}), *(Scene(scene.image, scene.coc_px, o) for o in options)]


def test_bits_do_not_depend_on_threads_and_pictures_not_on_the_instruction_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = torch.get_num_threads()
    for scene in scenes():
        wanted = scene.blurred()
        try:
            for threads in (1, 2, 3):
                torch.set_num_threads(threads)
                assert torch.equal(scene.blurred(), wanted)
        finally:
            torch.set_num_threads(before)
        with monkeypatch.context() as patched:
            patched.setattr(native, "_instructions", "baseline")
            assert native.describe() == "native (baseline)"
            assert_same_picture(wanted, scene.blurred(), scene.image)


def test_python_threads_may_render_concurrently() -> None:
    given = [*scenes(), *scenes()]
    wanted = [scene.blurred() for scene in given]
    with ThreadPoolExecutor(4) as pool:
        for picture, alone in zip(pool.map(Scene.blurred, given), wanted, strict=True):
            assert torch.equal(picture, alone)


INTERRUPTED = """
import os, signal, sys, threading, time, torch
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start background jobs with SIGINT ignored
os.environ["TORCHDOF_ENGINE"] = "native"
import torchdof
from torchdof.render.layers.plan import Plan
torch.set_num_threads(1)
image, coc_px = torch.rand(1, 3, 3000, 4000), torch.linspace(-40.0, 40.0, 4000).expand(1, 1, 3000, 4000).contiguous()
image[..., ::50, ::50] *= 1000.0
plan = Plan.for_scene(coc_px, 0.1 / 255, adapt=False)
torchdof.blur_by_coc(image[..., :40], coc_px[..., :40], plan=plan, tolerance=0.1 / 255)  # its kernels are kept
sent = []
def interrupt():
    sent.append(time.monotonic())
    os.kill(os.getpid(), signal.SIGINT)
threading.Timer(1.0, interrupt).start()
try:
    torchdof.blur_by_coc(image, coc_px, plan=plan, tolerance=0.1 / 255)
    print("not interrupted")
except KeyboardInterrupt:
    late = time.monotonic() - sent[0]
    small = torchdof.blur_by_coc(image[..., :40, :40], coc_px[..., :40, :40])  # the engine still works
    print("in time" if late < 1.0 and bool(small.isfinite().all()) else f"after {late} s")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a process of Windows cannot send itself Ctrl-C")
def test_ctrl_c_ends_a_long_rendering() -> None:
    assert output_of(INTERRUPTED, flags=["-I"]) == "in time\n"


INTERRUPTED_TWICE = """
import ctypes, os, signal, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from torchdof import blur_by_coc, native
cancelled, ended = ctypes.c_int32(0), []
def engine():
    while not cancelled.value:
        time.sleep(0.01)
    time.sleep(0.5)
    ended.append(True)
for seconds in (0.2, 0.4):
    threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    native._interruptible(engine, cancelled, 1 << 30)
except KeyboardInterrupt:
    print("after the engine" if ended else "while the engine runs")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a process of Windows cannot send itself Ctrl-C")
def test_ctrl_c_is_raised_after_the_engine_has_stopped() -> None:
    """Otherwise the engine would use memory that its caller has freed."""
    assert output_of(INTERRUPTED_TWICE, flags=["-I"]) == "after the engine\n"


@pytest.mark.parametrize("half", [0, 1, 2, 3, 7, 8, 10, 20, 64])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 6), (16, 16), (19, 37)])
def test_convolution_scatters_an_asymmetric_kernel(height: int, width: int, half: int) -> None:
    light, kernel = torch.rand(height, width), torch.rand(2 * half + 1, 2 * half + 1)
    wanted = loops.scatter(light[None, None], lambda *_: kernel[None])[0, 0].float()
    padded = torch.nn.functional.pad(light, (half,) * 4)[None]
    surface = (padded, torch.zeros_like(padded[0]), None)
    out = native.blend([surface], half, (height, width), [0.0], [(kernel[None], 1)], False, False)[0]
    torch.testing.assert_close(out, wanted, rtol=1e-5, atol=1e-6)


# Choice of the engine by ``TORCHDOF_ENGINE``


def test_an_engine_of_another_version_is_not_used_and_gives_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCHDOF_ENGINE", raising=False)
    monkeypatch.setattr(native, "_API", native._API._replace(checksum=0))  # that of another header
    native._loaded.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="of another version of torchdof, and is not used: install"):
            assert not native.chosen()
        assert native.describe() == "torch (the compiled engine is of another version of torchdof)"
        monkeypatch.setenv("TORCHDOF_ENGINE", "native")
        with pytest.raises(ValueError, match="is native, but the compiled engine is of another version"):
            native.chosen()
    finally:
        native._loaded.cache_clear()


def test_an_unknown_engine_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "numpy")
    for call in (native.describe, lambda: blur_by_coc(torch.rand(1, 3, 3, 4), torch.full((1, 1, 3, 4), 3.0))):
        with pytest.raises(ValueError, match="must be auto, native, gpu or torch, got 'numpy'"):
            call()
