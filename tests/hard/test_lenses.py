"""Numbers that are finite but absurd, in lenses, openings, fields and depth maps, are refused by name or do no harm."""

import base64
import math
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from matplotlib.figure import Figure
from torch import Tensor

from torchdof import BlurTable, blur_by_coc
from torchdof.cli.fitted import Shown
from torchdof.cli.main import app
from torchdof.fit import FitError
from torchdof.fit.lens.glass import Glass
from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.spot import focus_sensor, point_spread
from torchdof.fit.photo.dot import find_dot
from torchdof.io.images import Picture, write_image
from torchdof.optics.aperture import Aperture
from torchdof.optics.field import Field
from torchdof.render.edges import repair

pytestmark = pytest.mark.hard

HUGE = 10**400
SINGLET = "50 5 1.5 20 {}\n-50 3 1 20\n0 0 0 {}"


def field_table(**change: Any) -> BlurTable:
    given = {
        "coc": torch.tensor([-0.4, 0.1, 0.5], dtype=torch.float64),
        "radius": torch.tensor([0.0, 9.0, 20.0], dtype=torch.float64),
        "box": torch.tensor([0.0, 0.3, 0.3]).expand(3, 3, 3),
        "light": torch.rand(3, 3, 6, 4) + 0.1,
    }
    field = Field(**{**given, **change})
    return BlurTable("gaussian", [-0.4, 0.5], {"sigma": [0.2, 0.2]}, unit="mm", sensor_width_mm=36.0, field=field)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"box": torch.full((3, 3, 3), 1e38)}, r"field\.box must be lengths in the unit of field\.coc"),
        ({"box": torch.tensor([1e9, 0.1, 0.1]).expand(3, 3, 3)}, r"field\.box must be lengths"),
        ({"coc": torch.tensor([-1e-300, 0.0, 1e-300], dtype=torch.float64)}, r"field\.coc must reach somewhere"),
        ({"coc": torch.tensor([-1.0, 0.0, 1e300], dtype=torch.float64)}, r"field\.coc must reach somewhere"),
        ({"radius": torch.tensor([0.0, 1.0, 1e300], dtype=torch.float64)}, r"field\.radius must reach somewhere"),
    ],
)
def test_fields_beyond_any_lens_are_refused(change: dict[str, Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        field_table(**change)


@pytest.mark.parametrize("engine", ["torch", "native"])
@pytest.mark.parametrize("box", [1e-300, 1e-3, 1e3])
def test_fields_at_the_ends_of_what_is_taken_make_pictures(
    box: float, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    table = field_table(box=torch.full((3, 3, 3), box, dtype=torch.float64))
    out = blur_by_coc(torch.rand(1, 3, 9, 12), torch.linspace(-3, 4, 12).expand(1, 1, 9, 12), table=table)
    assert 0.0 <= float(out.min()) <= float(out.max()) <= 1.0 + 1e-5


def test_a_field_that_inflates_without_end_is_refused() -> None:
    data = field_table().field.to_dict()  # type: ignore[union-attr]
    bomb = base64.b64encode(zlib.compress(bytes(10**7), 9)).decode()
    with pytest.raises(ValueError, match="must hold 432 bytes"):
        Field.from_dict({**data, "light": bomb})
    with pytest.raises(ValueError, match="five numbers of cells"):
        Field.from_dict({**data, "light": bomb, "shape": [1, 3, 3, 5000, 5000]})


@pytest.mark.parametrize("name", ["blades", "rotation_deg", "curvature", "squeeze", "vignetting"])
def test_openings_of_a_number_of_400_digits_are_refused(name: str) -> None:
    given: dict[str, Any] = {"blades": 5, name: HUGE}
    with pytest.raises(ValueError, match=name):
        Aperture(**given)


@pytest.mark.parametrize(
    ("family", "params"),
    [
        ("radial", {"values": [[1.0, 1e308, 1.0]], "radius": [1.0]}),
        ("radial", {"values": [[0.0, 5e-324, 0.0]], "radius": [1.0]}),
        ("softm", {"radius": [1.0], "sigma": [0.1], "b": [1e308], "m": [4.0]}),
    ],
)
def test_profiles_whose_sums_overflow_are_refused(family: str, params: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"params\.(values|b) must"):
        BlurTable(family, [1.0], params)


@pytest.mark.parametrize("sellmeier", [("a",) * 6, None, (HUGE,) * 6, (True,) * 6, (1.0,) * 5, (math.nan,) * 6])
def test_coefficients_that_are_none_are_refused(sellmeier: Any) -> None:
    with pytest.raises(ValueError, match="glass x must have six finite coefficients"):
        Glass("x", sellmeier)


@pytest.mark.parametrize("wavelength", [None, "red", HUGE, math.nan, 0.0, -1.0])
def test_wavelengths_that_are_none_are_refused(wavelength: Any) -> None:
    with pytest.raises(ValueError, match="wavelength_um must be a number of micrometres"):
        Glass.named("N-BK7").index(wavelength)
    with pytest.raises(ValueError, match="no glass"):
        Glass.named(wavelength)


@pytest.mark.parametrize("words", ["A2=1e308", "A2=1e300 A4=-1e300", "k=1e300", "A16=1e308"])
def test_surfaces_beyond_any_lens_are_refused_without_a_warning(words: str, tmp_path: Path) -> None:
    (tmp_path / "lens.txt").write_text(SINGLET.format(words, 15))
    with pytest.raises(ValueError, match="lens.txt: line 1: (A16|A2|conic constant) must"):
        Lens.read(tmp_path / "lens.txt")


def test_a_stack_of_lenses_that_bends_light_beyond_measure_is_refused_without_a_warning(tmp_path: Path) -> None:
    (tmp_path / "lens.txt").write_text("0.001 1e7 4.9 20\n-0.001 1e7 1 20\n" * 30 + "-50 3 1 20\n0 0 0 15")
    with pytest.raises(ValueError, match="lens 'lens' bends light beyond measure"):
        focus_sensor(Lens.read(tmp_path / "lens.txt"), 2.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"z_m": 1e300}, "at most 1e\\+12 m away"),
        ({"field_mm": 1e300}, "field_mm"),
        ({"field_mm": math.nan}, "field_mm"),
        ({"rays": 10**12}, "rays must be a whole number from 16 to 100000000, got 1000000000000"),
        ({"rays": 16.5}, "rays must be"),
    ],
)
def test_spots_of_absurd_places_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        point_spread(Lens.read("double_gauss_50mm"), **{"z_m": 1.0, "sensor_mm": 38.0, "rays": 100, **change})


