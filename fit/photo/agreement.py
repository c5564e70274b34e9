"""Compares the fitted blur with the camera's numbers and distances."""

import math
from collections.abc import Sequence

import numpy as np

from ..problems import FitError, warn
from ..result import Array
from .captures import CAMERA, Captures

_MIN_BLUR_PX = 2.0  # radius of a blur that counts; smaller ones are dominated by aberrations
# log factors between both above which to warn and to refuse; a thick lens differs by up to 1.1, an f-stop by 1.41
_WARN_LOG, _REFUSE_LOG = math.log(1.15), math.log(1.35)


def check_agreement(captures: Captures, radius_px: Sequence[float] | Array) -> None:
    """Compares the fitted radius at each distance with the camera's, or without one with the other distances'."""
    measured, camera_px = np.asarray(radius_px, dtype=np.float64), captures.promised_px
    if camera_px is None:  # the scale is a median weighted by the defocus, so that one wrong distance has no effect
        defocus = np.abs(captures.defocus)
        order = np.argsort(measured / defocus)
        weight = np.cumsum(defocus[order])
        expected = defocus * (measured / defocus)[order][np.searchsorted(weight, 0.5 * weight[-1])]
    else:
        expected = np.abs(camera_px)
    is_large = np.maximum(expected, measured) > _MIN_BLUR_PX
    difference = np.maximum(np.abs(measured - expected) - 0.5, 0.0)  # half a pixel is for aberrations
    misfit = np.log1p(difference / np.maximum(np.minimum(measured, expected), 1e-9))
    misfit_log = float(np.max(np.where(is_large, misfit, 0.0)))
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
