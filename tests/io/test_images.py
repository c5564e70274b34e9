"""Images round trip through every type of file with known values, and broken files are refused in one sentence."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from torchdof.io.atomic import whole_file
from torchdof.io.images import Picture, read_image, read_values, write_image

GREY = 0.21404114  # linear light of an sRGB value of 0.5


def store(path: Path, array: np.ndarray, sample: str, names: tuple[str, ...] | None = None, **attributes: Any) -> Path:
    """Writes stored numbers by OpenImageIO alone."""
    array = np.atleast_3d(array)
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], sample)
    if names is not None:
        spec.channelnames = names
        spec.alpha_channel = names.index("A") if "A" in names else -1
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    return store_by(path, spec, array)


def store_by(path: Path, spec: oiio.ImageSpec, array: np.ndarray) -> Path:
    output = oiio.ImageOutput.create(str(path))
    assert output is not None and output.open(str(path), spec)
    assert output.write_image(np.ascontiguousarray(array)) and output.close()
    return path


def spec_of(path: Path) -> oiio.ImageSpec:
    source = oiio.ImageInput.open(str(path))
    assert source is not None
    return source.spec()


def stored(path: Path) -> np.ndarray:
    """Reads stored numbers by OpenImageIO alone, in their own type."""
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    assert source is not None
    values = source.read_image(source.spec().format)
    assert values is not None
    return values


def ramp(channels: int = 3, height: int = 4, width: int = 6) -> torch.Tensor:
    """Every value different, in [0, 1], no symmetry: a flip or a swap of channels shows."""
    return torch.linspace(0, 1, channels * height * width).reshape(1, channels, height, width)


@pytest.mark.parametrize(
    ("suffix", "sample", "transfer", "tolerance"),
    [
        (".exr", "half", "linear", 5e-4),
        (".exr", "float", "linear", 0.0),
        (".exr", "float", "srgb", 1e-6),
        (".tif", "float", "linear", 0.0),
        (".tif", "16", "srgb", 2e-5),
        (".tiff", "8", "srgb", 5e-3),
        (".png", "8", "srgb", 5e-3),
        (".png", "16", "srgb", 2e-5),
        (".png", "16", "linear", 1e-5),
        (".jpg", "8", "srgb", 0.1),
        (".hdr", "float", "linear", 8e-3),
        (".pfm", "float", "linear", 0.0),
    ],
)
def test_light_round_trips_within_the_precision_of_the_type(
    tmp_path: Path, suffix: str, sample: Any, transfer: Any, tolerance: float
) -> None:
    path = tmp_path / f"x{suffix}"
    write_image(path, Picture(ramp()), transfer=transfer, sample=sample)
    back = read_image(path, transfer=transfer)
    assert back.sample == sample
    assert back.channels == ("R", "G", "B")
    torch.testing.assert_close(back.pixels, ramp(), rtol=0, atol=tolerance)


@pytest.mark.parametrize(("suffix", "sample"), [(".png", "8"), (".png", "16"), (".tif", "8"), (".tif", "16")])
def test_every_integer_value_survives_reading_and_writing_bit_exact(tmp_path: Path, suffix: str, sample: Any) -> None:
    dtype = np.uint8 if sample == "8" else np.uint16
    count = 256 if sample == "8" else 65536
    values = np.repeat(np.arange(count, dtype=dtype).reshape(16, -1, 1), 3, axis=2)
    source = store(tmp_path / f"a{suffix}", values, "uint8" if sample == "8" else "uint16")
    write_image(tmp_path / f"b{suffix}", read_image(source))
    assert np.array_equal(stored(tmp_path / f"b{suffix}"), values)


@pytest.mark.parametrize(
    ("suffix", "sample", "light"),
    [
        (".png", "uint8", GREY),
        (".tif", "uint16", GREY),
        (".tif", "float", 0.5),
        (".exr", "half", 0.5),
        (".jpg", "uint8", GREY),
    ],
)
def test_integers_are_srgb_and_floats_are_linear_unless_stated(
    tmp_path: Path, suffix: str, sample: str, light: float
) -> None:
    path = store(tmp_path / f"x{suffix}", np.full((2, 2, 3), 0.5, np.float32), sample)
    assert read_image(path).pixels.mean().item() == pytest.approx(light, abs=5e-3)
    assert read_image(path, transfer="linear").pixels.mean().item() == pytest.approx(0.5, abs=5e-3)
    assert read_image(path, transfer="srgb").pixels.mean().item() == pytest.approx(GREY, abs=5e-3)


def test_float_tiff_is_linear_though_its_tag_says_srgb(tmp_path: Path) -> None:
    path = store(tmp_path / "x.tif", np.full((2, 2, 3), 0.5, np.float32), "float", FNumber=2.0)
    assert spec_of(path).get_string_attribute("oiio:ColorSpace").lower().startswith("srgb")
    assert read_image(path).pixels.mean().item() == 0.5


def test_transfer_of_the_result_follows_the_input_within_integers_and_the_type_across(tmp_path: Path) -> None:
    picture = Picture(torch.full((1, 3, 2, 2), 0.5), sample="16", transfer="linear")
    write_image(tmp_path / "a.png", picture)
    assert stored(tmp_path / "a.png")[0, 0, 0] == 32768
    write_image(tmp_path / "b.png", dataclasses.replace(picture, sample="float"))
    assert stored(tmp_path / "b.png")[0, 0, 0] == 188
    write_image(tmp_path / "c.exr", dataclasses.replace(picture, transfer="srgb"))
    assert stored(tmp_path / "c.exr")[0, 0, 0] == 0.5


@pytest.mark.parametrize(("suffix", "sample"), [(".png", "8"), (".png", "16"), (".tif", "8"), (".tif", "float")])
def test_straight_alpha_is_premultiplied_in_linear_light(tmp_path: Path, suffix: str, sample: Any) -> None:
    rgba = np.zeros((2, 2, 4), np.float32)
    rgba[..., :3], rgba[..., 3] = 0.5, 0.25
    kind = {"8": "uint8", "16": "uint16", "float": "float"}[sample]
    path = store(tmp_path / f"a{suffix}", rgba, kind, ("R", "G", "B", "A"), oiio__UnassociatedAlpha=1)
    picture = read_image(path, transfer="srgb")
    assert picture.channels == ("R", "G", "B", "A")
    torch.testing.assert_close(picture.pixels[0, :, 0, 0], torch.tensor([*[GREY / 4] * 3, 0.25]), rtol=0.02, atol=0)
    write_image(tmp_path / f"b{suffix}", picture)
    np.testing.assert_allclose(stored(tmp_path / f"b{suffix}"), stored(path), atol=1e-6)


def test_exr_alpha_is_premultiplied_already_and_light_without_coverage_survives(tmp_path: Path) -> None:
    rgba = np.zeros((1, 2, 4), np.float32)
    rgba[0, 0], rgba[0, 1] = (0.3, 0.2, 0.1, 0.5), (2.0, 1.0, 0.5, 0.0)
    path = store(tmp_path / "a.exr", rgba, "float", ("R", "G", "B", "A"))
    picture = read_image(path)
    assert picture.pixels[0, :, 0, 1].tolist() == [2.0, 1.0, 0.5, 0.0]
    write_image(tmp_path / "b.exr", picture)
    assert np.array_equal(stored(tmp_path / "b.exr"), rgba)


def test_alpha_is_refused_where_the_type_cannot_hold_it_unless_it_is_opaque(tmp_path: Path) -> None:
    picture = Picture(torch.full((1, 4, 2, 2), 0.5), channels=("R", "G", "B", "A"))
    with pytest.raises(ValueError, match=r"x\.jpg: a \.jpg file cannot hold the alpha channel; write \.exr"):
        write_image(tmp_path / "x.jpg", picture)
    picture.pixels[:, 3] = 1.0
    write_image(tmp_path / "x.jpg", picture)
    assert read_image(tmp_path / "x.jpg").channels == ("R", "G", "B")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr", ".jpg", ".pfm"])
def test_grey_images_have_one_channel(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / f"x{suffix}", Picture(ramp(1), channels=("Y",)))
    back = read_image(tmp_path / f"x{suffix}")
    assert back.channels == ("Y",)
    torch.testing.assert_close(back.pixels, ramp(1), rtol=0, atol=0.05)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr"])
def test_grey_with_alpha_round_trips(tmp_path: Path, suffix: str) -> None:
    pixels = torch.cat([ramp(1) * 0.5, torch.full((1, 1, 4, 6), 0.5)], dim=1)
    write_image(tmp_path / f"x{suffix}", Picture(pixels, channels=("Y", "A")))
    back = read_image(tmp_path / f"x{suffix}")
    assert back.channels == ("Y", "A")
    torch.testing.assert_close(back.pixels, pixels, rtol=0, atol=0.01)


def test_half_values_beyond_the_range_of_half_stay_finite(tmp_path: Path) -> None:
    write_image(tmp_path / "x.exr", Picture(torch.full((1, 3, 1, 1), 1e6)), sample="half")
    assert stored(tmp_path / "x.exr").max() == 65504.0


@pytest.mark.parametrize("depth_name", ["Z", "z", "depth", "Depth.Z", "ViewLayer.Depth.Z"])
def test_depth_channel_beside_colour_is_found(tmp_path: Path, depth_name: str) -> None:
    values = np.zeros((2, 3, 8), np.float32)
    names = ("R", "G", "B", "A", depth_name, "Normal.X", "Normal.Y", "Normal.Z")
    values[..., 3], values[..., 4], values[..., 7] = 1.0, 1234.5, -1.0
    picture = read_image(store(tmp_path / "x.exr", values, "float", names))
    assert picture.channels == ("R", "G", "B", "A")
    assert picture.depth is not None and bool((picture.depth == 1234.5).all())
    assert read_values(tmp_path / "x.exr")[0, 0, 0, 0] == 1234.5
    assert read_values(tmp_path / "x.exr", "Normal.Z")[0, 0, 0, 0] == -1.0


def test_normals_are_not_taken_for_depth(tmp_path: Path) -> None:
    names = ("R", "G", "B", "Normal.X", "Normal.Y", "Normal.Z")
    assert read_image(store(tmp_path / "x.exr", np.ones((2, 3, 6), np.float32), "float", names)).depth is None


def two_parts(path: Path, depth_size: tuple[int, int] = (2, 3)) -> Path:
    """An EXR file with colour of 0.25 as half in its first part and depth of 7.7 as float in its second."""
    colour, depth = oiio.ImageSpec(3, 2, 3, "half"), oiio.ImageSpec(depth_size[1], depth_size[0], 1, "float")
    depth.channelnames = ("Z",)
    for spec, name in ((colour, "beauty"), (depth, "geometry")):
        spec.full_width, spec.full_height = 6, 4  # parts share the full frame
        spec.attribute("oiio:subimagename", name)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None and output.open(str(path), (colour, depth))
    assert output.write_image(np.full((2, 3, 3), 0.25, np.float32))
    assert output.open(str(path), depth, "AppendSubimage")
    assert output.write_image(np.full((*depth_size, 1), 7.7, np.float32)) and output.close()
    return path


def test_multi_part_exr_gives_colour_and_depth_of_its_parts(tmp_path: Path) -> None:
    picture = read_image(two_parts(tmp_path / "x.exr"))
    assert picture.sample == "half"
    assert picture.pixels.unique().tolist() == [0.25]
    assert picture.depth is not None and picture.depth.unique().tolist() == [np.float32(7.7)]
    assert read_image(tmp_path / "x.exr", layer="beauty").pixels.unique().tolist() == [0.25]


def test_depth_part_of_another_size_is_left_out(tmp_path: Path) -> None:
    assert read_image(two_parts(tmp_path / "x.exr", depth_size=(4, 6))).depth is None


def test_half_colour_with_float_depth_stays_half(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(3, 2, 4, "half")
    spec.channelnames = ("R", "G", "B", "Z")
    spec.channelformats = (oiio.HALF, oiio.HALF, oiio.HALF, oiio.FLOAT)
    store_by(tmp_path / "x.exr", spec, np.full((2, 3, 4), 1.0001, np.float32))
    picture = read_image(tmp_path / "x.exr")
    assert picture.sample == "half"
    assert picture.depth is not None and picture.depth[0, 0, 0, 0].item() == pytest.approx(1.0001, abs=1e-7)


def test_layers_are_chosen_by_name(tmp_path: Path) -> None:
    names = ("a.R", "a.G", "a.B", "b.R", "b.G", "b.B")
    values = np.repeat(np.array([[[1, 1, 1, 2, 2, 2]]], np.float32), 2, axis=0)
    path = store(tmp_path / "x.exr", values, "float", names)
    assert read_image(path).pixels.unique().tolist() == [1.0]
    assert read_image(path, layer="b").pixels.unique().tolist() == [2.0]
    with pytest.raises(ValueError, match="no layer 'c' with colour; its layers with colour: a, b"):
        read_image(path, layer="c")


def test_plain_channels_come_before_those_of_layers(tmp_path: Path) -> None:
    values = np.repeat(np.array([[[1, 1, 1, 2, 2, 2]]], np.float32), 2, axis=0)
    path = store(tmp_path / "x.exr", values, "float", ("Albedo.R", "Albedo.G", "Albedo.B", "R", "G", "B"))
    assert read_image(path).pixels.unique().tolist() == [2.0]


def test_exr_keeps_its_place_in_the_full_frame(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(4, 3, 3, "float")
    spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = -2, 5, 0, 0, 100, 50
    store_by(tmp_path / "a.exr", spec, np.ones((3, 4, 3), np.float32))
    write_image(tmp_path / "b.exr", read_image(tmp_path / "a.exr"))
    back = spec_of(tmp_path / "b.exr")
    assert (back.x, back.y, back.full_width, back.full_height) == (-2, 5, 100, 50)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".exr"])
def test_metadata_of_the_input_is_kept(tmp_path: Path, suffix: str) -> None:
    attributes: dict[str, Any] = {"Make": "Maker", "Exif__FocalLength": 85.0, "FNumber": 1.8, "ImageDescription": "a b"}
    source = store(tmp_path / f"a{suffix}", np.zeros((4, 4, 3), np.float32), "uint8", **attributes)
    write_image(tmp_path / f"b{suffix}", read_image(source))
    back = spec_of(tmp_path / f"b{suffix}")
    assert back.get_string_attribute("Make") == "Maker"
    assert back.get_string_attribute("ImageDescription") == "a b"
    assert back.get_float_attribute("Exif:FocalLength") == 85.0
    assert back.get_float_attribute("FNumber") == pytest.approx(1.8)


def test_lossy_compression_of_an_exr_is_not_repeated(tmp_path: Path) -> None:
    source = store(tmp_path / "a.exr", np.zeros((4, 4, 3), np.float32), "half", compression="dwaa:45")
    write_image(tmp_path / "b.exr", read_image(source))
    assert spec_of(tmp_path / "b.exr").get_string_attribute("compression") == "zip"


def test_pfm_rows_run_from_the_bottom_and_its_scale_is_not_applied(tmp_path: Path) -> None:
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    (tmp_path / "x.pfm").write_bytes(b"Pf\n3 2\n-0.003922\n" + values.tobytes())
    assert read_values(tmp_path / "x.pfm")[0, 0].tolist() == [[3, 4, 5], [0, 1, 2]]
    (tmp_path / "y.pfm").write_bytes(b"Pf\n3 2\n1.0\n" + values.astype(">f4").tobytes())
    assert read_values(tmp_path / "y.pfm")[0, 0].tolist() == [[3, 4, 5], [0, 1, 2]]


def test_pfm_is_written_from_the_bottom_up(tmp_path: Path) -> None:
    write_image(tmp_path / "x.pfm", Picture(torch.arange(6.0).reshape(1, 1, 2, 3), channels=("Y",)))
    header, size, scale, data = (tmp_path / "x.pfm").read_bytes().split(b"\n", 3)
    assert (header, size) == (b"Pf", b"3 2")
    assert np.frombuffer(data, "<f4" if float(scale) < 0 else ">f4").tolist() == [3, 4, 5, 0, 1, 2]


@pytest.mark.parametrize(("suffix", "sample"), [(".png", "uint16"), (".tif", "uint16"), (".png", "uint8")])
def test_integer_maps_give_their_integers(tmp_path: Path, suffix: str, sample: str) -> None:
    values = np.array([[0, 1, 255], [7, 100, 200]], np.uint16 if sample == "uint16" else np.uint8)
    if sample == "uint16":
        values[0, 2] = 65535
    assert read_values(store(tmp_path / f"x{suffix}", values, sample))[0, 0].tolist() == values.tolist()


@pytest.mark.parametrize("shape", [(2, 3), (1, 2, 3), (1, 1, 2, 3), (2, 3, 1)])
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_arrays_are_read_as_maps(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    array = np.arange(6, dtype=np.float64).reshape(shape)
    path = tmp_path / f"x{suffix}"
    np.save(path, array) if suffix == ".npy" else np.savez(path, depth=array)
    assert read_values(path)[0, 0].tolist() == [[0, 1, 2], [3, 4, 5]]


def test_array_of_an_npz_is_chosen_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", a=np.zeros((2, 2)), b=np.ones((2, 2)))
    assert read_values(tmp_path / "x.npz", "b").mean() == 1.0
    with pytest.raises(ValueError, match="which of the arrays a, b is depth"):
        read_values(tmp_path / "x.npz")
    with pytest.raises(ValueError, match="no array 'c'; it has a, b"):
        read_values(tmp_path / "x.npz", "c")


def test_colour_picture_is_not_taken_for_depth_but_equal_channels_are(tmp_path: Path) -> None:
    path = store(tmp_path / "x.png", ramp()[0].permute(1, 2, 0).numpy(), "uint8")
    with pytest.raises(ValueError, match="which of the channels R, G, B is depth"):
        read_values(path)
    store(path, np.repeat(np.full((2, 2, 1), 9, np.uint8), 3, axis=2), "uint8")
    assert read_values(path).unique().tolist() == [9.0]


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


@pytest.mark.hard
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_pickled_objects_are_not_run(tmp_path: Path, suffix: str) -> None:
    bombs = np.array([[Bomb(tmp_path / "ran")]], dtype=object)
    path = tmp_path / f"x{suffix}"
    np.save(path, bombs, allow_pickle=True) if suffix == ".npy" else np.savez(path, bombs)
    with pytest.raises(ValueError, match="cannot be read as an array"):
        read_values(path)
    assert not (tmp_path / "ran").exists()


PICKLE = np.array([[{"a": 1}]], dtype=object)


@pytest.mark.hard
@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("none.png", None, "there is no such file"),
        ("empty.png", b"", "the file is empty"),
        ("text.exr", b"hello world, this is no image\n", "cannot be read"),
        ("text.png", b"hello world, this is no image\n", "cannot be read"),
        ("text.pfm", b"hello\n", "is not a PFM file"),
        ("header.pfm", b"PF\n3 2\n", "is not a PFM file"),
        ("short.pfm", b"PF\n3 2\n-1\n12345", "is cut short"),
        ("huge.pfm", b"PF\n999999 999999\n-1\n12345", "claims 999999 x 999999 pixels"),
        ("negative.pfm", b"PF\n-3 2\n-1\n12345", "claims -3 x 2 pixels"),
        ("picture.gif", b"GIF89a", "is not an image that can be read"),
        ("picture", b"x", "no suffix is not an image"),
    ],
)
def test_file_that_is_no_image_is_refused_by_name(tmp_path: Path, name: str, content: bytes | None, says: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises((ValueError, OSError), match=says) as caught:
        read_image(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.hard
@pytest.mark.parametrize(
    ("suffix", "sample"),
    [(".png", "8"), (".jpg", "8"), (".tif", "float"), (".exr", "half"), (".hdr", "float"), (".pfm", "float")],
)
@pytest.mark.parametrize("share", [0.1, 0.6, 0.98])
def test_truncated_file_is_refused_by_name(tmp_path: Path, suffix: str, sample: Any, share: float) -> None:
    write_image(tmp_path / f"whole{suffix}", Picture(torch.rand(1, 3, 100, 130)), sample=sample)
    content = (tmp_path / f"whole{suffix}").read_bytes()
    (tmp_path / f"cut{suffix}").write_bytes(content[: int(len(content) * share)])
    with pytest.raises(OSError, match=r"cut\.\w+: (is damaged or cut short|is cut short|cannot be read)"):
        read_image(tmp_path / f"cut{suffix}")


@pytest.mark.hard
@pytest.mark.parametrize("content", ["object", "text", "vector", "complex", "empty", "truncated", "junk", "huge"])
def test_array_that_is_no_map_is_refused_by_name(tmp_path: Path, content: str) -> None:
    path = tmp_path / "depth.npy"
    arrays = {"object": PICKLE, "text": np.array([["a"]]), "vector": np.zeros(5), "empty": np.zeros((0, 4))}
    arrays |= {"complex": np.zeros((2, 2), complex), "truncated": np.zeros((50, 50))}
    if content in arrays:
        np.save(path, arrays[content], allow_pickle=True)
    if content == "truncated":
        path.write_bytes(path.read_bytes()[:500])
    if content == "junk":
        path.write_bytes(b"\x93NUMPY junk")
    if content == "huge":
        np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=(2**15, 2**14))
    with pytest.raises((ValueError, OSError), match=r"depth\.npy: ") as caught:
        read_values(path)
    assert "\n" not in str(caught.value)


def test_colours_that_are_not_finite_are_counted_and_refused(tmp_path: Path) -> None:
    values = np.ones((4, 4, 3), np.float32)
    values[1, 2, 0], values[3, 3, :] = np.nan, np.inf
    with pytest.raises(ValueError, match=r"x\.exr: 2 pixels are not finite"):
        read_image(store(tmp_path / "x.exr", values, "float"))


def test_exr_without_colour_says_what_it_has(tmp_path: Path) -> None:
    path = store(tmp_path / "x.exr", np.ones((2, 2, 1), np.float32), "float", ("Z",))
    with pytest.raises(ValueError, match="has no colour: expected channels R, G, B or Y, found Z"):
        read_image(path)
    with pytest.raises(ValueError, match="no channel 'depth'; it has Z"):
        read_values(path, "depth")


@pytest.mark.parametrize(
    ("name", "sample", "says"),
    [
        ("x.hdr", "16", r"a \.hdr file holds samples of float, not 16"),
        ("x.jpg", "half", r"a \.jpg file holds samples of 8, not half"),
        ("x.gif", None, "cannot write files of type '.gif'"),
        ("x", None, "cannot write files of type 'none'"),
        ("missing/x.png", None, "there is no folder .*missing; make it first"),
    ],
)
def test_target_that_cannot_be_written_is_named(tmp_path: Path, name: str, sample: Any, says: str) -> None:
    with pytest.raises((ValueError, OSError), match=says):
        write_image(tmp_path / name, Picture(ramp()), sample=sample)


def test_target_that_is_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.png").mkdir()
    with pytest.raises(OSError, match=r"x\.png: is a folder"):
        write_image(tmp_path / "x.png", Picture(ramp()))


def test_failed_rename_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.png"
    write_image(path, Picture(ramp()))
    before = path.read_bytes()

    def fail(*arguments: object) -> None:
        raise OSError("no room")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no room"):
        write_image(path, Picture(1 - ramp()))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["x.png"]


FULL_DISK = """
import os, resource, signal, sys, torch
from torchdof.io.images import Picture, write_image
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
for kind in sys.argv[1:]:
    suffix, sample = kind.split()
    os.chdir(suffix[1:])
    try:
        write_image("x" + suffix, Picture(torch.rand(1, 3, 200, 300)), sample=sample)
        print(suffix, "written")
    except OSError as error:
        print(suffix, "refused:", error)
    os.chdir("..")
