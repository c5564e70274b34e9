"""Depth values of any stated kind to metres along the optical axis, and holes filled as asked."""

import math
import os
from typing import Literal

import torch
from torch import Tensor

from .arguments import number, real_tensor, show
from .files import read_values

__all__ = ["DepthKind", "depth_from_values", "fill_holes", "read_depth", "resolve_holes"]

DepthKind = Literal["z", "distance", "disparity", "inverse", "coc"]
KINDS: tuple[DepthKind, ...] = ("z", "distance", "disparity", "inverse", "coc")


def depth_from_values(
    values: Tensor,
    kind: DepthKind = "z",
    *,
    scale: float | None = None,
    offset: float = 0.0,
    unknown: float | None = None,
    fov_x_deg: float | None = None,
) -> Tensor:
    """Numbers of a depth map to metres along the optical axis; pixels without depth become NaN.

    =========== ============================================== ==========================================
    kind        result                                         for
    =========== ============================================== ==========================================
    z           ``scale * (value + offset)``                   renderers; millimetre maps (scale 0.001)
    distance    the same, as length of the ray, turned into z  path tracers, lidar
    disparity   ``scale / (value + offset)``                   stereo: scale = baseline [m] * focal [px]
    inverse     ``scale / (value + offset)``                   inverse depth, learned depth
    coc         ``scale * (value + offset)``, signed px        ready circles of confusion
    =========== ============================================== ==========================================

    Args:
        values: ``[B, 1, H, W]``.
        kind: What the numbers are.
        scale: Factor, 1 if None; disparity needs one.
        offset: Added to the value first.
        unknown: A value that means "not measured", for example 0, -1 or inf. NaN always does, and so does
            whatever leads to a depth that is zero, negative or NaN (a disparity of inf among them); for coc, NaN
            and inf.
        fov_x_deg: Horizontal field of view in degrees, needed for "distance".

    Returns:
        ``[B, 1, H, W]`` float32 in metres (pixels for coc), ``> 0`` or ``inf``, NaN where unknown.

    Raises:
        ValueError: If the kind is unknown or lacks the scale or field of view that it needs.

    Example:
        >>> depth_from_values(torch.tensor([[[[1500.0, 0.0]]]]), "z", scale=0.001)
        tensor([[[[1.5000,    nan]]]])
    """
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"the kind of depth must be one of {', '.join(KINDS)}, got {show(kind)}")
    _map("depth values", values)
    if values.ndim != 4 or values.shape[1] != 1:
        raise ValueError(f"depth values must be [B, 1, H, W], got {list(values.shape)}")
    if kind == "disparity" and scale is None:
        raise ValueError(
            "disparity needs a scale (--depth-scale): the baseline in metres times the focal length in pixels"
        )
    scale = 1.0 if scale is None else scale
    for factor in (scale, offset):
        if isinstance(factor, bool) or not isinstance(factor, int | float) or not abs(factor) < 1e300 or scale == 0.0:
            told = f"got scale {show(scale)} and offset {show(offset)}"
            raise ValueError(f"scale must be finite and not 0, offset finite, {told}")
    if unknown is not None and not math.isnan(unknown if isinstance(unknown, float) else 0.0):
        unknown = number("unknown", unknown, infinite=True)
    value = values.double()
    missing = value.isnan() if unknown is None else value.isnan() | (value == unknown)
    depth = scale / (value + offset) if kind in ("disparity", "inverse") else scale * (value + offset)
    if kind == "distance":
        if fov_x_deg is None:
            raise ValueError("distance along the ray needs the horizontal field of view (--fov-deg) to become depth")
        depth = depth / _ray_length(depth, fov_x_deg)
    missing = missing | (~depth.isfinite() if kind == "coc" else ~(depth > 0))
    return torch.where(missing, torch.nan, depth).float()


def fill_holes(depth: Tensor, fill: Literal["nearest", "far"] | float) -> Tensor:
    """Gives every pixel without depth (NaN) one.

    Args:
        depth: ``[1, 1, H, W]``.
        fill: "nearest" takes the nearest pixel that has depth (by jump flooding: now and then one that is a
            fraction of a pixel farther). "far" takes the farthest of the first pixels with depth to the left, right,
            above and below: what stereo cannot see lies behind. A number is the depth in metres, for example inf for
            a sky.

    Returns:
        ``[1, 1, H, W]`` without NaN; where there was a depth it is unchanged.

    Raises:
        ValueError: If no pixel has a depth to fill from, or the fill is unknown.

    Example:
        >>> fill_holes(torch.tensor([[[[1.0, torch.nan, torch.nan, 4.0]]]]), "far")
        tensor([[[[1., 4., 4., 4.]]]])
    """
    _map("depth", depth)
    if isinstance(fill, int | float) and not isinstance(fill, bool):
        if not fill > 0 or torch.finfo(depth.dtype).max < fill < math.inf:
            raise ValueError(f"the depth to fill with must be positive metres (inf allowed), got {show(fill)}")
        return torch.where(depth.isnan(), float(fill), depth)
    if not isinstance(fill, str) or fill not in ("nearest", "far"):
        raise ValueError(f"fill must be 'nearest', 'far' or metres, got {show(fill)}")
    if depth.ndim != 4 or depth.shape[:2] != (1, 1):
        raise ValueError(f"depth must be [1, 1, H, W], got {list(depth.shape)}")
    if not bool(depth.isnan().any()):
        return depth
    if bool(depth.isnan().all()):
        raise ValueError("no pixel has a depth; check the kind, scale and offset of the depth map")
    if fill == "nearest":
        return _nearest(depth[0, 0])[None, None]
    candidates = torch.stack([_first_along(depth, dim, back) for dim in (-1, -2) for back in (False, True)])
    farthest = torch.where(candidates.isnan(), -torch.inf, candidates).amax(dim=0)
    filled = torch.where(depth.isnan() & (farthest > -torch.inf), farthest, depth)
    return fill_holes(filled, "nearest")  # what has no depth in its row or column


