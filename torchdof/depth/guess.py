"""Guesses the kind of a depth map's numbers, and the subject of a picture, if the user states neither."""

import dataclasses
import math
from typing import Literal

import torch
from torch import Tensor

from .relative import RelativeKind
from .sanity import whole_numbers

__all__ = ["Guess", "guess_kind", "looks_relative", "subject_m"]

_MAX_SAMPLES = 65_536  # most pixels examined

# Kind of the numbers. Whole numbers are grey levels if the largest is <= _MAX_8_BIT or >= _MIN_16_BIT.
_MAX_8_BIT, _MIN_16_BIT = 255, 60_000
_NEAR_ZERO = 0.05  # numbers up to 1 are relative if the smallest is below this: in metres it would be too near
_EMPTY_GAP = 0.1  # smallest number over the largest from which a 0 is no number of the map
_KITTI_ASPECTS = (3.1, 3.7)  # width over height of KITTI's pictures, whose maps hold metres * 256
_KITTI_EMPTY = 0.6  # share of zeros from which whole numbers are a lidar's, as in KITTI's maps
_NO_METRES = 100.0  # m; a picture whose nearest surface is farther away has no depth of field
_NEAR_SHARE = 0.1  # the same as a share of the largest: a close-up in metres rarely spans as much
_CLEAR_DIFFERENCE = 0.3  # of mean ranks, in [0, 1], between the bottom's middle and the upper corners
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
    is_sure: bool = dataclasses.field(default=True, compare=False)  # whether the map shows which end is near


def guess_kind(values: Tensor, integers: bool = False, metric: bool = False) -> Guess:
    """Guesses the meaning of the numbers of a depth map ``[1, 1, H, W]``; NaN and infinite values are ignored.

    * Whole numbers are relative depth (grey levels) if the largest is at most 255, or at least 60,000. Otherwise they
      are millimetres, with 0 for pixels that were not measured; in maps of KITTI's shape, or if most are 0, metres
      times 256.
    * Other numbers are relative depth if they lie in [0, 1] and come near 0, or if some are negative; else metres;
      from 100 on, where nothing could be blurred, they are millimetres, or relative depth if a person is larger.
      A single negative number, such as -1, marks pixels without depth.
    * Relative depth is "disparity" (larger is nearer), unless the values clearly shrink downwards: the ground is nearer
      than the sky; or, where this is unclear, are smaller in the middle of the bottom than in the upper corners: a
      person is nearer than the background. For the same reason distances that clearly grow downwards are taken for
      relative disparity.

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
    if low == 0.0:  # "not measured" rather than a number of the map, if it is far from all others
        positive = float(finite[finite > 0].min())
        low = positive if positive > _EMPTY_GAP * high else low
    downwards = _growth_downwards(values)
    is_whole = integers or whole_numbers(finite)
    if is_whole:
        is_relative = high <= _MAX_8_BIT or high >= _MIN_16_BIT
    else:
        is_relative = low < 0 or (high <= 1 and low < max(_NEAR_ZERO, _NEAR_SHARE * high))
    if is_relative:
        to_person = _growth_to_person(values)
        is_clear = abs(downwards) > _CLEAR_CORRELATION
        is_farther = downwards < -_CLEAR_CORRELATION if is_clear else to_person < -_CLEAR_DIFFERENCE
        is_sure = is_clear and downwards * to_person >= 0  # a picture of the ground
        return Guess("relative", relative_kind="depth" if is_farther else "disparity", is_sure=is_sure)
    if downwards > _CLEAR_CORRELATION and not metric:
        return Guess("relative")
    if not is_whole and (metric or low < _NO_METRES):
        return Guess("z")
    if not is_whole:
        is_nearer = _growth_to_person(values) > _CLEAR_DIFFERENCE
        return Guess("relative", is_sure=False) if is_nearer else Guess("z", 0.001, 0.0)
    aspect = values.shape[-1] / values.shape[-2]
    is_of_kitti = _KITTI_ASPECTS[0] < aspect < _KITTI_ASPECTS[1] or float((values == 0).double().mean()) > _KITTI_EMPTY
    return Guess("z", 1 / 256 if is_of_kitti else 0.001, 0.0)


def looks_relative(metres: Tensor) -> bool:
    """Whether depth ``[1, 1, H, W]`` that is taken for metres clearly grows downwards, as disparity does."""
    return _growth_downwards(metres) > _CLEAR_CORRELATION


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


def _growth_to_person(values: Tensor) -> float:
    """Mean rank, in [0, 1], in the middle of the bottom less that in the upper corners; positive if it is larger."""
    values = _sampled(values)
    known = values.isfinite() & (values != 0)
    rows, columns = (torch.linspace(0.0, 1.0, n, dtype=torch.float64) for n in values.shape)
    is_side, is_middle = (columns - 0.5).abs() > 0.25, (columns - 0.5).abs() < 0.2
    corners = known & (rows < 0.4)[:, None] & is_side
    bottom = known & (rows > 0.6)[:, None] & is_middle
    if not bool(corners.any()) or not bool(bottom.any()):
        return 0.0
    ordered = values[known].sort().values
    ranks = [torch.searchsorted(ordered, values[area]).double().mean() / ordered.numel() for area in (bottom, corners)]
    return float(ranks[0] - ranks[1])


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
