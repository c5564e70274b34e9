"""Numbers that mark pixels without depth: found by their distance from all others, and turned into NaN."""

import math

from torch import Tensor

__all__ = ["without_sentinels"]

_LIMITS = (32767.0, 32768.0, 65472.0, 65504.0, 65534.0, 65535.0, 2.0**31 - 1, 2.0**31, 2.0**32 - 1, 2.0**32)
"""Largest numbers of types; without 255, which is white in a map of 8 bits."""
_LIMIT_RATIO, _HIGH_RATIO, _OTHER_RATIO = 1.25, 4.0, 50.0  # over the next smaller number: of a limit, if high, else
_HIGH = 60_000.0  # smallest number that may be a sentinel of 16 bits, such as 65000
_MOST = 4  # different sentinels of a map, and negative ones


def without_sentinels(values: Tensor) -> tuple[Tensor, str]:
    """A map ``[1, 1, H, W]`` with NaN for numbers that mark pixels without depth, and a remark on them, or "".

    Up to four of the largest numbers are sentinels if the smallest of them is that of a type, such as 65535, and 1.25
    times the next smaller number; is 60,000 or more, and 4 times the next one; or is 50 times the next one, such as
    1e10. Up to four negative numbers are sentinels if they are whole, such as -1 or -9999; several only beside numbers
    that are not whole, or that are larger than the distance of the lowest from 0.

    Example:
        >>> import torch
        >>> values, remark = without_sentinels(torch.tensor([[[[1500.0, 4000.0, 65535.0]]]]))
        >>> values, remark
        (tensor([[[[1500., 4000.,   nan]]]]), '1 px of 65535 without depth')
    """
    levels = values[values.isfinite()].unique()
    top, count = levels[-_MOST - 1 :].tolist(), 0
    for k in range(1, min(len(top), levels.numel() - 1)):
        number, following = top[-k], top[-k - 1]
        ratio = _LIMIT_RATIO if number in _LIMITS else _HIGH_RATIO if number >= _HIGH else _OTHER_RATIO
        if following > 0 and number > ratio * following:
            count = k
    marks = top[: -count - 1 : -1]
    levels = levels[: levels.numel() - count]
    negative, others = levels[levels < 0], levels[levels > 0]
    if 1 <= negative.numel() <= _MOST and others.numel() and levels.numel() > 2 and _is_whole(negative):
        is_apart = not _is_whole(others) or float(others[0]) > -float(negative[0])
        marks += negative.tolist() if negative.numel() == 1 or is_apart else []
    found = [(value, int((values == value).sum())) for value in marks]
    for value, _ in found:
        values = values.masked_fill(values == value, math.nan)
    return values, ", ".join(f"{count} px of {value:.6g} without depth" for value, count in found)


def _is_whole(values: Tensor) -> bool:
    return bool((values == values.round()).all())
