"""Compares the fitted blur with the camera's numbers and distances."""

import math
from collections.abc import Sequence

import numpy as np

from ..problems import FitError, warn
from ..result import Array, Mask
from .captures import CAMERA, Captures

_MIN_BLUR_PX = 2.0  # radius of a blur that counts; smaller ones are dominated by aberrations
# log factors between both above which to warn and to refuse; a thick lens differs by up to 1.1, an f-stop by 1.41
_WARN_LOG, _REFUSE_LOG = math.log(1.15), math.log(1.35)


def check_agreement(captures: Captures, radius_px: Sequence[float] | Array) -> None:
    """Compares the fitted radius at each distance with the camera's, or without one with the other distances'."""
    measured, camera_px = np.asarray(radius_px, dtype=np.float64), captures.promised_px
    defocus = np.abs(captures.defocus)
    expected = defocus * _common_factor(defocus, measured) if camera_px is None else np.abs(camera_px)
    is_large = np.maximum(expected, measured) > _MIN_BLUR_PX
    misfit_log = _misfit(expected, measured, is_large)
    # without a camera the scale is fitted to the distances themselves
    if int(is_large.sum()) < (3 if camera_px is None else 1) or misfit_log < _WARN_LOG:
        return
    worst = int(np.argmax(np.where(is_large, np.abs(np.log(measured / expected)), 0.0)))
    each = zip(measured / expected, captures.distances_m, strict=True)
    ratios = ", ".join(f"{ratio:.2f} at {distance:g} m" for ratio, distance in each)
    text = f"the blur's radius over the expected one is {ratios}: check the distance of a single odd one, the focus if "
    text += "near and far ones differ, and units, a crop (full_width_px) and the camera's numbers if all do"
    if camera_px is not None:
        text += f"; without {', '.join(CAMERA)} the scale is measured"
    file = captures.pairs[worst].files[1]
    if misfit_log > _REFUSE_LOG:
        raise FitError(text, "camera", file)
    warn(text, "camera", file)


def _common_factor(expected: Array, measured: Array) -> float:
    """Measured over expected: a median weighted by the expected values, so that one wrong distance has no effect."""
    order = np.argsort(measured / expected)
    weight = np.cumsum(expected[order])
    return float((measured / expected)[order][np.searchsorted(weight, 0.5 * weight[-1])])


def _misfit(expected: Array, measured: Array, is_large: Mask) -> float:
    """Largest |log(measured / expected)|, after subtracting half a pixel for aberrations."""
    difference = np.maximum(np.abs(measured - expected) - 0.5, 0.0)
    factor = np.log1p(difference / np.maximum(np.minimum(measured, expected), 1e-9))
    return float(np.max(np.where(is_large, factor, 0.0)))
