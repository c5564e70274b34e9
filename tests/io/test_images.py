"""Reading and writing images of every format: values, channels, parts and tags."""

import dataclasses
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from PIL import Image

from tests.files import spec_with, store, store_parts
from torchdof.io.colour import stated_primaries, stated_transfer
from torchdof.io.decode import read_parts
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
        assert read_image(path, transfer=transfer).pixels.mean().item() == pytest.approx(expected, abs=5e-3)


def profile(curve: bytes) -> bytes:
    """The parts of an ICC profile that are read: its table of tags, and the red curve."""
    tags = (1).to_bytes(4, "big") + b"rTRC" + (144).to_bytes(4, "big") + len(curve).to_bytes(4, "big")
    return bytes(128) + tags + curve


def png(path: Path, value: int, *chunks: tuple[bytes, bytes]) -> Path:
    """A PNG of 16 bits with one value, and some chunks."""

    def block(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = zlib.compress(b"".join(b"\0" + np.full((6, 3), value, ">u2").tobytes() for _ in range(4)))
    header = (b"IHDR", struct.pack(">IIBBBBB", 6, 4, 16, 2, 0, 0, 0))
    content = [block(*each) for each in (header, *chunks, (b"IDAT", rows), (b"IEND", b""))]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(content))
    return path


def chunks_of(path: Path) -> dict[bytes, bytes]:
    content, start, found = path.read_bytes(), 8, {}
    while start < len(content):
        length = int.from_bytes(content[start : start + 4], "big")
        found[content[start + 4 : start + 8]] = content[start + 8 : start + 8 + length]
        start += 12 + length
    return found


def gamma_chunk(exponent: float) -> tuple[bytes, bytes]:
    return b"gAMA", round(100_000 / exponent).to_bytes(4, "big")


PQ_HALF = 92.2457 / 203.0  # an encoded 0.5 is 92.2457 cd/m2
ICC = b"iCCP", b"x\0\0" + zlib.compress(profile(b"curv" + bytes(8)))


@pytest.mark.parametrize(
    ("stated", "transfer", "light"),
    [
        ([], "srgb", GREY),
        ([gamma_chunk(1.0)], "linear", 0.5),
        ([gamma_chunk(1.8)], "gamma 1.8", 0.5**1.8),
        ([gamma_chunk(2.4)], "gamma 2.4", 0.5**2.4),
        ([gamma_chunk(2.2)], "srgb", GREY),
        ([(b"sRGB", b"\0"), gamma_chunk(1.0)], "srgb", GREY),  # sRGB comes before gAMA
        ([(b"cICP", bytes([1, 8, 0, 1]))], "linear", 0.5),
        ([(b"cICP", bytes([1, 13, 0, 1])), gamma_chunk(1.0)], "srgb", GREY),
        ([(b"cICP", bytes([1, 1, 0, 1]))], "bt709", ((0.5 + 0.0992968) / 1.0992968) ** (1 / 0.45)),
        ([(b"cICP", bytes([9, 16, 0, 1]))], "pq", PQ_HALF),
        ([(b"cICP", bytes([9, 18, 0, 1]))], "hlg", 1 / 12),
    ],
)  # fmt: skip
def test_a_png_is_decoded_as_it_states_and_a_copy_states_the_same(
    tmp_path: Path, stated: Any, transfer: str, light: float
) -> None:
    source = png(tmp_path / "a.png", 32768, *stated)
    picture = read_image(source)
    assert picture.transfer == transfer
    assert float(picture.pixels.mean()) == pytest.approx(light, rel=1e-4)
    assert read_values(source).unique().tolist() == [32768.0]
    assert read_image(source, "linear").pixels.mean() == pytest.approx(0.5, rel=1e-4)
    write_image(tmp_path / "b.png", picture)
    assert stored(tmp_path / "b.png").min() == stored(tmp_path / "b.png").max() == 32768
    copy = chunks_of(tmp_path / "b.png")
    for name, content in stated:
        assert transfer == "srgb" or copy.get(name, content) == content
    again = read_image(tmp_path / "b.png")
    assert again.transfer == transfer and torch.equal(again.pixels, picture.pixels)
    write_image(tmp_path / "c.jpg", picture)  # a JPEG cannot state it
    assert transfer in ("pq", "hlg") or read_image(tmp_path / "c.jpg").pixels.mean() == pytest.approx(light, rel=0.02)


