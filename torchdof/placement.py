"""Where the surfaces of a scene lie on the blur axis (:mod:`torchdof.layers`): its ends, its planes, its borders."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as functional
from torch import Tensor

from .layers import blur_axis

__all__ = ["at_borders", "ends", "finest", "on_axis", "planes"]

_FINEST = 0.5
_FINEST_PARTS = 40.0
_WIDE = _FINEST * _FINEST_PARTS  # from which on the finest distance grows
_SAMPLES = 2**16  # pixels that tell where planes are


def finest(x: float) -> float:
    """Least distance between layers at a place that is worth anything: half a pixel, or a fortieth of the blur."""
    return max(_FINEST, abs(x) / _FINEST_PARTS)


def on_axis(coc_px: Tensor) -> Tensor:
    """Places of pixels, finite, shaped as ``coc_px``."""
    coc = coc_px.detach()
    # a kernel far larger than the frame is the same everywhere in it
    reach = 4.0 * max(coc.shape[-2:]) + 4.0
    return blur_axis(torch.where(torch.isnan(coc), 0.0, coc).clamp(-reach, reach))


def ends(x: Tensor) -> tuple[float, float]:
    """Nearest and farthest place."""
    low, high = torch.aminmax(x)
    return float(low), float(high)


def planes(x: Tensor, spacing: Callable[[float], float]) -> list[float]:
    """Places at which many pixels lie and few around them: planes that face the camera, and distant backgrounds.

    Args:
        x: Places of pixels, ``[B, 1, H, W]``.
        spacing: Distance of layers at a place.

    Example:
        >>> planes(torch.tensor([3.0, 7.25]).repeat(1, 1, 64, 32), lambda x: 1.0)
        [3.0, 7.25]
    """
    step = max(1, math.isqrt(x.numel() // _SAMPLES))
    return _crowded(x[..., ::step, ::step].flatten(), width=0.2, share=0.01, spacing=spacing)


def at_borders(x: Tensor) -> list[float]:
    """Places at which much of the frame's border lies.

    Surfaces go on beyond the frame as they are at its border. Light from there is not known; what stands for it is
    light of the same layer, which therefore must not reach far into the frame.
    """
    border = torch.cat([x[..., 0, :], x[..., -1, :], x[..., 0], x[..., -1]], -1).flatten()
    return _crowded(border, width=1.0, share=0.03)


def _crowded(
    x: Tensor, width: float, share: float, spacing: Callable[[float], float] | None = None, least: int = 16
) -> list[float]:
    """Places at which so large a share of all lies, and so many, most first.

    Args:
        x: Places, ``[n]``.
        width: What counts as one place, in finest distances.
        share: Of all places.
        spacing: Distance around, in which half of all must lie at the place; None does not look around.
        least: Number of places.
    """
    bins = torch.round(_in_finest(x) * (3.0 / width)).long()
    first = int(bins.min())
    count = torch.bincount(bins - first)
    sums = functional.pad(count.cumsum(0), (1, 0)).tolist()

    def within(at: int, reach: int) -> int:
        return int(sums[min(at + reach + 1, len(count))] - sums[max(at - reach, 0)])

    found: list[float] = []
    many = max(share * len(x), least)
    near = {i: within(i, 1) for i in range(len(count))}
    for i, held in sorted(near.items(), key=lambda item: -item[1]):
        if held < many:
            break
        place = _from_finest((first + i) * width / 3.0)
        if spacing is not None and 2 * held < within(i, round(1.5 * spacing(place) / (finest(place) * width))):
            continue
        if all(abs(place - other) > 0.6 * finest(place) for other in found):
            # one that occurs: its pixels then lie in no other layer
            found.append(float(x[(bins - first - i).abs() <= 1].median()))
    return found


def _in_finest(x: Tensor) -> Tensor:
    """Places in finest distances from focus."""
    steps = x.abs().clamp(max=_WIDE) / _FINEST + _FINEST_PARTS * (x.abs() / _WIDE).clamp_min(1.0).log()
    return steps * x.sign()


def _from_finest(steps: float) -> float:
    """The place so many finest distances from focus."""
    if abs(steps) <= _FINEST_PARTS:
        return steps * _FINEST
    return math.copysign(_WIDE * math.exp(abs(steps) / _FINEST_PARTS - 1.0), steps)
