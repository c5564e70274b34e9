"""Damaged, malicious, too large and unsupported files are refused with their name, in one line, without side effects.

tests/fuzz changes arbitrary bytes of files.
"""

import os
import shutil
import struct
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from tests.files import spec_with, store, store_parts
from torchdof import BlurTable
from torchdof.io import decode, paths
from torchdof.io.decode import MAX_ATTRIBUTES
from torchdof.io.images import Picture, read_image, read_values, write_image

pytestmark = pytest.mark.hard

Made = Callable[[Path], object]
KINDS = {".png": "8", ".tif": "float", ".exr": "half", ".jpg": "8", ".hdr": "float", ".pfm": "float"}


def tiny(height: int = 8, width: int = 9) -> Picture:
    return Picture(torch.linspace(0, 1, 3 * height * width).reshape(1, 3, height, width))


def with_bytes(content: bytes) -> Made:
    return lambda path: path.write_bytes(content)


def with_values(values: np.ndarray, *names: str, kind: str = "float", tags: dict[int, int] | None = None) -> Made:
    """Writes a file with OpenImageIO alone, then changes ``tags`` of a TIFF."""

    def make(path: Path) -> None:
        store(path, values, kind, names or None)
        content = bytearray(path.read_bytes())
        for tag, value in (tags or {}).items():
            start = struct.unpack_from("<I", content, 4)[0] + 2
            count = struct.unpack_from("<H", content, start - 2)[0]
            (at,) = (e for e in range(start, start + 12 * count, 12) if struct.unpack_from("<H", content, e)[0] == tag)
            struct.pack_into("<H", content, at + 8, value)
        path.write_bytes(content)

    return make


def with_array(array: Any, cut: int | None = None) -> Made:
    def make(path: Path) -> None:
        np.save(path, array, allow_pickle=True) if path.suffix == ".npy" else np.savez(path, array)
        path.write_bytes(path.read_bytes()[:cut])

    return make


def with_member(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(path.stem, "no array")


def loop(path: Path) -> None:
    path.symlink_to(path)


def deep(path: Path) -> None:
    spec = oiio.ImageSpec(4, 4, 2, "float")
    spec.channelnames, spec.deep = ("Z", "A"), True
    samples = oiio.DeepData()
    samples.init(16, 2, [oiio.FLOAT, oiio.FLOAT], ["Z", "A"])
    for pixel in range(16):
        samples.set_samples(pixel, 2)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None and output.open(str(path), spec)
    assert output.write_deep_image(samples) and output.close()


def large_map(path: Path) -> None:
    np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=(2**15, 2**14))


