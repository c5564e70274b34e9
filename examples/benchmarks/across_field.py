"""Blur across the field: the double Gauss at f/2, its table beside rays traced through the lens, and what that costs.

Usage: python examples/benchmarks/across_field.py [spots] [views] [cost] [--picture field.jpg]

``spots``: rendered point lights against directly traced spots. ``views``: rendered scenes against pictures made of rays
that are traced from each pixel back through the lens, which know the field and need no table. ``cost``: CPU time of one
thread beside the round table, in turns. Without a name all three are measured, in some minutes. ``--picture`` draws a
street at night through tables in three colours, of the lens's middle and of all its field.
"""

import argparse
import functools
import math
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.bench.timer import in_turns, processor_seconds
from torchdof.fit import trace_table
from torchdof.fit.lens import Lens
from torchdof.fit.lens.field import field_height_mm, spot_of_place
from torchdof.fit.lens.lens import RGB_UM
from torchdof.fit.lens.spot import focus_sensor
from torchdof.fit.lens.views import rays_of
from torchdof.io.sheet import write_sheet
from torchdof.optics.aperture import Aperture
from torchdof.reference.metrics import display, psnr
from torchdof.reference.scenes import Plane, plane_views, posts, waves

F_NUMBER, FOCUS_M, SENSOR_MM = 2.0, 2.0, 36.0
FIELD_MM = (0.0, 1.35, 2.7, 4.05, 5.4, 6.75, 8.1, 9.5, 10.9, 12.3, 13.7, 15.1, 16.5, 18.0, 19.8, 21.6)
PLACES_MM, AZIMUTH = (0.0, 7.0, 14.0, 20.0), 0.55
BLURS_PX = (-30.8, -21.2, -11.6, -5.8, 5.8, 9.6, 13.9, 17.3)  # at 1920 px
POINT_PX = 0.7  # standard deviation of a point light


def lens() -> Lens:
    """The shipped double Gauss at f/2."""
    return Lens.read("double_gauss_50mm").with_f_number(F_NUMBER)


def coc_mm(z_m: float) -> float:
    """Signed coc on the sensor of an object distance."""
    return float(camera().coc_px(torch.full((1, 1, 1, 1), z_m, dtype=torch.float64), 1)) * SENSOR_MM


def camera() -> Camera:
    """The thin lens that the traced one stands beside."""
    focal_mm = lens().paraxial().focal_length
    return Camera(focal_length_mm=focal_mm, f_number=F_NUMBER, focus_m=FOCUS_M, sensor_width_mm=SENSOR_MM)


def traced_spot(z_m: float, radius_mm: float, azimuth: float, half: int, width: int, rays: int = 160_000) -> np.ndarray:
    """What pixels ``[2 half + 1, 2 half + 1]`` get of the spot of a point whose sharp image is a small Gaussian."""
    sensor = focus_sensor(lens(), FOCUS_M)
    height = field_height_mm(lens(), z_m, sensor, radius_mm, "principal")
    u, v, weight = spot_of_place(lens(), z_m, sensor, height, rays)
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


def scenes() -> dict[str, list[Plane]]:
    """Planes of waves: one in front of the focus, one behind it, and bars before both."""
    near, far = waves(11, (0.5, 0.4, 0.3)), waves(12)
    return {
        "a plane at 0.9 m": [Plane(0.9, near)],
        "a plane at 8 m": [Plane(8.0, far)],
        "bars at 1 m, 2 m and 8 m": [
            *(
                Plane(1.0, near, posts(150.0, 24.0)),
                Plane(2.0, waves(13), posts(190.0, 60.0, -0.3, 40.0)),
                Plane(8.0, far),
            ),
        ],
    }


def views_db(
    tables: dict[str, BlurTable], planes: list[Plane], places_mm: tuple[float, ...], width: int, side: int, samples: int
) -> dict[str, list[float]]:
    """PSNR as displayed of a rendered scene against what rays through the lens make of it, in squares at places."""
    height = width * 2 // 3
    planes = sorted(planes, key=lambda plane: -plane.depth_m)
    sensor, size = focus_sensor(lens(), FOCUS_M), (height, width)

    def pinhole(_: int, x: Tensor, y: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        return [(x, y)] * len(planes), torch.ones_like(x)

    sharp = plane_views(planes, pinhole, size, (slice(None), slice(None)), 16)
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in size), indexing="ij")
    depth = torch.full((1, 1, height, width), planes[0].depth_m)
    for plane in planes[1:]:
        if plane.shape is not None:
            depth[0, 0][plane.shape(x, y)] = plane.depth_m
    rays = rays_of(lens(), [plane.depth_m for plane in planes], sensor, size, SENSOR_MM, samples)
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


