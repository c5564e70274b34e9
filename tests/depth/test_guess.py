"""Guesses about depth maps: the kind and direction of their numbers, and the distance of the subject."""

import math

import pytest
import torch
from torch import Tensor

from torchdof.depth import from_relative
from torchdof.depth.guess import Guess, guess_kind, subject_m

ROWS, COLUMNS = 48, 64
MILLIMETRES = Guess("z", 0.001, 0.0)


def ground(top: float, bottom: float) -> Tensor:
    """A map ``[1, 1, 48, 64]`` that is linear from its top row to its bottom row."""
    return torch.linspace(top, bottom, ROWS)[None, None, :, None].repeat(1, 1, 1, COLUMNS)


@pytest.mark.parametrize(
    ("values", "whole", "expected"),
    [
        (ground(0, 255).round(), False, Guess("relative")),
        (ground(255, 0).round(), False, Guess("relative", relative_kind="depth")),
        (ground(0, 65535).round(), False, Guess("relative")),
        (ground(65535, 900).round(), False, Guess("relative", relative_kind="depth")),
        (ground(7000, 600).round(), False, MILLIMETRES),
        (ground(600, 7000).round(), False, Guess("relative")),  # the ground would be farther than the sky
        (ground(8.0, 1.5), False, Guess("z")),
        (ground(0.3, 12.0), False, Guess("relative")),
        (ground(0.0, 1.0), False, Guess("relative")),
        (ground(1.0, 0.0), False, Guess("relative", relative_kind="depth")),
        (ground(0.9, 0.2), False, Guess("z")),  # a close-up
        (ground(-0.4, 3.0), False, Guess("relative")),
        (torch.cat([ground(-1.0, -1.0), ground(8.0, 1.5)], 3), False, Guess("z")),  # -1 was not measured
        (ground(6.0, 2.0).round(), False, Guess("z")),  # a few whole metres
        (ground(4000.5, 600.25), False, MILLIMETRES),  # resampled
        ((ground(2.0, 0.2).round() * 100), True, Guess("relative", relative_kind="depth")),
        (torch.full((1, 1, 4, 4), 2.0), False, Guess("z")),
        (torch.tensor([2.0, 6.0]).repeat_interleave(32).repeat(1, 1, ROWS, 1), False, Guess("z")),  # equal downwards
        (torch.full((1, 1, 4, 4), math.nan), False, Guess("z")),
    ],
)
def test_the_kind_of_a_map_follows_from_its_numbers(values: Tensor, whole: bool, expected: Guess) -> None:
    assert guess_kind(values, whole) == expected


