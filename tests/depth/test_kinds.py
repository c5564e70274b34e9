import functools
import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.refused import refuses
from torchdof.depth import from_relative, read_depth
from torchdof.depth.holes import fill_holes
from torchdof.depth.kinds import depth_from_values

NAN, INF = math.nan, math.inf


def row(*values: float) -> torch.Tensor:
    return torch.tensor([[[values]]])


@pytest.mark.parametrize(
    ("kind", "options", "value", "expected"),
    [
        ("z", {}, 2.5, 2.5),
        ("z", {"scale": 0.001}, 1500.0, 1.5),
        ("z", {"scale": 0.5, "offset": 2.0}, 4.0, 3.0),
        ("z", {}, INF, INF),
        ("disparity", {"scale": 0.193001 * 994.978, "offset": 31.086}, 50.0, 2.368248),
        ("disparity", {"scale": 100.0}, 0.0, INF),
        ("inverse", {}, 0.25, 4.0),
        ("inverse", {"scale": 2.0, "offset": 0.5}, 0.5, 2.0),
        ("coc", {}, -3.5, -3.5),
        ("coc", {"scale": 0.5}, 4.0, 2.0),
        ("coc", {}, 0.0, 0.0),
        *(("z", {}, value, NAN) for value in (0.0, -1.0, NAN)),
        *((kind, {"fov_x_deg": 1.0}, -INF, 1.0) for kind in ("z", "distance")),  # too near, so as near as the nearest
        ("z", {"unknown": -INF}, -INF, NAN),
        ("z", {"unknown": INF}, INF, NAN),
        ("z", {"unknown": 65535.0, "scale": 0.001}, 65535.0, NAN),
        *(("disparity", {"scale": 100.0}, value, NAN) for value in (INF, -2.0)),
        ("disparity", {"scale": 100.0, "unknown": 0.0, "offset": 5.0}, 0.0, NAN),
        ("inverse", {}, NAN, NAN),
        *(("coc", {}, value, NAN) for value in (INF, NAN)),
    ],
)
def test_kinds_of_depth_follow_formulas(kind: Any, options: dict[str, float], value: float, expected: float) -> None:
    first, other = depth_from_values(row(value, 1.0), kind, **options).flatten().tolist()
    assert first == pytest.approx(expected, rel=1e-5, nan_ok=True) and not math.isnan(other)


def test_distance_along_the_ray_of_a_plane_gives_back_its_depth() -> None:
    height, width, focal_px = 30, 40, 35.0
    y, x = torch.meshgrid(torch.arange(height) + 0.5 - height / 2, torch.arange(width) + 0.5 - width / 2, indexing="ij")
    length = 3.0 * torch.sqrt(1 + (x / focal_px) ** 2 + (y / focal_px) ** 2)
    fov_x_deg = math.degrees(2 * math.atan(width / 2 / focal_px))
    depth = depth_from_values(length[None, None], "distance", fov_x_deg=fov_x_deg)
    torch.testing.assert_close(depth, torch.full_like(depth, 3.0))


CORNER = torch.full((1, 1, 2, 3), NAN)
CORNER[0, 0, 0, 0] = 2.0
CROSS = torch.tensor([[[[1.0, INF, 1.0], [2.0, NAN, 3.0], [1.0, 1.0, 1.0]]]])


