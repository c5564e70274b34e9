"""Finding the dot."""

import numpy as np
import pytest

from torchdof.fit.photo.dot import find_dot, find_dots, noise_of, radial_mean


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4), (5.25, 3.5)])
def test_centre_and_radius_are_found_below_a_pixel(simulator, shift):
    picture = simulator.draw_dot(81, 9.0, shift) + np.random.default_rng(0).normal(0, 0.01, (81, 81))
    dot = find_dot(picture)
    assert (dot.x - 40, dot.y - 40) == pytest.approx(shift, abs=0.03)
    assert dot.radius == pytest.approx(9.0, abs=0.15)
    assert dot.noise == pytest.approx(0.01, rel=0.1)


def test_level_and_offset_do_not_move_the_dot(simulator):
    picture = simulator.draw_dot(81, 9.0, (2.2, -1.1))
    plain, changed = find_dot(picture), find_dot(300 * picture + 64)
    assert (plain.x, plain.y, plain.radius) == pytest.approx((changed.x, changed.y, changed.radius), abs=1e-6)
    assert changed.background == pytest.approx(64)


def test_a_ring_is_one_dot(simulator):
    ring = simulator.blur(simulator.draw_dot(101, 1.0), "ring", {"sigma": 1.5, "r_c": 14.0})
    assert len(find_dots(ring / ring.max() + np.random.default_rng(0).normal(0, 0.01, ring.shape))) == 1


def test_a_grid_gives_every_dot(simulator):
    picture = np.tile(simulator.draw_dot(60, 6.0), (3, 4))
    dots = find_dots(picture, smallest=0.3)
    assert len(dots) == 12
    assert sorted(round(d.x) for d in dots)[0] == round(29.5)


def test_dust_is_not_a_dot(simulator):
    picture = simulator.draw_dot(81, 9.0)
    picture[5:7, 60:62] = 0.9
    assert find_dot(picture).radius == pytest.approx(9.0, abs=0.1)


def test_noise_is_measured_beside_the_dot(simulator):
    picture = simulator.draw_dot(81, 9.0) + np.random.default_rng(0).normal(0, 0.02, (81, 81))
    assert noise_of(picture) == pytest.approx(0.02, rel=0.1)
    assert noise_of(simulator.draw_dot(81, 9.0)) == 0


def test_radial_mean_of_a_cone_is_the_cone():
    rows, columns = np.indices((41, 41))
    distance = np.hypot(rows - 20, columns - 20)
    mean, count = radial_mean(distance, distance)
    np.testing.assert_allclose(mean, np.arange(mean.size), atol=0.25)
    assert count[0] == 1