def portrait(person: float, wall: float) -> Tensor:
    """A person, who fills the middle of the bottom, in front of a wall that is a little slanted."""
    values = torch.linspace(wall, wall + 0.05, COLUMNS).expand(1, 1, ROWS, COLUMNS).clone()
    values[..., ROWS // 4 :, COLUMNS // 3 : 2 * COLUMNS // 3] = torch.linspace(person, person + 0.02, COLUMNS // 3)
    return (values - values.min()) / (values.max() - values.min())


def test_the_direction_of_a_portrait_is_that_of_the_person_and_is_not_sure() -> None:
    for values, kind in ((portrait(0.2, 0.8), "depth"), (portrait(0.8, 0.2), "disparity")):
        guess = guess_kind(values)
        assert (guess.relative_kind, guess.is_sure) == (kind, False)
    assert guess_kind(ground(0.0, 1.0)).is_sure and guess_kind(ground(1.0, 0.0)).is_sure
    corridor = torch.maximum(*((torch.linspace(-1, 1, n).abs().unsqueeze(d)) for n, d in ((ROWS, 1), (COLUMNS, 0))))
    assert guess_kind(corridor[None, None]) == Guess("relative")


def test_numbers_from_100_on_are_no_metres() -> None:
    """MiDaS writes numbers in the thousands."""
    assert guess_kind(100.5 + 2000 * portrait(0.8, 0.2)) == Guess("relative")
    assert guess_kind(100.5 + 2000 * portrait(0.2, 0.8)) == MILLIMETRES
    assert guess_kind(100.5 + 2000 * portrait(0.8, 0.2), metric=True) == Guess("z")


def test_kitti_is_known_by_its_shape_or_by_its_empty_pixels() -> None:
    values = (256 * torch.linspace(70.0, 5.0, 94)).round()[None, None, :, None].repeat(1, 1, 1, 311)
    assert guess_kind(values, integers=True) == Guess("z", 1 / 256, 0.0)
    lidar = (256 * ground(70.0, 5.0)).round()
    assert guess_kind(lidar, integers=True) == MILLIMETRES
    lidar[..., 1::2, :], lidar[..., ::3] = 0.0, 0.0
    assert guess_kind(lidar, integers=True) == Guess("z", 1 / 256, 0.0)


def test_a_zero_that_marks_a_hole_does_not_make_a_close_up_relative() -> None:
    values = ground(0.9, 0.2)
    values[..., 0, 0] = 0.0
    assert guess_kind(values) == Guess("z")


def test_metric_input_is_not_taken_for_disparity() -> None:
    assert guess_kind(ground(1.0, 9.0)).kind == "relative"
    assert guess_kind(ground(1.0, 9.0), metric=True) == Guess("z")
    assert guess_kind(ground(0.0, 1.0), metric=True).kind == "relative"


def test_holes_do_not_count() -> None:
    values = ground(8.0, 1.5)
    values[..., ::5], values[..., 1::5] = math.nan, math.inf
    assert guess_kind(values) == Guess("z")
    values = ground(7000, 600).round()
    values[..., ROWS // 2 :, ::2] = 0.0
    assert guess_kind(values) == MILLIMETRES


SKY = torch.full((1, 1, ROWS, COLUMNS), math.inf)


def subject(size: int, depth_m: float, behind: Tensor) -> Tensor:
    """The map ``behind`` with a square of ``depth_m`` in its middle."""
    depth = behind.clone()
    depth[..., ROWS // 2 - size : ROWS // 2 + size, COLUMNS // 2 - size : COLUMNS // 2 + size] = depth_m
    return depth


@pytest.mark.parametrize("behind", [ground(9.0, 8.0), SKY], ids=["wall", "sky"])
def test_the_nearer_surface_in_the_middle_is_the_subject(behind: Tensor) -> None:
    assert subject_m(subject(6, 2.0, behind)) == pytest.approx(2.0)
    assert subject_m(subject(1, 2.0, behind)) > 8.0  # a twig is not the subject


def test_surfaces_beside_the_middle_noise_stray_pixels_and_holes_are_not_the_subject() -> None:
    depth = subject(8, 2.0, ground(9.0, 9.0))
    depth[..., : ROWS // 5, :] = 0.5
    depth[..., : COLUMNS // 5] = 0.5
    assert subject_m(depth) == pytest.approx(2.0)
    depth = depth * (1 + 0.01 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(0)))
    depth[..., ROWS // 2, COLUMNS // 2], depth[..., ::7, ::7] = 0.1, math.nan
    assert subject_m(depth) == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_a_map_and_its_negative_have_the_same_subject(seed: int) -> None:
    """A person before a far wall and the ground, at distances that differ with the seed."""
    random = torch.Generator().manual_seed(seed)
    nearness, (wall, person) = ground(0.0, 1.0), torch.rand(2, generator=random).tolist()
    nearness[..., : ROWS // 2, :] *= wall
    nearness[..., 10:40, 24:44] = 0.2 + 0.7 * person
    nearness += 0.02 * torch.rand(nearness.shape, generator=random)
    depth, of_negative = from_relative(nearness, 1.0, 8.0), from_relative(1.0 - nearness, 1.0, 8.0, "depth")
    place = (depth - subject_m(depth)).abs().argmin()
    assert subject_m(of_negative, "depth") == pytest.approx(float(of_negative.flatten()[place]), rel=1e-4)


def test_a_large_map_is_judged_as_a_small_one() -> None:
    depth = subject(6, 2.0, ground(9.0, 8.0))
    large = torch.nn.functional.interpolate(depth, scale_factor=25, mode="nearest")
    assert subject_m(large) == pytest.approx(subject_m(depth), rel=1e-3)
    assert guess_kind(torch.nn.functional.interpolate(ground(0.3, 12.0), scale_factor=25)).kind == "relative"


def test_a_map_of_one_depth_has_a_subject_and_a_map_without_depth_is_refused() -> None:
    assert subject_m(ground(3.0, 3.0)) == pytest.approx(3.0)
    assert subject_m(SKY) == math.inf
    with pytest.raises(ValueError, match="no pixel has a depth"):
        subject_m(ground(0.0, 0.0))
