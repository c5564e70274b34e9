import math
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.refused import refuses
from torchdof.fit.lens.glass import C_UM, D_UM, F_UM
from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.spot import focus_sensor, point_spread


@pytest.fixture(scope="module")
def gauss() -> Lens:
    return Lens.read("double_gauss_50mm")


def test_the_blur_is_that_of_distances_from_the_principal_plane(gauss):
    spot = point_spread(gauss, 1.0, focus_sensor(gauss, 2.0, "paraxial"), meridional=True, rays=20_000)
    assert spot.radius == pytest.approx(0.37052, abs=2e-5)
    lens = gauss.with_f_number(16.0)
    assert point_spread(lens, 2.0, focus_sensor(lens, 2.0), meridional=True).radius < 1e-3


@pytest.mark.parametrize("z_m", [1.0, 2.0, 1e12, math.inf])
def test_spot_on_axis_is_round_and_agrees_with_the_fan(gauss, z_m):
    sensor = focus_sensor(gauss, 2.0)
    whole = point_spread(gauss, z_m, sensor)
    fan = point_spread(gauss, z_m, sensor, meridional=True)
    assert whole.asymmetry < 0.03
    assert abs(whole.centre) < 1e-9
    assert whole.rms == pytest.approx(fan.rms, rel=0.005)
    assert whole.pupil_mm2 == pytest.approx(fan.pupil_mm2, rel=0.02)
    shares = np.linspace(0.1, 1.0, 10) * fan.radius
    inside = [[float(s.weight[s.r <= r].sum()) for r in shares] for s in (whole, fan)]
    np.testing.assert_allclose(inside[0], inside[1], atol=0.01)


# Laikin, Lens Design, 4th ed., p. 63: Tessar, f/4.5, 4 inches, with SCHOTT glasses, scaled to 100 mm. Clear diameters
# are our choice
TESSAR = """
33.3410231  6.9813786  N-SK15 27.5152865
-249.523626 5.1378544  1      27.5152865
-52.321568  2.25125071 F2     23.763202
30.3243471  1.77348528 1      23.763202
0           3.83713177 0      18.7604226
-188.117011 2.25125071 K10    23.763202
32.5430798  8.47720963 N-SK15 27.5152865
-38.0661482 0          1      27.5152865
"""
DIOPTRES = (2.5, 2.0, 1.5, 1.2, 1.0, 0.7, 0.4, 0.0)  # focus distance, of 20 focal lengths, over object distance
# RMS radii in um of spots on the axis that optiland 0.6.3 traced with its own glasses, 4000 rays uniform over the pupil
OPTILAND = [
    ("double_gauss_50mm", C_UM, (716.0, 481.9, 246.4, 104.6, 16.00, 132.8, 273.0, 457.8)),
    ("double_gauss_50mm", D_UM, (707.6, 473.2, 237.6, 95.58, 12.95, 142.2, 282.4, 467.4)),
    ("double_gauss_50mm", F_UM, (702.6, 467.7, 231.8, 89.90, 15.03, 149.0, 289.5, 474.7)),
    ("wide_22mm", D_UM, (222.4, 147.9, 73.96, 30.08, 6.097, 44.47, 88.18, 146.4)),
    ("telephoto_250mm", D_UM, (1183.0, 796.0, 402.0, 162.1, 11.93, 245.0, 492.5, 827.1)),
    ("tessar", C_UM, (639.1, 425.2, 211.5, 83.58, 10.55, 131.3, 259.3, 430.3)),
    ("tessar", D_UM, (642.2, 428.1, 214.2, 86.09, 8.933, 128.7, 256.9, 428.0)),
    ("tessar", F_UM, (665.7, 451.4, 237.0, 108.4, 23.48, 106.4, 234.9, 406.3)),
]


