"""Reading a depth map from a file, as metres without holes."""

import os

from torch import Tensor

from ..io.images import read_values
from .holes import Fill, resolve_holes
from .kinds import DepthKind, depth_from_values

__all__ = ["read_depth"]


def read_depth(
    path: str | os.PathLike[str],
    kind: DepthKind = "z",
    *,
    scale: float | None = None,
    offset: float = 0.0,
    unknown: float | None = None,
    fov_x_deg: float | None = None,
    fill: Fill | None = None,
    channel: str | None = None,
) -> Tensor:
    """Reads a depth map: :func:`torchdof.io.images.read_values`, :func:`depth_from_values`, :func:`fill_holes`.

    Returns:
        ``[1, 1, H, W]`` float32 in metres (signed pixels for coc), without holes.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If the map has holes and ``fill`` is None, or an argument is missing or wrong.
    """
    depth = depth_from_values(
        read_values(path, channel), kind, scale=scale, offset=offset, unknown=unknown, fov_x_deg=fov_x_deg
    )
    return resolve_holes(depth, str(path), fill)[0]
