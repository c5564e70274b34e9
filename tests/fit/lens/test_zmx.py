import numpy as np
import pytest

from torchdof.fit.lens.catalogues import _MAKERS, _pages, named_glass
from torchdof.fit.lens.glass import C_UM, D_UM, F_UM

HEAD = "VERS 140124 258 36214\nMODE SEQ\nNAME A lens of a test\nUNIT {} X W X CM MR CPMM\n"
SINGLET = """SURF 0
  DISZ INFINITY
SURF 1
  CURV 0.0
  DISZ 3
SURF 2
  TYPE EVENASPH
  CURV 0.02 0 0 0 0 ""
  PARM 1 0
  PARM 2 -1.5e-6
  PARM 3 2e-10
  CONI -0.4
  DISZ 5
  GLAS N-BK7 0 0 1.5168 64.17 0
  DIAM 10 1 0 0 1 ""
SURF 3
  STOP
  TYPE STANDARD
  CURV -0.02
  DISZ 90
  CLAP 0 8 0
  DIAM 9
SURF 4
  DISZ -2
SURF 5
  DISZ 0
"""


@pytest.mark.parametrize(
    ("written", "glass", "encoding"),
    [
        ("N-BK7", "N-BK7", "utf-8"),
        ("S-BSL7", "S-BSL7", "utf-16"),
        ("N-BK7", "N-BK7", "utf-16-le"),  # without a byte order mark
    ],
)
def test_asphere_glass_curved_stop_and_clear_aperture_are_read(written, glass, encoding, lens_of):
    lens = lens_of((HEAD.format("MM") + SINGLET).replace("N-BK7", written), "lens.zmx", encoding)
    same = lens_of(f"50 5 {glass} 20 k=-0.4 A4=-1.5e-6 A6=2e-10\n-50 0 1 16 stop\n")
    assert lens.lines() == same.lines() and lens.surfaces[0].glass == same.surfaces[0].glass
    remark = "; S-BSL7 is OHARA's of 1.51633" if glass == "S-BSL7" else ""
    assert (lens.stop, lens.name, lens.source) == (1, "lens", f"Zemax file: A lens of a test{remark}")


@pytest.mark.parametrize(
    ("fields", "catalogues", "index", "abbe"),  # index and Abbe number of the makers' data sheets
    [
        ("S-LAH64 0 0 1.5 40 0", "SCHOTT OHARA", 1.78800, 47.37),
        ("S-LAH64 0 0 1.6 30 0", "", 1.78800, 47.37),  # numbers of an earlier choice
        ("s-lah64", "", 1.78800, 47.37),
        ("BK7 0 0 1.5 4.0E+1", "OLD_SCHO", 1.51680, 64.17),
        ("BSL7 0 0 1.5 40", "OHARA", 1.51633, 64.14),
        ("SK16 0 0 1.5 40", "SCHOTT", 1.62041, 60.32),
        ("N-LAK9 0 0 1.5 40", "SCHOTT", 1.69100, 54.71),
        ("H-K9L 0 0 1.5 40", "CDGM", 1.51680, 64.20),
        ("E-FD4 0 0 1.5 40", "HOYA", 1.75520, 27.53),
        ("SK16 0 0 1.5 40", "HOYA\nGCAT HIKARI", 1.62041, 60.25),
        ("F1 0 0 1.5 40", "SCHOTT\nGCAT CDGM", 1.60342, 38.01),
        ("F1 0 0 1.5 40", "CDGM\nGCAT SCHOTT", 1.60342, 38.01),
        ("J-SK16 0 0 1.5 40", "NIKON-HIKARI", 1.62041, 60.25),
        ("SILICA 0 0 1.5 40", "MISC", 1.45847, 67.82),
        ("B270 0 0 1.5 40", "MISC", 1.5230, 58.6),
        ("CAF2 0 0 1.5 40", "INFRARED", 1.43385, 95.0),
        ("___BLANK 1 0 1.788 47.4 0", "SCHOTT", 1.788, 47.4),
    ],
)
def test_a_glass_by_name_has_its_makers_index_and_not_the_placeholder(fields, catalogues, index, abbe, lens_of):
    text = (HEAD.format("MM") + f"GCAT {catalogues}\n" + SINGLET).replace("N-BK7 0 0 1.5168 64.17 0", fields)
    n_d, n_f, n_c = (lens_of(text, "lens.zmx").indices(um)[1] for um in (D_UM, F_UM, C_UM))
    assert n_d == pytest.approx(index, abs=5e-5)
    assert (n_d - 1) / (n_f - n_c) == pytest.approx(abbe, rel=3e-3)


