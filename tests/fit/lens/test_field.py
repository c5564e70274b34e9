"""Spots across the field: traced directly, and rendered with a table."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from torchdof import BlurTable, Camera, blur_by_coc
from torchdof.fit import trace_table
from torchdof.fit.lens import Lens
from torchdof.fit.lens.lens import RGB_UM
from torchdof.fit.lens.spot import field_height_mm, focus_sensor, spot_of_place
from torchdof.optics.aperture import Aperture

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
    height = field_height_mm(STOPPED, z_m, SENSOR, radius_mm)
    u, v, weight = spot_of_place(STOPPED, z_m, SENSOR, height, rays=rays)
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
    assert max(decibels(table.replace(field=None).replace(aperture=Aperture(vignetting=0.8)))) < 27.0


def test_lateral_colour_displaces_the_colours_of_a_point() -> None:
    options: dict[str, Any] = {"nodes": 5, "points": 9, "rays": 200, "field": (0, 16.5), "field_nodes": 2}
    table = trace_table(GAUSS, 4.0, 2.0, wavelengths_um=RGB_UM, field_rays=3_000, **options)
    assert table.field is not None
    stopped, width, column = GAUSS.with_f_number(4.0), 3840, 3680  # the column is 16.5 mm from the centre of 36 mm
    sensor = focus_sensor(stopped, 2.0)
    height = field_height_mm(stopped, 2.0, sensor, 16.5)
    centres = []
    for wavelength in RGB_UM:
        u, _, weight = spot_of_place(stopped, math.inf, sensor, height, rays=3_000, wavelength_um=wavelength)
        centres.append(float(weight @ u) * width / 36.0)
    image = torch.zeros(1, 3, 48, width)
    image[..., 24, column] = 1.0
    coc_px = float(table.field.coc[-1]) * width / 36.0
    with torch.no_grad():
        picture = blur_by_coc(image, torch.full_like(image[:, :1], coc_px), table=table)[0].double()
    across = picture.sum(1) @ (torch.arange(width) - column).double() / picture.sum((1, 2))
    assert centres[2] - centres[0] > 0.2  # px
    assert (across - across[1]).tolist() == pytest.approx([c - centres[1] for c in centres], abs=0.05)
