"""Files with a subject's mask."""

from functools import partial
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from click.testing import CliRunner
from PIL import Image

import torchdof
from tests.files import store_parts
from tests.io.test_portraits import HEIC
from tests.refused import refuses
from torchdof.cli.main import app
from torchdof.io.images import Picture, read_image, write_image
from torchdof.io.matte import matte_of_size, read_matte

GREY = np.array([[0, 51, 255]], np.uint8)
EXPECTED = torch.tensor([[[[0.0, 0.2, 1.0]]]])


def stored(path: Path, values: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        Image.fromarray(values).save(path)
    return path


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("grey.png", GREY),
        ("16_bits.png", GREY.astype(np.uint16) * 257),
        ("equal_channels.png", np.repeat(GREY[..., None], 3, -1)),
        ("cut_out.png", np.concatenate([np.full((1, 3, 3), 90, np.uint8), GREY[..., None]], -1)),
        ("bytes.npy", GREY),
        ("floats.npy", GREY / 255),
    ],
)
def test_numbers_of_a_mask_are_coverage_without_a_transfer_curve(name: str, values: np.ndarray, tmp_path: Path) -> None:
    torch.testing.assert_close(read_matte(stored(tmp_path / name, values)), EXPECTED)


@pytest.mark.parametrize(("name", "kind"), [("m.png", np.uint8), ("m.npy", np.uint8), ("m.npy", bool)])
def test_labels_of_0_and_1_are_coverage_too(name: str, kind: type, tmp_path: Path) -> None:
    labels = stored(tmp_path / name, np.array([[0, 1, 1]], kind))
    assert torch.equal(read_matte(labels), torch.tensor([[[[0.0, 1.0, 1.0]]]]))


def test_shades_of_grey_are_coverage_where_nothing_is_transparent(tmp_path: Path) -> None:
    opaque = np.stack([*[GREY.astype(np.uint8)] * 3, np.full(GREY.shape, 255, np.uint8)], -1)
    torch.testing.assert_close(read_matte(stored(tmp_path / "m.png", opaque)), EXPECTED)


def test_a_smaller_mask_is_resampled_to_the_photograph(tmp_path: Path) -> None:
    mask = read_matte(stored(tmp_path / "m.png", np.full((4, 6), 255, np.uint8)), (8, 12))
    assert torch.equal(mask, torch.ones(1, 1, 8, 12))


def test_a_mask_of_another_data_window_is_placed(tmp_path: Path) -> None:
    """The subject is in columns 3 to 5 of a frame of 12; the photograph shows columns 2 to 7."""
    spec = oiio.ImageSpec(4, 4, 1, "float")
    spec.x, spec.full_width = 3, 12
    store_parts(tmp_path / "m.exr", [(spec, np.repeat([[1, 1, 1, 0]], 4, 0).astype(np.float32)[..., None])])
    frame = read_matte(tmp_path / "m.exr", (4, 12), (0, 0, 0, 0, 12, 4))
    part = read_matte(tmp_path / "m.exr", (4, 6), (2, 0, 0, 0, 12, 4))
    assert frame[0, 0, 0].tolist() == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, 0]
    assert torch.equal(part, frame[..., 2:8])


MASK = torch.zeros(1, 1, 4, 6)

test_a_mask_of_another_shape_is_refused = refuses(
    (partial(matte_of_size, MASK, (6, 4)), "shape of the photograph, it has 6 x 4 pixels beside a photograph of 4 x 6"),
    (partial(matte_of_size, MASK, (8, 8)), "crop or turn it"),
)


