"""Spots across the field, traced, in a table and in a picture."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from examples.benchmarks import across_field
from torchdof import BlurTable, blur_by_coc
from torchdof.fit import trace_table
from torchdof.fit.lens import Lens
from torchdof.fit.lens.field import field_height_mm, spot_of_place
from torchdof.fit.lens.lens import RGB_UM
from torchdof.fit.lens.spot import focus_sensor
from torchdof.fit.lens.views import rays_of
from torchdof.optics.aperture import Aperture
from torchdof.reference.scenes import Plane, plane_views, waves

WIDTH, HEIGHT = 960, 640
PLACES_MM, AZIMUTHS = (7.0, 14.0, 20.0), (2.2, -2.6, 0.55)
RADII = (0.0, 6.0, 8.0, 13.0, 15.0, 19.0, 21.0)


@pytest.fixture(scope="module")
def gauss() -> Lens:
    return Lens.read("double_gauss_50mm")


@pytest.fixture(scope="module")
def table(gauss: Lens) -> BlurTable:
    return trace_table(gauss, 2.0, 2.0, nodes=5, points=17, rays=400, field=RADII, field_nodes=4, field_rays=40_000)


@pytest.mark.parametrize(("z_m", "least"), [(0.9, 37.0), (1e9, 34.0)])
def test_rendered_points_are_the_traced_spots(table: BlurTable, z_m: float, least: float) -> None:
    tables = {"field": table, "cut": table.replace(field=None).with_aperture(Aperture(vignetting=0.8))}
    found = across_field.rendered_spots_db(tables, z_m, PLACES_MM, AZIMUTHS, WIDTH)
    assert min(found["field"]) > least
    assert max(found["cut"]) < 27.0


def test_rays_traced_from_pixels_back_through_the_lens_see_the_spot(gauss: Lens) -> None:
    z_m, half, samples, size = 1e5, 8, 900, (HEIGHT, WIDTH)
    y, x = HEIGHT / 2 + 14.0 * WIDTH / 36.0 * math.sin(-2.6), WIDTH / 2 + 14.0 * WIDTH / 36.0 * math.cos(-2.6)
    row, column = round(y - 0.5), round(x - 0.5)
    dy, dx = row + 0.5 - HEIGHT / 2, column + 0.5 - WIDTH / 2
    spot = across_field.traced_spot(z_m, math.hypot(dy, dx) * 36.0 / WIDTH, math.atan2(dy, dx), half, WIDTH)

    def light(x: Tensor, y: Tensor) -> Tensor:
        away = (x - column - 0.5) ** 2 + (y - row - 0.5) ** 2
        return torch.exp(-0.5 * away / 0.7**2)[None] / (2.0 * math.pi * 0.7**2)

    stopped = gauss.with_f_number(2.0)
    rays = rays_of(stopped, [z_m], focus_sensor(stopped, 2.0), size, samples=samples)
    window = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
    seen = plane_views([Plane(z_m, light)], rays, size, window, samples)[0, 0].double().numpy()

    def decibels(seen: Any) -> float:
        return float(-10.0 * np.log10(((seen - spot) ** 2).mean() / spot.max() ** 2))

    assert seen.sum() == pytest.approx(1.0, abs=0.01)
    assert decibels(seen) > 36.0  # of so many rays
    assert decibels(seen[::-1, ::-1]) < 28.0  # it does not lie inwards


def test_a_picture_across_the_field_is_what_rays_through_the_lens_make(table: BlurTable) -> None:
    tables = {"field": table, "round": table.replace(field=None)}
    found = across_field.views_db(tables, [Plane(0.9, waves(11))], (14.0,), 360, 20, 100)
    assert found["field"][0] > 52.0
    assert found["round"][0] < 42.0


def test_lateral_colour_draws_colours_beside_each_other(gauss: Lens) -> None:
    options: dict[str, Any] = {"nodes": 5, "points": 9, "rays": 200, "field": (0, 16.5), "field_nodes": 2}
    table = trace_table(gauss, 4.0, 2.0, wavelengths_um=RGB_UM, field_rays=3_000, **options)
    assert table.field is not None
    stopped, width, column = gauss.with_f_number(4.0), 3840, 3680  # 16.5 mm from the middle of 36
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
