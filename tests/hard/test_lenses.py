"""Finite but absurd numbers in lenses, apertures, fields and depth maps are refused by name or do no harm."""

import base64
import functools
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
from torch import Tensor

from tests.refused import refuses
from tests.scenes import lens_with_a_field
from torchdof import BlurTable, blur_by_coc
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


@pytest.mark.parametrize("box", [1e-300, 1e-3, 1e3])
def test_fields_of_extreme_but_allowed_sizes_render(box: float, engine: str) -> None:
    table = lens_with_a_field(box=torch.full((4, 3, 3), box, dtype=torch.float64))
    out = blur_by_coc(torch.rand(1, 3, 9, 12), torch.linspace(-3, 4, 12).expand(1, 1, 9, 12), table=table)
    assert 0.0 <= float(out.min()) <= float(out.max()) <= 1.0 + 1e-5


def test_a_zip_bomb_in_a_field_is_refused() -> None:
    data = lens_with_a_field(colours=1).field.to_dict()  # type: ignore[union-attr]
    bomb = base64.b64encode(zlib.compress(bytes(10**7), 9)).decode()
    with pytest.raises(ValueError, match="must hold 1152 bytes"):
        Field.from_dict({**data, "light": bomb})
    with pytest.raises(ValueError, match="five numbers of cells"):
        Field.from_dict({**data, "light": bomb, "shape": [1, 4, 3, 5000, 5000]})


partial: Any = functools.partial


def field_of(**change: Any) -> Callable[[], Any]:
    return lambda: lens_with_a_field(**change)


def doubles(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def spot(**change: Any) -> Any:
    return point_spread(Lens.read("double_gauss_50mm"), **{"z_m": 1.0, "sensor_mm": 38.0, "rays": 100, **change})


ONE, BOX = {"radius": [1.0]}, torch.tensor([1e9, 0.1, 0.1]).expand(4, 3, 3)
DIGITS = ("blades", "rotation_deg", "curvature", "squeeze", "vignetting")
test_absurd_numbers_are_refused = refuses(
    (field_of(box=torch.full((4, 3, 3), 1e38)), r"field\.box must be lengths in the unit of field\.coc"),
    (field_of(box=BOX), r"field\.box must be lengths"),
    (field_of(coc=doubles(-1e-300, 0.0, 1e-301, 1e-300)), r"field\.coc must reach somewhere"),
    (field_of(coc=doubles(-1.0, 0.0, 1.0, 1e300)), r"field\.coc must reach somewhere"),
    (field_of(radius=doubles(0.0, 1.0, 1e300)), r"field\.radius must reach somewhere"),
    *((partial(Aperture, **{"blades": 5, name: HUGE}), name) for name in DIGITS),
    (lambda: BlurTable("radial", [1.0], {"values": [[1.0, 1e308, 1.0]], **ONE}), r"params\.values must"),
    (lambda: BlurTable("radial", [1.0], {"values": [[0.0, 5e-324, 0.0]], **ONE}), r"params\.values must"),
    (lambda: BlurTable("softm", [1.0], {**ONE, "sigma": [0.1], "b": [1e308], "m": [4.0]}), r"params\.b must"),
    *((partial(Glass, "x", six), "glass x must have six finite coefficients")
      for six in (("a",) * 6, None, (HUGE,) * 6, (True,) * 6, (1.0,) * 5, (math.nan,) * 6)),
    *((partial(Glass.named("N-BK7").index, um), "wavelength_um must be a number of micrometres")
      for um in (None, "red", HUGE, math.nan, 0.0, -1.0)),
    *((partial(Glass.named, name), "no glass") for name in (None, "red", HUGE, math.nan, 0.0)),
    (lambda: spot(z_m=1e300), r"at most 1e\+12 m away"),
    (lambda: spot(field_mm=1e300), "field_mm"),
    (lambda: spot(field_mm=math.nan), "field_mm"),
    (lambda: spot(rays=10**12), "rays must be a whole number from 16 to 100000000, got 1000000000000"),
    (lambda: spot(rays=16.5), "rays must be"),
    *((partial(find_dot, np.random.default_rng(0).random(size), file="dot.png"),
       "a picture of a dot must be .* at least 9 pixels on a side") for size in ((1, 1), (3, 200), (8, 8))),
    errors=(ValueError, FitError),
)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((SINGLET.format(words, 15), "lens.txt: line 1: (A16|A2|conic constant) must")
          for words in ("A2=1e308", "A2=1e300 A4=-1e300", "k=1e300", "A16=1e308")),
        ("0.001 1e7 4.9 20\n-0.001 1e7 1 20\n" * 30 + "-50 3 1 20\n0 0 0 15", "'lens' bends light beyond measure"),
    ],
)  # fmt: skip
def test_absurd_prescriptions_are_refused_without_a_warning(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "lens.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        focus_sensor(Lens.read(tmp_path / "lens.txt"), 2.0)


@pytest.mark.parametrize("auto", [True, False])
@pytest.mark.parametrize(
    ("near", "far", "light"),
    [(3e38, 1.0, 1.0), (1e16, -1e16, 1.0), (1e14, -1e14, 1.0), (3e38, -3e38, 1.0), (math.nan, 1.0, 1.0),
     (4.0, 1.0, 3e38), (4.0, 1.0, 1e-45)],
)  # fmt: skip
def test_repairs_of_maps_and_light_of_any_size_stay_finite(
    near: float, far: float, light: float, engine: str, auto: bool
) -> None:
    nearness = torch.full((1, 1, 24, 32), far)
    nearness[..., 6:18, 9:21] = near  # one pixel right of the image's square
    image = torch.full((1, 3, 24, 32), 0.1 * light)
    image[..., 6:18, 8:20] = light
    repaired = repair(image, nearness, torch.tensor(1.0), auto)
    known = torch.isfinite(nearness)
    assert torch.equal(torch.isfinite(repaired), known)
    assert float(repaired[known].abs().max()) <= 1.001 * float(nearness[known].abs().max())
    too_large = nearness.abs() > 1e15
    assert torch.equal(repaired[too_large], nearness[too_large])


def test_root_also_limits_photographs_without_a_description(tmp_path: Path) -> None:
    for folder in ("photographs", "elsewhere"):
        (tmp_path / folder).mkdir()
    for number in range(2):
        write_image(tmp_path / "elsewhere" / f"{number}.png", Picture(torch.rand(1, 3, 40, 40)))
        os.symlink(tmp_path / "elsewhere" / f"{number}.png", tmp_path / "photographs" / f"{number}.png")
    call = ["fit", str(tmp_path / "photographs"), "-o", str(tmp_path / "table.json"), "--root"]
    for root, message in ((tmp_path / "photographs", "lies outside of"), (tmp_path, "show the target")):
        assert message in CliRunner().invoke(app, [*call, str(root)]).output
