"""Our rays against those of optiland, an independent ray tracer. Optional: `pip install optiland`."""

import importlib
import importlib.util
import math
from typing import Any

import numpy as np
import pytest

from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.rays import trace_rays
from torchdof.fit.lens.spot import focus_sensor, point_spread

if importlib.util.find_spec("optiland") is None:
    pytest.skip("optiland is not installed; the rays go without their independent check", allow_module_level=True)

pytestmark = pytest.mark.filterwarnings("ignore")  # its warnings are not ours to fail on

LENSES = ("double_gauss_50mm", "wide_22mm", "telephoto_250mm")


def their_lens(lens: Lens, sensor_mm: float) -> Any:
    material = importlib.import_module("optiland.materials").IdealMaterial
    optic = importlib.import_module("optiland.optic").Optic()
    optic.surfaces.add(index=0, radius=np.inf, thickness=10.0)
    gaps = [*lens.thickness[:-1], sensor_mm]
    for i, (radius, gap, n) in enumerate(zip(lens.radius, gaps, lens.index, strict=True)):
        optic.surfaces.add(index=i + 1, radius=radius, thickness=gap, material=material(n=n), is_stop=i == lens.stop)
    optic.surfaces.add(index=len(gaps) + 1)
    optic.set_aperture(aperture_type="EPD", value=lens.paraxial().entrance_pupil_diameter)
    optic.fields.set_type("angle")
    optic.fields.add(y=0)
    optic.wavelengths.add(value=0.58756, is_primary=True)
    return optic


def their_rays(start: np.ndarray, direction: np.ndarray) -> Any:
    light, wavelength = np.ones_like(start[0]), np.full_like(start[0], 0.58756)
    return importlib.import_module("optiland.rays").RealRays(*start, *direction, light, wavelength)


@pytest.mark.parametrize("name", LENSES)
def test_focal_length_and_pupils_agree(name: str) -> None:
    lens = Lens.read(name)
    ours, theirs = lens.paraxial(), their_lens(lens, lens.paraxial().back_focal).paraxial
    assert float(np.ravel(theirs.f2())[0]) == pytest.approx(ours.focal_length, abs=1e-6)
    assert float(np.ravel(theirs.EPL())[0]) == pytest.approx(ours.entrance_pupil, abs=1e-6)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_rays_land_within_5e5_mm(name: str, slope: float) -> None:
    lens = Lens.read(name)
    sensor = focus_sensor(lens, 2.0, "paraxial")
    rng = np.random.default_rng(0)
    half = lens.paraxial().entrance_pupil_diameter / 2
    # from a point 1 m before the first vertex to points of the entrance pupil
    count = 400
    r, turn = half * np.sqrt(rng.random(count)), 2 * math.pi * rng.random(count)
    pupil = lens.paraxial().entrance_pupil
    source = np.array([[0.0], [-1000.0 * slope], [-1000.0]])
    direction = np.stack([r * np.cos(turn), r * np.sin(turn), np.full(count, pupil)]) - source
    direction /= np.linalg.norm(direction, axis=0)
    start = source + direction * (999.0 / direction[2])  # 1 mm before the vertex
    ours = trace_rays(lens, start, direction)
    assert ours.alive.sum() > count / 4
    x, y = ours.at(lens.vertices[-1] + sensor)
    theirs = importlib.import_module("optiland.rays").RealRays(
        *start, *direction, np.ones(count), np.full(count, 0.58756)
    )
    their_lens(lens, sensor).surfaces.trace(theirs, skip=1)
    apart = np.hypot(np.asarray(theirs.x) - x, np.asarray(theirs.y) - y)[ours.alive]
    print(f"{name}, slope {slope}: {int(ours.alive.sum())} rays, at most {apart.max():.1e} mm apart")
    assert apart.max() < 5e-5


def test_largest_blur_radius_of_the_double_gauss_agrees() -> None:
    lens = Lens.read("double_gauss_50mm")
    sensor = focus_sensor(lens, 2.0, "paraxial", "pupil")
    ours = point_spread(lens, 1.0, sensor, reference="pupil", meridional=True, rays=20_000).radius
    # a fan from 1 m before the entrance pupil; those that pass the stop
    height = np.linspace(0.0, 13.0, 200_001)
    pupil = lens.paraxial().entrance_pupil
    direction = np.stack([0 * height, height, np.full_like(height, 1000.0)]) / np.hypot(height, 1000.0)
    start = np.stack([0 * height, height, np.full_like(height, pupil)]) - direction * ((pupil + 1.0) / direction[2])
    optic = their_lens(lens, sensor)
    rays = importlib.import_module("optiland.rays").RealRays(
        *start, *direction, np.ones_like(height), np.full_like(height, 0.58756)
    )
    optic.surfaces.trace(rays, skip=1)
    passes = np.abs(np.asarray(optic.surfaces.surfaces[lens.stop + 1].y)) <= lens.diameter[lens.stop] / 2
    theirs = float(np.abs(np.asarray(rays.y))[passes].max())
    print(f"largest blur radius: {ours:.5f} mm, optiland {theirs:.5f} mm")
    assert ours == pytest.approx(theirs, abs=5e-5)
