"""Spots across the field, traced, in a table and in a picture."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.fit import trace_table
from torchdof.fit.lens import Lens
from torchdof.fit.lens.field import field_height_mm, spot_of_place
from torchdof.fit.lens.lens import RGB_UM
from torchdof.fit.lens.spot import focus_sensor
from torchdof.fit.lens.views import rays_of
from torchdof.optics.aperture import Aperture
from torchdof.reference.metrics import display, psnr
from torchdof.reference.scenes import Plane, plane_views, waves

WIDTH, HEIGHT = 960, 640
PLACES_MM, AZIMUTHS = (7.0, 14.0, 20.0), (2.2, -2.6, 0.55)
F_NUMBER, FOCUS_M, SENSOR_MM, AZIMUTH = 2.0, 2.0, 36.0, 0.55
POINT_PX = 0.7  # standard deviation of a point light
RADII = (0.0, 6.0, 8.0, 13.0, 15.0, 19.0, 21.0)


def stopped() -> Lens:
    return Lens.read("double_gauss_50mm").with_f_number(F_NUMBER)


def coc_mm(z_m: float) -> float:
    """Signed coc on the sensor of an object distance."""
    return float(camera().coc_px(torch.full((1, 1, 1, 1), z_m, dtype=torch.float64), 1)) * SENSOR_MM


def camera() -> Camera:
    """The thin lens that the traced one stands beside."""
    focal_mm = stopped().paraxial().focal_length
    return Camera(focal_length_mm=focal_mm, f_number=F_NUMBER, focus_m=FOCUS_M, sensor_width_mm=SENSOR_MM)


def traced_spot(z_m: float, radius_mm: float, azimuth: float, half: int, width: int, rays: int = 160_000) -> np.ndarray:
    """What pixels ``[2 half + 1, 2 half + 1]`` get of the spot of a point whose sharp image is a small Gaussian."""
    sensor = focus_sensor(stopped(), FOCUS_M)
    height = field_height_mm(stopped(), z_m, sensor, radius_mm, "principal")
    u, v, weight = spot_of_place(stopped(), z_m, sensor, height, rays)
    u, v = u * (width / SENSOR_MM), v * (width / SENSOR_MM)
    y, x = u * math.sin(azimuth) + v * math.cos(azimuth), u * math.cos(azimuth) - v * math.sin(azimuth)
    edges = np.linspace(-half - 0.5, half + 0.5, 5 * (2 * half + 1) + 1)
    fine = np.histogram2d(y, x, [edges, edges], weights=weight)[0]
    step = np.arange(-20, 21) / 5
    seen = np.convolve(np.exp(-0.5 * (step / POINT_PX) ** 2), np.ones(5))
    for axis in (0, 1):
        fine = np.apply_along_axis(np.convolve, axis, fine, seen / seen.sum(), mode="same")
    return fine[2::5, 2::5] * 25


def rendered_spots_db(
    tables: dict[str, BlurTable], z_m: float, places_mm: tuple[float, ...], azimuths: tuple[float, ...], width: int
) -> dict[str, list[float]]:
    """PSNR, peak 1, of rendered point lights against traced spots at places, in a square of 1.1 times the blur."""
    height = width * 2 // 3
    coc_px = coc_mm(z_m) * width / SENSOR_MM
    edges = torch.erf(torch.linspace(-3.5, 3.5, 8) / (POINT_PX * math.sqrt(2.0))).diff()
    blob = edges[:, None] * edges / edges.sum() ** 2
    half, spots = math.ceil(1.1 * abs(coc_px)) + 2, []
    image = torch.zeros(1, 1, height, width)
    for radius, azimuth in zip(places_mm, azimuths, strict=True):
        away = radius * width / SENSOR_MM
        row = round(height / 2 + away * math.sin(azimuth) - 0.5)
        column = round(width / 2 + away * math.cos(azimuth) - 0.5)
        image[0, 0, row - 3 : row + 4, column - 3 : column + 4] = blob
        dy, dx = row + 0.5 - height / 2, column + 0.5 - width / 2
        spot = traced_spot(z_m, math.hypot(dy, dx) * SENSOR_MM / width, math.atan2(dy, dx), half, width)
        spots.append((slice(row - half, row + half + 1), slice(column - half, column + half + 1), spot))
    found = {}
    for name, table in tables.items():
        with torch.no_grad():
            picture = blur_by_coc(image, torch.full_like(image, coc_px), table=table)[0, 0].double().numpy()
        errors = [((picture[rows, columns] - spot) ** 2).mean() / spot.max() ** 2 for rows, columns, spot in spots]
        found[name] = [-10.0 * math.log10(error) for error in errors]
    return found


def views_db(
    tables: dict[str, BlurTable], planes: list[Plane], places_mm: tuple[float, ...], width: int, side: int, samples: int
) -> dict[str, list[float]]:
    """PSNR as displayed of a rendered scene against what rays through the lens make of it, in squares at places."""
    height = width * 2 // 3
    planes = sorted(planes, key=lambda plane: -plane.depth_m)
    sensor, size = focus_sensor(stopped(), FOCUS_M), (height, width)

    def pinhole(_: int, x: Tensor, y: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        return [(x, y)] * len(planes), torch.ones_like(x)

    sharp = plane_views(planes, pinhole, size, (slice(None), slice(None)), 16)
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in size), indexing="ij")
    depth = torch.full((1, 1, height, width), planes[0].depth_m)
    for plane in planes[1:]:
        if plane.shape is not None:
            depth[0, 0][plane.shape(x, y)] = plane.depth_m
    rays = rays_of(stopped(), [plane.depth_m for plane in planes], sensor, size, SENSOR_MM, samples)
    windows, truths = [], []
    for radius in places_mm:
        away = radius * width / SENSOR_MM
        top, left = (
            round(n / 2 + away * turn - side / 2)
            for n, turn in ((height, math.sin(AZIMUTH)), (width, math.cos(AZIMUTH)))
        )
        windows.append((slice(top, top + side), slice(left, left + side)))
        truths.append(display(plane_views(planes, rays, size, windows[-1], samples)))
    found = {}
    for name, table in tables.items():
        with torch.no_grad():
            picture = display(DepthOfField(camera(), table, depth_edges="as given")(sharp, depth))
        found[name] = [psnr(picture[..., r, c], truth) for (r, c), truth in zip(windows, truths, strict=True)]
    return found


@pytest.fixture(scope="module")
def gauss() -> Lens:
    return Lens.read("double_gauss_50mm")


@pytest.fixture(scope="module")
def table(gauss: Lens) -> BlurTable:
    return trace_table(gauss, 2.0, 2.0, nodes=5, points=17, rays=400, field=RADII, field_nodes=4, field_rays=40_000)


@pytest.mark.parametrize(("z_m", "least"), [(0.9, 37.0), (1e9, 34.0)])
def test_rendered_points_are_the_traced_spots(table: BlurTable, z_m: float, least: float) -> None:
    tables = {"field": table, "cut": table.replace(field=None).with_aperture(Aperture(vignetting=0.8))}
    found = rendered_spots_db(tables, z_m, PLACES_MM, AZIMUTHS, WIDTH)
    assert min(found["field"]) > least
    assert max(found["cut"]) < 27.0


def test_rays_traced_from_pixels_back_through_the_lens_see_the_spot(gauss: Lens) -> None:
    z_m, half, samples, size = 1e5, 8, 900, (HEIGHT, WIDTH)
    y, x = HEIGHT / 2 + 14.0 * WIDTH / 36.0 * math.sin(-2.6), WIDTH / 2 + 14.0 * WIDTH / 36.0 * math.cos(-2.6)
    row, column = round(y - 0.5), round(x - 0.5)
    dy, dx = row + 0.5 - HEIGHT / 2, column + 0.5 - WIDTH / 2
    spot = traced_spot(z_m, math.hypot(dy, dx) * 36.0 / WIDTH, math.atan2(dy, dx), half, WIDTH)

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
    found = views_db(tables, [Plane(0.9, waves(11))], (14.0,), 360, 20, 100)
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
