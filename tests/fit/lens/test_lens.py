import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from torchdof.fit.lens.glass import C_UM, D_UM, F_UM, Glass, _catalogue
from torchdof.fit.lens.lens import Lens

FACTS = {
    "double_gauss_50mm": (50.3582, 36.1059),
    "wide_22mm": (22.0235, 14.3183),
    "telephoto_250mm": (249.5666, 105.0704),
}
SINGLET = "50 5 1.5168/64.17 20\n0 1 0 18\n-50 0 1 20\n"


def lens_from(tmp_path: Path, text: str) -> Lens:
    path = tmp_path / "lens.txt"
    path.write_text(text, encoding="utf-8")
    return Lens.read(path)


@pytest.mark.parametrize("name", FACTS)
def test_paraxial_focal_length_and_back_focal_distance_are_the_designs(name: str) -> None:
    first = Lens.read(name).paraxial()
    assert (first.focal_length, first.back_focal) == pytest.approx(FACTS[name], abs=1e-4)


def test_principal_planes_and_focal_points_are_a_focal_length_apart() -> None:
    for name in FACTS:
        first = Lens.read(name).paraxial()
        assert first.back_focal - first.rear_principal == pytest.approx(first.focal_length, rel=1e-12)
        assert first.front_principal - first.front_focal == pytest.approx(first.focal_length, rel=1e-12)


def test_thick_lens_agrees_with_the_lensmakers_equation(tmp_path: Path) -> None:
    lens = lens_from(tmp_path, "0 0 0 18\n60 8 1.6 20\n-90 0 1 20\n")
    power = 0.6 * (1 / 60 + 1 / 90 - 0.6 * 8 / (1.6 * 60 * 90))
    first = lens.paraxial()
    assert first.focal_length == pytest.approx(1 / power, rel=1e-12)
    assert first.back_focal == pytest.approx((1 - 0.6 * 8 / (1.6 * 60)) / power, rel=1e-12)
    # a stop before all glass is its own entrance pupil
    assert (first.entrance_pupil, first.entrance_pupil_diameter) == pytest.approx((0.0, 18.0))


def test_stop_may_be_a_curved_surface_of_glass(tmp_path: Path) -> None:
    front = lens_from(tmp_path, "40 3 1.5 10 stop\n-40 2 1 20\n").paraxial()
    assert (front.entrance_pupil, front.entrance_pupil_diameter) == (0.0, 10.0)
    # on the rear surface it is seen through the front one: 1.5 / 3 - power = 1 / distance, power = 0.5 / 40
    lens = lens_from(tmp_path, "40 3 1.5 20\n-40 2 1 10 stop\n")
    rear, seen = lens.paraxial(), 1 / (1.5 / 3 - 0.5 / 40)
    assert rear.entrance_pupil == pytest.approx(seen, rel=1e-12)
    assert rear.entrance_pupil_diameter == pytest.approx(10.0 * seen * 1.5 / 3, rel=1e-12)
    assert rear.exit_pupil == 0.0
    assert lens.with_f_number(8.0).diameter.tolist() == [20.0, pytest.approx(10.0 * rear.f_number / 8.0)]


def test_pupils_are_images_of_each_other() -> None:
    for name in FACTS:
        lens = Lens.read(name)
        first = lens.paraxial()
        v = first.exit_pupil - first.rear_principal
        u = first.front_principal - first.entrance_pupil
        # object distance u before H, image distance v behind H'
        assert 1 / u + 1 / v == pytest.approx(1 / first.focal_length, rel=1e-9)
        magnification = first.exit_pupil_diameter / first.entrance_pupil_diameter
        assert abs(v / u) == pytest.approx(magnification, rel=1e-9)


def test_stop_sets_the_f_number() -> None:
    lens = Lens.read("double_gauss_50mm")
    for f_number in (2.8, 8.0):
        assert lens.with_f_number(f_number).paraxial().f_number == pytest.approx(f_number, rel=1e-12)
    assert lens.with_stop(lens.diameter[lens.stop] / 2).paraxial().f_number == pytest.approx(
        2 * lens.paraxial().f_number, rel=1e-12
    )