ENCODED = np.linspace(0.0, 1.0, 1024)
ROMM = struct.pack(">HH5i", 3, 0, *(round(65536 * p) for p in (1.8, 1, 0, 1 / 16, 1 / 32)))
BT709 = struct.pack(">HH7i", 4, 0, *(round(65536 * p) for p in (1 / 0.45, 0.9095, 0.0905, 1 / 4.5, 0.081, 0, 0)))
SRGB = struct.pack(">HH5i", 3, 0, *(round(65536 * p) for p in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)))


def table(light: np.ndarray) -> bytes:
    return b"curv" + bytes(4) + len(light).to_bytes(4, "big") + (65535 * light).round().astype(">u2").tobytes()


@pytest.mark.parametrize(
    ("curve", "transfer"),
    [
        (table(np.array([0.0, 1.0])), "linear"),
        (table(ENCODED), "linear"),
        (table(ENCODED**1.8), "gamma 1.8"),
        (table(ENCODED**2.2), None),
        (b"para" + bytes(4) + ROMM, "gamma 1.8"),
        (b"para" + bytes(4) + struct.pack(">HH3i", 1, 0, 2 * 65536, 65536, 0), "gamma 2"),
        (b"para" + bytes(4) + BT709, "gamma 1.9445"),  # with the same light at a half
        (b"para" + bytes(4) + SRGB, None),
        (b"para" + bytes(4) + b"\0\3" + bytes(9), None),  # cut short
    ],
)
def test_the_curve_of_a_profile_is_its_exponent_at_a_half(curve: bytes, transfer: str | None) -> None:
    assert stated_transfer({"ICCProfile": profile(curve)}) == transfer


@pytest.mark.parametrize(
    ("suffix", "sample"), [(".tif", "uint16"), (".tif", "uint8"), (".jpg", "uint8"), (".webp", "uint8")]
)
@pytest.mark.parametrize("gamma", [1.0, 1.8])
def test_the_profile_of_any_file_of_integers_is_decoded_and_kept(
    tmp_path: Path, suffix: str, sample: str, gamma: float
) -> None:
    content = profile(b"para" + bytes(8) + round(gamma * 65536).to_bytes(4, "big"))
    spec = spec_with(np.zeros((8, 8, 3)), sample)
    spec.attribute("ICCProfile", f"uint8[{len(content)}]", np.frombuffer(content, np.uint8))
    store_parts(tmp_path / f"a{suffix}", [(spec, np.full((8, 8, 3), 0.5, np.float32))])
    picture = read_image(tmp_path / f"a{suffix}")
    assert float(picture.pixels.mean()) == pytest.approx(0.5**gamma, abs=0.01)
    for name in (f"b{suffix}", "b.exr"):
        write_image(tmp_path / name, picture)
        copy = read_image(tmp_path / name)
        torch.testing.assert_close(copy.pixels, picture.pixels, rtol=0, atol=0.01)
        assert ("ICCProfile" in copy.metadata) == (name != "b.exr")


def test_the_primaries_of_a_profile_are_those_of_an_exr_and_converted_for_a_pfm(tmp_path: Path) -> None:
    """Display P3, whose red is outside of sRGB, and sRGB, by their columns under D50."""
    p3 = [(0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407)]
    srgb = [(0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141)]
    for columns, red in ((p3, (1.2249, -0.0421, -0.0196)), (srgb, (1.0, 0.0, 0.0))):
        content = bytes(128) + struct.pack(">I", 3)
        for k, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ")):
            content += name + struct.pack(">II", 168 + 20 * k, 20)
        content += b"".join(b"XYZ " + bytes(4) + struct.pack(">3i", *(round(65536 * v) for v in c)) for c in columns)
        spec = spec_with(np.zeros((8, 8, 3)), "uint8")
        spec.attribute("ICCProfile", f"uint8[{len(content)}]", np.frombuffer(content, np.uint8))
        store_parts(tmp_path / "a.tif", [(spec, np.full((8, 8, 3), [1, 0, 0], np.float32))])
        picture = read_image(tmp_path / "a.tif")
        write_image(tmp_path / "b.tif", picture)
        assert torch.equal(read_image(tmp_path / "b.tif").pixels, picture.pixels)
        write_image(tmp_path / "b.exr", picture)
        assert (stated_primaries(read_image(tmp_path / "b.exr").metadata) is None) == (columns is srgb)
        for source in (picture, read_image(tmp_path / "b.exr")):
            write_image(tmp_path / "b.pfm", source)
            converted = read_image(tmp_path / "b.pfm").pixels[0, :, 0, 0]
            torch.testing.assert_close(converted, torch.tensor(red), rtol=0, atol=2e-3)


