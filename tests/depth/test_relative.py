"""Relative depth to metres: between two distances, and from points of known distance."""

import functools
import math
from typing import Any

import numpy as np
import pytest
import torch

from tests.refused import refuses
from tests.tolerances import TOLERANCES
from torchdof.depth import depth_from_values, from_relative, solve_scale
from torchdof.depth.relative import RELATIVE_KINDS

NAN, INF = math.nan, math.inf


def row(*values: float) -> torch.Tensor:
    return torch.tensor([[[list(values)]]])


@pytest.mark.parametrize("kind", RELATIVE_KINDS)
def test_extremes_are_at_near_and_far_and_values_between_follow_the_formula(kind: Any) -> None:
    expected = [2.0, 3.5, 8.0] if kind == "depth" else [8.0, 1 / (0.25 / 2 + 0.75 / 8), 2.0]
    torch.testing.assert_close(from_relative(row(-3.0, -2.0, 1.0), 2.0, 8.0, kind), row(*expected))


@pytest.mark.parametrize("kind", RELATIVE_KINDS)
@pytest.mark.parametrize("factor", [1e-6, 1.0, 3e7])
def test_scale_and_shift_of_the_values_do_not_matter(kind: Any, factor: float) -> None:
    values = torch.rand(1, 1, 5, 7, dtype=torch.float64)
    expected = from_relative(values, 1.5, 9.0, kind)
    torch.testing.assert_close(from_relative(factor * (values - 0.3), 1.5, 9.0, kind), expected)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.uint32, *TOLERANCES])
def test_integers_become_float32_and_floating_types_are_kept(dtype: torch.dtype) -> None:
    values = torch.tensor([[[[0, 30, 127]]]]).to(dtype)
    depth = from_relative(values, 1.0, 4.0)
    assert depth.dtype == (dtype if dtype.is_floating_point else torch.float32)
    expected = from_relative(values.double(), 1.0, 4.0).to(depth.dtype)
    torch.testing.assert_close(depth, expected, **TOLERANCES[depth.dtype])
    large = torch.tensor([[[[2**30, 2**30 + 1, 2**30 + 2]]]], dtype=torch.int32)
    assert from_relative(large, 1.0, 3.0, "depth").flatten().tolist() == [1.0, 2.0, 3.0]


def test_holes_stay_holes_and_do_not_stretch_the_range() -> None:
    depth = from_relative(row(1.0, NAN, 2.0, INF, -INF, 0.0), 1.0, 2.0, "depth", unknown=0.0)
    torch.testing.assert_close(depth, row(1.0, NAN, 2.0, NAN, NAN, NAN), equal_nan=True)


def test_each_item_has_its_own_extremes_unless_value_range_sets_the_scale_and_clamps_values() -> None:
    values = torch.stack([row(0.0, 1.0)[0], row(50.0, 90.0)[0]])
    assert from_relative(values, 1.0, 2.0).flatten().tolist() == [2.0, 1.0, 2.0, 1.0]
    depth = from_relative(row(-5.0, 0.0, 50.0, 100.0, 120.0), 1.0, 3.0, "depth", value_range=(0.0, 100.0))
    assert depth.flatten().tolist() == [1.0, 1.0, 2.0, 3.0, 3.0]
    assert from_relative(row(50.0), 1.0, 3.0, "depth", value_range=(0.0, 100.0)).item() == 2.0


def test_the_farthest_disparity_may_lie_at_infinity_and_passes_no_gradient() -> None:
    values = row(0.0, 0.5, 1.0, NAN).requires_grad_()
    depth = from_relative(values, 1.0, INF)
    assert depth[..., :3].flatten().tolist() == [INF, 2.0, 1.0]
    depth[depth.isfinite()].sum().backward()
    assert values.grad is not None and bool(values.grad.isfinite().all())