@pytest.mark.parametrize(
    ("depth", "fill", "expected"),
    [
        (row(1.0, NAN, NAN, 4.0), "nearest", [1.0, 1.0, 4.0, 4.0]),
        (row(1.0, NAN, NAN, NAN, 4.0), "far", [1.0, 4.0, 4.0, 4.0, 4.0]),
        (row(1.0, NAN, NAN, NAN, 4.0), 9.0, [1.0, 9.0, 9.0, 9.0, 4.0]),
        (row(1.0, NAN, NAN, NAN, 4.0), INF, [1.0, INF, INF, INF, 4.0]),
        (row(-5.0, NAN, -2.0), "far", [-5.0, -2.0, -2.0]),  # circles of confusion
        (CROSS, "far", [1.0, INF, 1.0, 2.0, INF, 3.0, 1.0, 1.0, 1.0]),  # searches columns too
        (CORNER, "far", [2.0] * 6),  # the nearest, where row and column have no depth
    ],
)
def test_holes_are_filled_by_the_given_rule(depth: torch.Tensor, fill: Any, expected: list[float]) -> None:
    assert fill_holes(depth, fill).flatten().tolist() == expected


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**31))
def test_nearest_is_as_near_as_the_nearest_of_all_pixels(height: int, width: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    depth = torch.rand(height, width, generator=generator) + 1.0
    depth[torch.rand(height, width, generator=generator) < 0.7] = NAN
    known = torch.nonzero(~depth.isnan()).tolist()
    if not known:
        return
    filled = fill_holes(depth[None, None], "nearest")[0, 0]
    for y in range(height):
        for x in range(width):
            best = min((y - i) ** 2 + (x - j) ** 2 for i, j in known)
            got = min((y - i) ** 2 + (x - j) ** 2 for i, j in known if depth[i, j] == filled[y, x])
            assert math.sqrt(got) <= math.sqrt(best) + 0.5


test_invalid_arguments_are_refused = refuses(
    (lambda: depth_from_values(row(1.0), cast(Any, "metres")), "must be one of z, distance, disparity, inverse"),
    (lambda: depth_from_values(row(1.0), "disparity"), "disparity needs a scale"),
    (lambda: depth_from_values(row(1.0), "distance"), "needs the horizontal field of view"),
    (lambda: depth_from_values(row(1.0), "distance", fov_x_deg=180.0), r"must be a number of degrees > 0 and < 180"),
    (lambda: depth_from_values(row(1.0), "z", scale=0.0), r"scale \(--depth-scale\) must not be 0"),
    (lambda: depth_from_values(row(1.0), "z", offset=NAN), r"offset \(--depth-offset\) must be a number"),
    *((functools.partial(fill_holes, row(NAN), fill), "no pixel has a depth; check the kind, scale and offset")
      for fill in cast(Any, ("nearest", "far"))),
    *((functools.partial(fill_holes, row(1.0, NAN), fill), "fill")
      for fill in cast(Any, ("middle", 0.0, -1.0, NAN, True))),
)  # fmt: skip


def test_relative_depth_is_read_with_its_nearest_and_farthest_distance(tmp_path: Path) -> None:
    path, values = tmp_path / "d.npy", torch.tensor([[[[0.0, 0.25], [0.5, 1.0]]]])
    np.save(path, values[0, 0].numpy())
    for kind in ("disparity", "depth"):
        read = read_depth(path, "relative", near_m=1.0, far_m=8.0, relative_kind=kind, value_range=(0.0, 2.0))
        assert torch.equal(read, from_relative(values, 1.0, 8.0, kind, value_range=(0.0, 2.0)))
    assert torch.equal(read_depth(path, "relative", near_m=1.0, far_m=8.0), from_relative(values, 1.0, 8.0))
    for wrong, message in (
        ({"near_m": 1}, "relative depth needs near_m and far_m"),
        ({"near_m": 1, "far_m": 2, "scale": 2.0}, "relative depth has no scale and offset"),
        ({"kind": "z", "near_m": 1, "far_m": 2}, "near_m, far_m describe relative depth; .* 'relative' .* got 'z'"),
        ({"kind": "metres"}, "the kind of depth must be one of z, .*, relative, got 'metres'"),
    ):
        with pytest.raises(ValueError, match=message):
            read_depth(path, **cast(Any, {"kind": "relative", **wrong}))


def test_holes_are_refused_without_a_fill(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.array([[1.0, 0.0], [np.nan, 2.0]]))
    with pytest.raises(ValueError, match=r"d\.npy: 2 pixels \(50\.0 %\) have no depth"):
        read_depth(tmp_path / "d.npy")
    assert read_depth(tmp_path / "d.npy", fill="far").flatten().tolist() == [1.0, 2.0, 2.0, 2.0]
