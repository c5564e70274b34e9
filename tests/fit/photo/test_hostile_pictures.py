"""A fit to bad data gives a number within its error bars, a warning, or an error: never a wrong number silently."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from torchdof.fit import BlurFit, FitError, fit_pair, fit_profile

pytestmark = pytest.mark.hard

Array = NDArray[np.float64]
Pair = tuple[Array, Array]
Camera = Callable[..., Pair]
SIZE, SIGMA = 61, 2.0


@pytest.fixture
def captured(simulator: ModuleType) -> Camera:
    """``captured(sigma, seed, **faults)`` gives a sharp picture of a dot and one blurred by a Gaussian."""

    def capture(sigma: float = SIGMA, seed: int = 0, **camera: Any) -> Pair:
        camera = {"size": SIZE, "dot_radius": 7.0, **camera}
        sharp, blurred = simulator.Simulator(**camera).pair("gaussian", {"sigma": sigma}, seed)
        return sharp, blurred

    return capture


def scaled(captured: Camera, gain: float, level: float = 0.0) -> Pair:
    sharp, blurred = captured()
    return gain * sharp + level, gain * blurred + level


def spoiled(captured: Camera, spoil: Callable[[Array], Array]) -> Pair:
    sharp, blurred = captured(snr_db=60.0)
    return sharp, spoil(blurred)


def repeated(share: float, distance: int) -> Callable[[Array], Array]:
    """Adds a copy of the picture, scaled and displaced."""
    return lambda picture: picture + share * np.roll(picture, (distance, distance), (0, 1))


def flat(level: float, noise: float = 0.0) -> Array:
    return level + noise * np.random.default_rng(3).normal(size=(SIZE, SIZE))


COLUMNS = np.linspace(0, 1, SIZE)
HOT = np.pad([[3.0]], ((32, 28), (30, 30)))
# name -> (pair, true sigma); sigma is None where no number would be right. Errors: test_pair.py
HOSTILE: dict[str, tuple[Callable[[Camera], Pair], float | None]] = {
    "all white": (lambda c: (flat(1.0), flat(1.0)), None),
    "flat and noisy": (lambda c: (c()[0], flat(0.3, 0.01)), None),
    "clipped at nine tenths": (lambda c: c(clip=0.9), SIGMA),
    "a window of 15 px": (lambda c: c(1.0, size=15, dot_radius=3.0), 1.0),
    "a dot of half a pixel": (lambda c: c(dot_radius=0.5), SIGMA),
    "no blur, no noise": (lambda c: c(0.0, snr_db=None), 0.0),
    "twice the same picture": (lambda c: (c()[0],) * 2, 0.0),
    "sharp and blurred swapped": (lambda c: c()[::-1], None),
    "black dot on white": (lambda c: scaled(c, -1.0, 1.0), None),
    "signal to noise 0 dB": (lambda c: c(snr_db=0.0), SIGMA),
    "signal to noise 10 dB": (lambda c: c(snr_db=10.0), SIGMA),
    "levels of 1e200": (lambda c: scaled(c, 1e200), SIGMA),
    "denormal levels": (lambda c: scaled(c, 1e-310), SIGMA),
    "on a level of 1e6": (lambda c: scaled(c, 1.0, 1e6), SIGMA),
    "a hot pixel in the dot": (lambda c: spoiled(c, lambda p: np.where(HOT > 0, HOT, p)), SIGMA),
    "a slope of stray light": (lambda c: spoiled(c, lambda p: p + 0.3 * COLUMNS), SIGMA),
    "half the picture black": (lambda c: spoiled(c, lambda p: np.where(COLUMNS < 0.5, 0.0, p)), SIGMA),
    "a second dot of a third": (lambda c: spoiled(c, repeated(0.3, 20)), SIGMA),
    "a second dot of a hundredth": (lambda c: spoiled(c, repeated(0.01, 20)), SIGMA),
    "two dots in one blur": (lambda c: spoiled(c, repeated(1.0, 8)), SIGMA),
}


def attempt(simulator: ModuleType, fit: Callable[[], BlurFit]) -> tuple[BlurFit | None, bool]:
    """The fit, or None if it was refused, and whether there was a warning."""
    found, warned = simulator.result_and_warnings(fit)
    assert len(str(found)) > 20
    return (None if isinstance(found, FitError) else found), bool(warned)


def off(fit: BlurFit, sigma: float) -> float:
    """Error of the fitted sigma in standard errors, after 0.01 px that are always allowed."""
    found, error = float(fit.params["sigma"]), float(fit.stderr["sigma"])
    # a Gaussian with a sigma below 0.3 px is one pixel, whatever its sigma
    return max(0.0, abs(max(found, 0.3) - max(sigma, 0.3)) - 0.01) / error


# "auto" walks through the code of all families
EXTREME = ("window of 15", "no blur", "noise 0 dB", "1e200", "denormal", "1e6", "swapped")
HOSTILE_CASES = [
    (name, family)
    for name in HOSTILE
    for family in ("gaussian", "auto", "radial")
    if family == "gaussian" or family == "auto" and any(words in name for words in EXTREME) or "swapped" in name
]


@pytest.mark.parametrize(("name", "family"), HOSTILE_CASES)
def test_a_hostile_pair_gives_a_right_number_a_warning_or_an_error(
    simulator: ModuleType, captured: Camera, name: str, family: str
) -> None:
    make, sigma = HOSTILE[name]
    fit, doubts = attempt(simulator, lambda: fit_pair(*make(captured), family))
    if fit is None or doubts:
        return
    assert sigma is not None, f"{fit.params} without a warning"
    if fit.family == "gaussian":
        assert off(fit, sigma) < 4


RADII = np.linspace(0.0, 8.0, 30)
BELL = np.exp(-(RADII**2) / 8)  # sigma 2
NOISE = np.random.default_rng(1).normal(size=30)
# name -> (r, strength, true sigma); None where no number is right. Errors: test_profile_fit.py
PROFILES: dict[str, tuple[Any, Any, float | None]] = {
    "noisy": (RADII, BELL + 0.05 * NOISE, 2.0),
    "a straight line down": (RADII, 8.1 - RADII, None),
    "growing outwards": (RADII, np.exp(RADII / 4), None),
    "clipped at a half": (RADII, np.minimum(BELL, 0.5), None),
    "an outlier of 100": (RADII, np.where(np.arange(30) == 20, 100.0, BELL), None),
    "a second peak": (RADII, BELL + np.exp(-((RADII - 7) ** 2) / 0.5), None),
    "levels of 1e300": (RADII, 1e300 * BELL, 2.0),
    "radii of 1e-300": (1e-300 * RADII, BELL, 2e-300),
    "repeated radii": (np.repeat(RADII, 3), np.repeat(BELL, 3), 2.0),
    "out of order": (RADII[::-1], BELL[::-1], 2.0),
}


@pytest.mark.parametrize("name", PROFILES)
def test_a_hostile_profile_gives_a_right_number_a_warning_or_an_error(simulator: ModuleType, name: str) -> None:
    r, strength, sigma = PROFILES[name]
    fit, doubts = attempt(simulator, lambda: fit_profile(r, strength, "gaussian"))
    if fit is None or doubts:
        return
    # a large residual over the noise between neighbours shows the misfit as well
    is_shown = fit.residual_over_noise > 2
    if sigma is None:
        assert is_shown, f"{fit.params} without a warning"
    else:
        assert is_shown or abs(float(fit.params["sigma"]) / sigma - 1) < 4 * float(fit.stderr["sigma"]) / sigma + 1e-6