def cost(tables: dict[str, BlurTable], reach_px: float, lamps: bool, rounds: int) -> dict[str, float]:
    """CPU time of pictures of 960 x 540 over that of the round table, medians of turns."""
    dice = torch.Generator().manual_seed(5)
    image = torch.nn.functional.interpolate(
        torch.rand(1, 3, 68, 120, generator=dice), (540, 960), mode="bicubic"
    ).clamp(0, 1)
    if lamps:
        for row, column in zip(*(torch.randint(n, (60,), generator=dice).tolist() for n in (540, 960)), strict=True):
            image[0, :, row, column] = 300.0
    bands = torch.randint(-10, 11, (1, 1, 9, 16), generator=dice).float() / 10.0
    coc_px = torch.nn.functional.interpolate(bands, (540, 960)) * reach_px
    works = {name: functools.partial(blur_by_coc, image, coc_px, table=table) for name, table in tables.items()}
    with torch.no_grad():
        taken = in_turns(works, rounds, processor_seconds)
    first = statistics.median(taken["round"])
    return {name: statistics.median(of) / first for name, of in taken.items()}


def draw(path: Path) -> None:
    """A street at night, the left half of it, through the middle of the lens all over and through the lens."""
    from examples.bokeh import street

    options: dict[str, Any] = {"wavelengths_um": RGB_UM, "field": FIELD_MM[::2] + FIELD_MM[-1:], "field_rays": 30_000}
    table = trace_table(lens(), F_NUMBER, FOCUS_M, nodes=9, field_nodes=8, **options)
    tables = {"as in the middle of the frame": table.replace(field=None), "traced across the field": table}
    image, depth = street(640, 960)
    shown = {}
    for name, table in tables.items():
        with torch.no_grad():
            picture = DepthOfField(camera(), table, depth_edges="as given")(image, depth)
        shown[name] = picture[..., 40:400, :480].clamp(0.0, 1.0)
    write_sheet(path, shown)


def main() -> None:
    """Measure what is asked for and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", nargs="*", help="spots, views, cost; by default all three")
    parser.add_argument("--picture", type=Path, help="draw this instead")
    parser.add_argument("--rounds", type=int, default=7, help="of the cost")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.picture:
        sys.path.insert(0, os.fspath(Path(__file__).parents[2]))
        draw(arguments.picture)
        return
    start = time.process_time()
    traced = trace_table(lens(), F_NUMBER, FOCUS_M, field=FIELD_MM, field_rays=100_000)
    print(f"{traced!r}: {time.process_time() - start:.0f} s of CPU time\n")
    plain = traced.replace(field=None)
    tables = {"field": traced, "vignetting=0.8": plain.with_aperture(Aperture(vignetting=0.8)), "round": plain}
    chosen: dict[str, Callable[[], None]] = {
        "spots": lambda: print_spots(tables),
        "views": lambda: print_views(tables),
        "cost": lambda: print_cost(tables, arguments.rounds),
    }
    for name in arguments.what or chosen:
        if name not in chosen:
            parser.error(f"there is no {name!r}; measured are {', '.join(chosen)}")
        chosen[name]()


def print_spots(tables: dict[str, BlurTable]) -> None:
    """The table of rendered point lights."""
    print("| blur radius |" + "".join(f" {place:g} mm |" for place in PLACES_MM))
    print("| --- |" + " --- |" * len(PLACES_MM))
    per_dioptre = coc_mm(1e9) * FOCUS_M  # the coc is linear in dioptres
    for blur in BLURS_PX:
        z_m = 1.0 / max(1.0 / FOCUS_M - blur * SENSOR_MM / 1920 / per_dioptre, 1e-9)
        found = rendered_spots_db(tables, z_m, PLACES_MM, (AZIMUTH,) * len(PLACES_MM), 1920)
        print(f"| {blur:g} px |" + _cells(found), flush=True)
    print()


def print_views(tables: dict[str, BlurTable]) -> None:
    """The table of rendered scenes."""
    print("| scene |" + "".join(f" {place:g} mm |" for place in PLACES_MM))
    print("| --- |" + " --- |" * len(PLACES_MM))
    for name, planes in scenes().items():
        print(f"| {name} |" + _cells(views_db(tables, planes, PLACES_MM, 720, 64, 400)), flush=True)
    print()


def print_cost(tables: dict[str, BlurTable], rounds: int) -> None:
    """The table of times."""
    del tables["vignetting=0.8"]
    tables["cut"] = BlurTable.disc().with_aperture(Aperture(vignetting=0.4))
    tables["blades"] = BlurTable.polygon(7, rotation_deg=15.0)
    print("| radii up to | lamps | traced field | `vignetting=0.4` | seven blades |\n| --- | --- | --- | --- | --- |")
    for reach in (8.0, 16.0, 32.0):
        for lamps in (False, True):
            found = cost(tables, reach, lamps, rounds)
            told = " | ".join(f"{found[name]:.2f}" for name in ("field", "cut", "blades"))
            print(f"| {reach:g} px | {'60' if lamps else 'none'} | {told} |", flush=True)


def _cells(found: dict[str, list[float]]) -> str:
    """Decibels of the first table, those of the others in brackets."""
    first, *others = found.values()
    return "".join(f" {first[i]:.1f} ({', '.join(f'{other[i]:.1f}' for other in others)}) |" for i in range(len(first)))


if __name__ == "__main__":
    main()
