"""The one clock of all benchmarks: what is compared takes turns, and so meets alike whatever else the machine does."""

import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, TypeVar

import torch

__all__ = ["in_turns", "median_and_spread", "processor_seconds", "timed", "times"]

_Name = TypeVar("_Name", bound=Hashable)
_Result = TypeVar("_Result")


def timed(work: Callable[[], _Result]) -> tuple[_Result, float]:
    """What a call returns, and the seconds it took."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def processor_seconds(work: Callable[[], object]) -> float:
    """Seconds of this process's processor time in a call, over all threads, without what other programs take."""
    start = time.process_time()
    work()
    return time.process_time() - start


def in_turns(
    works: Mapping[_Name, Callable[[], Any]],
    repeat: int,
    seconds_of: Callable[[Callable[[], Any]], float] = lambda work: timed(work)[1],
) -> dict[_Name, list[float]]:
    """Seconds of each, turn by turn, after one turn more to warm up.

    Args:
        works: What is compared, by name.
        repeat: How many turns.
        seconds_of: Calls one of them and tells its seconds: the clock, unless a tool times itself, or
            :func:`processor_seconds`.
    """
    seconds: dict[_Name, list[float]] = {name: [] for name in works}
    for turn in range(repeat + 1):
        for name, work in works.items():
            taken = seconds_of(work)
            if turn:
                seconds[name].append(taken)
    return seconds


def times(work: Callable[[], object], repeat: int) -> list[float]:
    """Seconds of so many calls, after one more to warm up."""
    return in_turns({"": work}, repeat)[""]


def median_and_spread(seconds: Sequence[float]) -> tuple[float, float]:
    """Median and interquartile range.

    Example:
        >>> median_and_spread([4.0, 1.0, 2.0, 3.0, 20.0])
        (3.0, 2.0)
    """
    low, high = torch.tensor(seconds, dtype=torch.float64).quantile(torch.tensor([0.25, 0.75], dtype=torch.float64))
    return statistics.median(seconds), float(high - low)
