import math
from dataclasses import replace
from functools import partial

import pytest

from tests.refused import refuses
from torchdof.fit.lens.glass import AIR, C_UM, D_UM, F_UM, G_UM, Glass, catalogue
from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.spot import focus_sensor

FACTS = {
    "double_gauss_50mm": (50.3582, 36.1059),
    "wide_22mm": (22.0235, 14.3183),
    "telephoto_250mm": (249.5666, 105.0704),
}
SINGLET = "50 5 1.5168/64.17 20\n0 1 0 18\n-50 0 1 20\n"
ASPHERE = "40 3 1.5 20 stop k=-0.6 A4=1.2e-06 A10=-3e-13\n-40 2 1 20 A2=0.001\n"


def turned(lens):
    """The lens with front and rear exchanged: radii and polynomials change their signs."""
    media = [(AIR, 0.0), *((surface.glass, surface.thickness) for surface in lens.surfaces[:-1])]
    surfaces = [
        replace(one, radius=-one.radius, polynomial=tuple(-a for a in one.polynomial), glass=glass, thickness=gap)
        for one, (glass, gap) in zip(lens.surfaces, media, strict=True)
    ]
    return replace(lens, surfaces=tuple(surfaces[::-1]), stop=len(surfaces) - 1 - lens.stop)


@pytest.mark.parametrize("name", FACTS)
def test_first_order_properties_equal_the_published_ones_and_are_consistent(name):
    lens = Lens.read(name)
    first, back = lens.paraxial(), turned(lens).paraxial()
    assert (first.focal_length, first.back_focal) == pytest.approx(FACTS[name], abs=1e-4)
    # principal planes and focal points are a focal length apart, on both sides
    assert first.back_focal - first.rear_principal == pytest.approx(first.focal_length, rel=1e-12)
    assert back.back_focal + first.front_principal == pytest.approx(first.focal_length, rel=1e-12)
    # pupils are images of each other: object distance u before H, image distance v behind H'
    u, v = first.front_principal - first.entrance_pupil, -back.entrance_pupil - first.rear_principal
    assert 1 / u + 1 / v == pytest.approx(1 / first.focal_length, rel=1e-9)
    assert abs(v / u) == pytest.approx(back.entrance_pupil_diameter / first.entrance_pupil_diameter, rel=1e-9)


def test_stop_may_be_a_curved_surface_of_glass(lens_of):
    front = lens_of("40 3 1.5 10 stop\n-40 2 1 20\n").paraxial()
    assert (front.entrance_pupil, front.entrance_pupil_diameter) == (0.0, 10.0)
    # on the rear surface it is seen through the front one: 1.5 / 3 - power = 1 / distance, power = 0.5 / 40
    lens = lens_of("40 3 1.5 20\n-40 2 1 10 stop\n")
    rear, seen = lens.paraxial(), 1 / (1.5 / 3 - 0.5 / 40)
    assert rear.entrance_pupil == pytest.approx(seen, rel=1e-12)
    assert rear.entrance_pupil_diameter == pytest.approx(10.0 * seen * 1.5 / 3, rel=1e-12)
    assert turned(lens).paraxial().entrance_pupil == 0.0
    stopped = [surface.diameter for surface in lens.with_f_number(8.0).surfaces]
    assert stopped == [20.0, pytest.approx(10.0 * rear.f_number / 8.0)]


def test_stop_sets_the_f_number(lens_of):
    lens = Lens.read("double_gauss_50mm")
    for f_number in (2.8, 8.0):
        assert lens.with_f_number(f_number).paraxial().f_number == pytest.approx(f_number, rel=1e-12)
    assert lens.with_f_number(2.0).surfaces[lens.stop].diameter == 17.1  # as marked: fully open
    with pytest.raises(ValueError, match=r"f_number must be at least 2\.03.*got 1\.8"):
        lens.with_f_number(1.8)
    # A2 r^2 is the paraxial sag of a sphere of curvature 2 A2
    sphere, asphere = (lens_of(f"{front}\n-40 2 1 20\n0 0 0 10\n") for front in ("50 3 1.5 20", "inf 3 1.5 20 A2=0.01"))
    assert asphere.paraxial().focal_length == pytest.approx(sphere.paraxial().focal_length, rel=1e-12)