"""
KINDS = {".png": "16", ".jpg": "8", ".tif": "float", ".exr": "half", ".hdr": "float", ".pfm": "float"}


@pytest.fixture(scope="module")
def full_disk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Where a file of each kind was overwritten on a disk that filled up, in a folder each, and what was said."""
    folder = tmp_path_factory.mktemp("full_disk")
    for suffix in KINDS:
        (folder / suffix[1:]).mkdir()
        (folder / suffix[1:] / f"x{suffix}").write_text("old")
    call = [sys.executable, "-c", FULL_DISK, *(" ".join(kind) for kind in KINDS.items())]
    run = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False)
    return folder, run.stdout + run.stderr


@pytest.mark.hard
@pytest.mark.parametrize("suffix", KINDS)
def test_full_disk_is_an_error_and_leaves_the_old_file(full_disk: tuple[Path, str], suffix: str) -> None:
    folder, said = full_disk
    assert f"{suffix} refused:" in said, said
    assert [(p.name, p.read_text()) for p in (folder / suffix[1:]).iterdir()] == [(f"x{suffix}", "old")]


def test_whole_file_follows_a_link_and_keeps_it(tmp_path: Path) -> None:
    (tmp_path / "real.png").write_text("old")
    (tmp_path / "link.png").symlink_to(tmp_path / "real.png")
    with whole_file(tmp_path / "link.png") as part:
        part.write_text("new")
    assert (tmp_path / "link.png").is_symlink()
    assert (tmp_path / "real.png").read_text() == "new"
