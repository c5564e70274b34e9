"""The field of a lens: spots over coc and distance from the middle of the frame."""

import base64
import zlib
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.refused import refuses
from tests.scenes import lens_with_a_field
from torchdof import BlurTable, blur_by_coc
from torchdof.optics.aperture import Aperture
from torchdof.optics.field import Field

COC, RADIUS = torch.tensor([-2.0, 0.5, 1.0]), torch.tensor([0.0, 10.0, 20.0])


def field(channels: int = 1) -> Field:
    light = torch.rand(channels, 3, 3, 8, 4, generator=torch.Generator().manual_seed(1)).double()
    box = torch.rand(3, 3, 3, generator=torch.Generator().manual_seed(2)).double() + 0.5
    return Field(COC, RADIUS, box, light)


def table(channels: int = 1, **arguments: Any) -> BlurTable:
    arguments |= {"unit": "mm", "sensor_width_mm": 36.0, "field": field(channels)}
    return BlurTable("disc", [-2.0, 1.0], {"radius": torch.ones(channels, 2)}, **arguments)


def test_spots_are_linear_between_nodes_and_grow_beyond_the_last_coc() -> None:
    lens = field(3)
    box, light = lens.spots(0.75, torch.tensor([5.0, 30.0]))
    assert_close(box[0], lens.box[1:, :2].mean((0, 1)))
    assert_close(light[:, 0], lens.light[:, 1:, :2].mean((1, 2)))
    assert_close(light[:, 1], lens.light[:, 1:, 2].mean(1))
    assert_close(light.sum((-2, -1)), torch.ones(3, 2, dtype=torch.float64))
    assert_close(lens.spots(3.0, RADIUS)[0], 3.0 * lens.box[2])
    assert_close(lens.spots(-3.0, RADIUS)[0], 1.5 * lens.box[0])
    middle, length, width = lens.box[2].unbind(-1)
    farthest = torch.hypot(middle.abs() + length, width).max()  # all cells are lit
    assert float(lens.reach(torch.tensor([1.0]))) == pytest.approx(float(farthest))


@pytest.mark.parametrize("channels", [1, 3])
def test_a_field_survives_save_and_load(channels: int, tmp_path: Any) -> None:
    lens = table(channels)
    lens.save(tmp_path / "lens.json")
    loaded = BlurTable.load(tmp_path / "lens.json")
    assert loaded.field is not None and lens.field is not None and loaded.depends_on_place
    assert_close(loaded.field.light, lens.field.light, rtol=0, atol=2e-5 * float(lens.field.light.max()))
    assert_close(loaded.field.box, lens.field.box, rtol=0, atol=0)
    assert loaded.fingerprint() != lens.replace(field=None).fingerprint()
    assert "Field(3 blurs, 3 distances to 20)" in repr(loaded)


@pytest.mark.parametrize("size", [1e-300, 1e-3, 1e3])
def test_fields_of_extreme_but_allowed_sizes_render(size: float, engine: str) -> None:
    lens = lens_with_a_field(box=torch.full((4, 3, 3), size, dtype=torch.float64))
    out = blur_by_coc(torch.rand(1, 3, 9, 12), torch.linspace(-3, 4, 12).expand(1, 1, 9, 12), table=lens)
    assert 0.0 <= float(out.min()) <= float(out.max()) <= 1.0 + 1e-5


def test_files_of_earlier_versions_load() -> None:
    data = BlurTable.polygon(5).to_dict()
    assert data["version"] == 3
    for version in (1, 2):
        assert BlurTable.from_dict({**data, "version": version}).aperture is not None


GOOD: dict[str, Any] = {"coc": COC, "radius": RADIUS, "box": torch.ones(3, 3, 3), "light": torch.ones(3, 3, 8, 4)}


BOMB = base64.b64encode(zlib.compress(bytes(10**7), 9)).decode()


def doubles(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def made(**change: Any) -> Callable[[], Any]:
    return lambda: Field(**{**GOOD, **change})


def lens(**change: Any) -> Callable[[], Any]:
    return lambda: lens_with_a_field(**change)


def read(**change: Any) -> Callable[[], Any]:
    return lambda: Field.from_dict({**field().to_dict(), **change})


test_bad_fields_are_refused_by_name = refuses(
    (made(coc=COC.abs()), "field.coc must be at least two strictly increasing"),
    (made(coc=COC + 3.0), "reach to both sides"),
    (made(radius=RADIUS + 1.0), "must begin at 0"),
    (made(box=torch.ones(3, 2, 3)), r"field.box must be \[3, 3, 3\]"),
    (made(light=torch.zeros(3, 3, 8, 4)), "must hold some light"),
    (lens(box=torch.full((4, 3, 3), 1e38)), r"field\.box must be lengths in the unit of field\.coc"),
    (lens(box=torch.tensor([1e9, 0.1, 0.1]).expand(4, 3, 3)), r"field\.box must be lengths"),
    (lens(coc=doubles(-1e-300, 0.0, 1e-301, 1e-300)), r"field\.coc must reach somewhere"),
    (lens(coc=doubles(-1.0, 0.0, 1.0, 1e300)), r"field\.coc must reach somewhere"),
    (lens(radius=doubles(0.0, 1.0, 1e300)), r"field\.radius must reach somewhere"),
    (read(shape=[1, 3, 3, 8]), "five numbers"),
    (read(shape=[1, 3, 3, 8, 5]), "must hold 720 bytes"),
    *((read(light=light), "deflated numbers") for light in ("no base64", 5)),
    (read(light=BOMB), "must hold 576 bytes"),
    (read(light=BOMB, shape=[1, 4, 3, 5000, 5000]), "five numbers of cells"),
    (read(box="wide"), "field.box must be numbers"),
    (lambda: table().replace(aperture=Aperture(blades=5)), "has its own opening"),
    (lambda: BlurTable("disc", [1.0], {"radius": [1.0]}, field=field()), "must state its unit"),
    (lambda: table().replace(field=field(3)), "field must have 1 channels"),
)
