"""Spots against those of optiland, an independent ray tracer (``pip install optiland``)."""

import importlib
import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchdof.fit.lens.glass import catalogue
from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.spot import focus_sensor, point_spread

if importlib.util.find_spec("optiland") is None:
    pytest.skip("optiland is not installed; rays are not checked independently", allow_module_level=True)

pytestmark = pytest.mark.filterwarnings("ignore")  # optiland's own warnings

# Laikin, Lens Design, 4th ed., p. 63: Tessar, f/4.5, 4 inches, with SCHOTT glasses. Clear diameters are our choice
TESSAR = """
1.3329  0.2791 N-SK15 1.1
-9.9754 0.2054 1      1.1
-2.0917 0.09   F2     0.95
1.2123  0.0709 1      0.95
0       0.1534 0      0.75
-7.5205 0.09   K10    0.95
1.3010  0.3389 N-SK15 1.1
-1.5218 0      1      1.1
"""
LINES_UM = (0.65627, 0.58756, 0.48613)  # C, d, F
DEPTHS = (2.5, 2.0, 1.5, 1.2, 1.0, 0.7, 0.4, 0.0)  # focus distance over object distance


def optiland_lens(lens: Lens, sensor_mm: float, wavelength_um: float = 0.58756) -> Any:
    """The lens in optiland, with optiland's glass of the same name where there is one, else our index."""
    materials = importlib.import_module("optiland.materials")
    optic = importlib.import_module("optiland.optic").Optic()
    optic.surfaces.add(index=0, radius=np.inf, thickness=10.0)
    last = len(lens.surfaces) - 1
    for i, one in enumerate(lens.surfaces):
        n, name = one.glass.index(wavelength_um), one.glass.name
        medium = materials.Material(name, "schott") if name in catalogue() else materials.IdealMaterial(n=n)
        asphere = {"surface_type": "even_asphere", "coefficients": one.polynomial} if one.polynomial else {}
        optic.surfaces.add(
            index=i + 1, radius=one.radius, thickness=sensor_mm if i == last else one.thickness, material=medium,
            is_stop=i == lens.stop, conic=one.conic, **asphere,
        )  # fmt: skip
    optic.surfaces.add(index=last + 2)
    optic.set_aperture(aperture_type="EPD", value=lens.paraxial().entrance_pupil_diameter)
    optic.fields.set_type("angle")
    optic.fields.add(y=0)
    optic.wavelengths.add(value=0.58756, is_primary=True)
    return optic


def optiland_rays(start: np.ndarray, direction: np.ndarray, wavelength_um: float = 0.58756) -> Any:
    light, wavelength = np.ones_like(start[0]), np.full_like(start[0], wavelength_um)
    return importlib.import_module("optiland.rays").RealRays(*start, *direction, light, wavelength)


def optiland_rms(lens: Lens, z_m: float, sensor: float, wavelength_um: float) -> float:
    """RMS radius in mm of the spot on the axis, from rays uniform over the entrance pupil that pass every aperture."""
    first = lens.paraxial()
    height = 1.5 * first.entrance_pupil_diameter / 2 * np.sqrt((np.arange(4000) + 0.5) / 4000)
    reach = 1000.0 * z_m - first.front_principal + first.entrance_pupil  # from the object to the entrance pupil
    along = np.ones_like(height)
    direction = np.stack([0 * height, height / reach if math.isfinite(reach) else 0 * height, along])
    direction /= np.linalg.norm(direction, axis=0)
    start = np.stack([0 * height, height, first.entrance_pupil * along])
    start = start - direction * ((first.entrance_pupil + 5.0) / direction[2])
    optic, rays = optiland_lens(lens, sensor, wavelength_um), optiland_rays(start, direction, wavelength_um)
    optic.surfaces.trace(rays, skip=1)
    passes = np.isfinite(np.asarray(rays.y))
    for i, surface in enumerate(lens.surfaces):
        passes &= np.abs(np.asarray(optic.surfaces.surfaces[i + 1].y)) <= surface.diameter / 2
    return float(np.sqrt(np.mean(np.asarray(rays.y)[passes] ** 2)))


@pytest.mark.parametrize("name", ["double_gauss_50mm", "wide_22mm", "telephoto_250mm", "tessar"])
def test_rms_spots_of_eight_depths_and_three_lines_agree_within_1_percent(name: str, tmp_path: Path) -> None:
    (tmp_path / "tessar.txt").write_text(TESSAR)
    lens = Lens.read(tmp_path / "tessar.txt").scaled(100.0) if name == "tessar" else Lens.read(name)
    focus_m = 20.0 * lens.paraxial().focal_length / 1000.0
    sensor = focus_sensor(lens, focus_m)
    worst = 0.0
    for wavelength_um in LINES_UM:
        for dioptres in DEPTHS:
            z_m = focus_m / dioptres if dioptres else math.inf
            ours = point_spread(lens, z_m, sensor, meridional=True, rays=4000, wavelength_um=wavelength_um).rms
            theirs = optiland_rms(lens, z_m, sensor, wavelength_um)
            worst = max(worst, abs(ours / theirs - 1.0))
    assert worst < 0.01
