"""The paper's ratio along spokes, and what it measures."""

import numpy as np
import pytest

from torchdof.fit import blur_strength, fit_pair, polar_samples
from torchdof.fit.problems import DotNotFoundError, FitError


def test_spokes_are_ten_degrees_apart_and_start_in_the_centre():
    r, theta, levels = polar_samples(np.ones((41, 41)), (20.0, 20.0), 12)
    assert levels.shape == (36, 13)
    assert r[0] == 0 and r[-1] == 12
    np.testing.assert_allclose(np.diff(np.rad2deg(theta)), 10)


def test_samples_follow_a_slope_exactly():
    rows, columns = np.indices((41, 41)).astype(float)
    r, theta, levels = polar_samples(2 * columns - rows, (20.25, 19.5), 12)
    x, y = 20.25 + r * np.cos(theta)[:, None], 19.5 + r * np.sin(theta)[:, None]
    np.testing.assert_allclose(levels, 2 * x - y, atol=1e-12)


def test_ratio_of_a_picture_with_itself_is_one(simulator):
    sharp, _ = simulator.Simulator(snr_db=None).pair("gaussian", {"sigma": 1.0})
    _, strength, spokes = blur_strength(sharp, sharp)
    np.testing.assert_allclose(strength, 1.0, atol=1e-9)
    assert len(np.unique(spokes)) == 36


def test_ratio_measures_the_dot_with_the_kernel_and_not_the_kernel(simulator):
    # the paper's own procedure: widths of about 9 to 14 px whatever the kernel's is; kept faithful, not corrected
    widths = []
    for sigma in (4.0, 8.0):
        sharp, blurred = simulator.Simulator(snr_db=None).pair("gaussian", {"sigma": sigma})
        fit = fit_pair(sharp, blurred, "gaussian", model="ratio")
        assert fit.model == "ratio"
        widths.append(fit.params["sigma"])
    assert widths[0] > 2 * 4.0 and widths[1] > 1.2 * 8.0


def test_ratio_needs_a_dot_and_a_sharp_picture():
    with pytest.raises(DotNotFoundError):
        fit_pair(np.zeros((41, 41)), np.zeros((41, 41)), model="ratio")
    with pytest.raises(FitError, match="sharp=None"):
        fit_pair(None, np.zeros((41, 41)), model="ratio")


def test_bad_spokes_are_refused():
    with pytest.raises(FitError, match="must be positive"):
        polar_samples(np.ones((9, 9)), (4, 4), radius=0)
