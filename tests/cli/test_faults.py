"""Interrupted sequences, frames that cannot be read or written, too little memory, and the progress bar."""

import functools
import io
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.files import as_an_ordinary_user
from torchdof.cli import output, renderer
from torchdof.io.images import Picture, read_image, write_image

pytestmark = pytest.mark.hard

SEQUENCE = "render shot.####.exr depth.npy -o out.####.exr --focus-m 2 --f-number 1.2 --sensor-width-mm 4"


def copies(folder: Path, count: int) -> None:
    for n in range(4, count + 1):
        os.link(folder / "shot.0001.exr", folder / f"shot.{n:04d}.exr")


def handle_interrupts() -> None:
    """Undoes the shell's "ignore SIGINT" for background jobs, which a child process would inherit."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_sequence_keeps_its_complete_frames_and_resumes(
    scene: Path, run: Callable[..., str], number: signal.Signals
) -> None:
    count = 400
    copies(scene, count)
    command = [sys.executable, "-m", "torchdof", *SEQUENCE.split()]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=handle_interrupts
    ) as process:
        deadline = time.monotonic() + 60
        while len(list(scene.glob("out.*.exr"))) < 5 and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.002)
        process.send_signal(number)
        output, errors = process.communicate(timeout=60)
    assert process.returncode in (128 + number, -number), errors  # Python may end itself by SIGINT: 130 for the shell
    assert errors == (b"interrupted\n" if number == signal.SIGINT else b"")
    done = sorted(scene.glob("out.*.exr"))
    assert 5 <= len(done) < count
    assert not list(scene.glob(".*")), "a partial file was left"
    assert [line.split(b":")[0].decode() for line in output.splitlines()] == [path.name for path in done]
    assert all(read_image(path).pixels.shape == (1, 3, 16, 24) for path in done)
    before = {path: path.stat().st_mtime_ns for path in done}
    for path in sorted(scene.glob("shot.*"))[len(done) + 3 :]:
        path.unlink()  # three more frames are enough
    assert run(f"{SEQUENCE} --resume").startswith(f"{len(done)} of {len(done) + 3} frames are there already")
    assert len(list(scene.glob("out.*.exr"))) == len(done) + 3
    assert {path: path.stat().st_mtime_ns for path in done} == before


@pytest.mark.parametrize("streams", ["<&- >&- 2>&-", "2>/dev/full"])
def test_a_picture_is_written_where_nobody_can_be_told(scene: Path, streams: str) -> None:
    line = "-m torchdof render shot.0001.exr depth.npy -o out.exr --focus-m 2000"  # gives a warning
    run = subprocess.run(["sh", "-c", f"{sys.executable} {line} {streams}"], timeout=120, check=False)
    assert run.returncode == 0
    assert read_image(scene / "out.exr").pixels.shape == (1, 3, 16, 24)


@pytest.mark.parametrize("broken", ["shot.0003.exr", "out.0003.exr"])
def test_a_frame_that_cannot_be_read_or_written_stops_the_sequence_and_is_named(
    scene: Path, run: Callable[..., str], broken: str
) -> None:
    copies(scene, 5)
    if broken.startswith("shot"):
        Path(broken).write_bytes(Path(broken).read_bytes()[:200])
    else:
        Path(broken).mkdir()
    message = run(SEQUENCE, code=2)
    assert message.startswith(f"error: {broken}: ") and message.count("\n") == 1
    done = sorted(path.name for path in scene.glob("out.*.exr") if path.is_file())
    assert done[:2] == ["out.0001.exr", "out.0002.exr"] and "out.0005.exr" not in done and not list(scene.glob(".*"))


@pytest.mark.parametrize(
    "line",
    [
        "render broken.exr depth.npy -o kept/x.exr --focus-m 2",
        "render broken.exr depth.npy -o x.exr --focus-m 2 --sheet kept/x.png",
        "render shot.####.exr broken.exr -o kept/more/x.####.exr --focus-m 2",
        "inspect broken.exr depth.npy -o kept/x.png",
        "bench --table nowhere --out kept/x",
        "bench broken.exr depth.npy --out kept",
        "fit nowhere -o kept/x.json",
        "fit nowhere -o x.json --plots kept/x",
        "fit --lens nowhere -o old.json",
        "export -o kept/x.onnx --table nowhere",
    ],
)
def test_commands_refuse_to_write_what_is_read_only_before_they_read_or_compute(
    line: str, scene: Path, run: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", as_an_ordinary_user)
    Path("broken.exr").write_bytes(b"no picture")
    Path("old.json").write_text("old")
    Path("old.json").chmod(0o400)
    Path("kept").mkdir(0o500)
    before = {*scene.rglob("*")}
    message = run(line, code=2)
    assert re.fullmatch(r"error: \S+: (may not write to the folder|is read-only).*\n", message), message
    assert {*scene.rglob("*")} == before and Path("old.json").read_text() == "old"


def test_the_next_frame_is_read_and_the_last_written_while_one_is_rendered(
    scene: Path, run: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    barrier = threading.Barrier(3)  # passes only if all three steps run at the same time

    def waiting(self: renderer.Renderer, step: Callable[..., Any], out: str, *arguments: Any, **named: Any) -> Any:
        if out in repr(arguments):
            barrier.wait(20)
        return step(self, *arguments, **named)

    for name, out in (("read", "shot.0003"), ("render", "out.0002"), ("write", "out.0001")):
        original = getattr(renderer.Renderer, name)
        monkeypatch.setattr(renderer.Renderer, name, functools.partialmethod(waiting, original, out))
    assert [line[:12] for line in run(SEQUENCE).splitlines()] == [f"out.000{n}.exr" for n in (1, 2, 3)]


@pytest.mark.parametrize("frames", ["0-300000000", "1-99999999999999999", "7", "9" * 5000])
def test_a_huge_range_of_frames_is_refused_at_once(scene: Path, run: Callable[..., str], frames: str) -> None:
    start = time.monotonic()
    message = run(f"{SEQUENCE} --frames", frames, code=2)
    assert "frames are missing" in message or "--frames expects FIRST-LAST" in message
    assert time.monotonic() - start < 5.0 and len(message) < 200


LIMITED = """
import resource, sys
import torch, torchdof.cli.main, torchdof.cli.renderer, OpenImageIO
torch.set_num_threads(1)
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + (96 << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
torchdof.cli.main.app(sys.argv[1:])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
@pytest.mark.parametrize("engine", ["torch", "native"])
def test_a_real_lack_of_memory_while_rendering_gives_one_sentence(
    scene: Path, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    write_image("big.exr", Picture(torch.rand(1, 3, 1000, 1500), sample="half"))
    np.save("big.npy", np.linspace(1, 9, 1_500_000, dtype=np.float32).reshape(1000, 1500))
    call = [sys.executable, "-c", LIMITED, "render", "big.exr", "big.npy", "-o", "out.exr", "--focus-m", "2"]
    process = subprocess.run([*call, "--f-number", "1.4"], capture_output=True, text=True, timeout=120)
    assert process.returncode == 2 and len(process.stderr.strip().splitlines()) == 1, process.stderr
    assert "memory" in process.stderr and not (scene / "out.exr").exists()


class Terminal(io.StringIO):
    """Standard error as a terminal."""

    def isatty(self) -> bool:
        return True


def test_a_step_shows_a_bar_on_the_terminal_and_results_still_go_to_the_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal, file = Terminal(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys, "stdout", file)
    monkeypatch.setenv("TERM", "xterm")
    with output.progress_bar("", 4) as update:
        for done in range(3):
            time.sleep(0.4)
            update(f"frame {done + 1} of 4", done)
        time.sleep(0.5)
        output.print_result(True, {"out": "a.png"}, "")
    assert "frame 3 of 4" in terminal.getvalue() and re.search(r"0:00:0[01]\S* \S*0:00:0[0-3]", terminal.getvalue())
    with output.progress_bar("rendering [out].png"):
        time.sleep(0.5)
    assert "rendering [out].png" in terminal.getvalue()
    assert file.getvalue() == '{"out": "a.png"}\n' and "a.png" not in terminal.getvalue()