def test_marked_f_number_means_fully_open_and_a_faster_one_is_refused() -> None:
    lens = Lens.read("double_gauss_50mm")
    assert lens.with_f_number(2.0).diameter[lens.stop] == 17.1
    with pytest.raises(ValueError, match=r"f_number must be at least 2\.03.*got 1\.8"):
        lens.with_f_number(1.8)


def test_scaling_keeps_the_f_number() -> None:
    lens = Lens.read("double_gauss_50mm")
    first, scaled = lens.paraxial(), lens.scaled(100.0).paraxial()
    assert scaled.focal_length == pytest.approx(100.0, rel=1e-12)
    assert scaled.f_number == pytest.approx(first.f_number, rel=1e-12)


def test_abbe_number_is_the_dispersion_between_c_and_f(tmp_path: Path) -> None:
    lens = lens_from(tmp_path, SINGLET)
    n_c, n_d, n_f = (lens.indices(at)[1] for at in (C_UM, D_UM, F_UM))
    assert n_d == pytest.approx(1.5168, abs=1e-12)
    assert (n_d - 1) / (n_f - n_c) == pytest.approx(64.17, rel=1e-12)
    assert (n_c, n_f) == pytest.approx((1.51432, 1.52238), abs=5e-5)  # BK7's catalogue; two terms of Cauchy: 2e-4
    assert lens.dispersive and not Lens.read("wide_22mm").dispersive


@pytest.mark.parametrize(
    ("glass", "lines"),  # catalogue: C, e, F, g
    [
        ("1.51680/64.17/0.5349", (1.51432, 1.51872, 1.52238, 1.52668)),  # N-BK7
        ("1.62004/36.37/0.5828", (1.61503, 1.62408, 1.63208, 1.64202)),  # F2
        ("1.80518/25.43/0.6092", (1.79609, 1.81265, 1.82775, 1.84707)),  # SF6
    ],
)
def test_three_numbers_of_a_catalogue_give_the_index_at_every_line(
    glass: str, lines: tuple[float, ...], tmp_path: Path
) -> None:
    lens = lens_from(tmp_path, f"50 5 {glass} 20\n-50 0 1 20\n0 0 0 19\n")
    found = [float(lens.indices(at)[1]) for at in (C_UM, 0.54607, F_UM, 0.43584)]
    assert found == pytest.approx(lines, abs=1.5e-4)


@pytest.mark.parametrize(
    ("glass", "lines"),  # SCHOTT's data sheets: C, d, F, g
    [
        ("N-BK7", (1.51432, 1.51680, 1.52238, 1.52668)),
        ("F2", (1.61503, 1.62004, 1.63208, 1.64202)),
        ("N-SK16", (1.61727, 1.62041, 1.62756, 1.63312)),
    ],
)
def test_glass_of_the_catalogue_has_its_makers_indices_to_the_last_digit(
    glass: str, lines: tuple[float, ...], tmp_path: Path
) -> None:
    lens = lens_from(tmp_path, f"50 5 {glass} 20\n-50 0 1 20\n0 0 0 19\n")
    found = [float(lens.indices(at)[1]) for at in (C_UM, D_UM, F_UM, 0.43584)]
    assert found == pytest.approx(lines, abs=1.1e-5)
    assert lens.indices()[1] == lens.indices(D_UM)[1] and lens.dispersive


def test_catalogue_is_that_of_glasses() -> None:
    assert len(_catalogue()) > 100
    for name, glass in _catalogue().items():
        assert (
            glass.name == name and 1.4 < glass.index(D_UM) < 2.1 and 15 < glass.abbe < 100 and 0.5 < glass.partial < 0.7
        )


def test_index_beyond_what_a_glass_lets_pass_is_refused() -> None:
    with pytest.raises(ValueError, match="glass N-BK7 has no refractive index from 1 to 5 at 0.14 um"):
        Glass.named("n-bk7").index(0.14)


