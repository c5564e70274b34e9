"""Faults from outside: files that lie, disks that are full, a sequence that is interrupted, data that want to run."""

import io
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from torchdof import BlurTable, Camera, DepthOfField
from torchdof.cli.main import app
from torchdof.depth.reading import read_depth
from torchdof.export import describe
from torchdof.fit import FitError, read_captures
from torchdof.fit.lens.lens import Lens
from torchdof.io.images import Picture, read_image, read_values, write_image

pytestmark = pytest.mark.hard

FUZZ = settings(
    max_examples=max(100, settings().max_examples // 5),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def tiny() -> torch.Tensor:
    return torch.linspace(0, 1, 3 * 8 * 9).reshape(1, 3, 8, 9)


# Files that lie


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


# Tables, manifests and prescriptions

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
WHOLE_TABLE = json.dumps(
    BlurTable("ring", [0.1, 0.2], {"sigma": [0.1, 0.2], "r_c": [0.0, 0.1]}, unit="fraction").to_dict()
)


@FUZZ
@given(st.data())
def test_any_table_file_is_read_or_refused_by_name(tmp_path: Path, data: Any) -> None:
    path = tmp_path / "lens.json"
    fields = json.loads(WHOLE_TABLE)
    kind = data.draw(st.sampled_from(["bytes", "json", "fields", "cut", "changed"]))
    if kind == "bytes":
        path.write_bytes(data.draw(st.binary(max_size=60)))
    elif kind == "json":
        path.write_text(json.dumps(data.draw(JSON)))
    elif kind == "fields":
        wrong = data.draw(st.dictionaries(st.sampled_from([*fields, "sensor_width_mm", "other"]), JSON, max_size=3))
        path.write_text(json.dumps({**fields, **wrong}))
    elif kind == "cut":
        path.write_text(WHOLE_TABLE[: data.draw(st.integers(0, len(WHOLE_TABLE)))])
    else:
        place = data.draw(st.integers(0, len(WHOLE_TABLE) - 1))
        path.write_text(WHOLE_TABLE[:place] + data.draw(st.characters(codec="utf-8")) + WHOLE_TABLE[place + 1 :])
    try:
        table = BlurTable.load(path)
    except ValueError as error:
        assert "lens.json" in str(error)
    else:
        kernels = table.kernels(torch.tensor([-1.0, 1.0]), 10, size=5)
        assert torch.isfinite(kernels).all() and float(kernels.min()) >= 0


MANIFEST = """focus_m = 0.5
sharp = "sharp.png"
focal_length_mm = 50.0
dots = "one"
[[shot]]
file = "near.png"
distance_m = 0.4
"""
TOML_VALUES = st.one_of(
    st.floats().map(repr), st.integers(-(10**30), 10**30).map(str), st.booleans().map(lambda b: str(b).lower()),
    st.text(max_size=6).map(json.dumps), st.just("[]"), st.just("{}"), st.just("1979-05-27"), st.text(max_size=6),
)  # fmt: skip


@FUZZ
@given(st.integers(0, 7), TOML_VALUES, st.none() | st.integers(0, 120))
def test_any_manifest_is_refused_by_name(tmp_path: Path, line: int, value: str, cut: int | None) -> None:
    lines = MANIFEST.splitlines()
    if line < len(lines) and "=" in lines[line]:
        lines[line] = lines[line].partition("=")[0] + "= " + value
    else:
        lines.insert(line, f"{value} = {value}")
    (tmp_path / "capture.toml").write_bytes("\n".join(lines)[:cut].encode("utf-8", "surrogatepass"))
    # the pictures are not there: a manifest that is right ends in the name of one
    with pytest.raises((FitError, OSError, ValueError), match=r"capture\.toml|\.png|is not an image"):
        read_captures(tmp_path)


WHOLE_LENS = (Path(sys.modules[Lens.__module__].__file__ or "").parent / "lenses" / "wide_22mm.txt").read_text()


@FUZZ
@given(st.data())
def test_any_prescription_is_read_or_refused_by_name(tmp_path: Path, data: Any) -> None:
    path = tmp_path / "lens.txt"
    place = data.draw(st.integers(0, len(WHOLE_LENS) - 1))
    added = data.draw(st.text(max_size=4) | st.sampled_from(["nan", "-1", "inf", "1e999", "\n", "/0", "stop"]))
    cut = data.draw(st.integers(0, len(WHOLE_LENS)) | st.just(len(WHOLE_LENS)))
    text = (WHOLE_LENS[:place] + added + WHOLE_LENS[place + 1 :])[:cut]
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        Lens.read(path)
    except ValueError as error:
        assert "lens.txt" in str(error)


# Data that want to run


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("suffix", [".json", ".toml", ".txt", ".npy", ".npz", ".png", ".exr", ".onnx"])
def test_a_pickle_under_any_name_is_not_run(tmp_path: Path, suffix: str) -> None:
    bomb = pickle.dumps(Bomb(tmp_path / "ran"))
    path = tmp_path / f"bomb{suffix}"
    path.write_bytes(bomb)
    readers = {".json": BlurTable.load, ".toml": read_captures, ".txt": Lens.read, ".onnx": describe}
    with pytest.raises((ValueError, OSError), match="bomb"):
        readers.get(suffix, read_values)(path)  # type: ignore[operator]
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("value", ["__import__('pathlib').Path('ran').touch()", "!!python/object:x", "[1, 2", "NaN"])
def test_metadata_of_an_onnx_file_are_data(tmp_path: Path, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    node = onnx.helper.make_node("Identity", ["image"], ["out"])
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in ("image", "out")]
    model = onnx.helper.make_model(onnx.helper.make_graph([node], "g", values[:1], values[1:]))
    model.metadata_props.add(key="torchdof.options", value=value)
    onnx.save_model(model, tmp_path / "x.onnx")
    try:
        assert set(describe(tmp_path / "x.onnx")) == {"options"}
    except ValueError as error:
        assert str(error)
    assert not (tmp_path / "ran").exists()


def test_a_state_is_loaded_as_weights_only(tmp_path: Path) -> None:
    dof = DepthOfField(Camera(focus_m=1.5), BlurTable.load("sato_j15"))
    torch.save(dof.state_dict(), tmp_path / "dof.pt")
    other = DepthOfField(Camera())
    other.load_state_dict(torch.load(tmp_path / "dof.pt", weights_only=True))
    assert other.camera.focus_m == 1.5 and other.table.to_dict() == dof.table.to_dict()


# Disks and interruptions


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


FULL = """
import resource, signal, sys
import torchdof.cli.main, torchdof.cli.render, OpenImageIO  # before files may not grow any more
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200, resource.RLIM_INFINITY))
torchdof.cli.main.app(sys.argv[1:])
"""


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


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files")
def test_a_disk_that_fills_up_in_a_sequence_ends_it_in_one_sentence(tmp_path: Path) -> None:
    arguments = frames(tmp_path, 3)
    run = subprocess.run(
        [sys.executable, "-c", FULL, "render", *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 2 and run.stderr.splitlines()[-1].startswith("error: out.0001.exr: could not be")
    assert not list(tmp_path.glob("*out.*")) and not list(tmp_path.glob(".*"))


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