# each makes a call that `refuses` runs
relative: Any = functools.partial(functools.partial, from_relative)
solved: Any = functools.partial(functools.partial, solve_scale)
TWO = row(1.0, 2.0)
test_invalid_arguments_are_refused = refuses(
    (relative(TWO, 5.0, 1.0), "near_m must be nearer than far_m, got near_m=5 and far_m=1"),
    (relative(TWO, 0.0, 1.0), "near_m must be a number of metres > 0"),
    (relative(TWO, 1.0, INF, "depth"), "far_m must be a number"),
    (relative(TWO, 1.0, 2.0, "metric"), "must be one of disparity, inverse, depth, got 'metric'"),
    (relative(row(3.0, 3.0), 1.0, 2.0), "two different values, got one value everywhere; give value_range"),
    (relative(row(NAN, INF), 1.0, 2.0), "no pixel has a depth; check the map"),
    (relative(torch.ones(3, 4), 1.0, 2.0), r"\[B, 1, H, W\] .*got \[3, 4\]"),
    (relative(np.ones((3, 4)), 1.0, 2.0), r"got a float64 array of shape \[3, 4\]; use torch.from_numpy"),
    (relative(torch.ones(1, 1, 3, 4, dtype=torch.bool), 1.0, 2.0), "got a torch.bool"),
    (relative(torch.ones(1, 1, 0, 4), 1.0, 2.0), "at least one pixel"),
    *((relative(TWO, 1.0, 2.0, value_range=pair), "value_range")
      for pair in ((2.0, 1.0), (0.0, NAN), (1.0,), "0,1")),
    *((solved(row(1.0, 2.0, 4.0), points, kind, patch=1), message)
      for points, kind, message in (
          ([(0.5, 0.5, 1.0), (0.6, 0.5, 2.0)], "disparity", "at least two points of different values, got 2"),
          ([(0.5, 0.5, 1.0), (2.5, 0.5, 4.0)], "disparity", "that is kind='depth', not 'disparity'"),
          ([(0.5, 0.5, 4.0), (2.5, 0.5, 1.0)], "depth", "that is kind='disparity', not 'depth'"),
          ([(0.5, 0.5, 1.0), (9.5, 0.5, 4.0)], "disparity", "must lie in the map of 3 x 1 pixels"),
          ([(0.5, 0.5, 0.0), (2.5, 0.5, 4.0)], "disparity", "the distance of a point must be a number of metres > 0"),
          ([(0.5, 0.5), (2.5, 0.5, 4.0)], "disparity", r"a point must be \(x, y, metres\)"),
          ([(0.5, 0.5, 1.0), (2.5, 0.5, 4.0)], "z", "must be one of disparity, inverse, depth"))),
)  # fmt: skip


@pytest.mark.parametrize("kind", RELATIVE_KINDS)
def test_two_points_give_scale_and_offset_exactly(kind: Any) -> None:
    values = torch.rand(1, 1, 20, 30)
    depth = 0.7 + 3.0 * values if kind == "depth" else 1 / (0.7 * values + 0.1)
    points = [(x + 0.5, y + 0.5, float(depth[0, 0, y, x])) for x, y in ((3, 4), (25, 11))]
    scale = solve_scale(values, points, kind, patch=1)
    torch.testing.assert_close(scale.depth(values), depth, rtol=1e-4, atol=1e-4)
    as_options = depth_from_values(values, scale.kind, scale=scale.scale, offset=scale.offset)
    torch.testing.assert_close(as_options, depth, rtol=1e-4, atol=1e-4)
    assert scale.residual < 1e-5


def test_near_points_do_not_outweigh_far_ones() -> None:
    values = torch.rand(1, 1, 40, 60, generator=torch.Generator().manual_seed(3))
    depth = 1 / (0.98 * values + 0.02)  # 1 to 50 m
    places = [((7 * y) % 60, y) for y in range(40)]
    points = [(x + 0.5, y + 0.5, float(depth[0, 0, y, x]) * (1 + 0.02 * (-1) ** y)) for x, y in places]
    scale = solve_scale(values, points, patch=1)
    assert scale.residual == pytest.approx(0.02, rel=0.1)
    assert float((scale.depth(values) / depth - 1).abs().max()) < 0.03


def test_a_point_at_infinity_fixes_the_offset() -> None:
    scale = solve_scale(row(0.5, 1.0, 2.0), [(0.5, 0.5, INF), (2.5, 0.5, 2.0)], patch=1)
    assert scale.offset == pytest.approx(-0.5) and scale.scale == pytest.approx(3.0)
    assert scale.depth(row(0.25, NAN))[0, 0, 0, 0] == INF and bool(scale.depth(row(0.25, NAN))[0, 0, 0, 1].isnan())


def as_read(values: torch.Tensor, most: float, **way: Any) -> torch.Tensor:
    """The values from 0 to ``most`` for which the depth of a map stands."""
    return most / from_relative(values, 1.0, INF, value_range=(0.0, most), **way)


@pytest.mark.parametrize("level", [1.0, 1.0 / 255.0])
def test_steps_of_8_bits_on_a_smooth_surface_become_ramps_and_edges_stay(level: float) -> None:
    given = torch.linspace(20.0, 110.0, 900).round().expand(1, 1, 12, 900).clone()  # ten pixels for each level
    given[..., 450:] += 40.0
    found = as_read(given * level, 255.0 * level) / level
    torch.testing.assert_close(found, given, rtol=0.0, atol=0.5001)
    steps = found.diff(dim=-1).abs()
    assert float(steps[..., 449].min()) > 39.0
    steps[..., 449] = 0.0
    assert float(steps.max()) < 0.3, "of one level as given"


@pytest.mark.parametrize("most", [40.0, 256.0])
def test_steps_of_few_levels_and_of_more_than_8_bits_stay(most: float) -> None:
    given = torch.linspace(1.0, most, 600).round().expand(1, 1, 4, 600)
    torch.testing.assert_close(as_read(given, most), given)


def test_an_unknown_value_does_not_move_the_next_level() -> None:
    given = torch.linspace(1.0, 255.0, 600).round().expand(1, 1, 4, 600).clone()
    given[..., 0] = 0.0
    found = as_read(given, 255.0, unknown=0.0)
    given[..., 0] = NAN
    torch.testing.assert_close(found, as_read(given, 255.0), equal_nan=True)
