"""Faults from outside: pictures that lie, disks that are full, writing that is interrupted."""

import io
import os
import re
import signal
import struct
import subprocess
import sys
import zipfile
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


# What is killed while it writes

WRITING = """
import signal, sys, time
from torchdof.io.atomic import whole_file
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, and stays so
with whole_file(sys.argv[1]) as part:
    part.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)
"""


def killed_while_writing(path: Path, number: int) -> int:
    """The exit status of a process that a signal reached while it wrote a file."""
    with subprocess.Popen([sys.executable, "-c", WRITING, str(path)], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None and run.stdout.readline() == "writing\n"
        run.send_signal(number)
        return run.wait(timeout=30)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_termination_while_a_file_is_written_leaves_nothing_of_it(tmp_path: Path, number: int) -> None:
    (tmp_path / "x.exr").write_text("old")
    assert killed_while_writing(tmp_path / "x.exr", number) == -number
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("x.exr", "old")]


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_what_a_killed_process_left_is_removed_by_the_next_that_writes_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchdof.io import atomic

    killed_while_writing(tmp_path / "x.exr", signal.SIGKILL)
    (left,) = tmp_path.iterdir()
    owner = left.name.split(".")[2].split("-")
    mine = tmp_path / ".y.exr-like.part"
    elsewhere = left.with_name(left.name.replace(owner[0], "0" * 8))  # of a process of another machine
    with subprocess.Popen([sys.executable, "-c", WRITING, str(tmp_path / "z.exr")], stdout=subprocess.PIPE) as living:
        assert living.stdout is not None and living.stdout.readline() == b"writing\n"
        others = {p.name for p in tmp_path.iterdir()} - {left.name}
        mine.write_text("of somebody else")
        elsewhere.write_text("of another machine")
        monkeypatch.setattr(atomic, "_tidied", set())
        BlurTable.disc().save(tmp_path / "table.json")
        assert {p.name for p in tmp_path.iterdir()} == {mine.name, elsewhere.name, "table.json", *others}
        living.kill()


def test_a_handler_of_the_caller_is_left_alone(tmp_path: Path) -> None:
    def handler(*_: Any) -> None: ...

    before = signal.signal(signal.SIGTERM, handler)
    try:
        BlurTable.disc().save(tmp_path / "x.json")
        assert signal.getsignal(signal.SIGTERM) is handler
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        BlurTable.disc().save(tmp_path / "x.json")
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)


# Files that are not what they are called


@pytest.mark.parametrize("name", ["x.png", "x.npy", "x.npz", "x.exr", "x.pfm"])
def test_a_link_to_itself_is_refused_for_reading_and_writing(tmp_path: Path, name: str) -> None:
    (tmp_path / name).symlink_to(tmp_path / name)
    (tmp_path / "table.json").symlink_to("other.json")
    (tmp_path / "other.json").symlink_to("table.json")
    with pytest.raises(OSError, match=f"{name}: is a link that leads back to itself"):
        read_values(tmp_path / name)
    if name in ("x.png", "x.exr", "x.pfm"):
        with pytest.raises(OSError, match=f"{name}: is a link that leads back to itself"):
            write_image(tmp_path / name, Picture(tiny()))
    with pytest.raises(OSError, match="table.json: is a link that leads back to itself"):
        BlurTable.disc().save(tmp_path / "table.json")
    assert (tmp_path / name).is_symlink() and (tmp_path / "table.json").is_symlink()


@pytest.mark.parametrize("member", ["depth.txt", "depth", "depth.npy"])
def test_members_of_an_npz_that_are_no_arrays_are_refused(tmp_path: Path, member: str) -> None:
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr(member, "no array")
    with pytest.raises(ValueError, match=r"x\.npz: cannot be read as an array"):
        read_values(tmp_path / "x.npz")


SILENT = """
import sys
from pathlib import Path
from torchdof.io.images import read_image
content = Path(sys.argv[1]).read_bytes()
for end in range(1, len(content), 1 + len(content) // 50):
    Path("x" + sys.argv[2]).write_bytes(content[:end])
    try:
        read_image("x" + sys.argv[2])
    except (ValueError, OSError):
        pass
for place in range(0, len(content), 1 + len(content) // 100):
    Path("x" + sys.argv[2]).write_bytes(content[:place] + bytes([content[place] ^ 77]) + content[place + 1 :])
    try:
        read_image("x" + sys.argv[2])
    except (ValueError, OSError):
        pass
"""


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".exr", ".hdr", ".pfm"])
def test_no_library_prints_a_line_of_its_own_about_a_damaged_picture(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / f"whole{suffix}", Picture(tiny()))
    call = [sys.executable, "-c", SILENT, f"whole{suffix}", suffix]
    run = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def a_million_pixels(path: Path) -> None:
    """Whole pictures as their headers go, of 1024 x 1024 pixels, in small files."""
    picture = torch.zeros(1, 3, 1, 1).expand(1, 3, 1024, 1024)
    if path.suffix in (".npy", ".npz"):
        zeros = np.zeros((1024, 1024), np.float32)
        np.save(path, zeros) if path.suffix == ".npy" else np.savez_compressed(path, depth=zeros)
    else:
        write_image(path, Picture(picture, sample="float" if path.suffix != ".png" else "16"))


LITTLE_MEMORY = """
import resource, sys
from torchdof.io.images import read_image, read_values
import OpenImageIO
from torchdof.io.memory import free_bytes
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + (4 << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
assert free_bytes() <= 4 << 20
try:
    (read_values if sys.argv[1].endswith(("y", "z")) else read_image)(sys.argv[1])
except (ValueError, OSError) as error:
    print("refused:", error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
@pytest.mark.parametrize("name", ["x.png", "x.exr", "x.tif", "x.pfm", "x.npy", "x.npz"])
def test_a_picture_that_memory_cannot_hold_is_refused_before_it_is_read(tmp_path: Path, name: str) -> None:
    a_million_pixels(tmp_path / name)
    call = [sys.executable, "-c", LITTLE_MEMORY, name]
    run = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr[-500:]
    assert re.match(
        rf"refused: {name}: .*(GiB of memory are free|more than there is memory for|Cannot allocate)", run.stdout
    )