def test_glass_beside_a_surface_is_refused() -> None:
    lens = Lens.read("wide_22mm")
    for wrong in ((Glass.named("F2"),), ("F2",) * len(lens.radius)):
        with pytest.raises(ValueError, match="glass must hold one Glass or None a surface"):
            dataclasses.replace(lens, glass=wrong)


def test_crown_and_flint_bring_red_and_blue_together(tmp_path: Path) -> None:
    # powers in the ratio of the Abbe numbers: 0.01 V1 / (V1 - V2) and -0.01 V2 / (V1 - V2)
    text = "44.78 4 1.5168/64.17 20\n-44.78 2 1.6200/36.37 20\n-811 1 1 20\n0 0 0 19\n"
    doublet, singlet = lens_from(tmp_path, text), lens_from(tmp_path, SINGLET)
    shift = [(lens.paraxial(C_UM).back_focal - lens.paraxial(F_UM).back_focal) for lens in (doublet, singlet)]
    assert abs(shift[0]) < 0.1 * shift[1]


def test_lines_are_read_back_as_the_same_lens(tmp_path: Path) -> None:
    for text in (
        SINGLET,
        "40 3 1.52/64/0.53 20\n-40 2 1 20\n0 0 0 10\n",
        "inf 3 1.5 20\n-40 2 1 20\n0 0 0 10\n",
        "40 3 1.5 20 stop k=-0.6 A4=1.2e-06 A10=-3e-13\n-40 2 1 20 A2=0.001\n",
        "40 3 1.5 20\ninf 3 1.5 12 stop\n-40 2 1 20\n",
        "glass MINE 1.04 0.23 1.01 0.006 0.02 103.56\n40 3 N-SK15 20\n0 1 0 9\n-90 2 MINE 20\n-40 2 1 20\n",
    ):
        lens = lens_from(tmp_path, text)
        again = lens_from(tmp_path, "\n".join(lens.lines()))
        for name in ("radius", "thickness", "index", "abbe", "partial", "diameter", "conic", "polynomial"):
            np.testing.assert_array_equal(getattr(again, name), getattr(lens, name))
        assert (again.stop, again.glass) == (lens.stop, lens.glass)


def test_scaling_an_asphere_keeps_its_shape(tmp_path: Path) -> None:
    lens = lens_from(tmp_path, "40 3 1.5 20 stop k=-0.6 A4=1.2e-06 A6=-3e-09\n-40 2 1 20\n")
    scaled = lens.scaled(2.5 * lens.paraxial().focal_length)
    r = np.linspace(0.0, 9.0, 7)
    np.testing.assert_allclose(scaled.shape(0).sag(6.25 * r * r)[0], 2.5 * lens.shape(0).sag(r * r)[0], rtol=1e-12)


def test_polynomial_of_r_squared_is_a_curvature(tmp_path: Path) -> None:
    sphere, asphere = (
        lens_from(tmp_path, f"{front} 3 1.5 20\n-40 2 1 20\n0 0 0 10\n") for front in ("50", "inf 3 1.5 20 A2=0.01 #")
    )
    assert asphere.paraxial().focal_length == pytest.approx(sphere.paraxial().focal_length, rel=1e-12)


