"""Spots across the field: traced directly, from a table, and in rendered pictures."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests import lenses
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.fit import trace_table
from torchdof.fit.lens import Lens
from torchdof.fit.lens.field import chief_ray_mm, field_height_mm, spot_of_place
from torchdof.fit.lens.lens import RGB_UM, trace_rays
from torchdof.fit.lens.spot import focus_sensor, vertex_distance_mm
from torchdof.optics.aperture import Aperture
from torchdof.reference.metrics import display, psnr
from torchdof.reference.scenes import Plane, plane_views, waves

WIDTH, HEIGHT = 960, 640
F_NUMBER, FOCUS_M, SENSOR_MM = 2.0, 2.0, 36.0
POINT_PX = 0.7  # sigma of the sharp image of a point light, a Gaussian
RADII = (0.0, 6.0, 8.0, 13.0, 15.0, 19.0, 21.0)


GAUSS = Lens.read("double_gauss_50mm")
STOPPED = GAUSS.with_f_number(F_NUMBER)
SENSOR = focus_sensor(STOPPED, FOCUS_M)
# the thin lens with the traced lens's focal length
CAMERA = Camera(GAUSS.paraxial().focal_length, F_NUMBER, FOCUS_M, SENSOR_MM)


def traced_spot(z_m: float, radius_mm: float, azimuth: float, half: int, width: int, rays: int = 160_000) -> np.ndarray:
    """Pixels ``[2 half + 1, 2 half + 1]`` of the traced spot of a point whose sharp image is a small Gaussian."""
    height = field_height_mm(STOPPED, z_m, SENSOR, radius_mm, "principal")
    u, v, weight = spot_of_place(STOPPED, z_m, SENSOR, height, rays)
    u, v = u * (width / SENSOR_MM), v * (width / SENSOR_MM)
    y, x = u * math.sin(azimuth) + v * math.cos(azimuth), u * math.cos(azimuth) - v * math.sin(azimuth)
    edges = np.linspace(-half - 0.5, half + 0.5, 5 * (2 * half + 1) + 1)
    fine = np.histogram2d(y, x, [edges, edges], weights=weight)[0]
    step = np.arange(-20, 21) / 5
    seen = np.convolve(np.exp(-0.5 * (step / POINT_PX) ** 2), np.ones(5))
    for axis in (0, 1):
        fine = np.apply_along_axis(np.convolve, axis, fine, seen / seen.sum(), mode="same")
    return fine[2::5, 2::5] * 25


@pytest.fixture(scope="module")
def table() -> BlurTable:
    return trace_table(GAUSS, 2.0, 2.0, nodes=5, points=17, rays=400, field=RADII, field_nodes=4, field_rays=20_000)


@pytest.mark.parametrize(("z_m", "least"), [(0.9, 37.0), (1e9, 34.0)])
def test_rendered_points_are_the_traced_spots(table: BlurTable, z_m: float, least: float) -> None:
    depth = torch.full((1, 1, HEIGHT, WIDTH), z_m, dtype=torch.float64)
    coc_px = CAMERA.coc_px(depth, WIDTH).float()
    edges = torch.erf(torch.linspace(-3.5, 3.5, 8) / (POINT_PX * math.sqrt(2.0))).diff()
    half, spots = math.ceil(1.1 * abs(float(coc_px[0, 0, 0, 0]))) + 2, []
    image = torch.zeros(1, 1, HEIGHT, WIDTH)
    for radius, azimuth in zip((7.0, 14.0, 20.0), (2.2, -2.6, 0.55), strict=True):
        away = radius * WIDTH / SENSOR_MM
        row = round(HEIGHT / 2 + away * math.sin(azimuth) - 0.5)
        column = round(WIDTH / 2 + away * math.cos(azimuth) - 0.5)
        image[0, 0, row - 3 : row + 4, column - 3 : column + 4] = edges[:, None] * edges / edges.sum() ** 2
        dy, dx = row + 0.5 - HEIGHT / 2, column + 0.5 - WIDTH / 2
        spot = traced_spot(z_m, math.hypot(dy, dx) * SENSOR_MM / WIDTH, math.atan2(dy, dx), half, WIDTH)
        spots.append((slice(row - half, row + half + 1), slice(column - half, column + half + 1), spot))

    def decibels(table: BlurTable) -> list[float]:
        """PSNR of each rendered point light against its traced spot of peak 1, in a square of 1.1 blur radii."""
        picture = blur_by_coc(image, coc_px, table=table)[0, 0].double().numpy()
        errors = [((picture[rows, columns] - spot) ** 2).mean() / spot.max() ** 2 for rows, columns, spot in spots]
        return [-10.0 * math.log10(error) for error in errors]

    assert min(decibels(table)) > least
    assert max(decibels(table.replace(field=None).with_aperture(Aperture(vignetting=0.8)))) < 27.0


def rays_of(z_m: float, size: tuple[int, int], samples: int) -> Any:
    """Rays from points of the sensor backwards through the lens to a plane, for `plane_views`.

    The turned lens is traced forwards. `plane_views` wants the pixel at which the sharp image shows the point where a
    ray meets the plane: the image through a small stop, whose distortion is a polynomial fitted to chief rays.
    """
    back, first, pixel = lenses.turned(STOPPED), STOPPED.paraxial(), SENSOR_MM / size[1]
    heights = 0.5 * math.hypot(*size) * pixel * np.linspace(0.1, 1.1, 9)
    distance = vertex_distance_mm(STOPPED, z_m, "principal", SENSOR)
    shown = [chief_ray_mm(STOPPED, z_m, SENSOR, height, "principal") for height in heights]
    away = heights / (SENSOR - first.rear_principal) * (distance + first.front_principal)
    distorted = np.polynomial.Polynomial.fit(away**2, shown / away, 4)
    middle = np.array([[size[1]], [size[0]]]) / 2

    def rays(n: int, x: Tensor, y: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        radius, angle = 1.05 * back.surfaces[0].diameter / 2 * math.sqrt((n + 0.5) / samples), n * 2.39996
        # the image on the sensor is upside down
        start = (middle - np.stack([x.double().numpy().ravel(), y.double().numpy().ravel()])) * pixel
        aim = radius * np.array([[math.cos(angle)], [math.sin(angle)]])
        run = np.concatenate([aim - start, np.full_like(start[:1], SENSOR)])
        length = np.sqrt((run * run).sum(0))
        traced = trace_rays(back, np.concatenate([start, np.full_like(start[:1], -SENSOR)]), run / length)
        place = traced.at(back.vertices[-1] + distance)
        column, row = torch.from_numpy(middle + place * distorted((place**2).sum(0)) / pixel).unflatten(1, x.shape)
        return [(column, row)], torch.from_numpy(traced.alive / length**4).reshape(x.shape)

    return rays


def test_rays_traced_from_pixels_back_through_the_lens_see_the_spot() -> None:
    z_m, half, samples = 1e5, 8, 900
    row, column = (
        round(n / 2 + 14.0 * WIDTH / SENSOR_MM * turn - 0.5) for n, turn in ((HEIGHT, -0.516), (WIDTH, -0.857))
    )
    dy, dx = row + 0.5 - HEIGHT / 2, column + 0.5 - WIDTH / 2
    spot = traced_spot(z_m, math.hypot(dy, dx) * SENSOR_MM / WIDTH, math.atan2(dy, dx), half, WIDTH)

    def light(x: Tensor, y: Tensor) -> Tensor:
        away = (x - column - 0.5) ** 2 + (y - row - 0.5) ** 2
        return torch.exp(-0.5 * away / POINT_PX**2)[None] / (2.0 * math.pi * POINT_PX**2)

    window = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
    rays = rays_of(z_m, (HEIGHT, WIDTH), samples)
    seen = plane_views([Plane(z_m, light)], rays, (HEIGHT, WIDTH), window, samples)[0, 0].double().numpy()
    straight, turned = (-10.0 * np.log10(((s - spot) ** 2).mean() / spot.max() ** 2) for s in (seen, seen[::-1, ::-1]))
    assert seen.sum() == pytest.approx(1.0, abs=0.01)
    assert straight > 36.0 and turned < 28.0  # 900 rays give 36 dB; the spot does not point inwards


def test_a_picture_of_a_table_with_a_field_equals_one_of_rays_through_the_lens(table: BlurTable) -> None:
    size, samples, plane = (240, 360), 100, Plane(0.9, waves(11))

    def pinhole(_: int, x: Tensor, y: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        return [(x, y)], torch.ones_like(x)

    sharp = plane_views([plane], pinhole, size, (slice(None), slice(None)), 16)
    top, left = (
        round(n / 2 + 140.0 * turn - 10) for n, turn in zip(size, (math.sin(0.55), math.cos(0.55)), strict=True)
    )
    window = slice(top, top + 20), slice(left, left + 20)
    truth = display(plane_views([plane], rays_of(0.9, size, samples), size, window, samples))

    def decibels(table: BlurTable) -> float:
        dof = DepthOfField(CAMERA, table, depth_edges="as given")
        return psnr(display(dof(sharp, torch.full((1, 1, *size), 0.9)))[(..., *window)], truth)

    assert decibels(table) > 52.0
    assert decibels(table.replace(field=None)) < 42.0


def test_lateral_colour_displaces_the_colours_of_a_point() -> None:
    options: dict[str, Any] = {"nodes": 5, "points": 9, "rays": 200, "field": (0, 16.5), "field_nodes": 2}
    table = trace_table(GAUSS, 4.0, 2.0, wavelengths_um=RGB_UM, field_rays=3_000, **options)
    assert table.field is not None
    stopped, width, column = GAUSS.with_f_number(4.0), 3840, 3680  # the column is 16.5 mm from the centre of 36 mm
    sensor = focus_sensor(stopped, 2.0)
    height = field_height_mm(stopped, 2.0, sensor, 16.5, "principal")
    centres = []
    for wavelength in RGB_UM:
        u, _, weight = spot_of_place(stopped, math.inf, sensor, height, 3_000, wavelength)
        centres.append(float(weight @ u) * width / 36.0)
    image = torch.zeros(1, 3, 48, width)
    image[..., 24, column] = 1.0
    coc_px = float(table.field.coc[-1]) * width / 36.0
    with torch.no_grad():
        picture = blur_by_coc(image, torch.full_like(image[:, :1], coc_px), table=table)[0].double()
    across = picture.sum(1) @ (torch.arange(width) - column).double() / picture.sum((1, 2))
    assert centres[2] - centres[0] > 0.2  # px
    assert (across - across[1]).tolist() == pytest.approx([c - centres[1] for c in centres], abs=0.05)


def test_spots_on_the_axis_are_round_and_centred(table: BlurTable) -> None:
    assert table.field is not None and table.channels == 1
    middle, length, width = table.field.box[:, 0].unbind(-1)
    assert float(middle.abs().max()) < 1e-3
    assert torch.allclose(length, width, rtol=0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"field": (1.0, 20.0)}, "from 0 on"),
        ({"field": (0.0, 20.0, 10.0)}, "must be increasing"),
        ({"field": 20.0}, "from 0 on"),
        ({"field": (0.0, 20.0), "field_mm": 3.0}, "give one of them"),
        ({"field": (0.0, 20.0), "field_nodes": 1}, "field_nodes must be"),
        ({"field": (0.0, 20.0), "field_rays": 5}, "field_rays must be"),
    ],
)
def test_bad_fields_are_refused_by_name(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trace_table(GAUSS, 2.0, 2.0, **change)
