"""Choose the places of layers: at both ends of the scene's coc range, at the coc of its border, and between these.

Places and distances are on the blur axis of :mod:`torchdof.render.layers.layer_weights`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...validation import ends
from .convolution import widest_float
from .layer_weights import blur_axis

DENSE = 0.65
"""Factor on the tolerance for the spacing of coarse layers, if the coc of the scene's border is unknown.

Measured on smooth slopes: at 0.8 or more, their layers are no denser than in a plan for the scene itself."""

_FEW = 100  # the radius of a frame is the mean of 1 / _FEW of its pixels, the most blurred ones

# A place gets a layer of its own if many of the border's pixels lie there; larger: fewer layers
_CROWD = 0.03  # share of the border's pixels
_LEAST_CROWD = 16  # and pixels, at least
APART = 0.6  # finest distances; a crowd nearer to another layer gets none

# Spacing of layers: measured so that errors stay below the tolerance; larger: fewer layers
_SPACING = 0.25  # px near focus at a tolerance of 1/255
_SPACING_POWER = 0.8  # exponent of the tolerance
_LOOSE = 4.0  # tolerance times 255 above which the spacing grows with its square root, to keep more than two layers
_GROWS_FROM_PX = 0.5  # px: blur above which the spacing grows
_GROWTH = 0.75  # exponent of the blur in the spacing
_FINEST = 0.5  # px: smallest distance between layers near the focus
_FINEST_PARTS = 40.0  # elsewhere the smallest distance is the blur divided by this
_WIDE = _FINEST * _FINEST_PARTS  # px: blur above which the smallest distance grows
_NEAR = 0.3  # spacings: nearer to a fixed node, a node merges with it; at twice this distance it does not move
_WIDEST = 4.0  # longer sides of a frame, and of a pixel more: radius above which kernels are constant in it


def on_axis(coc_px: Tensor, longest: int) -> Tensor:
    """Finite places on the blur axis of a coc in a frame whose longer side has ``longest`` pixels."""
    reach = _reach(longest)
    return blur_axis(torch.where(torch.isnan(coc_px), 0.0, coc_px).clamp(-reach, reach))


def _reach(longest: int) -> float:
    """Radius in pixels above which a kernel is constant within a frame whose longer side has ``longest`` pixels."""
    return _WIDEST * longest + _WIDEST


def finest(x: float) -> float:
    """Smallest useful distance between layers at ``x``: half a pixel, or a fortieth of the blur."""
    return max(_FINEST, abs(x) / _FINEST_PARTS)


def spacing(x: float, tolerance: float) -> float:
    """Distance on the blur axis from a node at ``x`` to the next one outwards."""
    times = tolerance * 255.0
    loose = times**_SPACING_POWER if times <= _LOOSE else max(_LOOSE**_SPACING_POWER, math.sqrt(times))
    return max(finest(x), _SPACING * loose * max(abs(x) + (1.0 - _GROWS_FROM_PX), 1.0) ** _GROWTH)


def spaced_nodes(low: float, high: float, tolerance: float, dense_from: float = math.inf) -> tuple[float, ...]:
    """Nodes outwards from focus by :func:`spacing`; the last on each side is at or beyond ``low`` or ``high``.

    Beyond ``dense_from`` they are spaced for the tolerance times :data:`DENSE`.
    """
    nodes = [0.0]
    for sign, limit in ((-1, -low), (1, high)):
        x = 0.0
        while x < limit:
            x += spacing(x, tolerance if x < dense_from else DENSE * tolerance)
            nodes.append(sign * x)
    return tuple(sorted(nodes))


def moved_to_fixed(node: float, fixed: Sequence[float], tolerance: float) -> float:
    """Move a node that is near a fixed one towards it; a very near one lands on it."""
    near = min(fixed, key=lambda other: abs(node - other))
    gap = abs(node - near) / spacing(node, tolerance)
    return near + (node - near) * min(max((gap - _NEAR) / _NEAR, 0.0), 1.0)


def extent(coc_px: Tensor) -> tuple[float, float]:
    """Nearest and farthest place of ``coc_px [B, 1, H, W]`` on the blur axis."""
    both = ends(coc_px)
    if math.isnan(both[0]):
        both = ends(torch.where(coc_px.isnan(), 0.0, coc_px))
    exact = torch.promote_types(coc_px.dtype, torch.float32)
    low, high = on_axis(torch.tensor(both, dtype=exact, device="cpu"), max(coc_px.shape[-2:])).tolist()
    return low, high


class Spread(NamedTuple):
    """Values of a scene from which its layers are planned, in host memory.

    They are the nearest and the farthest place on the blur axis, the places of the pixels at the frame's border, and
    the mean change of the coc between neighbours, as from :func:`mean_change`.
    """

    low: float
    high: float
    border: np.ndarray
    change: float


def spreads(coc_px: Tensor, count: int) -> list[Spread]:
    """The spread of each scene, which has ``count`` maps of ``coc_px [B, 1, H, W]``, copied to the host once."""
    known = torch.nan_to_num(coc_px.detach(), nan=0.0, posinf=torch.inf, neginf=-torch.inf)
    known = known.to(torch.promote_types(known.dtype, torch.float32))
    both = torch.stack(torch.aminmax(known.flatten(1), dim=1), 1)
    lines = [known[..., 0, :], known[..., -1, :], known[..., 0], known[..., -1]]
    longest = max(coc_px.shape[-2:])
    x = on_axis(torch.cat([both, *(line.flatten(1) for line in lines)], 1), longest)
    exact = np.float64 if x.dtype == torch.float64 else np.float32
    change = mean_change(known.clamp(-_reach(longest), _reach(longest)))
    values = torch.cat([change[:, None], x], 1).tolist()
    scenes = []
    for i in range(0, len(values), count):
        changes, lows, highs, *borders = zip(*values[i : i + count], strict=True)
        scenes.append(Spread(min(lows), max(highs), np.array(borders, exact).flatten(), min(changes)))
    return scenes


def mean_change(coc_px: Tensor) -> Tensor:
    """Mean change of each map ``[B, 1, H, W]`` between neighbours, horizontal plus vertical, in pixels: ``[B]``."""
    sums = coc_px.diff(dim=-1).abs().sum((1, 2, 3)) + coc_px.diff(dim=-2).abs().sum((1, 2, 3))
    return sums / math.prod(coc_px.shape[1:])


def largest_radii(coc_px: Tensor, count: int) -> list[float]:
    """Mean radius in pixels of the most blurred hundredth of each scene's most blurred map, a robust largest radius.

    Each scene has ``count`` maps of ``coc_px [B, 1, H, W]``.
    """
    radii = torch.where(torch.isnan(coc_px), 0.0, coc_px).abs().clamp(max=_reach(max(coc_px.shape[-2:]))).flatten(1)
    most = radii.topk(-(-radii.shape[1] // _FEW), sorted=False).values
    means = most.to(widest_float(most.device)).mean(1).tolist()
    return [max(means[i : i + count]) for i in range(0, len(means), count)]


def border_nodes(border: np.ndarray) -> list[float]:
    """Places at which many pixels of the frame's border lie, of their places ``[n]``; the most crowded first.

    Surfaces continue beyond the frame with the blur of its border. So large areas there have the same few blurs, and
    layers far from these cause visible errors. A place is an interval of the length of the finest distance: three bins
    of a histogram.
    """
    bins = np.rint(_in_finest(border) * 3.0).astype(int)
    first = int(bins.min())
    counts = np.pad(np.bincount(bins - first), 1)
    crowds = (counts[:-2] + counts[1:-1] + counts[2:]).tolist()
    places: list[float] = []
    least = max(_CROWD * len(border), _LEAST_CROWD)
    for i, count in sorted(enumerate(crowds), key=lambda item: -item[1]):
        if count < least:
            break
        place = _from_finest((first + i) / 3.0)
        if all(abs(place - other) > APART * finest(place) for other in places):
            # the lower median is a value that occurs, so pixels of that value lie in this layer alone
            crowd = np.sort(border[np.abs(bins - first - i) <= 1])
            places.append(float(crowd[(len(crowd) - 1) // 2]))
    return places


def _in_finest(x: np.ndarray) -> np.ndarray:
    """Convert places to numbers of finest distances from focus."""
    distance = np.abs(x)
    steps = np.minimum(distance, _WIDE) / _FINEST + _FINEST_PARTS * np.log(np.maximum(distance / _WIDE, 1.0))
    return np.copysign(steps, x)


def _from_finest(steps: float) -> float:
    """Place at a number of finest distances from focus: the inverse of :func:`_in_finest`."""
    if abs(steps) <= _FINEST_PARTS:
        return steps * _FINEST
    return math.copysign(_WIDE * math.exp(abs(steps) / _FINEST_PARTS - 1.0), steps)
