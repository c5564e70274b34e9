"""A file is written whole or not at all: on full disks, and when the process ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.files import as_an_ordinary_user
from tests.processes import output_of
from torchdof import BlurTable
from torchdof.io.atomic import atomic_file, check_writable
from torchdof.io.images import Picture, write_image

pytestmark = pytest.mark.hard

PICTURE = Picture(torch.linspace(0, 1, 3 * 8 * 9).reshape(1, 3, 8, 9))


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_no_other(
    error: type[BaseException], step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise error

    for name in ("x.exr", "x.json"):
        (tmp_path / name).write_text("old")
    monkeypatch.setattr(os, step, fail)
    for write in (lambda: write_image(tmp_path / "x.exr", PICTURE), lambda: BlurTable.disc().save(tmp_path / "x.json")):
        with pytest.raises(error):
            write()
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"x.exr": "old", "x.json": "old"}


CUT = """
import os, resource, signal, sys, torch
from torchdof.io.images import Picture, write_image
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
picture = Picture(torch.linspace(0, 1, 3 * 30 * 40).reshape(1, 3, 30, 40))
for folder in sys.argv[1:]:
    name, sample = folder.split()
    os.chdir(folder)
    write_image("whole" + name, picture, sample=sample)
    size = len(open("whole" + name, "rb").read())
    for limit in (size - 1, size - 3, size // 2, 100):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        try:
            write_image(name, picture, sample=sample)
            print(folder, "written")
        except OSError as error:
            print(folder, "refused:", error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    os.chdir("..")
"""
KINDS = (".png 8", ".png 16", ".exr half", ".exr float", ".tif float", ".hdr float", ".pfm float", ".jpg 8")


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files")
def test_a_full_disk_is_an_error_and_leaves_the_old_file(tmp_path: Path) -> None:
    folders = [f"x{kind}" for kind in KINDS]
    for name in folders:
        (tmp_path / name).mkdir()
        (tmp_path / name / name.split()[0]).write_text("old")
    lines = output_of(CUT, *folders, cwd=tmp_path).splitlines()
    for name in folders:
        results = [line.removeprefix(name) for line in lines if line.startswith(name)]
        assert len(results) == 4 and all(line.startswith(" refused:") for line in results), lines
        file = name.split()[0]
        assert sorted(p.name for p in (tmp_path / name).iterdir()) == [f"whole{file}", file]
        assert (tmp_path / name / file).read_text() == "old"


WRITING = """
import signal, sys, time
from torchdof.io.atomic import atomic_file, check_writable
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup would have set it to be ignored
with atomic_file(sys.argv[1]) as outer, atomic_file(sys.argv[1] + ".json") as inner:
    outer.write_bytes(b"half")
    inner.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)
"""


def writing(path: Path) -> subprocess.Popen[str]:
    """A process that is writing two files."""
    run = subprocess.Popen([sys.executable, "-c", WRITING, str(path)], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None and run.stdout.readline() == "writing\n"
    return run


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_termination_during_a_write_removes_the_temporary_files(tmp_path: Path, number: int) -> None:
    (tmp_path / "x.exr").write_text("old")
    with writing(tmp_path / "x.exr") as run:
        run.send_signal(number)
        assert run.wait(timeout=30) == 128 + number
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("x.exr", "old")]


def test_a_signal_handler_of_the_caller_is_kept(tmp_path: Path) -> None:
    def handler(*_: Any) -> None: ...

    before = signal.signal(signal.SIGTERM, handler)
    try:
        for mine in (handler, signal.SIG_DFL):
            signal.signal(signal.SIGTERM, mine)
            BlurTable.disc().save(tmp_path / "x.json")
            assert signal.getsignal(signal.SIGTERM) == mine
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_link_is_followed_and_kept(tmp_path: Path) -> None:
    (tmp_path / "real.png").write_text("old")
    (tmp_path / "link.png").symlink_to(tmp_path / "real.png")
    with atomic_file(tmp_path / "link.png") as part:
        part.write_text("new")
    assert (tmp_path / "link.png").is_symlink()
    assert (tmp_path / "real.png").read_text() == "new"


def test_a_folder_or_file_that_is_read_only_is_named_and_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", as_an_ordinary_user)
    (tmp_path / "x.exr").write_text("old")
    (tmp_path / "x.exr").chmod(0o444)
    with pytest.raises(PermissionError, match=r"x\.exr: is read-only; make it writable or name another file"):
        write_image(tmp_path / "x.exr", PICTURE)
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(PermissionError, match="may not write to the folder"):
            write_image(tmp_path / "y.exr", PICTURE)
        for path in (tmp_path / "x.exr", tmp_path / "missing" / "y.exr"):
            with pytest.raises(PermissionError, match="is read-only|may not write to the folder"):
                check_writable(path)
    finally:
        tmp_path.chmod(0o700)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("x.exr", "old")]


def test_concurrent_writers_of_one_file_leave_it_whole(tmp_path: Path) -> None:
    with atomic_file(tmp_path / "x.txt") as first:
        first.write_text("first")
        with atomic_file(tmp_path / "x.txt") as second:
            assert second != first
            second.write_text("second")
        assert (tmp_path / "x.txt").read_text() == "second"
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("x.txt", "first")]
