"""A sequence that is interrupted, a disk that fills up, names that clash."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from torchdof.cli.main import app
from torchdof.io.images import Picture, read_image, write_image

pytestmark = pytest.mark.hard


def tiny() -> torch.Tensor:
    return torch.linspace(0, 1, 3 * 8 * 9).reshape(1, 3, 8, 9)


def frames(folder: Path, count: int) -> list[str]:
    for n in range(1, count + 1):
        write_image(folder / f"shot.{n:04d}.exr", Picture(tiny() * n, sample="float"))
    np.save(folder / "depth.npy", np.linspace(1, 4, 72).reshape(8, 9))
    return ["shot.####.exr", "depth.npy", "-o", "out.####.exr", "--focus-m", "2"]


def heed_interrupts() -> None:
    """Tests that run in the background of a shell are told to ignore them, and so would be what they start."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_an_interrupted_sequence_keeps_what_is_whole_and_resumes(tmp_path: Path) -> None:
    count = 400
    arguments = frames(tmp_path, count)
    command = [sys.executable, "-m", "torchdof", "render", *arguments]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=heed_interrupts,
    ) as run:
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("out.*"))) < 5 and time.monotonic() < deadline and run.poll() is None:
            time.sleep(0.002)
        run.send_signal(signal.SIGINT)
        _, said = run.communicate(timeout=60)
    assert run.returncode not in (0, -signal.SIGSEGV), said
    done = sorted(tmp_path.glob("out.*.exr"))
    assert 5 <= len(done) < count
    assert not list(tmp_path.glob(".*")), "a part was left behind"
    for path in done:
        assert read_image(path).pixels.shape == (1, 3, 8, 9)
    before = {path: path.stat().st_mtime_ns for path in done}
    for path in sorted(tmp_path.glob("shot.*"))[len(done) + 3 :]:
        path.unlink()  # three more are enough to see that it goes on
    again = subprocess.run([*command, "--resume"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert again.returncode == 0, again.stderr
    assert again.stdout.startswith(f"{len(done)} of {len(done) + 3} frames are there already")
    assert len(list(tmp_path.glob("out.*.exr"))) == len(done) + 3
    assert {path: path.stat().st_mtime_ns for path in done} == before


FULL = """
import resource, signal, sys
import torchdof.cli.main, torchdof.cli.render, OpenImageIO  # before files may not grow any more
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200, resource.RLIM_INFINITY))
torchdof.cli.main.app(sys.argv[1:])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files")
def test_a_disk_that_fills_up_in_a_sequence_ends_it_in_one_sentence(tmp_path: Path) -> None:
    arguments = frames(tmp_path, 3)
    run = subprocess.run(
        [sys.executable, "-c", FULL, "render", *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 2 and run.stderr.splitlines()[-1].startswith("error: out.0001.exr: could not be")
    assert not list(tmp_path.glob("*out.*")) and not list(tmp_path.glob(".*"))


def test_two_frames_never_share_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = frames(tmp_path, 2)
    arguments[3] = "out.exr"
    result = CliRunner().invoke(app, ["render", *arguments])
    assert result.exit_code == 2 and "expected one place for the frame number" in result.stderr
    arguments[3] = "shot.####.exr"
    result = CliRunner().invoke(app, ["render", *arguments])
    assert result.exit_code == 2 and "is one of the inputs" in result.stderr
    arguments[3] = "depth.npy"
    before = (tmp_path / "depth.npy").read_bytes()
    result = CliRunner().invoke(app, ["render", *arguments])
    assert result.exit_code == 2 and (tmp_path / "depth.npy").read_bytes() == before
