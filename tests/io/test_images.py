"""Reading and writing images of every format: values, channels, parts and tags."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from tests.files import spec_with, store, store_parts
from torchdof.io.images import Picture, read_image, read_values, write_image

GREY = 0.21404114  # linear light of an sRGB value of 0.5
RGB = ("R", "G", "B")


def spec_of(path: Path) -> oiio.ImageSpec:
    source = oiio.ImageInput.open(str(path))
    assert source is not None
    return source.spec()


def stored(path: Path) -> np.ndarray:
    """Reads stored numbers with OpenImageIO alone, in their own type."""
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    assert source is not None
    values = source.read_image(source.spec().format)
    assert values is not None
    return values


def ramp(channels: int = 3, height: int = 4, width: int = 6) -> torch.Tensor:
    """Different values in [0, 1] without symmetry, so that tests detect flips and swapped channels."""
    return torch.linspace(0, 1, channels * height * width).reshape(1, channels, height, width)


@pytest.mark.parametrize(
    ("suffix", "sample", "transfer", "channels", "tolerance"),
    [
        (".exr", "float", "linear", "RGB", 0.0),
        (".exr", "float", "srgb", "RGB", 1e-6),
        (".tif", "16", "srgb", "RGB", 2e-5),
        (".png", "16", "srgb", "RGB", 2e-5),
        (".png", "16", "linear", "RGB", 1e-5),
        (".jpg", "8", "srgb", "RGB", 0.1),
        (".hdr", "float", "linear", "RGB", 8e-3),
        (".pfm", "float", "linear", "RGB", 0.0),
        (".exr", "half", "linear", "Y", 5e-4),
        (".png", "8", "srgb", "Y", 5e-3),
        (".jpg", "8", "srgb", "Y", 0.05),
        (".pfm", "float", "linear", "Y", 0.0),
        (".exr", "half", "linear", "YA", 5e-4),
        (".tif", "16", "srgb", "YA", 1e-4),
        (".tif", "float", "linear", "RGBA", 1e-6),
        (".png", "8", "linear", "RGBA", 5e-3),
    ],
)
def test_light_round_trips_within_the_precision_of_the_type(
    tmp_path: Path, suffix: str, sample: Any, transfer: Any, channels: str, tolerance: float
) -> None:
    path, pixels = tmp_path / f"x{suffix}", ramp(len(channels))
    if channels[-1] == "A":
        alpha = 0.5 + ramp(1) / 2
        pixels = torch.cat([pixels[:, :-1] * alpha, alpha], dim=1)
    write_image(path, Picture(pixels, channels=tuple(channels)), transfer=transfer, sample=sample)
    back = read_image(path, transfer=transfer)
    assert (back.sample, back.transfer, back.channels) == (sample, transfer, tuple(channels))
    torch.testing.assert_close(back.pixels, pixels, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("suffix", "sample"), [(".exr", "float"), (".tif", "16")])
def test_large_pictures_processed_in_strips_are_exact(tmp_path: Path, suffix: str, sample: Any) -> None:
    pixels = ramp(4, 700, 600)  # more than a million numbers
    pixels[:, 3] = 1.0
    write_image(tmp_path / f"x{suffix}", Picture(pixels, channels=("R", "G", "B", "A")), sample=sample)
    back = read_image(tmp_path / f"x{suffix}").pixels
    torch.testing.assert_close(back, pixels, rtol=0, atol=0.0 if sample == "float" else 2e-5)


@pytest.mark.parametrize(("suffix", "sample"), [(".png", "8"), (".png", "16"), (".tif", "8"), (".tif", "16")])
def test_every_integer_value_survives_reading_and_writing_bit_exact(tmp_path: Path, suffix: str, sample: Any) -> None:
    dtype = np.uint8 if sample == "8" else np.uint16
    count = 256 if sample == "8" else 65536
    values = np.repeat(np.arange(count, dtype=dtype).reshape(16, -1, 1), 3, axis=2)
    source = store(tmp_path / f"a{suffix}", values, "uint8" if sample == "8" else "uint16")
    write_image(tmp_path / f"b{suffix}", read_image(source))
    assert np.array_equal(stored(tmp_path / f"b{suffix}"), values)


FLOATS = [(".tif", "float"), (".tif", "double"), (".exr", "half")]  # although the tag of the first is sRGB


@pytest.mark.parametrize(
    ("suffix", "sample", "light"),
    [(".png", "uint8", GREY), (".tif", "uint16", GREY), (".jpg", "uint8", GREY), *((*kind, 0.5) for kind in FLOATS)],
)
def test_integers_are_srgb_and_floats_linear_by_default(tmp_path: Path, suffix: str, sample: str, light: float) -> None:
    path = store(tmp_path / f"x{suffix}", np.full((2, 2, 3), 0.5, np.float32), sample, FNumber=2.0)
    assert suffix != ".tif" or spec_of(path).get_string_attribute("oiio:ColorSpace").lower().startswith("srgb")
    for transfer, expected in ((None, light), ("linear", 0.5), ("srgb", GREY)):
        assert read_image(path, transfer=transfer).pixels.mean().item() == pytest.approx(  # type: ignore[arg-type]
            expected, abs=5e-3
        )


def test_transfer_is_kept_from_integers_to_integers_and_else_is_the_default(tmp_path: Path) -> None:
    picture = Picture(torch.full((1, 3, 2, 2), 0.5), sample="16", transfer="linear")
    for name, changes, first in (
        ("a.png", {}, 32768),
        ("b.png", {"sample": "float"}, 188),
        ("c.exr", {"transfer": "srgb"}, 0.5),
    ):
        write_image(tmp_path / name, dataclasses.replace(picture, **changes))  # type: ignore[arg-type]
        assert stored(tmp_path / name)[0, 0, 0] == first


@pytest.mark.parametrize(("suffix", "sample"), [(".png", "8"), (".png", "16"), (".tif", "8"), (".tif", "float")])
def test_straight_alpha_is_premultiplied_in_linear_light(tmp_path: Path, suffix: str, sample: Any) -> None:
    rgba = np.zeros((2, 2, 4), np.float32)
    rgba[..., :3], rgba[..., 3] = 0.5, 0.25
    kind = {"8": "uint8", "16": "uint16", "float": "float"}[sample]
    path = store(tmp_path / f"a{suffix}", rgba, kind, ("R", "G", "B", "A"), oiio__UnassociatedAlpha=1)
    picture = read_image(path, transfer="srgb")
    torch.testing.assert_close(picture.pixels[0, :, 0, 0], torch.tensor([*[GREY / 4] * 3, 0.25]), rtol=0.02, atol=0)
    write_image(tmp_path / f"b{suffix}", picture)
    np.testing.assert_allclose(stored(tmp_path / f"b{suffix}"), stored(path), atol=1e-6)


def test_exr_alpha_is_premultiplied_and_light_with_alpha_0_is_kept(tmp_path: Path) -> None:
    rgba = np.zeros((1, 2, 4), np.float32)
    rgba[0, 0], rgba[0, 1] = (0.3, 0.2, 0.1, 0.5), (2.0, 1.0, 0.5, 0.0)
    path = store(tmp_path / "a.exr", rgba, "float", ("R", "G", "B", "A"))
    picture = read_image(path)
    assert picture.pixels[0, :, 0, 1].tolist() == [2.0, 1.0, 0.5, 0.0]
    write_image(tmp_path / "b.exr", picture)
    assert np.array_equal(stored(tmp_path / "b.exr"), rgba)


def test_alpha_below_1_is_refused_by_formats_without_alpha(tmp_path: Path) -> None:
    picture = Picture(torch.full((1, 4, 2, 2), 0.5), channels=("R", "G", "B", "A"))
    with pytest.raises(ValueError, match=r"x\.jpg: a \.jpg file cannot hold the alpha channel; write \.exr"):
        write_image(tmp_path / "x.jpg", picture)
    picture.pixels[:, 3] = 1.0
    write_image(tmp_path / "x.jpg", picture)
    assert read_image(tmp_path / "x.jpg").channels == RGB


def test_half_values_beyond_the_range_of_half_stay_finite(tmp_path: Path) -> None:
    write_image(tmp_path / "x.exr", Picture(torch.full((1, 3, 1, 1), 1e6)), sample="half")
    assert stored(tmp_path / "x.exr").max() == 65504.0


# Channels, layers and parts


DEPTH_NAMES = ["Z", "z", ".Z", "depth", "Depth.Z", "ViewLayer.Depth.Z", "VRayZDepth", "Pz", "WorldDepth", "SceneDepth"]
DEPTH_NAMES += ["Depth.red", "FinalImageWorldDepth.R", "depth.[Z]", "zDepth.V"]


@pytest.mark.parametrize("depth_name", [*DEPTH_NAMES, None])
def test_a_depth_channel_is_found_beside_colour_and_normals(tmp_path: Path, depth_name: str | None) -> None:
    values = np.zeros((2, 3, 8), np.float32)
    names = ("R", "G", "B", "A", depth_name or "u", "Normal.X", "Normal.Y", "Normal.Z")
    values[..., 3], values[..., 4], values[..., 7] = 1.0, 1234.5, -1.0
    picture = read_image(store(tmp_path / "x.exr", values, "float", names))
    assert picture.channels == ("R", "G", "B", "A")
    assert read_values(tmp_path / "x.exr", "Normal.Z")[0, 0, 0, 0] == -1.0
    if depth_name is None:
        assert picture.depth is None
        return
    assert picture.depth is not None and bool((picture.depth == 1234.5).all())
    assert read_values(tmp_path / "x.exr")[0, 0, 0, 0] == 1234.5


def test_layers_are_chosen_by_name_and_plain_channels_come_first(tmp_path: Path) -> None:
    values = np.repeat(np.array([[[1, 1, 1, 2, 2, 2]]], np.float32), 2, axis=0)
    path = store(tmp_path / "x.exr", values, "float", ("a.R", "a.G", "a.B", "b.R", "b.G", "b.B"))
    assert read_image(path).pixels.unique().tolist() == [1.0]
    assert read_image(path, layer="b").pixels.unique().tolist() == [2.0]
    with pytest.raises(ValueError, match="no layer 'c' with colour; its layers with colour: a, b"):
        read_image(path, layer="c")
    with pytest.raises(ValueError, match="no channel 'depth'; it has a.R, "):
        read_values(path, "depth")
    store(path, values, "float", ("Albedo.R", "Albedo.G", "Albedo.B", "R", "G", "B"))
    assert read_image(path).pixels.unique().tolist() == [2.0]


@pytest.mark.parametrize(
    "names", ["r g b a", ".R .G .B .A", "L.red L.green L.blue L.alpha", "L.[red] L.[green] L.[blue] L.[alpha]"]
)
def test_colours_are_found_under_the_names_of_other_programs(tmp_path: Path, names: str) -> None:
    values = np.arange(1, 9, dtype=np.float32).reshape(1, 1, 8).repeat(2, 0)
    others = ("Depth.R", "Depth.G", "Depth.B", "z")
    picture = read_image(store(tmp_path / "x.exr", values, "float", (*names.split(), *others)))
    assert picture.channels == ("R", "G", "B", "A") and picture.pixels[0, :, 0, 0].tolist() == [1, 2, 3, 4]
    if "L." in names:
        assert read_image(tmp_path / "x.exr", layer="L").pixels[0, 0, 0, 0] == 1.0


def part(channels: tuple[str, ...], name: str = "", side: int = 32, sample: str = "float") -> Any:
    """A part of an EXR file with different values; all parts have the same full frame."""
    count = side * side * len(channels)
    values = np.linspace(0.1, 1, count, dtype=np.float32).reshape(side, side, len(channels))
    spec = spec_with(values, sample, channels, **({"oiio__subimagename": name} if name else {}))
    spec.full_width = spec.full_height = 32
    return spec, values


def test_the_first_part_with_colour_is_read_and_depth_of_the_same_size(tmp_path: Path) -> None:
    colour, depth, small = part(RGB, "beauty", sample="half"), part(("Z",), "z"), part(("Z",), "s", 16)
    picture = read_image(store_parts(tmp_path / "x.exr", [depth, colour]))
    assert picture.sample == "half"
    assert picture.depth is not None and torch.equal(picture.depth[0, 0], torch.from_numpy(depth[1][..., 0]))
    assert torch.equal(read_image(tmp_path / "x.exr", layer="beauty").pixels, picture.pixels)
    store_parts(tmp_path / "y.exr", [colour, small])
    assert read_image(tmp_path / "y.exr").depth is None
    assert read_values(tmp_path / "y.exr").shape == (1, 1, 16, 16)
    store_parts(tmp_path / "many.exr", [part(RGB, f"part {i}", 16) for i in range(200)])
    assert read_image(tmp_path / "many.exr", layer="part 199").pixels.shape == (1, 3, 16, 16)


WINDOWS = [(-3, -5, 0, 0, 8, 8), (100_000, 100_000, 0, 0, 8, 8), (50, 50, 0, 0, 10, 10), (0, 0, -9, -9, 1, 1)]


@pytest.mark.parametrize("make", ["tiles", "levels", *WINDOWS], ids=str)
def test_tiled_mipmapped_and_windowed_exr_files_survive_read_and_write(tmp_path: Path, make: Any) -> None:
    spec, values = part(("R", "G", "B", "Z"))
    if make == "tiles":
        spec.tile_width = spec.tile_height = 16
    if make in WINDOWS:
        spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = make
    if make == "levels":
        buffer = oiio.ImageBuf(spec)
        buffer.set_pixels(oiio.ROI(), values)
        assert oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, buffer, str(tmp_path / "x.exr"))
        source = oiio.ImageInput.open(str(tmp_path / "x.exr"))
        assert source is not None and source.seek_subimage(0, 2)
    else:
        store_parts(tmp_path / "x.exr", [(spec, values)])
    picture, truth = read_image(tmp_path / "x.exr"), torch.from_numpy(values).permute(2, 0, 1)[None]
    assert torch.equal(picture.pixels, truth[:, :3]) and torch.equal(read_values(tmp_path / "x.exr", "Z"), truth[:, 3:])
    assert make not in WINDOWS or picture.window == make
    write_image(tmp_path / "copy.exr", picture, sample="float")
    copy = read_image(tmp_path / "copy.exr")
    assert torch.equal(copy.pixels, picture.pixels) and copy.window == picture.window


# Metadata


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".exr"])
def test_metadata_of_the_input_is_kept(tmp_path: Path, suffix: str) -> None:
    attributes: dict[str, Any] = {"Make": "Maker", "Exif__FocalLength": 85.0, "FNumber": 1.8, "ImageDescription": "a b"}
    source = store(tmp_path / f"a{suffix}", np.zeros((4, 4, 3), np.float32), "uint8", **attributes)
    write_image(tmp_path / f"b{suffix}", read_image(source))
    back = spec_of(tmp_path / f"b{suffix}")
    for name, value in attributes.items():
        assert back.getattribute(name.replace("__", ":")) == (value if isinstance(value, str) else pytest.approx(value))
    if suffix == ".exr":  # all but a lossy compression
        write_image(tmp_path / "b.exr", read_image(store(source, stored(source), "half", compression="dwaa:45")))
        assert spec_of(tmp_path / "b.exr").get_string_attribute("compression") == "zip"
        assert spec_of(tmp_path / "b.exr").getattribute("colorInteropID") is None  # the file does not state primaries


# Maps


def test_pfm_rows_start_at_the_bottom_and_the_scale_is_not_applied(tmp_path: Path) -> None:
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    for head, stored_values in ((b"Pf\n3 2\n-0.003922\n", values), (b"Pf\n3 2\n1.0\n", values.astype(">f4"))):
        (tmp_path / "x.pfm").write_bytes(head + stored_values.tobytes())
        assert read_values(tmp_path / "x.pfm")[0, 0].tolist() == [[3, 4, 5], [0, 1, 2]]
    write_image(tmp_path / "x.pfm", Picture(torch.arange(6.0).reshape(1, 1, 2, 3), channels=("Y",)))
    header, size, scale, data = (tmp_path / "x.pfm").read_bytes().split(b"\n", 3)
    assert (header, size) == (b"Pf", b"3 2")
    assert np.frombuffer(data, "<f4" if float(scale) < 0 else ">f4").tolist() == [3, 4, 5, 0, 1, 2]


@pytest.mark.parametrize(
    ("suffix", "kind", "largest"),
    [(".png", np.uint16, 65535), (".tif", np.uint16, 65535), (".png", np.uint8, 255), (".tif", np.int16, -1)],
)
def test_integer_maps_are_not_scaled(tmp_path: Path, suffix: str, kind: Any, largest: int) -> None:
    values = np.array([[0, 1, largest], [7, 100, 200]]).astype(kind)
    assert read_values(store(tmp_path / f"x{suffix}", values, values.dtype.name))[0, 0].tolist() == values.tolist()


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


def test_equal_channels_are_one_map(tmp_path: Path) -> None:
    path = store(tmp_path / "x.png", np.repeat(np.full((2, 2, 1), 9, np.uint8), 3, axis=2), "uint8")
    assert read_values(path).unique().tolist() == [9.0]