def test_glasses_of_every_maker_have_a_dispersion_of_glass():
    count = 0
    for maker, (books, _) in _MAKERS.items():
        for book in books:
            for name in _pages(book).values():
                try:
                    glass, found_maker = named_glass(name, [maker])
                except ValueError as error:
                    assert "not for visible light" in str(error)  # noqa: PT017
                    continue
                n_c, n_d, n_f = map(glass.index, (C_UM, D_UM, F_UM))
                assert found_maker == maker and 1.4 < n_d < 2.2 and 14 < (n_d - 1) / (n_f - n_c) < 100, name
                count += 1
    assert count > 1000


@pytest.mark.parametrize(
    ("name", "encoding"), [("Größe", "latin-1"), ("レンズ 一号", "cp932"), ("镜头", "gbk"), ("Größe", "utf-8")]
)
def test_names_in_any_encoding_do_not_change_the_lens(name, encoding, lens_of):
    text = (HEAD.format("MM") + SINGLET).replace("A lens of a test", name)
    same = lens_of(HEAD.format("MM") + SINGLET, "lens.zmx")
    lens = lens_of(text, "lens.zmx", encoding)
    assert lens.lines() == same.lines() and lens.source == f"Zemax file: {name}"


def test_inches_are_millimetres_times_25_4(lens_of):
    inches, mm = (lens_of(HEAD.format(unit) + SINGLET, "lens.zmx") for unit in ("IN", "MM"))
    assert inches.paraxial().focal_length == pytest.approx(25.4 * mm.paraxial().focal_length, rel=1e-12)
    square = np.linspace(0.0, 9.0, 7) ** 2
    for one, other in zip(inches.surfaces, mm.surfaces, strict=True):
        assert (one.radius, one.thickness, one.diameter) == pytest.approx(
            (25.4 * other.radius, 25.4 * other.thickness, 25.4 * other.diameter), rel=1e-9
        )
        np.testing.assert_allclose(one.sag(25.4**2 * square)[0], 25.4 * other.sag(square)[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MODE SEQ", "MODE NSC", r"a sequential lens was expected \(MODE SEQ\), got 'MODE NSC'"),
        ("UNIT MM", "UNIT FURLONG", "UNIT must be one of MM, CM, IN, METER, got 'FURLONG'"),
        ("NAME", "MNUM 3\nNAME", "one configuration was expected, got 3"),
        ("TYPE EVENASPH", "TYPE COORDBRK", "surface 2: TYPE must be STANDARD or EVENASPH, got COORDBRK"),
        ("GLAS N-BK7 0 0 1.5168", "GLAS MIRROR 0 0 1.5168", "surface 2: mirrors are not traced"),
        ("GLAS N-BK7 0", "GLAS S-NICE 0", "surface 2: no glass 'S-NICE' in the catalogues of SCHOTT, OHARA, .*model"),
        ("GLAS N-BK7 0", "GLAS F1 0", "surface 2: glass F1 is a different one for each of HIKARI .*, CDGM"),
        ("GLAS N-BK7 0", "GLAS N-BK7 2", "surface 2: expected a glass by name, or a model glass with its numbers"),
        ("GLAS N-BK7 0", "GLAS ___BLANK 0", "surface 2: expected a glass by name, or a model glass with its numbers"),
        ("  CLAP 0 8 0", "  OBSC 0 2", "surface 3: only round apertures without obstruction are read, got OBSC"),
        ("CURV 0.02 0", "CURV x 0", "surface 2: CURV: expected a number, got 'x'"),
        ("  DIAM 10 1", "  MEMA 10 1", r"surface 2: no clear semi-diameter \(DIAM\)"),
        ("  STOP\n", "", r"expected one stop \(STOP\) among the surfaces of the lens, got 0"),
        (SINGLET, "SURF 0\n", "expected an object, surfaces of a lens and an image"),
        ("DISZ 5", "DISZ -5", "surface 2: thickness must be a number from 0"),
    ],
)
def test_unsupported_zmx_files_are_refused(old, new, message, lens_of):
    text = HEAD.format("MM") + SINGLET
    assert old in text
    with pytest.raises(ValueError, match=rf"lens\.zmx: {message}"):
        lens_of(text.replace(old, new), "lens.zmx")