def test_a_linear_profile_is_decoded_and_an_unknown_encoding_refused(tmp_path: Path) -> None:
    assert stated_transfer({"ICCProfile": profile(b"curv" + bytes(8))}) == "linear"
    gamma = profile(b"para" + bytes(8) + round(1.8 * 65536).to_bytes(4, "big"))
    assert stated_transfer({"ICCProfile": gamma, "oiio:ColorSpace": "lin_rec709_scene"}) == "gamma 1.8"
    assert stated_transfer({"ICCProfile": profile(b"para" + bytes(4) + b"\0\3" + bytes(20))}) is None  # that of sRGB
    for codes in ((1, 9, 0, 1), (3, 13, 0, 1), (9, 16, 0, 0)):
        path = png(tmp_path / "x.png", 9, (b"cICP", bytes(codes)))
        with pytest.raises(ValueError, match=r"x\.png: its colours are encoded as cICP .* expected transfer 1, "):
            read_image(path)
        assert read_image(path, "srgb").transfer == "srgb" and read_values(path).max() == 9.0


@pytest.mark.parametrize(
    ("primaries", "colour", "expected"),  # one colour in both
    [
        ((0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329), (0.6274, 0.0691, 0.0164), (1.0, 0.0, 0.0)),
        ((1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),  # XYZ, white
        ((0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767), (0.4397, 0.0898, 0.0175), (1.0, 0.0, 0.0)),
        ((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329), (0.2, 0.3, 0.4), (0.2, 0.3, 0.4)),
    ],
    ids=["Rec.2020", "XYZ", "ACES 2065-1", "Rec.709"],
)
def test_primaries_of_an_exr_are_kept_in_an_exr_and_else_converted(
    tmp_path: Path, primaries: Any, colour: Any, expected: Any
) -> None:
    spec = oiio.ImageSpec(6, 4, 3, "float")
    spec.attribute("chromaticities", "float[8]", primaries)
    values = np.ones((4, 6, 3), np.float32) * np.array(colour, np.float32)
    picture = read_image(store_parts(tmp_path / "a.exr", [(spec, values)]))
    assert picture.pixels[0, :, 0, 0].tolist() == pytest.approx(colour)
    write_image(tmp_path / "b.exr", picture)
    assert spec_of(tmp_path / "b.exr").getattribute("chromaticities") == pytest.approx(primaries)
    write_image(tmp_path / "b.pfm", picture)
    assert read_image(tmp_path / "b.pfm").pixels[0, :, 0, 0].tolist() == pytest.approx(expected, abs=2e-3)


def test_primaries_of_a_png_are_stated_in_an_exr(tmp_path: Path) -> None:
    write_image(tmp_path / "x.exr", read_image(png(tmp_path / "x.png", 9, (b"cICP", bytes([9, 16, 0, 1])))))
    assert spec_of(tmp_path / "x.exr").getattribute("chromaticities")[:2] == pytest.approx((0.708, 0.292))


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
    store_parts(tmp_path / "y.exr", [colour, small])  # depth of a quarter of the frame
    depth_m = read_image(tmp_path / "y.exr").depth
    assert depth_m is not None and depth_m.isfinite().sum() == 16 * 16
    assert torch.equal(depth_m[0, 0, :16, :16], torch.from_numpy(small[1][..., 0]))
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


# Depth of a layer, view or part


def of_values(**channels: float) -> Any:
    """One part whose channels are constant; `__` in a name stands for a dot."""
    values = np.ones((4, 6, len(channels)), np.float32) * np.array([*channels.values()], np.float32)
    return spec_with(values, "float", tuple(name.replace("__", ".") for name in channels)), values


def named(name: str, part: Any) -> Any:
    part[0].attribute("oiio:subimagename", name)
    return part


COLOUR = dict.fromkeys("RGB", 0.5)


@pytest.mark.parametrize(
    ("parts", "layer", "expected"),  # the depth of the layer, or a part of the refusal
    [
        ([of_values(**COLOUR, Z=2, left__R=1, left__G=1, left__B=1, left__Z=8)], None, 2.0),
        ([of_values(**COLOUR, Z=2, left__R=1, left__G=1, left__B=1, left__Z=8)], "left", 8.0),
        ([of_values(A__C__R=1, A__C__G=1, A__C__B=1, A__Depth__Z=2, B__Depth__Z=8)], "A.C", 2.0),
        ([of_values(b__Combined__R=1, b__Combined__G=1, b__Combined__B=1, a__Depth__Z=2, b__Depth__Z=8)], None, 8.0),
        ([of_values(**COLOUR, a__Depth__Z=2, b__Depth__Z=8)], None, "belongs to the image: a.Depth.Z, b.Depth.Z"),
        ([of_values(**COLOUR, a__Depth__Z=2, b__Depth__Z=2)], None, 2.0),  # the same numbers
        ([of_values(**COLOUR, Z=2, fog__Z=8)], None, 2.0),
        ([of_values(**COLOUR, N__X=1, N__Y=1, N__Z=8, P__Z=2)], None, 2.0),
        ([named("l", of_values(Z=2)), named("rgba_right", of_values(**COLOUR)), named("depth_right", of_values(Z=8))],
         "rgba_right", 8.0),
        ([named("rgba.left", of_values(**COLOUR)), named("z.right", of_values(Z=2)), named("z.left", of_values(Z=8))],
         None, 8.0),
        ([named("image left", of_values(**COLOUR)), named("depth right", of_values(Z=2))], None, "of another view"),
        ([of_values(L__R=1, L__G=1, L__B=1, R__Z=2)], "L", "of another view: R.Z"),
        ([of_values(cam1__R=1, cam1__G=1, cam1__B=1, cam2__Z=2)], None, "of another view: cam2.Z"),
        ([of_values(**COLOUR, Z=2, right__R=1, right__G=1, right__B=1)], "right", "of another view: Z"),
        ([named("beauty", of_values(**COLOUR)), named("tech", of_values(Z=2))], None, 2.0),
        ([named("rgb", of_values(**COLOUR)), named("one", of_values(Z=2)), named("two", of_values(Z=8))], None,
         "belongs to the image: one.Z, two.Z"),
    ],
)  # fmt: skip
def test_depth_is_that_of_the_layer_view_or_part_of_the_image(
    tmp_path: Path, parts: Any, layer: str | None, expected: Any
) -> None:
    picture = read_image(store_parts(tmp_path / "x.exr", parts), layer=layer)
    if isinstance(expected, float):
        assert picture.depth is not None and picture.depth.unique().tolist() == [expected]
        assert read_values(tmp_path / "x.exr", image=picture).unique().tolist() == [expected]
        return
    assert picture.depth is None and expected in picture.depth_problem
    with pytest.raises(ValueError, match=expected):
        read_values(tmp_path / "x.exr", image=picture)


@pytest.mark.parametrize("channel", ["depth_right", "depth_right.Z"])
def test_a_depth_channel_is_chosen_by_the_name_of_its_part(tmp_path: Path, channel: str) -> None:
    parts = [named(name, of_values(Z=z)) for name, z in (("depth_left", 2.0), ("depth_right", 8.0))]
    assert read_values(store_parts(tmp_path / "x.exr", parts), channel).unique().tolist() == [8.0]
    with pytest.raises(ValueError, match="which of its depth channels .*: depth_left.Z, depth_right.Z"):
        read_values(tmp_path / "x.exr", "Z")
    with pytest.raises(ValueError, match="no channel 'depth'; it has Z, Z in the parts depth_left, depth_right"):
        read_values(tmp_path / "x.exr", "depth")


@pytest.mark.parametrize("channels", [{"X": 1, "Y": 1, "Z": 8}, {"V.Mist.Z": 0.7}])
def test_a_coordinate_and_mist_are_no_depth(tmp_path: Path, channels: dict[str, float]) -> None:
    store_parts(tmp_path / "x.exr", [of_values(**COLOUR), named("other", of_values(**channels))])
    assert read_image(tmp_path / "x.exr").depth is None
    with pytest.raises(ValueError, match="which of the channels R, G, B, .* is depth"):
        read_values(tmp_path / "x.exr")


# Data windows


def with_window(values: np.ndarray, box: tuple[int, int, int, int], frame: tuple[int, int] = (0, 0)) -> Any:
    """A part with the values in a box (x, y, end x, end y) of a frame that starts at another place."""
    x, y, end_x, end_y = box
    cut = np.atleast_3d(values[y:end_y, x:end_x])
    spec = spec_with(cut, "float", ("Z",) if cut.shape[2] == 1 else RGB)
    spec.x, spec.y, spec.full_x, spec.full_y = x + frame[0], y + frame[1], *frame
    spec.full_height, spec.full_width = values.shape[:2]
    return spec, cut


FRAME = np.arange(1.0, 24 * 32 + 1, dtype=np.float32).reshape(24, 32)


@pytest.mark.parametrize("of_image", [(0, 0, 32, 24), (8, 6, 28, 20)])
@pytest.mark.parametrize("of_depth", [(0, 0, 32, 24), (8, 6, 32, 24), (2, 0, 32, 24), (0, 4, 10, 8), (28, 20, 32, 24)])
@pytest.mark.parametrize("start", [(0, 0), (-5, 7)])
def test_depth_of_another_data_window_lies_where_its_window_states(
    tmp_path: Path, of_image: Any, of_depth: Any, start: Any
) -> None:
    colours = np.repeat(FRAME[..., None], 3, 2)
    image = with_window(colours, of_image)
    expected = np.full_like(FRAME, np.nan)
    x, y, end_x, end_y = of_depth
    expected[y:end_y, x:end_x] = FRAME[y:end_y, x:end_x]
    x, y, end_x, end_y = of_image
    picture = read_image(store_parts(tmp_path / "image.exr", [image]))
    depth = read_values(store_parts(tmp_path / "depth.exr", [with_window(FRAME, of_depth, start)]), image=picture)
    np.testing.assert_array_equal(depth[0, 0].numpy(), expected[y:end_y, x:end_x])
    both = read_image(store_parts(tmp_path / "both.exr", [image, named("z", with_window(FRAME, of_depth))]))
    assert both.depth is not None
    np.testing.assert_array_equal(both.depth[0, 0].numpy(), expected[y:end_y, x:end_x])


def test_depth_of_half_the_size_or_without_a_window_is_placed_too(tmp_path: Path) -> None:
    part = store_parts(tmp_path / "part.exr", [with_window(np.repeat(FRAME[..., None], 3, 2), (8, 6, 28, 20))])
    picture, cut = read_image(part), FRAME[6:20, 8:28]
    for name, values in (("frame.npy", FRAME), ("part.npy", cut)):  # of the frame, and of the pixels
        np.save(tmp_path / name, values)
        np.testing.assert_array_equal(read_values(tmp_path / name, image=picture)[0, 0].numpy(), cut)
    half = store_parts(tmp_path / "half.exr", [with_window(FRAME[::2, ::2], (2, 0, 16, 12))])
    np.testing.assert_array_equal(read_values(half, image=picture)[0, 0].numpy(), FRAME[6:20:2, 8:28:2])
    odd = store_parts(tmp_path / "odd.exr", [with_window(np.repeat(FRAME[..., None], 3, 2), (7, 6, 28, 20))])
    with pytest.raises(ValueError, match="half.exr: its frame has 16 x 12 pixels, the image's 32 x 24, so that"):
        read_values(half, image=read_image(odd))
    store(tmp_path / "x.png", np.zeros((24, 32, 3), np.uint8), "uint8")
    shifted = store_parts(tmp_path / "z.exr", [with_window(FRAME, (4, 0, 32, 24))])
    assert read_values(shifted, image=read_image(tmp_path / "x.png"))[0, 0, 5, 4] == FRAME[5, 4]


# Other layers of a copy


def test_a_copy_with_all_layers_differs_only_in_the_image(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    names = ("R", "G", "B", "A", "Z", "dif.R", "dif.G", "dif.B", "Crypto00.R", "Crypto00.G")
    beauty = rng.random((6, 8, len(names)), np.float32)
    beauty[..., 3] = 1.0
    spec = spec_with(beauty, "half", names, Owner="me", oiio__subimagename="rgba")
    spec.attribute("cryptomatte/ab12/manifest", "{}")
    kinds = ["half"] * 4 + ["float"] + ["half"] * 3 + ["float"] * 2
    spec.channelformats = tuple(oiio.TypeDesc(kind) for kind in kinds)
    ids = rng.integers(0, 2**32 - 1, (4, 5, 1), np.uint32)
    ids_spec = spec_with(ids, "uint32", ("id",), oiio__subimagename="ids", view="left")
    ids_spec.x, ids_spec.y, ids_spec.full_width, ids_spec.full_height = 2, 1, 8, 6
    source = store_parts(tmp_path / "a.exr", [(ids_spec, ids), (spec, beauty)])
    picture = read_image(source, keep_layers=True)
    changed = dataclasses.replace(picture, pixels=picture.pixels / 2)
    write_image(tmp_path / "b.exr", changed)
    before, after = (read_parts(tmp_path / name) for name in ("a.exr", "b.exr"))
    for old, new in zip(before, after, strict=True):
        assert (new.label, new.window, {*new.names}) == (old.label, old.window, {*old.names})
        for k, name in enumerate(old.names):
            j = new.names.index(name)
            assert new.kinds[j] == old.kinds[k]
            is_image = old.label == "rgba" and name in "RGBA"
            assert np.array_equal(new.values[..., j], old.values[..., k] / (2 if is_image else 1)), name
    assert after[1].metadata["cryptomatte/ab12/manifest"][1] == "{}" and after[0].metadata["view"][1] == "left"
    write_image(tmp_path / "c.exr", read_image(source))
    (alone,) = read_parts(tmp_path / "c.exr")
    assert alone.names == ("R", "G", "B", "A") and alone.metadata["Owner"][1] == "me"
    assert not any(name.startswith("cryptomatte") for name in alone.metadata)


def test_layers_that_cannot_be_kept_are_refused(tmp_path: Path) -> None:
    spec, values = of_values(**COLOUR, id=7)
    spec.channelformats = tuple(map(oiio.TypeDesc, ("half", "half", "half", "uint")))
    path = store_parts(tmp_path / "a.exr", [(spec, values)])
    with pytest.raises(ValueError, match="a.exr: cannot keep the layers: id hold whole numbers beside others"):
        read_image(path, keep_layers=True)
    picture = read_image(store_parts(tmp_path / "b.exr", [of_values(**COLOUR, Z=1)]), keep_layers=True)
    grey = dataclasses.replace(picture, pixels=picture.pixels[:, :1], channels=("Y",))
    with pytest.raises(ValueError, match="cannot keep the layers of a picture whose channels are now Y"):
        write_image(tmp_path / "c.exr", grey)
    write_image(tmp_path / "c.png", picture)  # has no layers


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


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b" ", b"\r"])
@pytest.mark.parametrize("comment", [b"", b"# written by a program\n", b"# 3 4\r\n"])
@pytest.mark.parametrize("is_text", [False, True])
def test_pfm_headers_of_any_line_end_and_with_comments_are_read(
    tmp_path: Path, end: bytes, comment: bytes, is_text: bool
) -> None:
    values = np.array([[2.0, 2.3e-41, 2.5], [3.0, 4.0, 5.0]], "<f4")  # the second contains the byte of a line feed
    values[0, 1] = np.frombuffer(b"\n\r\n@", "<f4")[0]
    data = values[::-1].tobytes()
    if is_text:  # Windows
        data, end = data.replace(b"\n", b"\r\n"), end.replace(b"\n", b"\r\n") if end == b"\n" else end
    (tmp_path / "x.pfm").write_bytes(b"Pf" + end + comment + b"3 2" + end + b"-1.0" + end + data)
    assert np.array_equal(read_values(tmp_path / "x.pfm")[0, 0].numpy(), values)


