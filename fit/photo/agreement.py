"""Compares the fitted blur with the camera's numbers and distances, and finds the likely cause of a difference."""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from ..problems import FitError, warn
from ..result import Array, Mask
from .captures import CAMERA, Captures

_MIN_BLUR_PX = 2.0  # radius of a blur that counts; smaller ones are dominated by aberrations
# log factors between both above which to warn and to refuse; a thick lens differs by up to 1.1, an f-stop by 1.41
_WARN_LOG, _REFUSE_LOG = math.log(1.15), math.log(1.35)
_EXPLAINED_LOG = math.log(1.12)  # remaining log factor up to which a cause explains the difference
_UNITS = {3.28: "feet", 39.4: "inches", 100.0: "centimetres", 1000.0: "millimetres"}


def check_agreement(captures: Captures, radius_px: Sequence[float] | Array) -> None:
    """Compares the fitted radius at each distance with the camera's, and names the likely cause of a difference."""
    measured, camera_px = np.asarray(radius_px, dtype=np.float64), captures.promised_px
    defocus = np.abs(captures.defocus)
    expected = defocus * _common_factor(defocus, measured) if camera_px is None else np.abs(camera_px)
    is_large = np.maximum(expected, measured) > _MIN_BLUR_PX
    misfit_log = _misfit(expected, measured, is_large)
    # without a camera the scale is fitted to the distances themselves
    if int(is_large.sum()) < (3 if camera_px is None else 1) or misfit_log < _WARN_LOG:
        return
    readings = sorted(_causes(captures, expected, measured, is_large))
    likely = [text for misfit, text in readings if misfit < min(_EXPLAINED_LOG, 0.5 * misfit_log)]
    cause = "likely " + "; or ".join(likely[:2]) if likely else "no single number explains it: check them all"
    worst = int(np.argmax(np.where(is_large, np.abs(np.log(measured / expected)), 0.0)))
    giver, file = "the other distances" if camera_px is None else "the camera numbers", captures.pairs[worst].files[1]
    text = f"at {captures.distances_m[worst]:g} m the blur has a radius of {measured[worst]:.3g} px, but {giver} give "
    text += f"{expected[worst]:.3g} px; {cause}"
    if misfit_log <= _REFUSE_LOG:
        warn(text, "camera", file)
    else:
        remedy = "" if camera_px is None else f". Leave out {', '.join(CAMERA)} to have the scale measured instead"
        raise FitError(text + remedy, "camera", file)


def _causes(captures: Captures, expected: Array, measured: Array, is_large: Mask) -> Iterator[tuple[float, str]]:
    """Possible single mistakes: the misfit that remains if each is corrected, and its description."""
    distance, defocus = captures.distances_m, captures.defocus
    per_dioptre = float(np.median(expected / np.abs(defocus)))

    def place(defocus: float) -> str:
        """The distance with this defocus [1/m], as text."""
        vergence = 1 / captures.focus_m - defocus
        return f"{1 / vergence:.3g} m" if vergence > 0 else "beyond infinity"

    if captures.promised_px is not None:
        factor = _common_factor(expected, measured)  # of all blurs
        focal, stops, sensor = (float(getattr(captures, name)) for name in CAMERA)
        units = [name for unit, name in _UNITS.items() if abs(math.log(factor / unit)) < _EXPLAINED_LOG]
        causes = [f"the distances are in {name}, not in metres" for name in units]
        if factor > 1:
            width = round(captures.width_px * factor)
            causes.append(f"the pictures are a crop of frames about {width} px wide (state full_width_px)")
        causes += [
            f"the f-number is {stops / factor:.2g}, not {stops:g}",
            f"the sensor is {sensor / factor:.3g} mm wide, not {sensor:g}",
            f"the focal length is {focal * math.sqrt(factor):.3g} mm, not {focal:g}",
        ]
        yield _misfit(factor * expected, measured, is_large), ", or ".join(causes)
    for i, k in combinations(range(len(distance)), 2):
        exchanged = expected.copy()
        exchanged[[i, k]] = expected[[k, i]]
        yield _misfit(exchanged, measured, is_large), f"pictures at {distance[i]:g} and {distance[k]:g} m are exchanged"
    if is_large.sum() < 3:
        return
    for i in np.flatnonzero(is_large).tolist():
        stands = place(math.copysign(measured[i] / per_dioptre, defocus[i]))
        text = f"the distance of {distance[i]:g} m is misread: by its blur it stands at {stands}"
        yield _misfit(expected, measured, is_large & (np.arange(len(distance)) != i)), text
    if (defocus[is_large] > 0).any() and (defocus[is_large] < 0).any():
        shifts = np.linspace(-1, 1, 401) * float(np.abs(defocus).max())
        misfit, shift = min((_misfit(per_dioptre * np.abs(defocus - m), measured, is_large), m) for m in shifts)
        yield misfit, f"the lens was focused at {place(shift)}, not at {captures.focus_m:g} m"


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