def test_files_that_hold_no_coverage_are_refused(tmp_path: Path) -> None:
    for values, message in (
        (np.array([[0.0, 2.0]]), r"m.npy: a matte must hold coverage in \[0, 1\], it holds 0 to 2"),
        (np.array([[0.0, np.nan]]), "it holds nan to nan"),
        (np.array([[-1, 3]]), "coverage"),
    ):
        with pytest.raises(ValueError, match=message):
            read_matte(stored(tmp_path / "m.npy", values))
    colours = stored(tmp_path / "m.png", np.arange(12, dtype=np.uint8).reshape(1, 4, 3))
    with pytest.raises(ValueError, match="m.png: a matte must have one channel or alpha, it has R, G, B, all unequal"):
        read_matte(colours)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cover = torch.zeros(1, 1, 48, 64)
    cover[..., :30], cover[..., 30] = 1.0, 0.25
    image = torch.rand(1, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    write_image("image.exr", Picture(image, sample="float"))
    np.save("depth.npy", torch.where(cover.roll(-2, -1) > 0.9, 1.0, 4.0)[0, 0].numpy())
    Image.fromarray((255 * cover[0, 0]).byte().numpy()).save("mask.png")
    Image.fromarray(np.zeros((64, 48), np.uint8)).save("turned.png")


def render(line: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, f"render {line}".split(), catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.output


def test_the_command_and_photo_use_a_mask(files: None) -> None:
    options = "--focus-m 4 --aperture-radius-m 0.05 --fov-deg 40"
    render(f"image.exr depth.npy -o plain.exr {options}")
    render(f"image.exr depth.npy -o matted.exr {options} --matte mask.png")
    render(f"image.exr depth.npy -o none.exr {options} --matte none")
    plain, matted, none = (read_image(f"{name}.exr").pixels for name in ("plain", "matted", "none"))
    assert torch.equal(plain, none) and float((matted - plain).abs().max()) > 0.01
    camera = {"focus_m": 4.0, "aperture_radius_m": 0.05, "fov_deg": 40.0}
    for matte in ("mask.png", read_matte("mask.png")):
        assert torch.equal(torchdof.photo("image.exr", "depth.npy", matte=matte, **camera).pixels, matted)
    for line, message in (
        ("--matte turned.png", "turned.png: a matte must have the shape of the photograph"),
        ("--matte missing.png", "missing.png"),
        ("--matte mask.png --no-occlusion", "a matte needs occlusion=True"),
    ):
        assert message in render(f"image.exr depth.npy -o out.exr {options} {line}", 2)


def test_a_portrait_is_rendered_with_its_own_matte_unless_none_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    told = render(f"{HEIC} -o own.png --blur 5%")
    assert "own.png: the own matte of the portrait decides where the subject ends (else --matte)" in told
    assert "own matte of" not in render(f"{HEIC} -o none.png --blur 5% --matte none")
    own, none = (read_image(name).pixels for name in ("own.png", "none.png"))
    assert not torch.equal(own, none)


def test_each_frame_has_its_own_mask_or_all_share_one(files: None) -> None:
    options = "--focus-m 4 --aperture-radius-m 0.05 --fov-deg 40"
    for n in (1, 2):
        Path(f"shot.{n}.exr").write_bytes(Path("image.exr").read_bytes())
    Image.open("mask.png").save("mask.1.png")
    Image.open("mask.png").transpose(Image.Transpose.FLIP_LEFT_RIGHT).save("mask.2.png")
    render(f"shot.#.exr depth.npy -o own.#.exr {options} --matte mask.#.png")
    render(f"shot.#.exr depth.npy -o same.#.exr {options} --matte mask.png")
    render(f"image.exr depth.npy -o one.exr {options} --matte mask.png")
    own_1, own_2, same_2, one = (read_image(f"{name}.exr").pixels for name in ("own.1", "own.2", "same.2", "one"))
    assert torch.equal(own_1, one) and torch.equal(same_2, one) and not torch.equal(own_2, one)
    Path("mask.2.png").unlink()
    assert "mask.2.png" in render(f"shot.#.exr depth.npy -o own.#.exr {options} --matte mask.#.png", 2)
    message = "mask.#.png: masks of frames are for a sequence"
    assert message in render(f"image.exr depth.npy -o out.exr {options} --matte mask.#.png", 2)
