"""Faults from outside: pictures that lie, disks that are full, writing that is interrupted."""

import io
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchdof import BlurTable
from torchdof.depth.reading import read_depth
from torchdof.io.images import Picture, read_image, read_values, write_image

pytestmark = pytest.mark.hard

FUZZ = settings(
    max_examples=max(100, settings().max_examples // 5),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def tiny() -> torch.Tensor:
    return torch.linspace(0, 1, 3 * 8 * 9).reshape(1, 3, 8, 9)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr", ".jpg", ".hdr", ".pfm"])
@FUZZ
@given(st.data())
def test_a_picture_with_bytes_changed_is_read_or_refused_by_name(suffix: str, tmp_path: Path, data: Any) -> None:
    path = tmp_path / f"x{suffix}"
    if not path.exists():
        write_image(tmp_path / f"whole{suffix}", Picture(tiny()))
        path.touch()
    content = bytearray((tmp_path / f"whole{suffix}").read_bytes())
    # mostly in the header, where sizes and offsets are
    places = st.integers(0, min(len(content), 400) - 1) | st.integers(0, len(content) - 1)
    for place, value in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), min_size=1, max_size=6)):
        content[place] = value
    path.write_bytes(content[: data.draw(st.integers(1, len(content)) | st.just(len(content)))])
    for read in (read_image, read_values):
        try:
            read(path)
        except (ValueError, OSError) as error:
            assert path.name in str(error)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
@FUZZ
@given(st.data())
def test_an_array_with_bytes_changed_is_read_or_refused_by_name(suffix: str, tmp_path: Path, data: Any) -> None:
    stored = io.BytesIO()
    array = np.linspace(1, 2, 12, dtype=np.float32).reshape(3, 4)
    np.save(stored, array) if suffix == ".npy" else np.savez_compressed(stored, depth=array)
    content = bytearray(stored.getvalue())
    places = st.integers(0, len(content) - 1)
    for place, value in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), min_size=1, max_size=6)):
        content[place] = value
    path = tmp_path / f"x{suffix}"
    path.write_bytes(content[: data.draw(st.integers(1, len(content)) | st.just(len(content)))])
    try:
        read_depth(path, fill="far")
    except (ValueError, OSError) as error:
        assert path.name in str(error)


def huge_png(path: Path) -> None:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", 200_000, 200_000, 16, 2, 0, 0, 0)
    pixels = chunk(b"IDAT", zlib.compress(b"0" * 100)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + pixels)


def huge_exr(path: Path) -> None:
    write_image(path, Picture(tiny()))
    content = bytearray(path.read_bytes())
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        start = content.index(name) + len(name) + 4
        content[start : start + 16] = struct.pack("<iiii", 0, 0, 1_000_000, 1_000_000)
    path.write_bytes(content)


def huge_hdr(path: Path) -> None:
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 900000 +X 900000\n" + bytes(100))


def huge_npy(path: Path) -> None:
    header = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }".ljust(117) + "\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode())


MEASURED = """
import resource, sys
from torchdof.bench import memory
from torchdof.io.images import read_image, read_values
resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
for read in (read_image, read_values):
    try:
        read(sys.argv[1])
        print("read")
    except (ValueError, OSError) as error:
        print("refused:", error)
print(memory.peak_mb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
@pytest.mark.parametrize(
    ("name", "make"), [("x.png", huge_png), ("x.exr", huge_exr), ("x.hdr", huge_hdr), ("x.npy", huge_npy)]
)
def test_huge_sizes_in_a_header_are_refused_without_the_memory(tmp_path: Path, name: str, make: Any) -> None:
    make(tmp_path / name)
    run = subprocess.run(
        [sys.executable, "-c", MEASURED, name], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, run.stderr[-500:]
    *said, megabytes = run.stdout.splitlines()
    assert len(said) == 2 and all(line.startswith("refused:") and name in line for line in said)
    assert float(megabytes) < 1500


def test_an_interruption_while_a_frame_is_written_leaves_nothing_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    (tmp_path / "x.exr").write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_image(tmp_path / "x.exr", Picture(tiny()))
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("x.exr", b"old")]


CUT = """
import os, resource, signal, sys, torch
from torchdof.io.images import Picture, read_image, write_image
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

KINDS = [(".png", "8"), (".png", "16"), (".exr", "half"), (".exr", "float"), (".tif", "float"), (".hdr", "float"),
         (".pfm", "float"), (".jpg", "8")]  # fmt: skip


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """Where a picture of each kind was written four times to a disk that was too full, in a folder each."""
    folder = tmp_path_factory.mktemp("cut")
    folders = [f"x{suffix} {sample}" for suffix, sample in KINDS]
    for name in folders:
        (folder / name).mkdir()
        (folder / name / name.split()[0]).write_text("old")
    call = [sys.executable, "-c", CUT, *folders]
    return folder, subprocess.run(call, cwd=folder, capture_output=True, text=True, timeout=120)


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files")
@pytest.mark.parametrize(("suffix", "sample"), KINDS)
def test_a_disk_that_is_full_at_the_last_byte_is_noticed(
    cut: tuple[Path, subprocess.CompletedProcess[str]], suffix: str, sample: str
) -> None:
    folder, run = cut
    name = f"x{suffix} {sample}"
    said = [line.removeprefix(name) for line in run.stdout.splitlines() if line.startswith(name)]
    assert len(said) == 4 and all(line.startswith(" refused:") for line in said), run.stdout + run.stderr
    assert (folder / name / f"x{suffix}").read_text() == "old"
    assert sorted(p.name for p in (folder / name).iterdir()) == [f"wholex{suffix}", f"x{suffix}"]


@pytest.mark.parametrize("what", ["table", "picture"])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / ("x.json" if what == "table" else "x.exr")
    path.write_text("old")

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        BlurTable.disc().save(path) if what == "table" else write_image(path, Picture(tiny()))
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [(path.name, "old")]


def test_writers_of_one_name_at_once_leave_one_whole_file(tmp_path: Path) -> None:
    script = """
import sys, torch
from torchdof.io.images import Picture, write_image
for _ in range(20):
    write_image("x.exr", Picture(torch.full((1, 3, 50, 60), float(sys.argv[1]))))
"""
    runs = [subprocess.Popen([sys.executable, "-c", script, value], cwd=tmp_path) for value in ("1", "2")]
    assert [run.wait(timeout=120) for run in runs] == [0, 0]
    assert read_image(tmp_path / "x.exr").pixels.unique().tolist() in ([1.0], [2.0])
    assert [p.name for p in tmp_path.iterdir()] == ["x.exr"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(PermissionError, match="may not write to the folder"):
            write_image(tmp_path / "x.exr", Picture(tiny()))
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize("missing", ["R", "G", "B"])
def test_a_missing_channel_is_named_with_those_that_are_there(tmp_path: Path, missing: str) -> None:
    import OpenImageIO as oiio

    names = tuple(c for c in "RGB" if c != missing)
    spec = oiio.ImageSpec(4, 3, 2, "float")
    spec.channelnames = names
    output = oiio.ImageOutput.create(str(tmp_path / "x.exr"))
    assert output is not None and output.open(str(tmp_path / "x.exr"), spec)
    assert output.write_image(np.ones((3, 4, 2), np.float32)) and output.close()
    with pytest.raises(ValueError, match="has no colour: expected channels R, G, B or Y, found"):
        read_image(tmp_path / "x.exr")
