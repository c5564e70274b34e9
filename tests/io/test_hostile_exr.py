"""EXR files of every make, and such as nobody makes: tiles, levels, parts, windows, deep samples, endless headers."""

import struct
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from torchdof.io.exr import MOST_ATTRIBUTES
from torchdof.io.images import Picture, read_image, read_values, write_image

pytestmark = pytest.mark.hard


def spec_of(channels: tuple[str, ...] = ("R", "G", "B", "Z"), size: int = 32, name: str = "") -> oiio.ImageSpec:
    spec = oiio.ImageSpec(size, size, len(channels), "float")
    spec.channelnames = channels
    spec.full_width = spec.full_height = 32
    if name:
        spec.attribute("name", name)
    return spec


def values_of(spec: oiio.ImageSpec) -> np.ndarray:
    count = spec.width * spec.height * spec.nchannels
    return np.linspace(0.1, 1, count, dtype=np.float32).reshape(spec.height, spec.width, spec.nchannels)


def store(path: Path, *specs: oiio.ImageSpec) -> None:
    output = oiio.ImageOutput.create(str(path))
    assert output is not None and output.open(str(path), specs if len(specs) > 1 else specs[0])
    for number, spec in enumerate(specs):
        assert not number or output.open(str(path), spec, "AppendSubimage")
        assert output.write_image(values_of(spec)), output.geterror()
    assert output.close()


def check(path: Path, spec: oiio.ImageSpec) -> None:
    """The first level of the file, as it was written, is read and can be written again."""
    picture = read_image(path)
    truth = torch.from_numpy(values_of(spec)).permute(2, 0, 1)[None]
    assert torch.equal(picture.pixels, truth[:, :3])
    assert torch.equal(read_values(path, "Z"), truth[:, 3:])
    write_image(path.with_name("copy.exr"), picture, sample="float")
    copy = read_image(path.with_name("copy.exr"))
    assert torch.equal(copy.pixels, picture.pixels) and copy.window == picture.window


def test_tiles_are_read(tmp_path: Path) -> None:
    spec = spec_of()
    spec.tile_width = spec.tile_height = 16
    store(tmp_path / "x.exr", spec)
    check(tmp_path / "x.exr", spec_of())


def test_of_several_levels_the_first_is_read(tmp_path: Path) -> None:
    picture = oiio.ImageBuf(spec_of())
    picture.set_pixels(oiio.ROI(), values_of(spec_of()))
    assert oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, picture, str(tmp_path / "x.exr"))
    source = oiio.ImageInput.open(str(tmp_path / "x.exr"))
    assert source is not None and source.seek_subimage(0, 2)
    check(tmp_path / "x.exr", spec_of())


@pytest.mark.parametrize(
    "window",
    [(-3, -5, 0, 0, 8, 8), (100_000, 100_000, 0, 0, 8, 8), (50, 50, 0, 0, 10, 10), (0, 0, -9, -9, 1, 1)],
    ids=["beyond", "far off", "beside", "another"],
)
def test_pixels_may_lie_beyond_the_display_window(tmp_path: Path, window: tuple[int, ...]) -> None:
    spec = spec_of()
    spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = window
    store(tmp_path / "x.exr", spec)
    assert read_image(tmp_path / "x.exr").window == window
    check(tmp_path / "x.exr", spec_of())


def test_of_several_parts_the_first_with_colour_is_read_and_depth_of_its_size(tmp_path: Path) -> None:
    colour, depth, small = spec_of(("R", "G", "B"), name="beauty"), spec_of(("Z",), name="z"), spec_of(("Z",), 16, "s")
    store(tmp_path / "x.exr", depth, colour)
    picture = read_image(tmp_path / "x.exr")
    assert picture.depth is not None and torch.equal(picture.depth[0, 0], torch.from_numpy(values_of(depth)[..., 0]))
    store(tmp_path / "y.exr", colour, small)
    assert read_image(tmp_path / "y.exr").depth is None
    assert read_values(tmp_path / "y.exr").shape == (1, 1, 16, 16)
    many = [spec_of(("R", "G", "B"), 16, f"part {i}") for i in range(200)]
    store(tmp_path / "many.exr", *many)
    assert read_image(tmp_path / "many.exr", layer="part 199").pixels.shape == (1, 3, 16, 16)


def test_deep_samples_are_refused_by_name(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(4, 4, 2, "float")
    spec.channelnames, spec.deep = ("Z", "A"), True
    samples = oiio.DeepData()
    samples.init(16, 2, [oiio.FLOAT, oiio.FLOAT], ["Z", "A"])
    for pixel in range(16):
        samples.set_samples(pixel, 2)
    output = oiio.ImageOutput.create(str(tmp_path / "x.exr"))
    assert output is not None and output.open(str(tmp_path / "x.exr"), spec)
    assert output.write_deep_image(samples) and output.close()
    for read in (read_image, read_values):
        with pytest.raises(ValueError, match=r"x\.exr: holds deep samples; flatten it"):
            read(tmp_path / "x.exr")


def test_a_thousand_and_more_channels_are_refused_by_name(tmp_path: Path) -> None:
    store(tmp_path / "x.exr", spec_of(tuple(f"c{i}.R" for i in range(1200)), 4))
    with pytest.raises(OSError, match=r"x\.exr: cannot be read \(1200 channels"):
        read_image(tmp_path / "x.exr")


def with_attributes(path: Path, count: int) -> None:
    """An EXR with so many attributes in its header."""
    write_image(path, Picture(torch.rand(1, 3, 8, 9)))
    content, end = path.read_bytes(), 8
    while content[end]:
        name_end = content.index(b"\0", end)
        type_end = content.index(b"\0", name_end + 1)
        end = type_end + 5 + int.from_bytes(content[type_end + 1 : type_end + 5], "little")
    more = b"".join(b"a%d\0int\0" % i + struct.pack("<Ii", 4, i) for i in range(count))
    (pixels_at,) = struct.unpack("<Q", content[end + 1 : end + 9])  # of its only block of lines
    path.write_bytes(content[:end] + more + b"\0" + struct.pack("<Q", pixels_at + len(more)) + content[end + 9 :])


def test_attributes_are_kept_and_endless_ones_refused_at_once(tmp_path: Path) -> None:
    with_attributes(tmp_path / "some.exr", 500)
    assert read_image(tmp_path / "some.exr").metadata["a499"][1] == 499
    for count in (MOST_ATTRIBUTES, 100_000):
        with_attributes(tmp_path / "x.exr", count)
        start = time.perf_counter()
        with pytest.raises(ValueError, match=rf"x\.exr: its headers hold more than {MOST_ATTRIBUTES} attributes"):
            read_image(tmp_path / "x.exr")
        assert time.perf_counter() - start < 2.0  # its library takes minutes


@pytest.mark.parametrize("place", range(4, 120, 5))
@pytest.mark.parametrize("value", [b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f"])
def test_hostile_sizes_in_headers_are_refused_by_name(tmp_path: Path, place: int, value: bytes) -> None:
    path = tmp_path / "x.exr"
    store(path, spec_of(("R", "G", "B"), 16, "beauty"), spec_of(("Z",), 16, "z"))
    content = path.read_bytes()
    path.write_bytes(content[:place] + value + content[place + 4 :])
    try:
        read_image(path)
    except (ValueError, OSError) as error:
        assert "x.exr" in str(error)
