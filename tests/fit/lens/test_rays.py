import math

import numpy as np
import pytest

from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.rays import trace_rays

LENSES = ("double_gauss_50mm", "wide_22mm", "telephoto_250mm")


def surfaces(radius: list[float], thickness: list[float], index: list[float], diameter: float = 1e3) -> Lens:
    count = len(radius)
    full = np.full(count, diameter)
    return Lens(np.array(radius), np.array(thickness), np.array(index), np.full(count, math.inf), full, stop=0)


def beam(count: int = 500, reach: float = 5.0, tilt: float = 0.1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-reach, reach, (2, count))
    u, v = rng.uniform(-tilt, tilt, (2, count))
    direction = np.stack([u, v, np.ones(count)])
    return np.stack([x, y, np.full(count, -1.0)]), direction / np.linalg.norm(direction, axis=0)


def test_snell_holds_at_a_surface() -> None:
    # the tangential part of index x direction does not change; directions stay unit vectors
    for radius in (30.0, -30.0):
        lens = surfaces([math.inf, radius, math.inf], [1.0, 4.0, 0.0], [1.0, 1.6, 1.0])
        position, direction = beam()
        front = surfaces([math.inf, radius], [1.0, 0.0], [1.0, 1.0])
        at = trace_rays(front, position, direction).position  # on the sphere, not refracted
        normal = (at - np.array([[0.0], [0.0], [1.0 + radius]])) / radius
        before = 1.0 * np.cross(direction, normal, axis=0)
        inside = trace_rays(lens, position, direction)  # leaves through a plane: x and y of n * direction are kept
        u, v = inside.direction[:2] / 1.6
        behind = np.stack([u, v, np.sqrt(1 - u * u - v * v)])
        after = 1.6 * np.cross(behind, normal, axis=0)
        np.testing.assert_allclose(after, before, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(inside.direction, axis=0), 1.0, atol=1e-13)
        np.testing.assert_allclose(np.linalg.norm(at - np.array([[0.0], [0.0], [1.0 + radius]]), axis=0), 30.0)


def test_light_path_is_reversible() -> None:
    for name in LENSES:
        lens = Lens.read(name)
        index = lens.indices()
        back = Lens(
            -lens.radius[::-1],
            np.append(lens.thickness[:-1][::-1], 0.0),
            np.append(index[1:-1][::-1], 1.0),
            lens.abbe,
            lens.diameter[::-1],
            len(lens.radius) - 1 - lens.stop,
        )
        position, direction = beam(reach=2.0, tilt=0.05)
        rays = trace_rays(lens, position, direction)
        assert rays.alive.any()
        length = lens.vertices[-1]
        mirror = np.array([[1.0], [1.0], [-1.0]])
        start = rays.position * mirror + np.array([[0.0], [0.0], [length]])
        home = trace_rays(back, start, -rays.direction * mirror)
        keep = rays.alive
        np.testing.assert_allclose((-home.direction * mirror)[:, keep], direction[:, keep], atol=1e-12)
        x, y = (v[keep] for v in home.at(length + 1.0))
        np.testing.assert_allclose(np.stack([x, y]), position[:2, keep], atol=1e-10)


def test_sphere_images_its_aplanatic_point_without_aberration() -> None:
    # Weierstrass: rays that head for R (1 + n) behind the vertex of a glass sphere meet at R (1 + 1 / n) inside it
    radius, n = 20.0, 1.5
    angle = np.linspace(0.05, 0.6, 40)
    aim = radius * (1 + n)
    direction = np.stack([np.zeros_like(angle), -np.sin(angle), np.cos(angle)])
    position = np.array([[0.0], [0.0], [aim]]) - direction * (aim + 5.0) / direction[2]
    # the sphere around the image point receives rays along its radii: they leave unrefracted
    centre, small = radius * (1 + 1 / n), 8.0
    ball = surfaces([radius, small], [centre - small, 0.0], [n, 1.0])
    rays = trace_rays(ball, position, direction)
    x, y = rays.at(centre)
    assert rays.alive.all()
    np.testing.assert_allclose(np.hypot(x, y), 0.0, atol=1e-10)


def test_rays_near_the_axis_follow_the_paraxial_matrix() -> None:
    for name in LENSES:
        lens = Lens.read(name)
        height, angle = 1e-4, 2e-5
        start = np.array([[0.0], [height], [0.0]])
        direction = np.array([[0.0], [math.sin(angle)], [math.cos(angle)]])
        rays = trace_rays(lens, start, direction)
        expected = lens.matrix(0, len(lens.radius)) @ np.array([height, angle])
        found = rays.at(lens.vertices[-1])[1][0], rays.direction[1, 0] / rays.direction[2, 0]
        np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_totally_reflected_rays_end() -> None:
    prism = surfaces([math.inf, -20.0], [30.0, 0.0], [1.5, 1.0])
    height = np.array([0.0, 13.0, 13.4, 15.0])  # the critical angle on a sphere of 20 is at 20 / 1.5 = 13.33
    position = np.stack([np.zeros(4), height, np.full(4, -1.0)])
    rays = trace_rays(prism, position, np.tile([[0.0], [0.0], [1.0]], 4))
    assert rays.alive.tolist() == [True, True, False, False]


