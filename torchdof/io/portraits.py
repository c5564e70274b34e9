"""Depth and matte that a phone stores inside a photograph, as HEIC and JPEG files hold them."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from .decode import Part

__all__ = ["Embedded", "by_inverse", "by_range"]

_METRES = {"m": 1.0, "meters": 1.0, "metres": 1.0, "mm": 0.001, "millimeters": 0.001, "millimetres": 0.001}


@dataclasses.dataclass(frozen=True)
class Embedded:
    """The maps of a photograph; each has the orientation of the stored photograph.

    Args:
        depth: Stored numbers, ``[h, w]``, or None.
        meaning: Arguments of :func:`torchdof.depth.from_relative` with which the numbers become metres, and
            ``along_ray`` if these are distances along the ray. Empty if the file does not state it.
        matte: Coverage by the subject, ``[h, w]``, float32 in [0, 1], or None.
        original: The photograph without blur, if the file's own is blurred already.
        problem: Reason for which the maps of the file cannot be used, or "".
    """

    depth: np.ndarray | None = None
    meaning: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    matte: np.ndarray | None = None
    original: Part | None = None
    problem: str = ""


def by_inverse(smallest: float, largest: float, top: float) -> dict[str, Any]:
    """Meaning of numbers from 0 to ``top`` that are linear in 1 / distance, with 1 / m at both ends."""
    if not (math.isfinite(smallest) and smallest < largest and 0 < largest < math.inf):
        raise ValueError(f"it claims a disparity from {smallest:g} to {largest:g} per metre; name a depth file")
    if smallest > 0:
        return {"near_m": 1 / largest, "far_m": 1 / smallest, "kind": "inverse", "value_range": (0.0, top)}
    at_infinity = -smallest / (largest - smallest) * top
    return {"near_m": 1 / largest, "far_m": math.inf, "kind": "inverse", "value_range": (at_infinity, top)}


def by_range(values: np.ndarray, stated: Mapping[str, str | None]) -> tuple[np.ndarray, dict[str, Any]]:
    """Numbers of GDepth or Dynamic Depth, and their meaning.

    With n = number / largest possible number, the distance d in the file's unit is ``near + n (far - near)`` for
    RangeLinear, and ``far near / (far - n (far - near))`` for RangeInverse, so that 0 is the nearest. Ends in dioptres
    are converted to metres; 1 / distance is then linear in n.

    Args:
        values: ``[h, w]``, uint8 or uint16.
        stated: The properties ``Format``, ``Near``, ``Far``, ``Units`` and ``MeasureType``; None if absent.

    Raises:
        ValueError: If the unit or the ends make no sense.
    """
    unit, top = (stated["Units"] or "m").lower(), float(np.iinfo(values.dtype).max)
    try:
        ends = float(stated["Near"] or math.nan), float(stated["Far"] or math.nan)
        ends_m = (1 / ends[0], 1 / ends[1]) if unit == "diopters" else tuple(_METRES[unit] * end for end in ends)
    except (KeyError, ValueError, ZeroDivisionError):
        ends_m = (math.nan, math.nan)
    near_m, far_m = sorted(ends_m)
    if not 0 < near_m < far_m < math.inf:
        facts = ", ".join(f"{name} {stated[name]}" for name in ("Near", "Far", "Units"))
        raise ValueError(f"it has no sensible range of distances ({facts}); name a depth file")
    is_linear = stated["Format"] == "RangeLinear" and unit != "diopters"
    if is_linear is (ends_m[0] > ends_m[1]):  # "inverse" is larger for nearer surfaces, "depth" for farther ones
        values = np.iinfo(values.dtype).max - values
    meaning = {"near_m": near_m, "far_m": far_m, "kind": "depth" if is_linear else "inverse", "value_range": (0.0, top)}
    return values, meaning | ({"along_ray": True} if stated["MeasureType"] == "OpticRay" else {})