def test_numbers_like_random_bytes_are_refused_and_sentinels_are_not(tmp_path: Path) -> None:
    depth = np.linspace(2.0, 5.0, 4800, dtype="<f4").reshape(60, 80)
    noise = np.random.default_rng(0).bytes(4 * depth.size)
    for data in (depth.tobytes()[1:] + b"\0", depth.astype(">f4").tobytes(), noise):
        (tmp_path / "x.pfm").write_bytes(b"Pf\n80 60\n-1\n" + data)
        np.save(tmp_path / "x.npy", np.frombuffer(data, "<f4").reshape(60, 80))
        store(tmp_path / "x.exr", np.load(tmp_path / "x.npy"), "float", ("Z",))
        store(tmp_path / "x.tif", np.load(tmp_path / "x.npy"), "float")
        assert "as random bytes have" in read_image(store_parts(tmp_path / "rgbz.exr", [
            (spec_with(np.zeros((60, 80, 3)), "float", RGB), np.zeros((60, 80, 3), np.float32)),
            named("z", (spec_with(np.zeros((60, 80, 1)), "float", ("Z",)), np.load(tmp_path / "x.npy")[..., None])),
        ])).depth_problem  # fmt: skip
        for name in ("x.pfm", "x.npy", "x.exr", "x.tif"):
            with pytest.raises(ValueError, match="as random bytes have: its bytes are in another order"):
                read_values(tmp_path / name)
    depth[20:], depth[:20:2], depth[1] = 1e30, 0.0, np.inf
    np.save(tmp_path / "x.npy", depth)
    assert np.array_equal(read_values(tmp_path / "x.npy")[0, 0].numpy(), depth)


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