@pytest.mark.parametrize(
    ("glass", "lines", "apart"),  # catalogue and data sheets: C, d, e, F, g
    [
        ("1.51680/64.17/0.5349", (1.51432, 1.51680, 1.51872, 1.52238, 1.52668), 1.5e-4),  # N-BK7
        ("1.62004/36.37/0.5828", (1.61503, 1.62004, 1.62408, 1.63208, 1.64202), 1.5e-4),  # F2
        ("1.5168/64.17", (1.51432, 1.51680, None, 1.52238, None), 5e-5),  # two terms of Cauchy's: 2e-4
        ("N-BK7", (1.51432, 1.51680, 1.51872, 1.52238, 1.52668), 1.1e-5),
        ("F2", (1.61503, 1.62004, 1.62408, 1.63208, 1.64202), 1.1e-5),
        ("n-sk16", (1.61727, 1.62041, None, 1.62756, 1.63312), 1.1e-5),
        ("1.5", (1.5, 1.5, 1.5, 1.5, 1.5), 0.0),
    ],
)
def test_glasses_have_their_makers_indices(glass, lines, apart, lens_of):
    lens = lens_of(f"50 5 {glass} 20\n-50 0 1 20\n0 0 0 19\n")
    known = {line: n for line, n in zip((C_UM, D_UM, 0.54607, F_UM, G_UM), lines, strict=True) if n}
    assert [lens.indices(line)[1] for line in known] == pytest.approx(list(known.values()), abs=apart)
    assert lens.indices()[1] == lens.indices(D_UM)[1]
    assert (lens.indices(F_UM)[1] != lens.indices(C_UM)[1]) == (glass != "1.5")
    if "/" in glass:
        n_d, abbe, *partial = map(float, glass.split("/"))
        n_c, n_f, n_g = (lens.indices(line)[1] for line in (C_UM, F_UM, G_UM))
        assert (lens.indices()[1], (n_d - 1) / (n_f - n_c)) == pytest.approx((n_d, abbe), rel=1e-12)
        assert [(n_g - n_f) / (n_f - n_c)] * len(partial) == pytest.approx(partial, rel=1e-9)


def test_indices_and_dispersions_of_the_catalogue_are_those_of_glasses():
    assert len(catalogue()) > 100
    for name, glass in catalogue().items():
        n_c, n_d, n_f, n_g = map(glass.index, (C_UM, D_UM, F_UM, G_UM))
        assert glass.name == name and 1.4 < n_d < 2.1
        assert 15 < (n_d - 1) / (n_f - n_c) < 100 and 0.5 < (n_g - n_f) / (n_f - n_c) < 0.7


