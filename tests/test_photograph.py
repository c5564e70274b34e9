"""``torchdof.photo``: the command ``torchdof render`` as a function."""

from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torchdof
from tests.io.test_portraits import HEIC
from tests.refused import refuses
from torchdof.cli.main import app
from torchdof.io.images import Picture, read_image, write_image

IMAGE = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(1))
DEPTH = torch.linspace(0, 1, 32).reshape(1, 1, 32, 1).expand(1, 1, 32, 48)  # relative, larger is nearer


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        ({}, ""),
        ({"focus_at": (4, 4), "blur": 0.05}, "--focus-at 4,4 --blur 5%"),
        ({"focus_at": ((4, 4), (9, 4))}, "--focus-at 4,4 --focus-at 9,4"),
        ({"focus_m": 2.0, "equivalent": (85, 1.4), "near_m": 1.5}, "--focus-m 2 --equivalent 85mm,1.4 --near-m 1.5"),
    ],
)
def test_a_photo_is_the_picture_that_the_command_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object], arguments: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_image("image.exr", Picture(IMAGE, sample="float"))
    np.save("depth.npy", DEPTH.numpy())
    line = CliRunner().invoke(app, f"render image.exr depth.npy -o out.exr {arguments}".split(), catch_exceptions=False)
    written = read_image("out.exr").pixels
    for image, depth in (("image.exr", "depth.npy"), (IMAGE, DEPTH), (IMAGE, Path("depth.npy"))):
        result = torchdof.photo(image, depth, **options)
        assert torch.equal(result.pixels, written)
        assert result.depth.shape == (1, 1, 32, 48) and result.camera is not None
        assert all(note.split()[-1] in line.output for note in result.notes if ":" not in note)


def test_a_portrait_needs_no_depth() -> None:
    result = torchdof.photo(HEIC, tolerance="draft")
    assert result.picture.matte is not None and "its own depth is used, from 0.5 to 4 m" in result.notes[0]
    assert float(result.depth.min()) == pytest.approx(0.5) and result.coc_px.shape == (1, 1, 192, 128)


test_wrong_arguments_are_refused = refuses(
    (lambda: torchdof.photo(IMAGE, DEPTH, out="a.png"), "unknown options out; expected some of aperture, "),
    (lambda: torchdof.photo(IMAGE, DEPTH, blur=3), "blur must be a share of the width, .* such as 0.02, got 3"),
    (lambda: torchdof.photo(IMAGE[0], DEPTH), r"image must be \[1, C, H, W\]"),
    (lambda: torchdof.photo(IMAGE, DEPTH[0]), r"depth must be \[B, 1, H, W\]"),
    (lambda: torchdof.photo(IMAGE), "has no depth channel"),
    (lambda: torchdof.photo(IMAGE, DEPTH, focus_m=2.0, focus_at=(1, 1)), "both say where to focus"),
)
