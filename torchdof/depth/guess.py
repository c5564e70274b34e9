"""Guesses the kind of a depth map's numbers, and the subject of a picture, if the user states neither."""

import dataclasses
import math
from typing import Literal

import torch
from torch import Tensor

from .relative import RelativeKind
from .sanity import whole_numbers

__all__ = ["Guess", "guess_kind", "subject_m"]

_MAX_SAMPLES = 65_536  # most pixels examined

# Kind of the numbers. Whole numbers are grey levels if the largest is <= _MAX_8_BIT or >= _MIN_16_BIT.
_MAX_8_BIT, _MIN_16_BIT = 255, 60_000
_NEAR_ZERO = 0.05  # numbers up to 1 are relative if the smallest is below this: in metres it would be too near
_CLEAR_CORRELATION = 0.35  # absolute correlation of values and rows above which values clearly grow or shrink downwards

# Subject of a picture: a peak in the histogram of nearness, which is linear in the numbers of the map
_BINS = 64  # bins of nearness
_REACH_BINS = 3  # bins on each side of a peak that belong to its surface; more: surfaces merge
_MIDDLE_SIGMA = 1 / 6  # standard deviation of the weight of the middle, over each side of the picture
_OUTLIERS = 0.01  # share of the pixels at each end of the distances that is ignored as outliers
_SUBJECT_SHARE = 0.2  # smallest share of the middle that the subject fills


@dataclasses.dataclass(frozen=True)
class Guess:
    """The meaning of the numbers of a depth map."""

    kind: Literal["z", "relative"]  # metres after multiplication by scale; near and far, without a unit
    scale: float | None = None  # metres per unit, for "z"; None for metres
    unknown: float | None = None  # the value that means "not measured"
    relative_kind: RelativeKind = "disparity"  # larger for nearer surfaces; "depth" is larger for farther ones


def guess_kind(values: Tensor, integers: bool = False, metric: bool = False) -> Guess:
    """Guesses the meaning of the numbers of a depth map ``[1, 1, H, W]``; NaN and infinite values are ignored.

    * Whole numbers are relative depth (grey levels) if the largest is at most 255, or at least 60,000. Otherwise they
      are millimetres, with 0 for pixels that were not measured.
    * Other numbers are relative depth if they lie in [0, 1] and come near 0, or if some are negative; else metres.
      A single negative number, such as -1, marks pixels without depth.
    * Relative depth is "disparity" (larger is nearer), unless the values clearly shrink downwards: the ground is nearer
      than the sky. For the same reason distances that clearly grow downwards are taken for relative disparity.

    ``integers``: the file type holds whole numbers only; otherwise the values are examined. ``metric``: other input is
    in metres; distances are then never taken for disparity.
    """
    negative = values[values < 0]
    if negative.numel() > 1 and bool((negative == negative[0]).all()):
        values = values.masked_fill(values < 0, math.nan)
    finite = values[values.isfinite()]
    low, high = (float(end) for end in finite.aminmax()) if finite.numel() else (0.0, 0.0)
    if low == high:
        return Guess("z")
    downwards = _growth_downwards(values)
    is_whole = integers or whole_numbers(finite)
    if is_whole:
        is_relative = high <= _MAX_8_BIT or high >= _MIN_16_BIT
    else:
        is_relative = low < 0 or (high <= 1 and low < _NEAR_ZERO)
    if is_relative:
        return Guess("relative", relative_kind="depth" if downwards < -_CLEAR_CORRELATION else "disparity")
    if downwards > _CLEAR_CORRELATION and not metric:
        return Guess("relative")
    return Guess("z", 0.001, 0.0) if is_whole else Guess("z")


def subject_m(depth: Tensor, kind: RelativeKind = "disparity") -> float:
    """Distance in metres of the subject in the middle of a depth map ``[1, 1, H, W]``; invalid depths are ignored.

    The subject is the nearest surface that fills at least a fifth of the middle, which is a Gaussian weight with a
    standard deviation of a sixth of each side. The distance is the median of that surface.

    ``kind`` is that of the numbers from which the depth was made. Surfaces are found in a histogram over those numbers,
    which is over 1 / depth for ``"disparity"`` and metric depth, and over depth for ``"depth"``. So a map and its
    negative, in which larger is farther, have the same subject.
    """
    depth = _sampled(depth).double().cpu()
    y, x = (torch.linspace(-0.5, 0.5, size + 2, dtype=torch.float64)[1:-1] for size in depth.shape)
    weight = torch.exp(-0.5 * ((y[:, None] / _MIDDLE_SIGMA).square() + (x / _MIDDLE_SIGMA).square()))
    is_linear = kind == "depth"
    is_known = (depth > 0) & (depth.isfinite() | (not is_linear))
    if not bool(is_known.any()):
        raise ValueError("no pixel has a depth; check the kind, scale and offset of the depth map")
    known = depth[is_known]
    nearness, order = (-known if is_linear else 1.0 / known).sort()
    weight = weight[is_known][order]
    low, high = (float(nearness[int(share * (nearness.numel() - 1))]) for share in (_OUTLIERS, 1.0 - _OUTLIERS))
    bins = ((nearness - low) / max(high - low, 1e-9) * _BINS).clamp(0, _BINS - 1).long()
    shares = torch.zeros(_BINS, dtype=torch.float64).index_add_(0, bins, weight / weight.sum())
    windows = torch.nn.functional.pad(shares, (_REACH_BINS, _REACH_BINS)).unfold(0, 2 * _REACH_BINS + 1, 1)
    window_shares, is_peak = windows.sum(1), windows.amax(1) == shares
    is_subject = (window_shares >= min(_SUBJECT_SHARE, float(window_shares.max()))) & is_peak & (shares > 0)
    peak_bin = int(is_subject.nonzero().max()) if bool(is_subject.any()) else int(window_shares.argmax())
    of_surface = (bins - peak_bin).abs() <= _REACH_BINS
    cumulative = weight[of_surface].cumsum(0)
    median = float(nearness[of_surface][int((cumulative >= 0.5 * cumulative[-1]).nonzero()[0])])
    if is_linear:
        return -median
    return 1.0 / median if median > 0 else math.inf


def _sampled(values: Tensor) -> Tensor:
    """Every n-th row and column of a map ``[1, 1, H, W]``, so that about ``_MAX_SAMPLES`` values remain: ``[h, w]``."""
    step = math.ceil(math.sqrt(values.numel() / _MAX_SAMPLES))
    return values[0, 0, step // 2 :: step, step // 2 :: step]


def _growth_downwards(values: Tensor) -> float:
    """Correlation of the ranks of the values with their rows, in [-1, 1]; positive if values grow downwards."""
    values = _sampled(values)
    known = values.isfinite() & (values != 0)
    rows = torch.arange(values.shape[0], dtype=torch.float64)[:, None].expand(values.shape)[known]
    if rows.numel() < 2:
        return 0.0
    _, rank_index, counts = values[known].unique(return_inverse=True, return_counts=True)
    ranks = (counts.cumsum(0) - 0.5 * counts)[rank_index]  # equal values have equal ranks
    rows, ranks = rows - rows.mean(), ranks - ranks.mean()
    return float((rows * ranks).sum() / (rows.norm() * ranks.norm()).clamp(min=1e-12))
