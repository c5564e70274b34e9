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


# Names, numbers and memory


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the command runs: an image and its depth."""
    monkeypatch.chdir(tmp_path)
    write_image("x.exr", Picture(tiny()))
    np.save("depth.npy", np.linspace(1, 4, 72).reshape(8, 9))
    return tmp_path


def render(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["render", *arguments, "--focus-m", "2"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, (result.stderr or result.stdout).strip()


@pytest.mark.parametrize("name", ["take #1/x.exr", "50%done/x.exr", "IMG #1.exr", "a##b.exr", "%d.exr", "x %03d.exr"])
def test_a_file_by_that_very_name_is_no_pattern(folder: Path, name: str) -> None:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    write_image(path, Picture(tiny()))
    np.save(path.with_suffix(".npy"), np.linspace(1, 4, 72).reshape(8, 9))
    out = path.with_name(f"out {path.name}")
    assert render(name, str(path.with_suffix(".npy")), "-o", str(out))[0] == 0
    assert read_image(out).pixels.shape == (1, 3, 8, 9)


def test_a_folder_may_be_called_like_a_pattern_in_a_sequence(folder: Path) -> None:
    (folder / "take #1").mkdir()
    for n in (1, 2):
        write_image(folder / f"take #1/shot.{n:04d}.exr", Picture(tiny()))
    assert render("take #1/shot.####.exr", "depth.npy", "-o", "take #1/out.%03d.exr")[0] == 0
    assert sorted(p.name for p in (folder / "take #1").glob("out*")) == ["out.001.exr", "out.002.exr"]


def test_a_single_image_is_written_where_it_is_told(folder: Path) -> None:
    assert render("x.exr", "depth.npy", "-o", "take #2.exr")[0] == 0 and (folder / "take #2.exr").is_file()
    code, said = render("x.exr", "depth.npy", "-o", "out.####.exr")
    assert code == 2 and said == "error: x.exr: is a single image; for a sequence write it as shot.####.exr"


@pytest.mark.parametrize("frames", ["0-300000000", "1-99999999999999999", "7"])
def test_a_range_of_frames_is_not_counted_out(folder: Path, frames: str) -> None:
    write_image("shot.0001.exr", Picture(tiny()))
    start = time.monotonic()
    code, said = render("shot.####.exr", "depth.npy", "-o", "out.####.exr", "--frames", frames)
    assert code == 2 and "there is no such file" in said and time.monotonic() - start < 5.0
    code, said = render("shot.####.exr", "depth.npy", "-o", "out.####.exr", "--frames", "9" * 5000)
    assert code == 2 and said.startswith("error: --frames expects first-last") and len(said) < 200
    code, said = render("shot.%099999999d.exr", "depth.npy", "-o", "out.####.exr")
    assert code == 2 and "must have at most 18 digits" in said


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--f-number", "0"), "--f-number must be positive"),
        (("--f-number", "1e-42"), "this lens (--focal-length-mm (not given) 50, --f-number 1e-42, --focus-m 2"),
        (("--sensor-width-mm", "1e-300"), "--sensor-width-mm 1e-300"),
        (("--focal-length-mm", "1e6"), "--focus-m must be longer than the focal length (1e+06 mm)"),
        (("--fov-deg", "40", "--aperture-radius-m", "1e45"), "--fov-deg 40, --aperture-radius-m 1e+45"),
        (("--fov-deg", "40", "--aperture-radius-m", "-1"), "--aperture-radius-m must be positive"),
        (("--fov-deg", "40", "--f-number", "1e-42"), "--f-number 1e-42"),
        (("--fill-depth", "1e-45", "--depth-unknown", "1"), "blurs a depth of 1.4e-45 m"),
    ],
)
def test_an_impossible_lens_is_named_by_its_option(folder: Path, arguments: tuple[str, ...], named: str) -> None:
    code, said = render("x.exr", "depth.npy", "-o", "out.exr", *arguments)
    assert code == 2 and named in said
    assert not any(word in said for word in ("coc_px", "check=False", "f_number", "focus_m", "_mm", "_deg"))
    assert not (folder / "out.exr").exists()


@pytest.mark.parametrize("link", ["x.exr", "depth.npy", "out.exr"])
def test_a_link_to_itself_is_refused_in_one_sentence(folder: Path, link: str) -> None:
    (folder / link).unlink(missing_ok=True)
    (folder / link).symlink_to(link)
    code, said = render("x.exr", "depth.npy", "-o", "out.exr")
    assert code == 2 and said.startswith(f"error: {link}: is a link that leads back to itself")
    assert (folder / link).is_symlink()


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 8 GiB for an array"),
        RuntimeError("std::bad_alloc"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: ..."),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 8 bytes."),
    ],
    ids=str,
)
def test_too_little_memory_is_one_sentence(folder: Path, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("torchdof.cli.frame.depth_of_field", fail)
    code, said = render("x.exr", "depth.npy", "-o", "out.exr")
    assert code == 2 and said.startswith("error: there is too little memory for this image")
    assert len(said.splitlines()) == 1


SMALL = """
import resource, sys
import torch, torchdof.cli.main, torchdof.cli.render, OpenImageIO
torch.set_num_threads(1)
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + (96 << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
torchdof.cli.main.app(sys.argv[1:])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
@pytest.mark.parametrize("engine", ["torch", "native"])
def test_memory_that_runs_out_while_rendering_is_one_sentence(
    folder: Path, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    write_image("big.exr", Picture(torch.rand(1, 3, 1000, 1500), sample="half"))
    np.save("big.npy", np.linspace(1, 9, 1_500_000, dtype=np.float32).reshape(1000, 1500))
    call = [sys.executable, "-c", SMALL, "render", "big.exr", "big.npy", "-o", "out.exr", "--focus-m", "2"]
    run = subprocess.run([*call, "--f-number", "1.4"], cwd=folder, capture_output=True, text=True, timeout=120)
    assert run.returncode == 2 and len(run.stderr.strip().splitlines()) == 1, run.stderr
    assert "memory" in run.stderr and not (folder / "out.exr").exists()
