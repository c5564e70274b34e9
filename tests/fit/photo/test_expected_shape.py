"""Blurs of one or two pixels, whose shape the pictures leave open."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from torchdof.fit import FitError, fit_pair
from torchdof.fit.photo.expected_shape import deviations
from torchdof.optics.psf import FAMILIES, pixel_kernels

HELD = {"fit_magnification": False}
SMALL = [("softm", {"radius": 1.2, "sigma": 0.35, "b": 0.4, "m": 3.0}), ("ring", {"sigma": 0.8, "r_c": 0.3})]


def disc_radius(family, params):
    """Radius of the uniform disc with the second moment of a PSF, px; drawn large, pixels have no effect."""
    drawn = {name: value * (1.0 if name in ("b", "m") else 16.0) for name, value in params.items()}
    kernel = pixel_kernels(family, drawn).numpy()
    offset = np.arange(len(kernel)) - len(kernel) // 2
    return float(np.sqrt(2 * (kernel * (offset[:, None] ** 2 + offset**2)).sum())) / 16.0


@pytest.mark.parametrize(("family", "params"), SMALL)
def test_a_small_blur_has_a_right_size_a_usual_shape_and_finite_errors(simulator, family, params):
    camera, pulls = simulator.Simulator(size=41, dot_radius=8.0), []
    for seed in range(4):
        fit = fit_pair(*camera.pair(family, params, seed), family, **HELD)
        pulls.append((fit.radius - disc_radius(family, params)) / fit.radius_stderr)
        assert fit.radius_stderr < 0.04 * fit.radius
        for name, value in params.items():
            assert abs(fit.params[name] - value) < 2 * fit.stderr[name] < 4.0
    assert np.abs(pulls).max() < 3


@pytest.mark.parametrize(("family", "params"), SMALL)
def test_rounding_does_not_change_a_small_blur(simulator, family, params):
    sharp, blurred = simulator.Simulator(size=41, dot_radius=8.0).pair(family, params, 4)
    rounded = blurred + np.random.default_rng(0).normal(0.0, 1e-10, blurred.shape)
    fit, other = (fit_pair(sharp, picture, family, **HELD) for picture in (blurred, rounded))
    for name in params:
        assert other.params[name] == pytest.approx(fit.params[name], abs=0.02 * fit.stderr[name], rel=1e-6)
        assert other.params[name] == pytest.approx(fit.params[name], abs=0.02)


def test_a_fit_of_a_larger_blur_decides_the_shape_of_a_small_one(simulator):
    camera, (family, params) = simulator.Simulator(size=51, dot_radius=8.0), SMALL[0]
    shape = {"sigma": 0.5, "b": -0.7, "m": 4.0}
    larger = fit_pair(*camera.pair(family, {"radius": 6.0, **shape}), family, **HELD)
    pair = camera.pair(family, params, 1)
    alone, similar = (fit_pair(*pair, family, like=like, **HELD) for like in (None, larger))
    assert similar.params["b"] < alone.params["b"] - 0.2 and similar.stderr["b"] < alone.stderr["b"]
    assert similar.radius == pytest.approx(alone.radius, rel=0.01)
    # a large blur keeps its own shape
    own = fit_pair(*camera.pair(family, {"radius": 6.0, **shape}), family, like=alone, **HELD)
    assert own.params["b"] == pytest.approx(larger.params["b"], abs=larger.stderr["b"])
    with pytest.raises(FitError, match="like must be a BlurFit, the result of a fit, got 'softm'"):
        fit_pair(*pair, family, like="softm")


@pytest.mark.parametrize("family", FAMILIES)
def test_slopes_of_the_deviations_equal_finite_differences(family):
    params = np.array([1.3, 0.6, 0.4, 2.0, 0.1, 0.2])  # the last two are moves
    found, slopes = deviations(family, params, None)
    assert slopes.shape == (found.size, params.size) and (found.size > 0) == (family in ("ring", "softm"))
    if found.size:
        differences = approx_fprime(params, lambda p: deviations(family, p, None)[0]).reshape(slopes.shape)
        np.testing.assert_allclose(slopes, differences, atol=1e-6)
