import numpy as np
import pytest

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
        ("S-BSL7", "1.5168/64.17", "utf-16"),  # not in the catalogue
    ],
)
def test_asphere_glass_curved_stop_and_clear_aperture_are_read(written, glass, encoding, lens_of):
    lens = lens_of((HEAD.format("MM") + SINGLET).replace("N-BK7", written), "lens.zmx", encoding)
    same = lens_of(f"50 5 {glass} 20 k=-0.4 A4=-1.5e-6 A6=2e-10\n-50 0 1 16 stop\n")
    assert lens.lines() == same.lines() and lens.surfaces[0].glass == same.surfaces[0].glass
    assert (lens.stop, lens.name, lens.source) == (1, "lens", "Zemax file: A lens of a test")


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
        ("GLAS N-BK7 0 0 1.5168 64.17 0", "GLAS S-NICE", "surface 2: glass S-NICE is not in the catalogue of SCHOTT"),
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
