import math
from pathlib import Path

import numpy as np
import pytest

from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.spot import focus_sensor, point_spread

LENSES = ("double_gauss_50mm", "wide_22mm", "telephoto_250mm")
HEAD = "VERS 140124 258 36214\nMODE SEQ\nNAME A lens of a test\nUNIT {} X W X CM MR CPMM\n"
SINGLET = """SURF 0
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ INFINITY
  DIAM 0 0 0 0 1 ""
SURF 1
  TYPE STANDARD
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
  TYPE STANDARD
  CURV 0
  DISZ 0
"""


def as_zmx(lens: Lens) -> str:
    parts = [HEAD.format("MM"), "SURF 0\n  TYPE STANDARD\n  CURV 0\n  DISZ INFINITY\n"]
    for i, (radius, thickness, n, v, diameter) in enumerate(
        zip(lens.radius, lens.thickness, lens.index, lens.abbe, lens.diameter, strict=True)
    ):
        parts.append(f"SURF {i + 1}\n  TYPE STANDARD\n" + ("  STOP\n" if i == lens.stop else ""))
        parts.append(f"  CURV {1 / radius:.17g} 0 0\n  DISZ {thickness:.17g}\n  DIAM {diameter / 2:.17g} 1 0 0 1\n")
        parts.append(f"  GLAS ___BLANK 1 0 {n:.17g} {v if math.isfinite(v) else 0:.17g} 0\n" if n > 1 else "")
    return "".join(parts) + f"SURF {len(lens.radius) + 1}\n  TYPE STANDARD\n  CURV 0\n  DISZ 0\n"


def read(tmp_path: Path, text: str, encoding: str = "utf-8") -> Lens:
    (tmp_path / "lens.zmx").write_text(text, encoding=encoding)
    return Lens.read(tmp_path / "lens.zmx")


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_shipped_lens_written_as_zmx_is_read_as_itself(name: str, encoding: str, tmp_path: Path) -> None:
    lens = Lens.read(name)
    again = read(tmp_path, as_zmx(lens), encoding)
    for column in ("radius", "thickness", "index", "abbe", "diameter"):
        np.testing.assert_allclose(getattr(again, column), getattr(lens, column), rtol=1e-14)
    assert (again.stop, again.name, again.source) == (lens.stop, "lens", "Zemax file: A lens of a test")
    sensor = focus_sensor(lens, 2.0)
    spots = [point_spread(one, 1.0, sensor, meridional=True, rays=100).rms for one in (lens, again)]
    assert spots[0] == pytest.approx(spots[1], rel=1e-12)


def test_asphere_glass_curved_stop_and_clear_aperture_are_read(tmp_path: Path) -> None:
    lens = read(tmp_path, HEAD.format("MM") + SINGLET)
    (tmp_path / "same.txt").write_text("50 5 N-BK7 20 k=-0.4 A4=-1.5e-6 A6=2e-10\n-50 0 1 16 stop\n")
    same = Lens.read(tmp_path / "same.txt")
    assert lens.lines() == same.lines()
    assert lens.glass == same.glass and lens.stop == 1
    np.testing.assert_array_equal(lens.indices(0.48613), same.indices(0.48613))


def test_inches_are_millimetres_times_25_4(tmp_path: Path) -> None:
    inches, mm = (read(tmp_path, HEAD.format(unit) + SINGLET) for unit in ("IN", "MM"))
    scaled = mm.scaled(25.4 * mm.paraxial().focal_length)
    assert inches.paraxial().focal_length == pytest.approx(scaled.paraxial().focal_length, rel=1e-12)
    np.testing.assert_allclose(inches.polynomial, scaled.polynomial, rtol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MODE SEQ", "MODE NSC", r"a sequential lens was expected \(MODE SEQ\), got 'MODE NSC'"),
        ("UNIT MM", "UNIT FURLONG", "UNIT must be one of MM, CM, IN, METER, got 'UNIT FURLONG"),
        ("NAME", "MNUM 3\nNAME", "one configuration was expected, got 3"),
        ("TYPE EVENASPH", "TYPE COORDBRK", "surface 2: TYPE must be STANDARD or EVENASPH, got COORDBRK"),
        ("GLAS N-BK7 0 0 1.5168", "GLAS MIRROR 0 0 1.5168", "surface 2: mirrors are not traced"),
        ("GLAS N-BK7 0 0 1.5168 64.17 0", "GLAS S-NICE", "surface 2: glass S-NICE is not in the catalogue of SCHOTT"),
        ("  CLAP 0 8 0", "  OBSC 0 2", "surface 3: only round apertures without obstruction are read, got OBSC"),
        ("CURV 0.02 0", "CURV x 0", "surface 2: CURV must be a finite number, got 'x'"),
        ("  DIAM 10 1", "  MEMA 10 1", r"surface 2: no clear semi-diameter \(DIAM\)"),
        ("  STOP\n", "", r"expected one stop \(STOP\) among the surfaces of the lens, got 0"),
        (SINGLET, "SURF 0\n", "expected an object, surfaces of a lens and an image"),
        ("DISZ 5", "DISZ -5", "thickness must be >= 0"),
    ],
)
def test_what_is_no_such_lens_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = HEAD.format("MM") + SINGLET
    assert old in text
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, text.replace(old, new))
    assert "lens.zmx" in str(caught.value)


def test_glass_of_another_maker_has_the_files_index_and_abbe_number(tmp_path: Path) -> None:
    lens = read(tmp_path, (HEAD.format("MM") + SINGLET).replace("N-BK7", "S-BSL7"))
    assert (lens.index[0], lens.abbe[0], lens.glass) == (1.5168, 64.17, (None, None))
