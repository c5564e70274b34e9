"""Reads a depth map of any kind from a file."""

import os
from typing import Any, Literal

from torch import Tensor

from ..io.images import Picture, read_map
from ..validation import choice
from .holes import Fill, resolve_holes
from .kinds import KINDS, DepthKind, depth_from_values
from .relative import RelativeKind, from_relative

__all__ = ["read_depth"]


def read_depth(
    path: str | os.PathLike[str],
    kind: DepthKind | Literal["relative"] | None = None,
    *,
    scale: float | None = None,
    offset: float = 0.0,
    unknown: float | None = None,
    fov_x_deg: float | None = None,
    near_m: float | None = None,
    far_m: float | None = None,
    relative_kind: RelativeKind | None = None,
    value_range: tuple[float, float] | None = None,
    fill: Fill | None = None,
    channel: str | None = None,
    image: Picture | None = None,
) -> Tensor:
    """Reads a depth map: :func:`torchdof.io.images.read_values`, a conversion to metres, :func:`fill_holes`.

    Args:
        path: A depth map, or a phone's portrait with depth in it.
        kind: Kind of the numbers. "relative" converts by :func:`from_relative`, the others by
            :func:`depth_from_values`. None takes what a portrait states about its depth, and "z" for other files.
        scale: As for :func:`depth_from_values`, like ``offset``, ``unknown`` and ``fov_x_deg``; not of "relative".
        offset: Added to the value before scaling.
        unknown: A value that marks pixels without depth.
        fov_x_deg: Horizontal field of view in degrees; required for "distance".
        near_m: As for :func:`from_relative`, like ``far_m``, ``relative_kind`` (its ``kind``, by default "disparity")
            and ``value_range``; only of "relative", which needs both distances.
        far_m: Distance of the farthest value, in metres.
        relative_kind: "disparity", "inverse" or "depth".
        value_range: ``(smallest, largest)`` value; None takes the extremes of the map.
        fill: As for :func:`fill_holes`; None refuses holes.
        channel: As for :func:`torchdof.io.images.read_values`, like ``image``.
        image: The picture that the map belongs to, in whose frame an EXR's data window is placed.

    Returns:
        ``[1, 1, H, W]`` float32 in metres (signed pixels for coc), without holes.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If the map has holes and ``fill`` is None, or an argument is missing, wrong, or of another kind.

    Example:
        >>> import tempfile, numpy
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     numpy.save(folder + "/depth.npy", numpy.array([[0.0, 0.5, 1.0]]))
        ...     read_depth(folder + "/depth.npy", "relative", near_m=1.0, far_m=4.0)
        tensor([[[[4.0000, 1.6000, 1.0000]]]])
    """
    if kind is not None:
        choice("the kind of depth", kind, (*KINDS, "relative"))
    of_relative: dict[str, Any] = {"near_m": near_m, "far_m": far_m, "kind": relative_kind, "value_range": value_range}
    of_relative = {name: value for name, value in of_relative.items() if value is not None}
    is_scaled = scale is not None or offset != 0.0
    values, meaning = read_map(path, channel, image=image)
    if kind is None and meaning and not of_relative and not is_scaled:
        kind, of_relative = "relative", {**meaning}
    if kind == "relative":
        is_along_ray = of_relative.pop("along_ray", False)
        if is_scaled:
            raise ValueError(f"{path}: relative depth has no scale and offset: near_m and far_m say it; leave them out")
        if not {"near_m", "far_m"} <= of_relative.keys():
            ends = "near_m and far_m, the distances in metres of its nearest and farthest value"
            raise ValueError(f"{path}: relative depth needs {ends}")
        depth = from_relative(values, **of_relative, unknown=unknown)
        if is_along_ray:
            depth = depth_from_values(depth, "distance", fov_x_deg=fov_x_deg)
    else:
        if of_relative:
            names = {"kind": "relative_kind"}
            given = ", ".join(names.get(name, name) for name in of_relative)
            raise ValueError(f"{path}: {given} describe relative depth; give kind 'relative' with them, got {kind!r}")
        depth = depth_from_values(values, kind or "z", scale=scale, offset=offset, unknown=unknown, fov_x_deg=fov_x_deg)
    return resolve_holes(depth, str(path), fill, kind == "relative")[0]
