"""``torchdof render`` of phone portraits, which need no depth file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.io.test_portraits import HEIC, NEAR_FAR, PHOTOGRAPH, STEPS
from tests.phones import gdepth, jpeg, multi_picture, png
from torchdof.cli.frame import read_frame
from torchdof.cli.options import Scene
from torchdof.io.images import read_image

Run = Callable[..., str]


def scene(**options: Any) -> Scene:
    return Scene(**options)


def test_an_iphone_portrait_is_rendered_by_one_command(tmp_path: Path, run: Run) -> None:
    line = run(f"render {HEIC} -o", tmp_path / "out.jpg")
    assert "5.7 mm, from the file" in line and "0.5 m, on what is nearest the middle" in line
    written = read_image(tmp_path / "out.jpg")
    assert written.pixels.shape == (1, 3, 192, 128) and written.orientation == 1
    assert written.metadata["Exif:FocalLengthIn35mmFilm"][1] == 26
    run(f"inspect {HEIC} -o", tmp_path / "sheet.png")


def test_options_come_before_what_a_portrait_states_about_its_depth(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(gdepth(jpeg(PHOTOGRAPH), png(STEPS), **NEAR_FAR))
    frame = read_frame(path, None, scene())
    assert (float(frame.values.min()), float(frame.values.max())) == pytest.approx((2.0, 6.0))
    assert frame.guess.startswith("its own depth is used, from 2 to 6 m") and not frame.remarks
    far = read_frame(path, None, scene(near_m=1.0, far_m=30.0)).values
    assert (float(far[0, 0, 12, 4]), float(far[0, 0, 12, 28])) == pytest.approx((1.0, 30.0))
    numbers = read_frame(path, None, scene(depth_kind="z", depth_scale=0.1, depth_offset=1.0)).values
    assert float(numbers[0, 0, 12, 4]) == pytest.approx(25.6)

    np.save(tmp_path / "d.npy", np.full((24, 32), 3.0))
    assert float(read_frame(path, tmp_path / "d.npy", scene(depth_kind="z")).values.mean()) == 3.0
    (tmp_path / "plain.jpg").write_bytes(jpeg(PHOTOGRAPH))
    assert torch.equal(read_frame(tmp_path / "plain.jpg", path, scene()).values, frame.values)  # as the depth file


def test_distances_along_the_ray_need_the_field_of_view(tmp_path: Path) -> None:
    path, flat = tmp_path / "a.jpg", np.full((24, 32), 255, np.uint8)
    path.write_bytes(gdepth(jpeg(PHOTOGRAPH), png(flat), MeasureType="OpticRay", **NEAR_FAR))
    with pytest.raises(ValueError, match="needs --fov-deg"):
        read_frame(path, None, scene())
    corner = read_frame(path, None, scene(fov_deg=90.0, aperture_radius_m=0.01)).values[0, 0, 0, 0]
    assert float(corner) == pytest.approx(6.0 / np.sqrt(1 + (15.5 / 16) ** 2 + (11.5 / 16) ** 2), rel=1e-3)


def test_depth_without_a_statement_is_guessed_and_damaged_depth_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(multi_picture(jpeg(PHOTOGRAPH), jpeg(STEPS)))
    assert "taken for relative depth" in read_frame(path, None, scene()).guess
    path.write_bytes(gdepth(jpeg(PHOTOGRAPH), b"text", **NEAR_FAR))
    with pytest.raises(ValueError, match="a.jpg: its depth cannot be used: it is neither"):
        read_frame(path, None, scene())
