"""The paper's ratio along spokes, and what it measures."""

import numpy as np
import pytest

from torchdof.fit import blur_strength, fit_pair


def test_strength_is_sampled_every_pixel_of_36_spokes_and_is_the_pictures_ratio(simulator):
    sharp, _ = simulator.Simulator(snr_db=None).pair("gaussian", {"sigma": 1.0})
    rows, columns = np.indices(sharp.shape) - 50.0
    r, strength, spoke = blur_strength(sharp, sharp * (1 + 0.02 * columns - 0.01 * rows))
    assert len(np.unique(spoke)) == 36 and sorted(np.unique(r)) == list(range(12))
    theta = np.deg2rad(10 * spoke)
    expected = 1 + r * (0.02 * np.cos(theta) - 0.01 * np.sin(theta))  # bilinear between pixels, as a plane is
    np.testing.assert_allclose(strength[r < 10], expected[r < 10], atol=1e-9)


@pytest.mark.parametrize(("sigma", "least"), [(4.0, 8.0), (8.0, 9.6)])
def test_ratio_measures_the_dot_with_the_kernel_and_not_the_kernel(simulator, sigma, least):
    # the paper's own procedure: widths of about 9 to 14 px whatever the kernel's is; kept faithful, not corrected
    fit = fit_pair(*simulator.Simulator(snr_db=None).pair("gaussian", {"sigma": sigma}), "gaussian", model="ratio")
    assert fit.model == "ratio" and fit.params["sigma"] > least