@pytest.mark.parametrize(("name", "line_um", "rms_um"), OPTILAND)
def test_spots_are_those_of_an_independent_ray_tracer(name, line_um, rms_um, lens_of):
    lens = lens_of(TESSAR) if name == "tessar" else Lens.read(name)
    focus_m = 20.0 * lens.paraxial().focal_length / 1000.0
    sensor, traced = focus_sensor(lens, focus_m), []
    for dioptres in DIOPTRES:
        z_m = focus_m / dioptres if dioptres else math.inf
        traced.append(1000 * point_spread(lens, z_m, sensor, meridional=True, rays=4000, wavelength_um=line_um).rms)
    assert traced == pytest.approx(rms_um, rel=2e-3)


def test_a_near_point_lights_rings_of_the_pupil_by_their_solid_angle(gauss):
    # 8 cm in front of H the pupil's rim is 12 degrees off the axis; a cone has the solid angle 2 pi (1 - cos)
    spot = point_spread(gauss, 0.08, 60.0, meridional=True, rays=4_000)
    pupil = gauss.paraxial().entrance_pupil
    distance = 80.0 - gauss.paraxial().front_principal + pupil
    rim = math.sqrt(spot.pupil_mm2 / math.pi)
    # the outermost tenth of the fan's rays: rings of equal area, from 0.9 of the pupil's area outwards
    cosine = [distance / math.hypot(distance, rim * math.sqrt(share)) for share in (0.9, 1.0)]
    outer = spot.weight[round(0.9 * len(spot.weight)) :].sum()
    assert outer == pytest.approx((cosine[0] - cosine[1]) / (1.0 - cosine[1]), rel=2e-3)


def test_vignetting_reduces_light_and_symmetry_towards_the_corner(gauss):
    sensor = focus_sensor(gauss, 2.0)
    spots = [point_spread(gauss, 1.0, sensor, field_mm=f) for f in (0.0, 6.0, 12.0, 18.0)]
    area, asymmetry = [spot.pupil_mm2 for spot in spots], [spot.asymmetry for spot in spots]
    assert area == sorted(area, reverse=True) and area[3] < 0.5 * area[0]
    assert asymmetry == sorted(asymmetry) and asymmetry[3] > 0.3
    for spot in spots:
        assert spot.weight.sum() == pytest.approx(1.0, abs=1e-12) and spot.weight.min() > 0
        assert abs(spot.weight @ spot.y) < 1e-12  # hits are relative to the centroid


@pytest.mark.parametrize("z_m", [2.0, math.inf])
@pytest.mark.parametrize(("field_mm", "distortion"), [(0.1, 1e-4), (10.0, 0.008)])
def test_field_mm_is_the_height_of_a_pinholes_image(gauss, z_m, field_mm, distortion):
    lens = gauss.with_f_number(16.0)
    centre = point_spread(lens, z_m, focus_sensor(lens, z_m), field_mm=field_mm, rays=5_000).centre
    assert centre == pytest.approx(field_mm, rel=distortion)


focused: Any = partial(partial, focus_sensor, Lens.read("double_gauss_50mm"), focus_m=2.0)
spread: Any = partial(partial, point_spread, Lens.read("double_gauss_50mm"), z_m=1.0, sensor_mm=37.4)
test_wrong_arguments_are_refused = refuses(
    (focused(kind="film"), "focus must be one of best, paraxial, got 'film'"),
    (focused(focus_m=0.02), "must lie in front of the lens"),
    (focused(focus_m=0.045), r"farther than the focal length \(50.36 mm\)"),
    (spread(rays=3), "rays must be a whole number from 16 to 100000000, got 3"),
    (spread(rays=10**12), "rays must be a whole number from 16"),
    (spread(rays=16.5), "rays must be"),
    (spread(z_m=1e300), r"at most 1e\+12 m away"),
    (spread(field_mm=1e300), "field_mm"),
    (spread(field_mm=math.nan), "field_mm"),
    (spread(field_mm=1.0, meridional=True), "points on the axis"),
    (spread(field_mm=90.0), "no ray of the object point passes"),
)
