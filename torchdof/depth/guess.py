"""What a depth map and its picture are likely to mean where nobody says it: the kind of numbers, and the subject."""

import dataclasses
import math
from typing import Literal

import torch
from torch import Tensor

from .relative import RelativeKind
from .sanity import whole_numbers

__all__ = ["Guess", "guess_kind", "subject_m"]

_ONE_BYTE, _FILLED = 255, 60_000  # whole numbers up to here are shades of grey; from here on, of 16 bits
_NEXT_TO_ZERO = 0.05  # of values from 0 to 1; nothing is photographed so near in metres
_CLEAR = 0.35  # correlation from which on a picture's lower part is taken for nearer than its upper one
_SAMPLES = 65_536
_BINS, _REACH = 64, 3  # of 1 / distance; a surface is a bin and as many on each side
_SPREAD = 1 / 6  # standard deviation of what counts as the middle, of each side of the picture
_STRAY = 0.01  # of the pixels, the nearest and the farthest
_SUBJECT = 0.2  # of the middle, at least, is the subject


@dataclasses.dataclass(frozen=True)
class Guess:
    """What the numbers of a map are taken for.

    Args:
        kind: "z": metres after ``scale``; "relative": near and far, without a unit.
        scale: Metres a unit, for "z".
        unknown: The value that means "not measured", or None.
        relative_kind: Which way relative depth runs.
    """

    kind: Literal["z", "relative"]
    scale: float = 1.0
    unknown: float | None = None
    relative_kind: RelativeKind = "disparity"


def guess_kind(values: Tensor, whole: bool = False, metric: bool = False) -> Guess:
    """Guesses what the numbers of a depth map are.

    Whole numbers up to 255, or up to the end of 16 bits, are shades of grey: relative depth; others are millimetres,
    zero where nothing was measured. Other numbers are metres, unless they run from 0 to 1 or are negative. Relative
    depth is disparity, larger is nearer, unless its lower part is clearly smaller than its upper one: the ground is
    nearer than the sky. By the same sign, what would be a distance is relative disparity where it clearly grows
    downwards, as an estimator's own numbers do.

    Args:
        values: ``[1, 1, H, W]``; what is not finite is left out.
        whole: Whether the file can hold whole numbers only; otherwise the values tell.
        metric: Whether what else is known is in metres: numbers that may be distances then are.

    Example:
        >>> guess_kind(torch.linspace(0, 255, 256).round().reshape(1, 1, 16, 16)).kind
        'relative'
        >>> guess_kind(torch.linspace(600, 7000, 256).round().reshape(1, 1, 16, 16).flip(2))
        Guess(kind='z', scale=0.001, unknown=0.0, relative_kind='disparity')
        >>> guess_kind(torch.linspace(2.5, 8.0, 256).reshape(1, 1, 16, 16).flip(2)).scale
        1.0
    """
    known = values[values.isfinite()]
    low, high = (float(end) for end in known.aminmax()) if known.numel() else (0.0, 0.0)
    if low == high:
        return Guess("z")
    downwards = _growth_downwards(values)
    if whole or whole_numbers(known):
        is_relative = high <= _ONE_BYTE or high >= _FILLED
        otherwise = Guess("z", 0.001, 0.0)
    else:
        is_relative = low < 0 or (high <= 1 and low < _NEXT_TO_ZERO)
        otherwise = Guess("z")
    if is_relative:
        return Guess("relative", relative_kind="depth" if downwards < -_CLEAR else "disparity")
    return Guess("relative") if downwards > _CLEAR and not metric else otherwise


def subject_m(depth: Tensor) -> float:
    """Distance of the subject nearest to the middle of the picture, in metres.

    It is the nearest surface that fills at least a fifth of the middle, weighted by a Gaussian of a sixth of each side;
    of this surface the median counts, so that neither an edge nor a stray pixel does.

    Args:
        depth: ``[1, 1, H, W]``, metres; NaN, zero and negative ones are left out, ``inf`` counts.

    Raises:
        ValueError: If no pixel has a depth.

    Example:
        >>> depth = torch.full((1, 1, 60, 90), 8.0)
        >>> depth[..., 20:, 35:55] = 2.0
        >>> round(subject_m(depth), 6)
        2.0
    """
    step = math.ceil(math.sqrt(depth.numel() / _SAMPLES))
    depth = depth[0, 0, step // 2 :: step, step // 2 :: step].double().cpu()
    y, x = (torch.linspace(-0.5, 0.5, size + 2, dtype=torch.float64)[1:-1] for size in depth.shape)
    weight = torch.exp(-0.5 * ((y[:, None] / _SPREAD).square() + (x / _SPREAD).square()))
    known = depth > 0
    if not bool(known.any()):
        raise ValueError("no pixel has a depth; check the kind, scale and offset of the depth map")
    dioptres, order = (1.0 / depth[known]).sort()
    weight = weight[known][order]
    low, high = (float(dioptres[int(share * (dioptres.numel() - 1))]) for share in (_STRAY, 1.0 - _STRAY))
    bins = ((dioptres - low) / max(high - low, 1e-9) * _BINS).clamp(0, _BINS - 1).long()
    shares = torch.zeros(_BINS, dtype=torch.float64).index_add_(0, bins, weight / weight.sum())
    around = torch.nn.functional.pad(shares, (_REACH, _REACH)).unfold(0, 2 * _REACH + 1, 1)  # [bins, reach]
    filled, peak = around.sum(1), around.amax(1) == shares
    enough = (filled >= min(_SUBJECT, float(filled.max()))) & peak & (shares > 0)
    nearest = int(enough.nonzero().max()) if bool(enough.any()) else int(filled.argmax())
    of_surface = (bins - nearest).abs() <= _REACH
    summed = weight[of_surface].cumsum(0)
    median = float(dioptres[of_surface][int((summed >= 0.5 * summed[-1]).nonzero()[0])])
    return 1.0 / median if median > 0 else math.inf


def _growth_downwards(values: Tensor) -> float:
    """Correlation of the values' ranks with their rows, -1 to 1: positive where the lower part has larger ones."""
    step = math.ceil(math.sqrt(values.numel() / _SAMPLES))
    values = values[0, 0, step // 2 :: step, step // 2 :: step]
    known = values.isfinite() & (values != 0)
    rows = torch.arange(values.shape[0], dtype=torch.float64)[:, None].expand(values.shape)[known]
    if rows.numel() < 2:
        return 0.0
    _, places, counts = values[known].unique(return_inverse=True, return_counts=True)
    ranks = (counts.cumsum(0) - 0.5 * counts)[places]  # equal values share one
    rows, ranks = rows - rows.mean(), ranks - ranks.mean()
    return float((rows * ranks).sum() / (rows.norm() * ranks.norm()).clamp(min=1e-12))
