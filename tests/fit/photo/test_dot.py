"""Detection of the dot: centre, radius, noise; rings, dust and grids."""

import numpy as np
import pytest

from torchdof.fit import FitError, fit_pair
from torchdof.fit.photo.captures import demosaiced
from torchdof.fit.photo.dot import LAGS, correlate, correlation_of, find_dot, find_dots, independent_share, noise_beside


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (8, 8)])
def test_a_small_picture_is_refused(size):
    with pytest.raises(FitError, match="a picture of a dot must be .* at least 9 pixels on a side"):
        find_dot(np.random.default_rng(0).random(size), file="dot.png")


@pytest.mark.parametrize(("gain", "level"), [(1.0, 0.0), (300.0, 64.0)])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4), (5.25, 3.5)])
def test_centre_and_radius_have_subpixel_accuracy_at_any_level(simulator, shift, gain, level):
    picture = simulator.draw_dot(81, 9.0, shift) + np.random.default_rng(0).normal(0, 0.01, (81, 81))
    dot = find_dot(gain * picture + level)
    assert (dot.x - 40, dot.y - 40) == pytest.approx(shift, abs=0.03)
    assert dot.radius == pytest.approx(9.0, abs=0.15)
    assert dot.noise == pytest.approx(0.01 * gain, rel=0.1) and dot.background == pytest.approx(level, abs=0.01 * gain)


def test_a_ring_is_one_dot_dust_is_ignored_and_every_dot_of_a_grid_is_found(simulator):
    ring = simulator.blur(simulator.draw_dot(101, 1.0), "ring", {"sigma": 1.5, "r_c": 14.0})
    assert len(find_dots(ring / ring.max() + np.random.default_rng(0).normal(0, 0.01, ring.shape))) == 1
    dusty = simulator.draw_dot(81, 9.0)
    dusty[5:7, 60:62] = 0.9
    assert find_dot(dusty).radius == pytest.approx(9.0, abs=0.1)
    dots = find_dots(np.tile(simulator.draw_dot(60, 6.0), (3, 4)), smallest=0.3)
    assert sorted((round(d.y - 29.5), round(d.x - 29.5)) for d in dots) == [
        (60 * row, 60 * column) for row in range(3) for column in range(4)
    ]


# Noise of neighbouring pixels: the estimate of its correlation, and standard errors


def test_independent_noise_has_no_estimated_correlation():
    noise, everywhere = np.random.default_rng(0).normal(size=(90, 90)), np.ones((90, 90), dtype=bool)
    correlation, fine = noise_beside(noise, 0.0, everywhere)
    assert np.count_nonzero(correlation) == 1 and correlation[LAGS, LAGS] == independent_share(correlation) == 1
    assert fine == pytest.approx(1.0, abs=0.1)


def test_the_correlation_of_demosaiced_noise_is_that_of_its_filter():
    noise = demosaiced(np.random.default_rng(1).normal(size=(160, 160)), "RGGB").mean(0)
    used = np.ones(noise.shape, dtype=bool)
    used[40:80, 40:90] = False
    correlation = correlation_of(np.where(used, noise, 100.0), used)
    # each of the pattern's four pixels has its own filter; stationary noise has the mean of their correlations
    parts = []
    for y in (0, 1):
        for x in (0, 1):
            point = np.zeros((31, 31))
            point[15 + y, 15 + x] = 1.0
            parts.append(demosaiced(point, "RGGB").mean(0))
    expected = sum(np.real(np.fft.ifft2(np.abs(np.fft.fft2(p)) ** 2)) for p in parts)
    expected = np.fft.fftshift(expected / expected[0, 0])[15 - LAGS : 16 + LAGS, 15 - LAGS : 16 + LAGS]
    np.testing.assert_allclose(correlation[LAGS, LAGS : LAGS + 3], expected[LAGS, LAGS : LAGS + 3], atol=0.08)
    assert noise_beside(noise, 0.0, used)[1] < 0.3 and independent_share(correlation) < 0.3


def test_the_noise_of_a_demosaiced_jpeg_is_not_overestimated(simulator):
    camera = simulator.Simulator(size=91, bayer=True, jpeg=90, level=0.7, black=0.02)
    fits = [fit_pair(*camera.pair("gaussian", {"sigma": 3.0}, s), "gaussian") for s in range(2)]
    # JPEG removes fine noise from the dark background; assuming the same share on the dot would give 0.28
    assert 0.4 < np.mean([f.residual_over_noise for f in fits]) < 1.1


def test_correlate_weights_neighbours_by_the_correlation():
    correlation = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
    correlation[LAGS - 1 : LAGS + 2, LAGS - 1 : LAGS + 2] = np.outer([0.5, 1, 0.5], [0.5, 1, 0.5])
    picture = np.random.default_rng(2).normal(size=(20, 20))
    summed = sum(correlation[LAGS + y, LAGS + x] * picture[10 + y, 10 + x] for y in (-1, 0, 1) for x in (-1, 0, 1))
    assert correlate(picture[None], correlation)[0, 10, 10] == pytest.approx(summed)