def test_source_is_kept() -> None:
    assert "2,673,491" in Lens.read("double_gauss_50mm").source


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("50 5 1.5 20\n0 1 0\n", r"line 2: expected the columns radius thickness index diameter, got 3"),
        ("50 5 1.5 20\n0 1 0 18\n-50 x 1 20\n", r"line 3, column thickness: expected a number, got 'x'"),
        ("50 5/2 1.5 20\n", r"line 1, column thickness: expected a number, got '5/2'"),
        ("50 5 1.5/ 20\n", r"line 1, column index: expected a number, index/V, index/V/P_gF or a glass, got '1.5/'"),
        ("50 5 1.5/-3 20\n", r"line 1, column index: the Abbe number must be positive"),
        ("50 5 0.9 20\n", r"line 1, column index: index must be between 1 and 5"),
        ("50 5 0 20\n", r"line 1, column index: index must be between 1 and 5"),
        ("50 -5 1.5 20\n", r"line 1, column thickness: thickness must be >= 0"),
        ("# comment\n50 5 1.5 0\n", r"line 2, column diameter: diameter must be positive"),
        ("nan 5 1.5 20\n", r"line 1, column radius: radius must be a number"),
        ("0 1 0 18\n0 1 0 18\n", r"line 2, column radius: a second stop"),
        ("50 5 1.5 20\n0 1 1.7 18\n", r"line 2, column index: the stop does not change the index"),
        ("50 5 1.5 20\n-50 0 1 20\n", r"no aperture stop among 2 surfaces"),
        ("50 5 1.5 20 stop\n0 1 0 18\n", r"line 2, column radius: a second stop"),
        ("50 5 1.5 20 A5=1\n", r"line 1: behind the columns expected stop, k=NUMBER or A2=NUMBER to A16=.*got 'A5=1'"),
        ("50 5 1.5 20 k=x\n", r"line 1: behind the columns expected .* got 'k=x'"),
        (
            "50 5 BK8 20\n",
            r"line 1, column index: no glass 'BK8' in the catalogue of SCHOTT; define it by",
        ),
        ("glass X 1 2 3\n", r"line 1: expected glass NAME B1 B2 B3 C1 C2 C3, got 'X 1 2 3'"),
        ("glass X 30 0 0 0.01 0.02 90\n", r"line 1: glass X has no refractive index from 1 to 5 at 0.4 um"),
        ("glass X nan 0 0 0.01 0.02 90\n", r"line 1: glass X must have six finite coefficients"),
        ("50 5 1.5 20 k=inf\n", r"line 1: k must be finite, got 'inf'"),
        ("", r"no aperture stop among 0 surfaces"),
        ("50 5 1.5 20\n0 1 0 18\n", r"the index behind the last surface must be 1"),
    ],
)
def test_wrong_prescription_is_refused_with_file_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        lens_from(tmp_path, text)
    assert "lens.txt" in str(caught.value)


def test_unknown_lens_lists_the_shipped_ones() -> None:
    with pytest.raises(FileNotFoundError, match=r"double_gauss_50mm, telephoto_250mm, wide_22mm"):
        Lens.read("triplet")


def test_diverging_lens_has_no_focal_length(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not converge light"):
        lens_from(tmp_path, "-50 5 1.5 20\n0 1 0 18\n50 0 1 20\n").paraxial()


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_wrong_numbers_are_refused(value: float) -> None:
    lens = Lens.read("wide_22mm")
    for change in (lens.with_f_number, lens.scaled):
        with pytest.raises(ValueError, match="must be positive and finite"):
            change(value)
    with pytest.raises(ValueError, match=r"surface 5: diameter must be positive"):
        lens.with_stop(value)
    with pytest.raises(ValueError, match="wavelength_um must be in micrometres"):
        lens.indices(value)


@pytest.mark.parametrize(
    "line",
    ["1e-300 5 1.5 20", "1e300 5 1.5 20", "50 1e300 1.5 20", "50 5 1.5 1e300", "50 5 1.5 1e-300", "50 5 1.5/1e-9 20"],
)
def test_numbers_that_are_finite_but_absurd_are_refused(tmp_path, line):
    (tmp_path / "x.txt").write_text(f"{line}\n0 1 0 18\n-50 0 1 20\n")
    with pytest.raises(ValueError, match=r"x\.txt: line 1, column "):
        Lens.read(tmp_path / "x.txt")


def test_a_prescription_of_endless_surfaces_is_refused(tmp_path):
    (tmp_path / "x.txt").write_text("50 5 1.5 20\n" * 2000 + "0 1 0 18\n-50 0 1 20\n")
    with pytest.raises(ValueError, match="line 1001: a lens has at most 1000 surfaces"):
        Lens.read(tmp_path / "x.txt")
