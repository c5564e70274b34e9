"""Whether the fitted blur is the one that the camera's numbers and the distances promise; where not, what is wrong.

A circle of confusion computed from a focal length, an f-number, a sensor's width and a distance stands beside a radius
that was measured. Any number that was misread makes the two differ, and how they differ over the distances tells which.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ..problems import FitError, warn
from ..result import Array, Mask
from .captures import CAMERA, Captures

__all__ = ["check_agreement", "frame_width"]

_TELLING_PX = 2.0  # smaller blurs are the lens's aberrations as much as its defocus
_WARNED, _REFUSED = math.log(1.15), math.log(1.35)  # a thick lens close by differs by a tenth; one stop is 1.41
_EXPLAINED = math.log(1.12)
_UNITS = {3.28: "feet", 39.4: "inches", 100.0: "centimetres", 1000.0: "millimetres"}


def frame_width(captures: Captures, radius_px: Sequence[float]) -> int:
    """Width of the frame that the sensor's width belongs to.

    A picture smaller than EXIF says it was taken was either cropped, and its pixels are those of the sensor, or scaled
    down, and its frame is the sensor's. The blur tells.

    Args:
        captures: with or without an `original_width_px`.
        radius_px: of the uniform disc with the fitted kernels' second moment, for each pair.

    Returns:
        The original's width for a crop, with a warning of kind "camera"; else that of the pictures.
    """
    promised, original = captures.promised_px, captures.original_width_px
    if promised is None or original is None or original == captures.width_px:
        return captures.width_px
    scaled = _common_factor(np.abs(promised), np.asarray(radius_px))
    cropped = scaled * captures.width_px / original
    if abs(math.log(cropped)) >= min(abs(math.log(scaled)), _REFUSED):
        return captures.width_px
    text = (
        f"the pictures are {captures.width_px} px wide and EXIF says they were taken {original} px wide: they are "
        f"taken for a crop, as which their blur is {cropped:.2f} times what the camera promises (scaled down, "
        f"{scaled:.2f} times); state full_width_px = {original} to say so, or {captures.width_px} to deny it"
    )
    warn(text, "camera", file=captures.pairs[0].files[0], number=cropped)
    return original


def check_agreement(captures: Captures, radius_px: Sequence[float]) -> None:
    """Compare the fitted blur with the camera's circle of confusion, and name the likely cause where they differ.

    Args:
        captures: with the right `width_px`.
        radius_px: of the uniform disc with the fitted kernels' second moment, for each pair.

    Raises:
        FitError: of kind "camera" where they differ by more than a factor of 1.35; it warns from 1.15 on.
    """
    measured, promised = np.asarray(radius_px, dtype=np.float64), captures.promised_px
    defocus = np.abs(captures.defocus)
    expected = defocus * _common_factor(defocus, measured) if promised is None else np.abs(promised)
    telling = np.maximum(expected, measured) > _TELLING_PX
    # without a camera the first distances set the scale
    if int(telling.sum()) < (3 if promised is None else 1):
        return
    off = _misfit(expected, measured, telling)
    if off < _WARNED:
        return
    readings = _readings(captures, expected, measured, telling)
    likely = [text for misfit, text in sorted(readings, key=lambda r: r[0]) if misfit < min(_EXPLAINED, 0.5 * off)]
    worst = int(np.argmax(np.where(telling, np.abs(np.log(measured / expected)), 0.0)))
    who = "the other distances" if promised is None else "the camera's numbers"
    text = (
        f"at {captures.distances_m[worst]:g} m the blur has a radius of {measured[worst]:.3g} px, and {who} promise "
        f"{expected[worst]:.3g} px; "
    )
    cause = "; or ".join(likely[:2])
    text += f"likely {cause}" if cause else "no single number explains it: check them all, and the picture of the fit"
    file, factor = captures.pairs[worst].files[1], float(measured[worst] / expected[worst])
    if off > _REFUSED:
        if promised is not None:
            text += ". Leave out focal_length_mm, f_number and sensor_width_mm to have the scale measured instead"
        raise FitError(text, "camera", file=file, number=factor)
    warn(text, "camera", file=file, number=factor)


def _readings(captures: Captures, expected: Array, measured: Array, telling: Mask) -> list[tuple[float, str]]:
    """What one mistake could each explain: a wrong scale, a wrong distance, two exchanged, another focus.

    Returns:
        How far the blur is then from what the numbers promise, and what the mistake is.
    """
    distance, defocus = captures.distances_m, captures.defocus
    per_dioptre = float(np.median(expected / np.abs(defocus)))
    readings = []
    if captures.promised_px is not None:
        factor = _common_factor(expected, measured)
        readings.append((_misfit(factor * expected, measured, telling), _scale_causes(captures, factor)))
    for i, k in combinations(range(len(distance)), 2):
        exchanged = expected.copy()
        exchanged[[i, k]] = expected[[k, i]]
        text = f"the pictures at {distance[i]:g} and {distance[k]:g} m are exchanged"
        readings.append((_misfit(exchanged, measured, telling), text))
    if telling.sum() < 3:
        return readings
    for i in map(int, np.flatnonzero(telling)):
        others = telling.copy()
        others[i] = False
        stands = _stands(captures, math.copysign(measured[i] / per_dioptre, defocus[i]))
        text = f"the distance of {distance[i]:g} m is misread: by its blur it stands at {stands or 'beyond infinity'}"
        readings.append((_misfit(expected, measured, others), text))
    if (defocus[telling] > 0).any() and (defocus[telling] < 0).any():
        moved = np.linspace(-1, 1, 401) * float(np.abs(defocus).max())
        misfits = [_misfit(per_dioptre * np.abs(defocus - m), measured, telling) for m in moved]
        best = int(np.argmin(misfits))
        stands = _stands(captures, moved[best])
        if stands:
            text = f"the lens was focused at {stands}, not at {captures.focus_m:g} m"
            readings.append((misfits[best], text))
    return readings


def _stands(captures: Captures, defocus: float) -> str:
    """The distance of a defocus [1/m], empty where there is none."""
    vergence = 1 / captures.focus_m - defocus
    return f"{1 / vergence:.3g} m" if vergence > 0 else ""


def _scale_causes(captures: Captures, factor: float) -> str:
    """Every number that could be wrong by itself if all blurs are `factor` times what is promised."""
    focal, stops, sensor = (float(getattr(captures, name)) for name in CAMERA)
    units = [name for unit, name in _UNITS.items() if abs(math.log(factor / unit)) < _EXPLAINED]
    causes = [f"the distances are in {name}, not in metres" for name in units]
    if factor > 1:
        causes.append(
            f"the pictures are a crop of frames about {round(captures.width_px * factor)} px wide (state "
            "full_width_px, or cut them by crop = [left, top, width, height] instead of in an editor)"
        )
    causes += [
        f"the f-number is {stops / factor:.2g}, not {stops:g}",
        f"the sensor is {sensor / factor:.3g} mm wide, not {sensor:g}",
        f"the focal length is {focal * math.sqrt(factor):.3g} mm, not {focal:g}",
    ]
    return ", or ".join(causes)


def _common_factor(expected: Array, measured: Array) -> float:
    """Measured over expected, the median weighted by what is expected: a single wrong distance has no say."""
    order = np.argsort(measured / expected)
    weight = np.cumsum(expected[order])
    return float((measured / expected)[order][np.searchsorted(weight, 0.5 * weight[-1])])


def _misfit(expected: Array, measured: Array, telling: Mask) -> float:
    """Largest |log(measured / expected)|, without what a pixel of aberrations explains."""
    apart = np.maximum(np.abs(measured - expected) - 0.5, 0.0)
    factor = np.log1p(apart / np.maximum(np.minimum(measured, expected), 1e-9))
    return float(np.max(np.where(telling, factor, 0.0)))
