"""Spots across the field, traced, in a table and in a picture."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from torchdof import BlurTable, blur_by_coc
from torchdof.fit import trace_table
from torchdof.fit.lens import Lens
from torchdof.fit.lens.field import field_height_mm, spot_of_place
from torchdof.fit.lens.spot import focus_sensor
from torchdof.fit.lens.trace import signed_coc_mm
from torchdof.optics.aperture import Aperture

WIDTH, HEIGHT, SENSOR_MM = 960, 640, 36.0
PLACES = ((7.0, 2.2), (14.0, -2.6), (20.0, 0.55))  # mm from the middle of the frame, and azimuth
RADII = (0.0, 6.0, 8.0, 13.0, 15.0, 19.0, 21.0)


@pytest.fixture(scope="module")
def gauss() -> Lens:
    return Lens.read("double_gauss_50mm")


@pytest.fixture(scope="module")
def table(gauss: Lens) -> BlurTable:
    return trace_table(gauss, 2.0, 2.0, nodes=5, points=17, rays=400, field=RADII, field_nodes=4, field_rays=40_000)


def traced(lens: Lens, z_m: float, radius_mm: float, azimuth: float, half: int) -> Any:
    """What pixels get of the spot of a point whose sharp image is a Gaussian of 0.7 px."""
    stopped = lens.with_f_number(2.0)
    sensor = focus_sensor(stopped, 2.0)
    height = field_height_mm(stopped, z_m, sensor, radius_mm, "principal")
    u, v, weight = spot_of_place(stopped, z_m, sensor, height, 90_000)
    u, v = u * (WIDTH / SENSOR_MM), v * (WIDTH / SENSOR_MM)
    y, x = u * math.sin(azimuth) + v * math.cos(azimuth), u * math.cos(azimuth) - v * math.sin(azimuth)
    edges = np.linspace(-half - 0.5, half + 0.5, 5 * (2 * half + 1) + 1)
    fine = np.histogram2d(y, x, [edges, edges], weights=weight)[0]
    step = np.arange(-20, 21) / 5
    seen = np.convolve(np.exp(-0.5 * (step / 0.7) ** 2), np.ones(5))
    for axis in (0, 1):
        fine = np.apply_along_axis(np.convolve, axis, fine, seen / seen.sum(), mode="same")
    return fine[2::5, 2::5] * 25


@pytest.mark.parametrize(("z_m", "least"), [(0.9, 37.0), (1e9, 34.0)])
def test_rendered_points_are_the_traced_spots(gauss: Lens, table: BlurTable, z_m: float, least: float) -> None:
    focal = gauss.paraxial().focal_length
    coc_px = signed_coc_mm(z_m, focal, 2.0, 2.0) * WIDTH / SENSOR_MM
    edges = torch.erf(torch.linspace(-3.5, 3.5, 8) / (0.7 * math.sqrt(2.0))).diff()
    blob = edges[:, None] * edges / edges.sum() ** 2
    image, half, spots = torch.zeros(1, 1, HEIGHT, WIDTH), math.ceil(1.1 * abs(coc_px)) + 2, []
    for radius, azimuth in PLACES:
        away = radius * WIDTH / SENSOR_MM
        row = round(HEIGHT / 2 + away * math.sin(azimuth) - 0.5)
        column = round(WIDTH / 2 + away * math.cos(azimuth) - 0.5)
        image[0, 0, row - 3 : row + 4, column - 3 : column + 4] = blob
        dy, dx = row + 0.5 - HEIGHT / 2, column + 0.5 - WIDTH / 2
        spot = traced(gauss, z_m, math.hypot(dy, dx) * SENSOR_MM / WIDTH, math.atan2(dy, dx), half)
        spots.append((slice(row - half, row + half + 1), slice(column - half, column + half + 1), spot))

    def decibels(table: BlurTable) -> list[float]:
        with torch.no_grad():
            picture = blur_by_coc(image, torch.full_like(image, coc_px), table=table)[0, 0].double().numpy()
        errors = [((picture[rows, columns] - spot) ** 2).mean() / spot.max() ** 2 for rows, columns, spot in spots]
        return [-10.0 * math.log10(error) for error in errors]

    assert min(decibels(table)) > least
    assert max(decibels(table.replace(field=None).with_aperture(Aperture(vignetting=0.8)))) < 27.0


def test_on_the_axis_spots_are_round_and_lie_on_it(table: BlurTable) -> None:
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
def test_bad_fields_are_refused_by_name(gauss: Lens, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trace_table(gauss, 2.0, 2.0, **change)
