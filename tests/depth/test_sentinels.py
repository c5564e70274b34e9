"""Sentinels are distinguished from depth by their distance from all other numbers."""

import math

import pytest
import torch

from torchdof.depth.guess import Guess, guess_kind
from torchdof.depth.sentinels import without_sentinels

MM = torch.linspace(4000.0, 600.0, 48).round()[None, None, :, None].repeat(1, 1, 1, 64)


@pytest.mark.parametrize("count", [1, 3, 500])
@pytest.mark.parametrize("value", [65535.0, 65504.0, 1e10, 4294967296.0, -1.0, -9999.0, 250000.0])
def test_a_sentinel_becomes_nan_and_the_guess_is_that_of_the_other_numbers(value: float, count: int) -> None:
    given = MM.clone()
    given.view(-1)[:count] = value
    values, remark = without_sentinels(given)
    assert remark == f"{count} px of {value:.6g} without depth"
    assert int(values.isnan().sum()) == count and torch.equal(values.nan_to_num(value), given)
    assert guess_kind(values, True) == Guess("z", 0.001, 0.0)


def test_several_sentinels_are_found() -> None:
    given = MM.clone()
    given.view(-1)[:4] = torch.tensor([65535.0, 1e10, math.inf, -1.0])
    values, remark = without_sentinels(given)
    assert remark == "1 px of 1e+10 without depth, 1 px of 65535 without depth, 1 px of -1 without depth"
    assert values.view(-1)[2] == math.inf and int(values.isnan().sum()) == 3


@pytest.mark.parametrize("marks", [(65535, 65534, 65533), (65000,), (60000, 61000), (1e10, 65533), (-1, -2)])
@pytest.mark.parametrize("is_whole", [True, False])
def test_neighbouring_sentinels_of_16_bits_and_negative_ones_are_found(marks: tuple[int, ...], is_whole: bool) -> None:
    given = MM + (0.0 if is_whole else 0.5)
    given.view(-1)[: len(marks)] = torch.tensor(marks, dtype=torch.float32)
    values, remark = without_sentinels(given)
    assert int(values.isnan().sum()) == len(marks) and remark.count("1 px of") == len(marks)
    assert guess_kind(values) == Guess("z", 0.001, 0.0)


@pytest.mark.parametrize(
    "values",
    [
        torch.cat([torch.linspace(-2.0, 40.0, 43), torch.full((3029,), 5.0)]),
        torch.cat([torch.linspace(-9.0, 40.0, 99), torch.full((2973,), 5.0)]),
        torch.linspace(0, 65535, 3072).round(),
        torch.linspace(0, 255, 3072).round(),
        torch.linspace(-3.0, 4.0, 3072),
        torch.linspace(0.1, 20.0, 3072).square(),
        torch.tensor([0.5, 65535.0]).repeat(1536),
        torch.full((3072,), math.nan),
    ],
)
def test_numbers_of_a_map_are_no_sentinels(values: torch.Tensor) -> None:
    given = values.reshape(1, 1, 48, 64)
    kept, remark = without_sentinels(given)
    assert kept is given and not remark
