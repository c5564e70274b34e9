"""Numbers that mark pixels without depth: found by their distance from all others, and turned into NaN."""

import math

from torch import Tensor

__all__ = ["without_sentinels"]

_LIMITS = (32767.0, 32768.0, 65472.0, 65504.0, 65534.0, 65535.0, 2.0**31 - 1, 2.0**31, 2.0**32 - 1, 2.0**32)
"""Largest numbers of types; without 255, which is white in a map of 8 bits."""
_LIMIT_RATIO, _OTHER_RATIO = 1.25, 50.0  # over the next smaller number: of a limit, of another number
_MOST = 4  # different sentinels of a map


def without_sentinels(values: Tensor) -> tuple[Tensor, str]:
    """A map ``[1, 1, H, W]`` with NaN for numbers that mark pixels without depth, and a remark on them, or "".

    The largest number is a sentinel if it is that of a type, such as 65535, and 1.25 times the next smaller number, or
    if it is 50 times the next one, such as 1e10. The only negative number is one if it is whole, such as -1 or -9999.

    Example:
        >>> import torch
        >>> values, remark = without_sentinels(torch.tensor([[[[1500.0, 4000.0, 65535.0]]]]))
        >>> values, remark
        (tensor([[[[1500., 4000.,   nan]]]]), '1 px of 65535 without depth')
    """
    found = list[tuple[float, int]]()
    levels = values[values.isfinite()].unique()
    for _ in range(_MOST):
        if levels.numel() < 3:
            break
        largest, following = float(levels[-1]), float(levels[-2])
        ratio = _LIMIT_RATIO if largest in _LIMITS else _OTHER_RATIO
        if not (following > 0 and largest > ratio * following):
            break
        found.append((largest, int((values == largest).sum())))
        levels = levels[:-1]
    if levels.numel() > 2 and levels[0] < 0 <= levels[1] and float(levels[0]).is_integer():
        found.append((float(levels[0]), int((values == levels[0]).sum())))
    for value, _ in found:
        values = values.masked_fill(values == value, math.nan)
    return values, ", ".join(f"{count} px of {value:.6g} without depth" for value, count in found)
