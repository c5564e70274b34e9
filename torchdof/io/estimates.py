"""What depth estimators write beside their depth: several maps in a file, and the camera that they estimated."""

import contextlib
import dataclasses
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

_PIXELS = 16.0  # focal lengths below are shares of the width, as MoGe's, and not pixels
_UNIT_FOCAL_PX = 300.0  # px; the metric model of Depth Anything 3 gives metres for a lens of this focal length


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Facts in a depth file that are no depth.

    Args:
        fov_x_deg: Horizontal field of view of the map, in degrees, or None.
        metric_scale: Factor with which the numbers of Depth Anything 3's metric model become metres; None for others.
    """

    fov_x_deg: float | None = None
    metric_scale: float | None = None


def estimate_of(path: Path, width: int, place: tuple[int, int] | None = None) -> Estimate:
    """The camera of a depth map of a width in pixels, which is one of several maps if it has a ``place``.

    It is read from ``focallength_px`` or ``intrinsics`` of an ``.npz`` file (Depth Pro, Depth Anything 3, UniDepth,
    MoGe), or from ``fov.json`` beside the map (MoGe). What makes no sense is ignored.
    """
    with contextlib.suppress(OSError, ValueError, TypeError, LookupError, ArithmeticError, zipfile.BadZipFile):
        if path.suffix.lower() == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                names = set(arrays.files)
                focal_px = _focal_px(arrays, names, width, place[0] if place else 0)
            fov_x_deg = 2 * math.degrees(math.atan(width / (2 * focal_px)))
            is_depth_anything = {"depth", "conf", "intrinsics"} <= names
            return Estimate(_sensible(fov_x_deg), focal_px / _UNIT_FOCAL_PX if is_depth_anything else None)
        return Estimate(_sensible(float(json.loads(path.with_name("fov.json").read_bytes())["fov_x"])))
    return Estimate()


def _focal_px(arrays: Any, names: set[str], width: int, place: int) -> float:
    """Focal length in pixels of the map; a matrix may be one of several."""
    if "focallength_px" in names:
        return float(np.ravel(arrays["focallength_px"])[place if arrays["focallength_px"].size > 1 else 0])
    matrices = np.reshape(arrays["intrinsics"], (-1, 3, 3))
    focal = float(matrices[place if len(matrices) > 1 else 0][0, 0])
    return focal if focal > _PIXELS else focal * width


def _sensible(fov_x_deg: float) -> float | None:
    return fov_x_deg if 1.0 < fov_x_deg < 170.0 else None