def step(near: float, far: float) -> Tensor:
    """A map of nearness in which a square stands out, displaced by a pixel against that of the image."""
    nearness = torch.full((1, 1, 24, 32), far)
    nearness[..., 6:18, 9:21] = near
    return nearness


@pytest.mark.parametrize("auto", [True, False])
@pytest.mark.parametrize("engine", ["torch", "native"])
@pytest.mark.parametrize(
    "case",
    [
        (step(3e38, 1.0), 1.0),
        (step(1e16, -1e16), 1.0),
        (step(1e14, -1e14), 1.0),
        (step(3e38, -3e38), 1.0),
        (step(4.0, 1.0), 3e38),
        (step(4.0, 1.0), 1e-45),
        (step(math.nan, 1.0), 1.0),
    ],
    ids=["3e38", "1e16", "1e14", "both ends", "bright", "dark", "unknown"],
)
def test_repairs_of_maps_and_light_of_any_size_stay_finite(
    case: tuple[Tensor, float], engine: str, auto: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    nearness, light = case
    image = torch.full((1, 3, 24, 32), 0.1 * light)
    image[..., 6:18, 8:20] = light
    mended = repair(image, nearness, torch.tensor(1.0), auto)
    known = torch.isfinite(nearness)
    assert torch.equal(torch.isfinite(mended), known)
    assert float(mended[known].abs().max()) <= 1.001 * float(nearness[known].abs().max())
    beyond = nearness.abs() > 1e15
    assert torch.equal(mended[beyond], nearness[beyond])


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (8, 8)])
def test_pictures_too_small_for_a_dot_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(FitError, match="a picture of a dot must be .* at least 9 pixels on a side"):
        find_dot(np.random.default_rng(0).random(size), file="dot.png")


@pytest.mark.parametrize("focus", ["0", "-1", "nan", "0.02"])
def test_the_command_line_refuses_a_focus_within_the_lens(focus: str, tmp_path: Path) -> None:
    arguments = ["fit", "--lens", "wide_22mm", "-o", str(tmp_path / "table.json"), "--focus-m", focus]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2 and "--focus-m must be a number of metres" in done.output


def test_a_root_holds_photographs_without_a_description_as_well(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    (tmp_path / "elsewhere").mkdir()
    for number in range(2):
        write_image(tmp_path / "elsewhere" / f"{number}.png", Picture(torch.rand(1, 3, 40, 40)))
        os.symlink(tmp_path / "elsewhere" / f"{number}.png", tmp_path / "photographs" / f"{number}.png")
    call = ["fit", str(tmp_path / "photographs"), "-o", str(tmp_path / "table.json"), "--root"]
    said: Callable[[Path], str] = lambda root: CliRunner().invoke(app, [*call, str(root)]).output  # noqa: E731
    assert "lies outside of" in said(tmp_path / "photographs")
    assert "show the target" in said(tmp_path)


def test_a_plot_that_cannot_be_finished_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_disk(_: Figure, path: Path) -> None:
        Path(path).write_bytes(b"half of a picture")
        raise OSError("No space left on device")

    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(OSError, match="No space left"):
        Shown(quiet=True).draw(BlurTable.disc(), tmp_path, "disc")
    assert not list(tmp_path.iterdir())