def test_rays_that_miss_or_are_clipped_end_without_warnings() -> None:
    lens = surfaces([math.inf, 10.0, math.inf], [1.0, 5.0, 0.0], [1.0, 1.5, 1.0])
    height = np.array([5.0, 9.99, 10.01, 1e6])
    position = np.stack([np.zeros(4), height, np.full(4, -1.0)])
    forward = np.tile([[0.0], [0.0], [1.0]], 4)
    assert trace_rays(lens, position, forward).alive.tolist() == [True, False, False, False]
    air = surfaces([math.inf, 10.0], [1.0, 0.0], [1.0, 1.0])  # a sphere without glass can only be missed
    assert trace_rays(air, position, forward).alive.tolist() == [True, True, False, False]
    small = lens.with_stop(8.0)
    assert trace_rays(small, position, forward).alive.tolist() == [False] * 4
    assert trace_rays(small, position, forward, clip=False).alive[0]


def shaped(radius: float, index: float, conic: float = 0.0, polynomial: tuple[float, ...] = ()) -> Lens:
    """A surface of glass behind a wide stop, and a sphere of glass that ends behind it where light has its focus."""
    wide = np.full(2, 1e3)
    return Lens(
        np.array([math.inf, radius]), np.array([30.0, 0.0]), np.array([index, 1.0]), np.full(2, math.inf), wide, stop=0,
        conic=np.array([0.0, conic]), polynomial=np.array([[0.0] * len(polynomial), polynomial]),
    )  # fmt: skip


def test_hyperboloid_focuses_a_beam_in_one_point() -> None:
    # Descartes: glass ends in a hyperboloid of conic constant -n^2; the focus lies at R / (1 - n), for any height
    n, radius = 1.5, -20.0
    height = np.linspace(-15.0, 15.0, 31)
    position = np.stack([0.3 * height, height, np.full_like(height, -3.0)])
    forward = np.tile([[0.0], [0.0], [1.0]], 31)
    rays = trace_rays(shaped(radius, n, -n * n), position, forward)
    assert rays.alive.all()
    np.testing.assert_allclose(rays.at(30.0 + radius / (1 - n)), 0.0, atol=1e-10)
    assert np.abs(rays.at(29.0 + radius / (1 - n))[1]).max() > 0.1


def test_polynomial_asphere_is_the_conic_whose_series_it_is() -> None:
    # sag of a sphere: c r^2 / 2 + c^3 r^4 / 8 + c^5 r^6 / 16 + 5 c^7 r^8 / 128 + 7 c^9 r^10 / 256 + ...
    c = -1 / 60.0
    series = tuple(factor * c**power for factor, power in ((1 / 2, 1), (1 / 8, 3), (1 / 16, 5), (5 / 128, 7)))
    position, direction = beam(reach=5.0, tilt=0.2)
    made = trace_rays(shaped(math.inf, 1.5, 0.0, series), position, direction)
    sphere = trace_rays(shaped(-60.0, 1.5), position, direction)
    assert made.alive.all()
    np.testing.assert_allclose(made.position, sphere.position, atol=1e-7)
    np.testing.assert_allclose(made.direction, sphere.direction, atol=1e-8)


def test_snell_holds_at_an_asphere() -> None:
    lens = shaped(-30.0, 1.6, -0.7, (0.0, 2e-5, -1e-7))
    position, direction = beam()
    rays = trace_rays(lens, position, direction)
    at, shape = rays.position - np.array([[0.0], [0.0], [30.0]]), lens.shape(1)
    height, slope = shape.sag(at[0] ** 2 + at[1] ** 2)
    np.testing.assert_allclose(at[2], height, atol=1e-10)
    step = 1e-4  # the slope is the sag's own
    np.testing.assert_allclose(
        slope, (shape.sag(at[0] ** 2 + at[1] ** 2 + step)[0] - shape.sag(at[0] ** 2 + at[1] ** 2 - step)[0]) / 2 / step,
        atol=1e-8,
    )  # fmt: skip
    normal = np.stack([-2 * slope * at[0], -2 * slope * at[1], np.ones_like(slope)])
    u, v = direction[:2] / 1.6  # behind the flat front
    inside = np.stack([u, v, np.sqrt(1 - u * u - v * v)])
    change = np.cross(1.6 * inside - rays.direction, normal, axis=0)
    np.testing.assert_allclose(change[:, rays.alive], 0.0, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=0)[rays.alive], 1.0, atol=1e-12)


def test_rays_beyond_the_rim_of_a_conic_end() -> None:
    height = np.array([5.0, 9.9, 10.1, 40.0, 1e6])
    position = np.stack([np.zeros(5), height, np.full(5, -1.0)])
    forward = np.tile([[0.0], [0.0], [1.0]], 5)
    for conic, polynomial in ((0.0, (0.0, 1e-7)), (0.0, ())):
        lens = shaped(-10.0, 1.0, conic, polynomial)
        assert trace_rays(lens, position, forward).alive.tolist() == [True, True, False, False, False]


def test_rays_that_meet_surfaces_out_of_order_end() -> None:
    # a lens whose surfaces cross at a height of 6 mm: beyond, there is no glass between them
    lens = surfaces([math.inf, 20.0, -20.0], [1.0, 2 * (20.0 - math.sqrt(400.0 - 36.0)), 0.0], [1.0, 1.5, 1.0])
    height = np.array([0.0, 5.9, 6.1, 8.0])
    position = np.stack([np.zeros(4), height, np.full(4, -1.0)])
    rays = trace_rays(lens, position, np.tile([[0.0], [0.0], [1.0]], 4))
    assert rays.alive.tolist() == [True, True, False, False]


def test_wrong_shapes_are_refused() -> None:
    lens = Lens.read("wide_22mm")
    for position, direction in ((np.zeros(3), np.zeros(3)), (np.zeros((3, 2)), np.zeros((3, 1)))):
        with pytest.raises(ValueError, match=r"position and direction must both be \[3, R\]"):
            trace_rays(lens, position, direction)