def resolve_holes(depth: Tensor, name: str, fill: Literal["nearest", "far"] | float | None) -> tuple[Tensor, int]:
    """Counts the pixels without depth (NaN), and refuses or fills them.

    Args:
        depth: ``[1, 1, H, W]``.
        name: Of the file, for the message.
        fill: As for :func:`fill_holes`; None refuses.

    Returns:
        The depth without holes, and how many there were.

    Raises:
        ValueError: If there are holes and ``fill`` is None, or nothing to fill them from.
    """
    holes = int(depth.isnan().sum())
    if holes == 0:
        return depth, 0
    if fill is None:
        raise ValueError(
            f"{name}: {holes} pixels ({100 * holes / depth.numel():.1f} %) have no depth (NaN, zero, negative or "
            "marked unknown); say how to fill them: fill 'nearest' or 'far' (--fill-depth)"
        )
    try:
        return fill_holes(depth, fill), holes
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def read_depth(
    path: str | os.PathLike[str],
    kind: DepthKind = "z",
    *,
    scale: float | None = None,
    offset: float = 0.0,
    unknown: float | None = None,
    fov_x_deg: float | None = None,
    fill: Literal["nearest", "far"] | float | None = None,
    channel: str | None = None,
) -> Tensor:
    """Reads a depth map: :func:`torchdof.files.read_values`, :func:`depth_from_values`, :func:`fill_holes`.

    Returns:
        ``[1, 1, H, W]`` float32 in metres (signed pixels for coc), without holes.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it has holes and ``fill`` is None, or something is missing or unclear.
    """
    depth = depth_from_values(
        read_values(path, channel), kind, scale=scale, offset=offset, unknown=unknown, fov_x_deg=fov_x_deg
    )
    return resolve_holes(depth, str(path), fill)[0]


def _map(name: str, values: Tensor) -> None:
    # integers are what files hold; of the rest only what arithmetic works on
    if isinstance(values, Tensor) and values.dtype in (torch.uint8, torch.int16, torch.int32, torch.int64):
        values = values.double()
    real_tensor(name, values, "[B, 1, H, W]")
    if not values.numel():
        raise ValueError(f"{name} must have at least one pixel, got {list(values.shape)}")


def _ray_length(like: Tensor, fov_x_deg: float) -> Tensor:
    """Length of the ray to depth 1 through each pixel's centre, ``[1, 1, H, W]``."""
    if isinstance(fov_x_deg, bool) or not isinstance(fov_x_deg, int | float) or not 0.0 < fov_x_deg < 180.0:
        raise ValueError(f"the field of view must be in (0, 180) degrees, got {show(fov_x_deg)}")
    height, width = like.shape[-2:]
    focal_px = width / 2 / max(math.tan(math.radians(fov_x_deg) / 2), 1e-300)
    x = (torch.arange(width, dtype=like.dtype) + 0.5 - width / 2) / focal_px
    y = (torch.arange(height, dtype=like.dtype) + 0.5 - height / 2) / focal_px
    return torch.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)[None, None]


def _first_along(depth: Tensor, dim: int, back: bool) -> Tensor:
    """The last value that is not NaN at or before each place along a dimension; NaN where there is none."""
    seen = depth.flip(dim) if back else depth
    place = torch.arange(seen.shape[dim]).reshape([-1 if d == seen.ndim + dim else 1 for d in range(seen.ndim)])
    last = torch.where(seen.isnan(), -1, place).cummax(dim=dim).values
    found = torch.where(last >= 0, seen.gather(dim, last.clamp(min=0)), torch.nan)
    return found.flip(dim) if back else found


def _nearest(depth: Tensor) -> Tensor:
    """Jump flooding (Rong and Tan 2006), on the holes alone: ``[H, W]`` with NaN to ``[H, W]`` without."""
    height, width = depth.shape
    y, x = torch.nonzero(depth.isnan(), as_tuple=True)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    seed = torch.where(depth.isnan(), -1, rows * width + columns)
    step = 1 << max(height, width).bit_length()
    steps = [step]
    while steps[-1] > 1:
        steps.append(steps[-1] // 2)
    for step in [*steps, 2, 1]:
        best = seed[y, x]
        best_distance = _squared_distance(best, y, x, width)
        for dy in (-step, 0, step):
            for dx in (-step, 0, step):
                inside = (y + dy >= 0) & (y + dy < height) & (x + dx >= 0) & (x + dx < width)
                other = seed[(y + dy).clamp(0, height - 1), (x + dx).clamp(0, width - 1)]
                other = torch.where(inside, other, -1)
                distance = _squared_distance(other, y, x, width)
                best = torch.where(distance < best_distance, other, best)
                best_distance = torch.minimum(best_distance, distance)
        seed[y, x] = best
    return depth.flatten()[seed]


def _squared_distance(seed: Tensor, y: Tensor, x: Tensor, width: int) -> Tensor:
    far = torch.iinfo(torch.int64).max
    return torch.where(seed < 0, far, (seed // width - y) ** 2 + (seed % width - x) ** 2)