class Bomb:
    """Creates a file if it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("ran"),))


def holed() -> np.ndarray:
    values = np.ones((4, 4, 3), np.float32)
    values[1, 2, 0], values[3, 3, :] = np.nan, np.inf
    return values


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(side: int, pixels: bytes) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def huge_exr(path: Path) -> None:
    write_image(path, tiny())
    content = bytearray(path.read_bytes())
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        start = content.index(name) + len(name) + 4
        content[start : start + 16] = struct.pack("<iiii", 0, 0, 1_000_000, 1_000_000)
    path.write_bytes(content)


SHAPE = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }".ljust(117).encode() + b"\n"
NPY = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(SHAPE)) + SHAPE
HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 900000 +X 900000\n" + bytes(100)
GREY, COLOUR, TEXT = np.ones((2, 3, 1), np.float32), np.ones((2, 3, 3), np.float32), b"hello world, this is no image\n"
NOT_RGB = r"colours are not stored as RGB or grey \(photometric interpretation"

# name, function that makes the file, error of read_image, error of read_values (None: not tried)
FILES: list[tuple[str, Made | None, str | None, str | None]] = [
    ("none.png", None, "there is no such file", "there is no such file"),
    ("none.npy", None, "is not an image that can be read", "there is no such file"),
    ("empty.png", with_bytes(b""), "the file is empty", "the file is empty"),
    ("folder.png", Path.mkdir, "is a folder; name a file in it", "is a folder; name a file in it"),
    ("folder", Path.mkdir, "is a folder; name a file in it", "is a folder; name a file in it"),
    ("text.png", with_bytes(TEXT), "cannot be read", "cannot be read"),
    ("text.pfm", with_bytes(b"hello\n"), "is not a PFM file", "is not a PFM file"),
    ("header.pfm", with_bytes(b"PF\n3 2\n"), "is not a PFM file", None),
    ("zero.pfm", with_bytes(b"Pf\n1 1\n0\n1234"), "has scale 0, which states no byte order", "scale 0"),
    ("dots.pfm", with_bytes(b"Pf\n1 1\n..\n1234"), "its scale should be a number, got '..'", "scale"),
    ("long.pfm", with_bytes(b"Pf\n1 1\n-1\n12345"), "is longer than its header says", "is longer"),
    ("short.pfm", with_bytes(b"PF\n3 2\n-1\n12345"), "is cut short", None),
    ("huge.pfm", with_bytes(b"PF\n999999 999999\n-1\n12345"), "claims 999999 x 999999 pixels", None),
    ("negative.pfm", with_bytes(b"PF\n-3 2\n-1\n12345"), "claims -3 x 2 pixels", None),
    ("huge.png", with_bytes(png(200_000, zlib.compress(b"0" * 100))), "exceeds the .* limit", "exceeds the .* limit"),
    ("huge.exr", huge_exr, "exceeds the .* limit", "exceeds the .* limit"),
    ("huge.hdr", with_bytes(HDR), "resolution may not exceed", "resolution may not exceed"),
    ("huge.npy", with_bytes(NPY), None, "cannot be read as an array"),
    ("picture.gif", with_bytes(b"GIF89a"), "is not an image that can be read", "is not a depth map"),
    ("picture", with_bytes(b"x"), "a file without a suffix is not an image", "a file without a suffix is not a depth"),
    *((f"loop{suffix}", loop, None, "there is no such file") for suffix in (".png", ".npy", ".npz")),
    ("deep.exr", deep, "holds deep samples; flatten it", "holds deep samples; flatten it"),
    ("c.exr", with_values(np.ones((4, 4, 1200), np.float32), *(f"c{i}.R" for i in range(1200))), "1200 channels", None),
    ("holes.exr", with_values(holed()), "2 pixels are not finite", None),
    ("bright.tif", with_values(np.full((2, 3, 3), 1e39), kind="double"), "6 pixels are not finite", None),
    ("z.exr", with_values(GREY, "Z"), "has no colour: expected channels R, G, B or Y, found Z", None),
    *(
        (f"no{c}.exr", with_values(np.ones((2, 3, 2), np.float32), *"RGB".replace(c, "")), "expected channels R", None)
        for c in "RGB"
    ),
    ("lab.tif", with_values(COLOUR, kind="uint8", tags={262: 8}), f"{NOT_RGB} 8", f"{NOT_RGB} 8"),
    ("mosaic.tif", with_values(GREY, kind="uint16", tags={262: 32803}), f"{NOT_RGB} 32803", f"{NOT_RGB} 32803"),
    ("negative.tif", with_values(GREY, kind="uint16", tags={262: 0}), f"{NOT_RGB} 0", f"{NOT_RGB} 0"),
    ("signed.tif", with_values(GREY, kind="int16"), "numbers of type int16, for which white is not defined", None),
    ("colour.png", with_values(np.eye(3, dtype=np.float32)[None], kind="uint8"), None, "colours of a heat map"),
    ("bomb.npy", with_array(np.array([[Bomb()]], object)), None, "cannot be read as an array"),
    ("bomb.npz", with_array(np.array([[Bomb()]], object)), None, "cannot be read as an array"),
    ("text.npy", with_array(np.array([["a"]])), None, r"expected an array \[H, W\] of numbers"),
    ("complex.npy", with_array(np.zeros((2, 2), complex)), None, r"expected an array \[H, W\] of numbers"),
    ("zero.npy", with_array(np.zeros((0, 4))), None, r"expected an array \[H, W\] of numbers"),
    ("cut.npy", with_array(np.zeros((50, 50)), cut=500), None, "cannot be read as an array"),
    ("junk.npy", with_bytes(b"\x93NUMPY junk"), None, "cannot be read as an array"),
    ("large.npy", large_map, None, "claims 16384 x 32768 pixels"),
    *((f"{m}.npz", with_member, None, "cannot be read as an array") for m in ("depth.txt", "depth", "depth.npy")),
]


@pytest.mark.parametrize(("name", "make", "image", "values"), FILES, ids=[file[0] for file in FILES])
def test_invalid_files_are_refused_by_name_in_one_line(
    name: str, make: Made | None, image: str | None, values: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if make is not None:
        make(tmp_path / name)
    for read, message in ((read_image, image), (read_values, values)):
        if message is not None:
            with pytest.raises((ValueError, OSError), match=message) as caught:
                read(tmp_path / name)
            assert name in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "ran").exists()


NO_TARGETS: list[tuple[str, Any, str]] = [
    ("x.hdr", "16", r"a \.hdr file holds samples of float, not 16"),
    ("x.jpg", "half", r"a \.jpg file holds samples of 8, not half"),
    ("x.gif", None, "cannot write files of type '.gif'"),
    ("x", None, "cannot write a file without a type"),
    ("file/x.png", None, "x.png: its folder cannot be made, because .*file is a file"),
    ("folder.png", None, r"folder\.png: is a folder"),
]


@pytest.mark.parametrize(("name", "sample", "message"), NO_TARGETS)
def test_a_target_that_cannot_be_written_is_named(name: str, sample: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises((ValueError, OSError), match=message):
        write_image(tmp_path / name, tiny(), sample=sample)


@pytest.mark.parametrize(
    ("name", "how"),
    [("a.heic", "install its reader"), ("a.AVIF", "install its reader"), ("a.dng", "develop it to linear")],
)
def test_a_format_without_a_reader_is_refused_with_its_conversion(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, how: str
) -> None:
    monkeypatch.setattr(paths, "readers", lambda: ["jpeg"])
    monkeypatch.setattr(paths, "has_pi_heif", lambda: False)
    (tmp_path / name).write_bytes(TEXT)
    with pytest.raises(ValueError, match=rf"{name}: {Path(name).suffix.lower()} is not read here: {how}"):
        read_image(tmp_path / name)
    # OpenImageIO looks at the content, so that a renamed JPEG replaces a file of this format
    write_image(tmp_path / "a.jpg", Picture(torch.full((1, 3, 8, 8), 0.2159)))
    (tmp_path / "a.jpg").rename(tmp_path / name)
    monkeypatch.setattr(paths, "readers", lambda: ["heif", "raw"])
    assert float(read_image(tmp_path / name).pixels.mean()) == pytest.approx(0.2159, abs=0.002)


def test_files_with_names_that_are_not_utf_8_are_read_and_written(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    for suffix, sample in KINDS.items():
        write_image(folder / f"x{suffix}", tiny(), sample=sample)  # type: ignore[arg-type]
        named = folder / (os.fsdecode(b"\xe9") + suffix)
        (folder / f"x{suffix}").rename(named)
        assert torch.equal(read_image(named).pixels, read_image(shutil.copy(named, tmp_path / f"copy{suffix}")).pixels)
    np.save(folder / os.fsdecode(b"\xe9.npy"), np.ones((2, 3)))
    assert read_values(folder / os.fsdecode(b"\xe9.npy")).mean() == 1.0
    BlurTable.disc().save(folder / "x.json")
    named.write_bytes(TEXT)
    with pytest.raises(OSError, match="is not a PFM file"):
        read_image(named)


# Damage


@pytest.mark.parametrize(("suffix", "sample"), KINDS.items())
@pytest.mark.parametrize("share", [0.1, 0.6, 0.98])
def test_a_truncated_file_is_refused(tmp_path: Path, suffix: str, sample: Any, share: float) -> None:
    write_image(tmp_path / f"whole{suffix}", Picture(torch.rand(1, 3, 100, 130)), sample=sample)
    content = (tmp_path / f"whole{suffix}").read_bytes()
    (tmp_path / f"cut{suffix}").write_bytes(content[: int(len(content) * share)])
    with pytest.raises(OSError, match=r"cut\.\w+: (is damaged or cut short|is cut short|cannot be read)"):
        read_image(tmp_path / f"cut{suffix}")
    assert decode.is_complete(tmp_path / f"whole{suffix}") and not decode.is_complete(tmp_path / f"cut{suffix}")


def test_attributes_are_kept_and_too_many_are_refused_at_once(tmp_path: Path) -> None:
    for count in (500, MAX_ATTRIBUTES):
        attributes: dict[str, Any] = {f"a{n}": n for n in range(count)}
        path = store(tmp_path / f"{count}.exr", COLOUR, "half", **attributes)
        if count == 500:
            assert read_image(path).metadata["a499"][1] == 499
            continue
        start = time.perf_counter()
        with pytest.raises(ValueError, match=rf"exr: its headers hold more than {MAX_ATTRIBUTES} attributes"):
            read_image(path)
        assert time.perf_counter() - start < 2.0  # OpenEXR takes minutes for many


def test_each_part_is_held_against_the_memory_that_the_others_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    black = np.zeros((40, 40, 3), np.float16)
    parts = [(spec_with(black, "half", oiio__subimagename=f"part {n}"), black) for n in range(5)]
    store_parts(tmp_path / "x.exr", parts)
    assert read_image(tmp_path / "x.exr", layer="part 3").pixels.shape == (1, 3, 40, 40)
    free = iter([1e5, 1e5, 1e4])
    monkeypatch.setattr(decode, "free_bytes", lambda: next(free))
    with pytest.raises(ValueError, match="GiB of memory are free"):
        read_image(tmp_path / "x.exr")


def test_a_picture_that_does_not_fit_into_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for suffix, sample in KINDS.items():
        write_image(tmp_path / f"x{suffix}", tiny(), sample=sample)  # type: ignore[arg-type]
    np.save(tmp_path / "x.npy", np.zeros((40, 40)))
    np.savez_compressed(tmp_path / "x.npz", depth=np.zeros((40, 40)))
    files = [(path, read) for path in tmp_path.iterdir() for read in (read_image, read_values)]
    with monkeypatch.context() as patch:
        patch.setattr(decode, "free_bytes", lambda: 1e2)
        for path, read in files:
            if read is read_values or path.suffix in KINDS:
                with pytest.raises((ValueError, OSError), match=rf"{path.name}: .*(GiB of memory are free|memory for)"):
                    read(path)
    # where the memory that is free is unknown
    monkeypatch.setattr(oiio.ImageInput, "read_image", lambda *_: torch.empty(2**50))
    with pytest.raises(OSError, match=r"x\.exr: does not fit into memory"):
        read_image(tmp_path / "x.exr")