def test_primaries_of_a_png_are_converted_unless_it_is_srgb(tmp_path: Path) -> None:
    """Chunk cHRM: white, red, green, blue; Display P3's red is outside of sRGB."""
    path = tmp_path / "p3.png"
    Image.new("RGB", (4, 4), (255, 0, 0)).save(path)  # without sRGB or gAMA
    plain = path.read_bytes()
    body = b"cHRM" + struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
    chunk = struct.pack(">I", 32) + body + struct.pack(">I", zlib.crc32(body))
    path.write_bytes(plain[:33] + chunk + plain[33:])
    stated = read_image(path)
    assert stated_primaries(stated.metadata) == (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)
    write_image(tmp_path / "copy.exr", stated)
    assert stated_primaries(read_image(tmp_path / "copy.exr").metadata) is not None
    write_image(tmp_path / "float.pfm", dataclasses.replace(stated, sample="float", transfer="linear"))
    converted = read_image(tmp_path / "float.pfm").pixels[0, :, 0, 0]
    torch.testing.assert_close(converted, torch.tensor([1.2249, -0.0421, -0.0196]), rtol=0, atol=1e-3)
    body = b"sRGB\0"
    srgb = struct.pack(">I", 1) + body + struct.pack(">I", zlib.crc32(body))
    path.write_bytes(plain[:33] + chunk + srgb + plain[33:])
    assert stated_primaries(read_image(path).metadata) is None


def test_a_float_map_of_one_channel_may_have_holes(tmp_path: Path) -> None:
    values = np.array([[2.0, np.nan], [3.0, 4.0]], np.float32)
    path = store(tmp_path / "x.tif", values, "float")
    assert np.array_equal(read_values(path)[0, 0].numpy(), values, equal_nan=True)


def test_a_pfm_of_half_floats_is_named(tmp_path: Path) -> None:
    path = tmp_path / "half.pfm"
    path.write_bytes(b"Pf\n4 3\n-1.0\n" + np.ones(12, "<f2").tobytes())
    with pytest.raises(OSError, match="half.pfm: holds 2 bytes a number, as of half floats; .* write float32"):
        read_image(path)
