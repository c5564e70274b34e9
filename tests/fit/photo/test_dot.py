"""Detection of the dot: centre, radius, noise; rings, dust and grids."""

import numpy as np
import pytest

from torchdof.fit import FitError
from torchdof.fit.photo.dot import find_dot, find_dots


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
