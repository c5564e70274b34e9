"""Depth maps in files, of any kind, to metres without holes."""

import os
from typing import Literal

from torch import Tensor

from ..io.images import Picture, read_values
from ..validation import choice
from .holes import Fill, resolve_holes
from .kinds import KINDS, DepthKind, depth_from_values
from .relative import RelativeKind, from_relative

__all__ = ["read_depth"]


def read_depth(
    path: str | os.PathLike[str],
    kind: DepthKind | Literal["relative"] = "z",
    *,
    scale: float | None = None,
    offset: float = 0.0,
    unknown: float | None = None,
    fov_x_deg: float | None = None,
    near_m: float | None = None,
    far_m: float | None = None,
    relative_kind: RelativeKind = "disparity",
    value_range: tuple[float, float] | None = None,
    fill: Fill | None = None,
    channel: str | None = None,
    image: Picture | None = None,
) -> Tensor:
    """Reads a depth map: :func:`torchdof.io.images.read_values`, conversion to metres, :func:`fill_holes`.

    The conversion is :func:`depth_from_values` with ``scale``, ``offset``, ``unknown`` and ``fov_x_deg``. For the kind
    ``"relative"`` it is :func:`from_relative` with ``near_m``, ``far_m``, ``relative_kind``, ``value_range`` and
    ``unknown``. ``image``, if given, is the picture that the map belongs to, in whose frame an EXR's data window is placed.

    Returns:
        ``[1, 1, H, W]`` float32 in metres (signed pixels for coc), without holes.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If the map has holes and ``fill`` is None, or an argument is missing, wrong, or of another kind.
    """
    choice("the kind of depth", kind, (*KINDS, "relative"))
    is_relative = kind == "relative"
    if is_relative and (scale is not None or offset != 0.0):
        raise ValueError("relative depth has no scale and offset: near_m and far_m say it; leave them out")
    if not is_relative and (near_m, far_m, value_range, relative_kind) != (None, None, None, "disparity"):
        names = "near_m, far_m, relative_kind and value_range"
        raise ValueError(f"{names} are for the kind 'relative', got the kind {kind!r}; leave them out")
    values = read_values(path, channel, image)
    if kind == "relative":
        if near_m is None or far_m is None:
            raise ValueError("relative depth needs near_m and far_m, the distances of the nearest and farthest value")
        depth = from_relative(values, near_m, far_m, relative_kind, value_range=value_range, unknown=unknown)
        depth = depth.float()
    else:
        depth = depth_from_values(values, kind, scale=scale, offset=offset, unknown=unknown, fov_x_deg=fov_x_deg)
    return resolve_holes(depth, str(path), fill, zero_is_known=is_relative)[0]
