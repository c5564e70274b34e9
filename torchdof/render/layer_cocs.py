"""Where the layers of a scene are put on the blur axis: at its ends and at the coc of its border, and in between.

Distances are those of :mod:`torchdof.render.layer_weights`' blur axis.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..validation import ends
from .layer_weights import blur_axis

__all__ = ["DENSE", "border_nodes", "extent", "finest", "on_axis", "slid", "spaced_nodes", "spacing", "widest"]

DENSE = 0.65
"""Share of the tolerance for which coarse layers are spaced where nothing tells where a scene's borders lie.

Measured on smooth slopes: from 0.8 on their layers are no denser than what a scene itself gets."""

_FEW = 100  # the largest radii of a frame: 1 / _FEW of its pixels may exceed them
_FINEST = 0.5
_FINEST_PARTS = 40.0
_WIDE = _FINEST * _FINEST_PARTS  # from which on the finest distance grows
_SPACING = 0.25  # px near focus at a tolerance of 1/255; measured, as the next two: errors stay below the tolerance
_SPACING_POWER = 0.8  # of the tolerance
_NEAR = 0.3  # of the spacing: so near to a fixed node there is no other; at twice as far one is where it would be
_LOOSE = 4.0  # of 255: from there on by its square root, lest a picture consists of two layers


def on_axis(coc_px: Tensor, longest: int) -> Tensor:
    """Places on the blur axis, finite, of some pixels of a frame whose longer side has so many."""
    reach = _reach(longest)
    return blur_axis(torch.where(torch.isnan(coc_px), 0.0, coc_px).clamp(-reach, reach))


def _reach(longest: int) -> float:
    """Radius beyond which a kernel is the same everywhere in a frame whose longer side has so many pixels."""
    return 4.0 * longest + 4.0


def finest(x: float) -> float:
    """Least distance between layers at a place that is worth anything: half a pixel, or a fortieth of the blur."""
    return max(_FINEST, abs(x) / _FINEST_PARTS)


def spacing(x: float, tolerance: float) -> float:
    """Distance on the blur axis from a node at ``x`` to the next one outwards."""
    times = tolerance * 255.0
    loose = times**_SPACING_POWER if times <= _LOOSE else max(_LOOSE**_SPACING_POWER, math.sqrt(times))
    return max(finest(x), _SPACING * loose * max(abs(x) + 0.5, 1.0) ** 0.75)


def spaced_nodes(low: float, high: float, tolerance: float, dense_from: float = math.inf) -> tuple[float, ...]:
    """Nodes outwards from focus by :func:`spacing`, the last on each side at or beyond the given end.

    From ``dense_from`` on they are spaced as for a share of the tolerance.
    """
    nodes = [0.0]
    for sign, limit in ((-1, -low), (1, high)):
        x = 0.0
        while x < limit:
            x += spacing(x, tolerance if x < dense_from else DENSE * tolerance)
            nodes.append(sign * x)
    return tuple(sorted(nodes))


def slid(node: float, fixed: Sequence[float], tolerance: float) -> float:
    """A node between fixed ones: moved towards one that comes near, and in the end onto it."""
    near = min(fixed, key=lambda other: abs(node - other))
    gap = abs(node - near) / spacing(node, tolerance)
    return near + (node - near) * min(max((gap - _NEAR) / _NEAR, 0.0), 1.0)


def extent(coc_px: Tensor) -> tuple[float, float]:
    """Nearest and farthest place of the pixels ``[B, 1, H, W]``."""
    both = ends(coc_px)
    if math.isnan(both[0]):
        both = ends(torch.where(coc_px.isnan(), 0.0, coc_px))
    exact = torch.promote_types(coc_px.dtype, torch.float32)
    low, high = on_axis(torch.tensor(both, dtype=exact, device="cpu"), max(coc_px.shape[-2:])).tolist()
    return low, high


def widest(coc_px: Tensor) -> float:
    """Mean radius in pixels of the hundredth of a map's pixels that is blurred most; the largest of ``[B, 1, H, W]``.

    A few pixels add next to nothing to it.
    """
    radii = torch.where(torch.isnan(coc_px), 0.0, coc_px).abs().clamp(max=_reach(max(coc_px.shape[-2:]))).flatten(1)
    most = radii.topk(-(-radii.shape[1] // _FEW), sorted=False).values
    return float(most.double().mean(1).amax())


def border_nodes(coc_px: Tensor) -> list[float]:
    """Places at which much of the frame's border lies.

    Surfaces go on beyond the frame as they are at its border, so what comes from there comes from few blurs: layers far
    from these show.
    """
    border = torch.cat([coc_px[..., 0, :], coc_px[..., -1, :], coc_px[..., 0], coc_px[..., -1]], -1)
    return _crowded(on_axis(border, max(coc_px.shape[-2:])).flatten(), width=1.0, least_share=0.03)


def _crowded(x: Tensor, width: float, least_share: float) -> list[float]:
    """Places at which at least so large a share of all places ``[n]`` lies, and 16, the most crowded first.

    What counts as one place is ``width`` finest distances wide, three bins of the histogram.
    """
    bins = torch.round(_in_finest(x) * (3.0 / width)).long()
    first = int(bins.min())
    counts = functional.pad(torch.bincount(bins - first), (1, 1))
    crowds = (counts[:-2] + counts[1:-1] + counts[2:]).tolist()
    places: list[float] = []
    least = max(least_share * len(x), 16)
    for i, count in sorted(enumerate(crowds), key=lambda item: -item[1]):
        if count < least:
            break
        place = _from_finest((first + i) * width / 3.0)
        if all(abs(place - other) > 0.6 * finest(place) for other in places):
            # one that occurs: its pixels then lie in no other layer
            places.append(float(x[(bins - first - i).abs() <= 1].median()))
    return places


def _in_finest(x: Tensor) -> Tensor:
    """Places in finest distances from focus."""
    steps = x.abs().clamp(max=_WIDE) / _FINEST + _FINEST_PARTS * (x.abs() / _WIDE).clamp_min(1.0).log()
    return steps * x.sign()


def _from_finest(steps: float) -> float:
    """The place so many finest distances from focus."""
    if abs(steps) <= _FINEST_PARTS:
        return steps * _FINEST
    return math.copysign(_WIDE * math.exp(abs(steps) / _FINEST_PARTS - 1.0), steps)
