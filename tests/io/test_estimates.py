"""Files of depth estimators: which array is depth, several maps in one file, the camera beside them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchdof.io.estimates import Estimate, estimate_of
from torchdof.io.images import read_values

APPROX: Any = pytest.approx
DEPTH = np.linspace(1, 5, 24, dtype=np.float32).reshape(4, 6)
MATRIX = np.array([[3.0, 0, 3], [0, 3, 2], [0, 0, 1]]) * [[10.0], [10.0], [1.0]]


@pytest.mark.parametrize("name", ["depth", "depths", "predicted_depth"])
def test_the_array_called_depth_is_depth(tmp_path: Path, name: str) -> None:
    arrays: dict[str, Any] = {"conf": DEPTH * 2, name: DEPTH[None], "intrinsics": MATRIX}
    np.savez(tmp_path / "d.npz", **arrays)
    assert np.array_equal(read_values(tmp_path / "d.npz")[0, 0], DEPTH)
    assert np.array_equal(read_values(tmp_path / "d.npz", "conf")[0, 0], DEPTH * 2)
    np.savez(tmp_path / "d.npz", points=DEPTH, conf=DEPTH)
    with pytest.raises(ValueError, match=r"which of the arrays points, conf is depth\? name it"):
        read_values(tmp_path / "d.npz")


def test_pixels_outside_the_mask_of_an_estimator_are_far(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", depth=DEPTH, mask=DEPTH < 4)
    assert read_values(tmp_path / "d.npz")[0, 0].isinf().numpy().tolist() == (DEPTH >= 4).tolist()


def test_several_maps_without_a_sequence_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.stack([DEPTH] * 3))
    with pytest.raises(ValueError, match=r"holds 3 maps \(an array \[3, 4, 6\]\); give a sequence of as many images"):
        read_values(tmp_path / "d.npy")


def test_the_field_of_view_is_that_of_the_estimated_camera(tmp_path: Path) -> None:
    np.savez(tmp_path / "pro.npz", depth=DEPTH, focallength_px=3.0)
    assert estimate_of(tmp_path / "pro.npz", 6) == Estimate(APPROX(90.0))
    several = np.stack([MATRIX, MATRIX * 2])
    np.savez(tmp_path / "three.npz", depth=DEPTH[None], conf=DEPTH[None], intrinsics=several)
    assert estimate_of(tmp_path / "three.npz", 60) == Estimate(APPROX(90.0), APPROX(0.1))
    assert estimate_of(tmp_path / "three.npz", 120, (1, 2)) == Estimate(APPROX(90.0), APPROX(0.2))
    np.savez(tmp_path / "shares.npz", depth=DEPTH, intrinsics=np.diag([0.5, 0.75, 1.0]))
    assert estimate_of(tmp_path / "shares.npz", 6) == Estimate(APPROX(90.0))
    (tmp_path / "fov.json").write_text(json.dumps({"fov_x": 61.5, "fov_y": 40.0}))
    assert estimate_of(tmp_path / "depth.exr", 6) == Estimate(61.5)


def test_a_camera_that_makes_no_sense_is_ignored(tmp_path: Path) -> None:
    cameras: tuple[Any, ...] = ("text", np.zeros((3, 3)), np.zeros(2), np.full((3, 3), np.nan))
    for number, intrinsics in enumerate(cameras):
        np.savez(tmp_path / f"{number}.npz", depth=DEPTH, intrinsics=intrinsics)
        assert estimate_of(tmp_path / f"{number}.npz", 6) == Estimate()
    (tmp_path / "fov.json").write_text("[")
    assert estimate_of(tmp_path / "depth.exr", 6) == Estimate()


@pytest.mark.parametrize(
    "content",
    [
        b"P5\n# a comment\n3 2\n1023\n" + np.array([0, 5, 300, 1000, 1023, 7], ">u2").tobytes(),
        b"P2\n3 2\n1023\n0 5 300 1000 1023 7\n",
    ],
)
def test_a_pgm_map_has_the_numbers_of_its_file(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "d.pgm").write_bytes(content)
    assert read_values(tmp_path / "d.pgm").flatten().tolist() == [0, 5, 300, 1000, 1023, 7]