@pytest.mark.parametrize(
    "text",
    [
        *(SINGLET, ASPHERE),
        *(f"{front} 20\n-40 2 1 20\n0 0 0 10\n" for front in ("40 3 1.52/64/0.53", "inf 3 1.5")),
        *(f"40 3 1.5 20\ninf 3 {index} 12 stop\n-40 2 1 20\n" for index in (1.5, 1.6)),
        "glass MINE 1.04 0.23 1.01 0.006 0.02 103.56\n40 3 N-SK15 20\n0 1 0 9\n-90 2 MINE 20\n-40 2 1 20\n",
    ],
)
def test_lines_are_read_back_as_the_same_lens(text, lens_of):
    lens = lens_of(f"# source: a test\n{text}")
    again = lens_of("\n".join(lens.lines()))
    assert (again.surfaces, again.stop, lens.source) == (lens.surfaces, lens.stop, "a test")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("50 5 1.5 20\n0 1 0\n", r"line 2: expected the columns radius thickness index diameter, got 3"),
        ("50 5 1.5 20\n0 1 0 18\n-50 x 1 20\n", r"line 3: thickness: expected a number, got 'x'"),
        ("50 5 1.5/60/0.5/2 20\n", r"line 1: index: expected a number, index/V, index/V/P_gF or a glass"),
        ("50 5 1.5/1e-9 20\n", r"line 1: the Abbe number must be at least 1"),
        ("50 5 1.5/60/1.5 20\n", r"line 1: .*P_gF between 0 and 1, got 1.5/60/1.5"),
        ("50 5 0.9 20\n", r"line 1: glass 0.9 has no refractive index from 1 to 5"),
        ("50 -5 1.5 20\n", r"line 1: thickness must be a number from 0 to"),
        ("# comment\n50 5 1.5 0\n", r"line 2: diameter must be a number from 0.001 to"),
        ("1e-300 5 1.5 20\n", r"line 1: radius must be inf, or 0.001 to 1e\+07 mm long"),
        ("0 1 0 18\n0 1 0 18\n", r"line 2: radius: a second stop"),
        ("50 5 1.5 20\n0 1 1.7 18\n", r"line 2: index: the stop does not change the index"),
        ("50 5 1.5 20\n-50 0 1 20\n", r"no aperture stop among 2 surfaces"),
        ("50 5 1.5 20 A5=1\n", r"line 1: behind the columns expected stop, k=NUMBER or A2=NUMBER to A16=.*got 'A5=1'"),
        ("50 5 1.5 20 k=inf\n", r"line 1: conic constant must be a number from -1e\+06 to"),
        ("50 5 BK88 20\n", r"line 1: no glass 'BK88' in the catalogues of SCHOTT, .*; define it by"),
        ("glass X 1 2 3\n", r"line 1: expected glass NAME B1 B2 B3 C1 C2 C3, got 'X 1 2 3'"),
        ("glass X 30 0 0 0.01 0.02 90\n", r"line 1: glass X has no refractive index from 1 to 5 at 0.4 um"),
        ("glass X nan 0 0 0.01 0.02 90\n", r"line 1: glass X must have six finite coefficients"),
        *((f"50 5 1.5 20 {words}\n", "line 1: (A16|A2|conic constant) must")
          for words in ("A2=1e308", "A2=1e300 A4=-1e300", "k=1e300", "A16=1e308")),
        ("50 5 1.5 20\n0 1 0 18\n", r"the index behind the last surface must be 1"),
        ("50 5 1.5 20\n" * 2000 + "0 1 0 18\n-50 0 1 20\n", "line 1001: a lens has at most 1000 surfaces"),
    ],
)  # fmt: skip
def test_wrong_prescription_is_refused_with_file_line_and_column(lens_of, text, message):
    with pytest.raises(ValueError, match=rf"lens\.txt: {message}"):
        lens_of(text)


def test_impossible_lenses_are_refused_by_name(lens_of):
    with pytest.raises(FileNotFoundError, match=r"double_gauss_50mm, telephoto_250mm, wide_22mm"):
        Lens.read("triplet")
    with pytest.raises(ValueError, match="does not converge light"):
        lens_of("-50 5 1.5 20\n0 1 0 18\n50 0 1 20\n").paraxial()
    with pytest.raises(ValueError, match="'lens' bends light beyond measure"):
        focus_sensor(lens_of("0.001 1e7 4.9 20\n-0.001 1e7 1 20\n" * 30 + "-50 3 1 20\n0 0 0 15"), 2.0)


test_absurd_numbers_are_refused = refuses(
    *((partial(Glass, "x", six), "glass x must have six finite coefficients")
      for six in (("a",) * 6, None, (10**400,) * 6, (True,) * 6, (1.0,) * 5, (math.nan,) * 6)),
    *((partial(catalogue()["N-BK7"].index, um), "wavelength_um must be a number of micrometres")
      for um in (None, "red", 10**400, math.nan, 0.0, -1.0)),
    (partial(replace, Lens.read("double_gauss_50mm").surfaces[0], radius=10**400), "radius must be inf"),
)  # fmt: skip
