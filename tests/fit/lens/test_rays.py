import math

import numpy as np
import pytest

from torchdof.fit.lens.glass import Glass
from torchdof.fit.lens.lens import Lens, trace_rays
from torchdof.fit.lens.surface import Surface

ALONG = np.array([[0.0], [0.0], [1.0]])


def surfaces(*rows: tuple[float, float, float], conic: float = 0.0, polynomial: tuple[float, ...] = ()) -> Lens:
    """A lens from rows (radius, thickness, index) with the stop in front; `conic`, `polynomial`: last surface."""
    shapes = [(0.0, ())] * (len(rows) - 1) + [(conic, polynomial)]
    made = [Surface(r, t, Glass.of_numbers(n), 1e3, *shape) for (r, t, n), shape in zip(rows, shapes, strict=True)]
    return Lens(tuple(made), stop=0)


def shaped(radius: float, index: float, conic: float = 0.0, polynomial: tuple[float, ...] = ()) -> Lens:
    """A block of glass with a flat front and the given rear surface."""
    return surfaces((math.inf, 30.0, index), (radius, 0.0, 1.0), conic=conic, polynomial=polynomial)


def beam(count: int = 500, reach: float = 5.0, tilt: float = 0.1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-reach, reach, (2, count))
    u, v = rng.uniform(-tilt, tilt, (2, count))
    direction = np.stack([u, v, np.ones(count)])
    return np.stack([x, y, np.full(count, -1.0)]), direction / np.linalg.norm(direction, axis=0)


def heights(*height: float, x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Rays parallel to the axis at the given heights."""
    y = np.array(height)
    return np.stack([x * y, y, np.full(len(y), -1.0)]), np.repeat(ALONG, len(y), 1)


@pytest.mark.parametrize(
    ("radius", "conic", "polynomial"), [(30.0, 0.0, ()), (-30.0, 0.0, ()), (-30.0, -0.7, (0.0, 2e-5, -1e-7))]
)
def test_rays_end_on_the_surface_and_obey_snells_law(radius, conic, polynomial):
    lens = shaped(radius, 1.6, conic, polynomial)
    position, direction = beam()
    rays = trace_rays(lens, position, direction)
    at, surface = rays.position - 30.0 * ALONG, lens.surfaces[1]
    if not polynomial:
        np.testing.assert_allclose(np.linalg.norm(at - radius * ALONG, axis=0), abs(radius))
    square, step = at[0] ** 2 + at[1] ** 2, 1e-4
    height, slope = surface.sag(square)
    np.testing.assert_allclose(at[2], height, atol=1e-10)
    numeric = (surface.sag(square + step)[0] - surface.sag(square - step)[0]) / 2 / step
    np.testing.assert_allclose(slope, numeric, atol=1e-8)  # the slope is the derivative of the sag
    normal = np.stack([-2 * slope * at[0], -2 * slope * at[1], np.ones_like(slope)])
    u, v = direction[:2] / 1.6  # behind the flat front
    inside = np.stack([u, v, np.sqrt(1 - u * u - v * v)])
    # Snell's law: index * direction changes only along the normal; directions stay unit vectors
    change = np.cross(1.6 * inside - rays.direction, normal, axis=0)
    assert rays.alive.sum() > 400
    np.testing.assert_allclose(change[:, rays.alive], 0.0, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=0)[rays.alive], 1.0, atol=1e-12)


def test_hyperboloid_focuses_a_beam_in_one_point():
    # Descartes: a rear surface with conic constant -n^2 focuses a parallel beam at R / (1 - n), at any height
    n, radius = 1.5, -20.0
    rays = trace_rays(shaped(radius, n, -n * n), *heights(*np.linspace(-15.0, 15.0, 31), x=0.3))
    assert rays.alive.all()
    np.testing.assert_allclose(rays.at(30.0 + radius / (1 - n)), 0.0, atol=1e-10)
    assert np.abs(rays.at(29.0 + radius / (1 - n))[1]).max() > 0.1


def test_a_polynomial_asphere_with_a_spheres_series_equals_the_sphere():
    # sag of a sphere: c r^2 / 2 + c^3 r^4 / 8 + c^5 r^6 / 16 + 5 c^7 r^8 / 128 + 7 c^9 r^10 / 256 + ...
    c = -1 / 60.0
    series = tuple(factor * c**power for factor, power in ((1 / 2, 1), (1 / 8, 3), (1 / 16, 5), (5 / 128, 7)))
    made, sphere = (
        trace_rays(lens, *beam(tilt=0.2)) for lens in (shaped(math.inf, 1.5, 0.0, series), shaped(-60.0, 1.5))
    )
    assert made.alive.all()
    np.testing.assert_allclose(made.position, sphere.position, atol=1e-7)
    np.testing.assert_allclose(made.direction, sphere.direction, atol=1e-8)


WALL = surfaces((math.inf, 1.0, 1.0), (10.0, 5.0, 1.5), (math.inf, 0.0, 1.0))


@pytest.mark.parametrize(
    ("lens", "height", "alive"),
    [
        # the critical angle on a sphere of 20 is at 20 / 1.5 = 13.33
        (surfaces((math.inf, 30.0, 1.5), (-20.0, 0.0, 1.0)), (0.0, 13.0, 13.4, 15.0), (1, 1, 0, 0)),
        (WALL, (5.0, 9.99, 10.01, 1e6), (1, 0, 0, 0)),  # totally reflected behind the sphere, or beside it
        (surfaces((math.inf, 1.0, 1.0), (10.0, 0.0, 1.0)), (5.0, 9.99, 10.01, 1e6), (1, 1, 0, 0)),
        (WALL.with_stop(8.0), (3.9, 4.1, 9.99, 1e6), (1, 0, 0, 0)),
        (shaped(-10.0, 1.0), (5.0, 9.9, 10.1, 40.0, 1e6), (1, 1, 0, 0, 0)),
        (shaped(-10.0, 1.0, 0.0, (0.0, 1e-7)), (5.0, 9.9, 10.1, 40.0, 1e6), (1, 1, 0, 0, 0)),
        # the surfaces cross at a height of 6 mm; further out there is no glass between them
        (
            surfaces((math.inf, 1.0, 1.0), (20.0, 2 * (20.0 - math.sqrt(400.0 - 36.0)), 1.5), (-20.0, 0.0, 1.0)),
            (0.0, 5.9, 6.1, 8.0),
            (1, 1, 0, 0),
        ),
    ],
    ids=["reflected", "missed", "missed in air", "stopped", "beyond a sphere", "beyond an asphere", "out of order"],
)
def test_blocked_rays_end_without_warnings(lens, height, alive):
    assert trace_rays(lens, *heights(*height)).alive.tolist() == [bool(one) for one in alive]


def test_many_rays_give_the_results_of_few():
    position, direction = heights(*np.linspace(0.0, 12.0, 40_000))
    many = trace_rays(WALL, position, direction)
    few = trace_rays(WALL, position[:, 16_300:16_400], direction[:, :100])  # across the end of a chunk
    for found, expected in zip(many, few, strict=True):
        np.testing.assert_array_equal(found[..., 16_300:16_400], expected)
