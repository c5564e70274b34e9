"""A fit to bad data gives a number within its error bars, a warning, or an error: never a wrong number silently."""

import numpy as np
import pytest

from tests.fit.simulator import Simulator, result_and_warnings
from torchdof.fit import FitError, fit_pair

pytestmark = pytest.mark.hard

SIZE, SIGMA = 61, 2.0
COLUMNS = np.linspace(0, 1, SIZE)
HOT = np.pad([[3.0]], ((32, 28), (30, 30)))


def pair(sigma=SIGMA, gain=1.0, level=0.0, **camera):
    """A sharp picture of a dot and one blurred by a Gaussian."""
    sharp, blurred = Simulator(**{"size": SIZE, "dot_radius": 7.0, **camera}).pair("gaussian", {"sigma": sigma})
    return gain * sharp + level, gain * blurred + level


def spoiled(spoil):
    sharp, blurred = pair(snr_db=60.0)
    return sharp, spoil(blurred)


def repeated(share, distance):
    """Adds a copy of the blurred picture, scaled and displaced."""
    return spoiled(lambda picture: picture + share * np.roll(picture, (distance, distance), (0, 1)))


# name -> (pair, true sigma); sigma is None where no number would be right. Errors: test_pair.py
HOSTILE = {
    "flat and noisy": (lambda: (pair()[0], np.random.default_rng(3).normal(0.3, 0.01, (SIZE, SIZE))), None),
    "a window of 15 px": (lambda: pair(1.0, size=15, dot_radius=3.0), 1.0),
    "a dot of half a pixel": (lambda: pair(dot_radius=0.5), SIGMA),
    "no blur, no noise": (lambda: pair(0.0, snr_db=None), 0.0),
    "twice the same picture": (lambda: (pair()[0],) * 2, 0.0),
    "sharp and blurred swapped": (lambda: pair()[::-1], None),
    "black dot on white": (lambda: pair(gain=-1.0, level=1.0), None),
    "signal to noise 0 dB": (lambda: pair(snr_db=0.0), SIGMA),
    "levels of 1e200": (lambda: pair(gain=1e200), SIGMA),
    "denormal levels": (lambda: pair(gain=1e-310), SIGMA),
    "on a level of 1e6": (lambda: pair(level=1e6), SIGMA),
    "a hot pixel in the dot": (lambda: spoiled(lambda p: np.where(HOT > 0, HOT, p)), SIGMA),
    "a slope of stray light": (lambda: spoiled(lambda p: p + 0.3 * COLUMNS), SIGMA),
    "half the picture black": (lambda: spoiled(lambda p: np.where(COLUMNS < 0.5, 0.0, p)), SIGMA),
    "a second dot of a third": (lambda: repeated(0.3, 20), SIGMA),
    "a second dot of a hundredth": (lambda: repeated(0.01, 20), SIGMA),
    "two dots in one blur": (lambda: repeated(1.0, 8), SIGMA),
}


def attempt(fit):
    """The fit, or None if it was refused, and whether there was a warning."""
    found, warned = result_and_warnings(fit)
    assert len(str(found)) > 20
    return (None if isinstance(found, FitError) else found), bool(warned)


# "auto" walks through the code of all families
EXTREME = ("window of 15", "no blur", "noise 0 dB", "1e200", "denormal", "1e6", "swapped")
HOSTILE_CASES = [
    *((name, "gaussian") for name in HOSTILE),
    *(
        pytest.param(name, "auto", marks=[] if "window of 15" in name else [pytest.mark.sweep])
        for name in HOSTILE
        if any(words in name for words in EXTREME)
    ),
    ("sharp and blurred swapped", "radial"),
]


@pytest.mark.parametrize(("name", "family"), HOSTILE_CASES)
def test_a_hostile_pair_gives_a_right_number_a_warning_or_an_error(name, family):
    make, sigma = HOSTILE[name]
    fit, doubts = attempt(lambda: fit_pair(*make(), family))
    if fit is None or doubts:
        return
    assert sigma is not None, f"{fit.params} without a warning"
    if fit.family == "gaussian":
        # a Gaussian with a sigma below 0.3 px is one pixel, whatever its sigma; 0.01 px are always allowed
        error = abs(max(fit.params["sigma"], 0.3) - max(sigma, 0.3)) - 0.01
        assert error < 4 * fit.stderr["sigma"]
