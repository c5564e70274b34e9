"""Relative depth, as estimators give it, to metres: from two distances, or from points of known distance."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..tensors import is_traced, refuse_old_compiler
from ..validation import choice, number, numbers, one_channel, show, whole
from .kinds import depth_from_values

__all__ = ["RELATIVE_KINDS", "RelativeKind", "Scale", "from_relative", "solve_scale"]

RelativeKind = Literal["disparity", "inverse", "depth"]
RELATIVE_KINDS: tuple[RelativeKind, ...] = ("disparity", "inverse", "depth")

_LEVELS = 64  # fewest levels that a map of 8 bits spans; with fewer, a step of one level may be an edge
_REACHES_PX = (4, 2, 1)  # distances over which steps of one level are smoothed; more: wider ramps


def from_relative(
    values: Tensor,
    near_m: float,
    far_m: float,
    kind: RelativeKind = "disparity",
    *,
    value_range: tuple[float, float] | None = None,
    unknown: float | None = None,
) -> Tensor:
    """Relative depth to metres: the nearest value lies at ``near_m``, the farthest at ``far_m``.

    =========== ======================================= =====================================================
    kind        between the extremes                    for
    =========== ======================================= =====================================================
    disparity   1 / depth is linear, larger is nearer   MiDaS, DPT, Depth Anything; stereo of unknown scale
    inverse     the same                                inverse depth up to scale and shift
    depth       depth is linear, larger is farther      Marigold, and other affine-invariant depth
    =========== ======================================= =====================================================

    Maps of 8 bits, of numbers from 0 to 255 or from 0 to 1, have steps on smooth surfaces. In a strong blur each step
    near the focus would appear as a fine line, so steps become ramps: values change by at most half a level.

    Args:
        values: ``[B, 1, H, W]``, floating point or whole numbers, of any range. NaN and infinite values are holes.
        near_m: Distance of the nearest value, in metres, > 0.
        far_m: Distance of the farthest value, in metres, > ``near_m``; ``inf`` is allowed except for ``"depth"``.
        kind: Kind of the numbers.
        value_range: ``(smallest, largest)``; other values are clamped to this range. None takes the extremes of each
            item. Give it for the frames of a shot, so that all have the same scale.
        unknown: A value that marks pixels without depth, for example 0.

    Returns:
        ``[B, 1, H, W]`` in metres, on the device and in the dtype of ``values`` (float32 for whole numbers); NaN in
        holes. Differentiable with respect to ``values``; an infinite depth passes no gradient.

    Raises:
        ValueError: If an argument is not as described, or an item does not have two different values.

    Reference:
        Ranftl et al., "Towards robust monocular depth estimation", IEEE TPAMI 2022, section 5: disparity up to scale
        and shift.

    Example:
        >>> from_relative(torch.tensor([[[[0, 128, 255]]]], dtype=torch.uint8), near_m=1.0, far_m=5.0)
        tensor([[[[5.0000, 1.6623, 1.0000]]]])
    """
    refuse_old_compiler()
    choice("the kind of relative depth", kind, RELATIVE_KINDS)
    near_m = number("near_m", near_m, low=0, unit="metres")
    far_m = number("far_m", far_m, low=0, unit="metres", infinite=kind != "depth")
    if not near_m < far_m:
        raise ValueError(f"near_m must be nearer than far_m, got near_m={near_m:g} and far_m={far_m:g}")
    one_channel("relative depth", values, whole=True)
    dtype = values.dtype if values.is_floating_point() else torch.float32
    value = values.to(torch.promote_types(dtype, torch.float32)) if values.is_floating_point() else values.double()
    is_known = value.isfinite()
    if unknown is not None:
        is_known = is_known & (value != number("unknown", unknown, infinite=True))
    if value_range is None:
        low = torch.where(is_known, value, torch.inf).amin((1, 2, 3), keepdim=True)
        high = torch.where(is_known, value, -torch.inf).amax((1, 2, 3), keepdim=True)
        if not is_traced() and not bool((low < high).all()):
            if bool((low > high).any()):
                raise ValueError("no pixel has a depth; check the map, and the value that means unknown")
            problem = "relative depth needs two different values, got one value everywhere"
            raise ValueError(f"{problem}; give value_range=(smallest, largest) (--value-range) to say its place")
    else:
        ends = numbers("value_range", value_range)
        if ends.shape != (2,) or not ends[0] < ends[1]:
            raise ValueError(f"value_range must be (smallest, largest), got {show(value_range)}")
        low, high = ends.to(value)
    value = _smooth_steps(torch.where(is_known, value, torch.nan))
    fraction = ((torch.where(is_known, value, low) - low) / (high - low)).clamp(0.0, 1.0)
    if kind == "depth":
        depth = near_m + (far_m - near_m) * fraction
    else:
        inverse = fraction / near_m + (1.0 - fraction) / far_m
        depth = 1.0 / torch.where(inverse > 0, inverse, 1.0)
        depth = torch.where(inverse > 0, depth, torch.inf)
    return torch.where(is_known, depth, torch.nan).to(dtype)


def _smooth_steps(values: Tensor) -> Tensor:
    """Turns the steps of one level in maps of 8 bits into ramps; changes a value by at most half a level."""
    known = values.detach().nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    low, high = known.amin((1, 2, 3), keepdim=True), known.amax((1, 2, 3), keepdim=True)
    level = torch.where(high > 1.0, 1.0, 1.0 / 255.0)
    levels = known / level
    is_whole = ((levels - levels.round()).abs() < 1e-3).all(-1, True).all(-2, True)
    is_of_8_bits = is_whole & (high - low > _LEVELS * level) & (low >= 0) & (high <= 255.0 * level)
    if not is_traced() and not bool(is_of_8_bits.any()):
        return values
    smooth = values
    for reach in _REACHES_PX:
        for dim in (-1, -2):
            count, ends = values.shape[dim], (reach, reach, 0, 0) if dim == -1 else (0, 0, reach, reach)
            given, now = (functional.pad(t, ends, mode="replicate") for t in (values, smooth))
            middle = now.narrow(dim, reach, count)
            for start in (0, 2 * reach):
                is_near = (given.narrow(dim, start, count) - values).abs() < 1.5 * level
                smooth = smooth + torch.where(is_near, (now.narrow(dim, start, count) - middle) / 4.0, 0.0)
    smooth = torch.minimum(torch.maximum(smooth, values - level / 2.0), values + level / 2.0)
    return torch.where(is_of_8_bits, smooth, values)


@dataclasses.dataclass(frozen=True)
class Scale:
    """Conversion of the values of a map to metres: arguments of :func:`torchdof.depth.depth_from_values`.

    Args:
        kind: "disparity": ``scale / (value + offset)``; "z": ``scale * (value + offset)``.
        scale: Factor.
        offset: Added to the value before scaling.
        residual: RMS relative error of depth at the points of :func:`solve_scale`.
    """

    kind: Literal["disparity", "z"]
    scale: float
    offset: float
    residual: float

    def depth(self, values: Tensor) -> Tensor:
        """Metres ``[B, 1, H, W]``, float32; a disparity of 0 or less is at infinity, holes stay NaN.

        Example:
            >>> Scale("disparity", 2.0, 0.5, 0.0).depth(torch.tensor([[[[0.5, -0.5, -3.0]]]]))
            tensor([[[[2., inf, inf]]]])
        """
        depth = depth_from_values(values, self.kind, scale=self.scale, offset=self.offset)
        is_infinite = (values.double() + self.offset) * math.copysign(1.0, self.scale) <= 0
        return torch.where(is_infinite, torch.inf, depth) if self.kind == "disparity" else depth


def solve_scale(
    values: Tensor, points: Sequence[tuple[float, float, float]], kind: RelativeKind = "disparity", patch: int = 5
) -> Scale:
    """Scale and offset of relative depth from points of known distance.

    Two points give an exact solution; more are fitted by least squares of the relative errors of depth. ``torchdof
    render`` takes the result as ``--depth-kind disparity --depth-scale SCALE --depth-offset OFFSET`` (``--depth-kind
    z`` for "depth").

    Args:
        values: ``[1, 1, H, W]``, floating point or whole numbers; values that are not finite are left out.
        points: ``(x, y, metres)``, at least two with different values: pixels from the top left edge, and the distance
            along the optical axis, > 0; for disparity ``inf`` allowed.
        kind: As for :func:`from_relative`.
        patch: Side in pixels of the square patch around a point, whose median is used.

    Returns:
        The scale.

    Raises:
        ValueError: If an argument is not as described, all points have the same value, or the values of ``kind`` would
            grow in the other direction.

    Example:
        >>> values = torch.tensor([[[[1.0, 2.0, 4.0]]]])
        >>> scale = solve_scale(values, [(0.5, 0.5, 4.0), (2.5, 0.5, 1.0)], patch=1)
        >>> round(scale.scale, 6), round(abs(scale.offset), 6)
        (4.0, 0.0)
    """
    choice("the kind of relative depth", kind, RELATIVE_KINDS)
    one_channel("relative depth", values, whole=True)
    if values.shape[0] != 1:
        raise ValueError(f"values must be one map [1, 1, H, W], got {list(values.shape)}; solve each on its own")
    whole("patch", patch, 1, 2**31)
    samples = torch.tensor([_point(values, p, kind, patch) for p in points], dtype=torch.float64, device="cpu")
    value, metres = samples.reshape(-1, 2).unbind(1)
    if len(value.unique()) < 2:
        got = f"{len(value)} points of values {value.unique().tolist()}"
        raise ValueError(f"scale and offset need at least two points of different values, got {got}")
    # Solve a v + b = y with y = z for "depth", else 1/z. Each row is divided by y, so that errors are relative.
    weight = 1.0 / metres if kind == "depth" else metres.clamp(max=1e6 * float(metres.min()))
    target = metres.isfinite().double() if kind != "depth" else torch.ones_like(value)
    design = torch.stack([value * weight, weight], dim=1)
    factor, constant = torch.linalg.lstsq(design, target[:, None], driver="gelsd").solution[:, 0].tolist()
    if not factor > 0:
        other, direction = ("disparity", "nearer") if kind == "depth" else ("depth", "farther")
        raise ValueError(f"at the points, larger values are {direction}; that is kind={other!r}, not {kind!r}")
    residual = float((design @ design.new_tensor([factor, constant]) - target).square().mean().sqrt())
    if kind == "depth":
        return Scale("z", factor, constant / factor, residual)
    return Scale("disparity", 1.0 / factor, constant / factor, residual)


def _point(values: Tensor, point: tuple[float, float, float], kind: RelativeKind, patch: int) -> tuple[float, float]:
    """Median value around a point, and its distance in metres."""
    if not isinstance(point, Sequence) or len(point) != 3:
        raise ValueError(f"a point must be (x, y, metres), got {show(point)}")
    x, y = (number(name, coordinate) for name, coordinate in zip("xy", point, strict=False))
    metres = number("the distance of a point", point[2], low=0, unit="metres", infinite=kind != "depth")
    height, width = values.shape[-2:]
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError(f"point ({x:g}, {y:g}) must lie in the map of {width} x {height} pixels (x, y)")
    column, row, reach = int(x), int(y), patch // 2
    window = values[0, 0, max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1].double()
    window = window[window.isfinite()]
    if not window.numel():
        raise ValueError(f"no value within {reach} pixels of point ({x:g}, {y:g}); choose another point")
    return float(window.median()), metres
