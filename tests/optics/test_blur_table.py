import copy
import json
import math
import stat
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.kernels import kernel_of
from torchdof import BlurTable
from torchdof.optics import psf


def at(table: BlurTable, *coc_px: float, width: int = 100) -> dict[str, list[float]]:
    """Parameters of a one-channel table at these signed coc."""
    params = table.params(torch.tensor(coc_px, dtype=torch.float64), width)
    return {name: value[0].tolist() for name, value in params.items()}


def example(**changes: Any) -> dict[str, Any]:
    """A whole table as stored, with fields changed; a field set to None is left out."""
    data: dict[str, Any] = {
        "schema": "torchdof/blur-table",
        "version": 3,
        "name": "lens",
        "family": "ring",
        "unit": "mm",
        "sensor_width_mm": 36.0,
        "coc": [-0.2, -0.1, 0.3],
        "params": {"sigma": [0.1, 0.04, 0.12], "r_c": [0.0, 0.05, 0.1]},
        "strength": [0.5, 0.6, 0.7],
        "residual": [0.01, 0.02, 0.03],
        "provenance": {"camera": "a lens", "focus_m": 2.0},
    }
    return {name: value for name, value in {**copy.deepcopy(data), **changes}.items() if value is not None}


TWO_SIDES = BlurTable("ring", [-4.0, -2.0, 2.0, 8.0], {"sigma": [1.0, 0.4, 0.5, 3.0], "r_c": [0.0, 1.0, 1.0, 2.0]},
                      unit="fraction")  # fmt: skip


IN_FOCUS = BlurTable("gaussian", [0.0, 0.1], {"sigma": [0.01, 0.05]}, unit="fraction")
TILTED = BlurTable("softm", [-1.0, 1.0],
                   {"radius": [1.0, 1.1], "sigma": [0.1, 0.2], "b": [-0.5, 2.0], "m": [2.0, 4.0]})  # fmt: skip
WIDENING = BlurTable("disc", [0.01, 0.02], {"radius": [0.01, 0.03]}, unit="fraction")
IN_MM = BlurTable("disc", [0.1, 0.2], {"radius": [0.1, 0.3]}, unit="mm", sensor_width_mm=24.0)


@pytest.mark.parametrize(
    ("table", "width", "coc_px", "expected"),
    [
        (TWO_SIDES, 100, [-400, -200, 200, 800], {"sigma": [100, 40, 50, 300], "r_c": [0, 100, 100, 200]}),
        (TWO_SIDES, 100, [500, -300, 100, -50], {"sigma": [175, 70, 25, 10]}),
        (TWO_SIDES, 100, [0], {"sigma": [0], "r_c": [0]}),
        (TWO_SIDES, 100, [-800, 1600], {"sigma": [200, 600]}),
        (IN_FOCUS, 100, [0, 5, 10, -5], {"sigma": [1, 3, 5, 3]}),
        (BlurTable("disc", [1.0], {"radius": [1.2]}), 100, [-3, 3], {"radius": [3.6, 3.6]}),
        (BlurTable("disc", [-1.0], {"radius": [1.2]}), 100, [-3, 3], {"radius": [3.6, 3.6]}),
        (TILTED, 100, [-6, 6, 500], {"radius": [6, 6.6, 550], "sigma": [0.6, 1.2, 100], "b": [-0.5, 2, 2]}),
        (TILTED, 100, [-6, 6, 500], {"m": [2, 4, 4]}),
        (WIDENING, 1000, [15], {"radius": [20]}),
        (WIDENING, 2000, [30], {"radius": [40]}),
        (IN_MM, 2400, [15], {"radius": [20]}),
        (BlurTable.disc(), 10, [3], {"radius": [3]}),
        (BlurTable.disc(), 10_000, [3], {"radius": [3]}),
        (BlurTable.gaussian(0.25), 100, [8], {"sigma": [2]}),
        (BlurTable.gaussian(), 100, [2], {"sigma": [1]}),  # the second moment of a disc, R^2 / 2, is 2 sigma^2
    ],
    ids=str,
)
def test_parameters_are_linear_between_nodes_and_lengths_grow_beyond(
    table: BlurTable, width: int, coc_px: list[float], expected: dict[str, list[float]]
) -> None:
    found = at(table, *coc_px, width=width)
    assert {name: found[name] for name in expected} == {name: pytest.approx(v) for name, v in expected.items()}


@pytest.mark.parametrize("name", ["disc", "gaussian", "sato_j15"])
def test_kernels_are_one_pixel_in_focus_and_move_light_with_the_square_of_the_coc(name: str) -> None:
    table = {"disc": BlurTable.disc, "gaussian": BlurTable.gaussian}.get(name, lambda: BlurTable.load(name))()
    moved = 1.0 - table.kernels(torch.tensor([0.0, 0.01, -0.01, 0.02], dtype=torch.float64), 100, size=5)[:, 0, 2, 2]
    assert float(moved[0]) == pytest.approx(0.0, abs=1e-12)
    assert_close(moved[1], moved[2])
    assert 5e-5 < float(moved[1]) < 2e-4 and float(moved[3] / moved[1]) == pytest.approx(4.0, rel=0.03)


def test_a_blur_in_focus_fades_in_with_the_square_of_the_coc() -> None:
    table = BlurTable("gaussian", [0.0, 1.0], {"sigma": [0.8, 0.8]})
    kernels = table.kernels(torch.tensor([0.0, 0.1, 0.2, 0.5], dtype=torch.float64), 100, size=9)
    moved = 1.0 - kernels[:, 0, 4, 4]
    assert_close(moved[:3], torch.tensor([0.0, 0.04, 0.16], dtype=torch.float64), rtol=1e-8, atol=1e-8)
    assert_close(kernels[3, 0], kernel_of("gaussian", 0.8, size=9))
    colours = BlurTable("gaussian", [0.0, 1.0], {"sigma": [[0.05, 0.05], [0.8, 0.8]]})
    small, large = colours.kernels(torch.tensor([0.07], dtype=torch.float64), 100, size=9)[0]
    assert_close(small, kernel_of("gaussian", 0.05, size=9))  # each colour fades in by its own blur
    assert float(large[4, 4]) > 0.9


def test_channels_have_their_own_kernels() -> None:
    table = BlurTable("disc", [-1.0, 1.0], {"radius": [[1.0, 1.0], [1.1, 0.9], [1.2, 0.8]]})
    assert table.channels == 3 and "3 channels" in repr(table)
    kernels = table.kernels(torch.tensor([-5.0, 5.0]), 100, size=15)
    assert kernels.shape == (2, 3, 15, 15)
    assert_close(kernels[0, 2], kernel_of("disc", 6.0, size=15))
    assert_close(kernels[1, 1], kernel_of("disc", 4.5, size=15))
    shared = BlurTable("ring", [1.0], {"sigma": [[0.2], [0.3]], "r_c": [0.5]})
    assert shared.params(torch.tensor(4.0), 100)["r_c"].tolist() == [2.0, 2.0]


def test_radial_values_are_interpolated_and_scale_only_in_radius() -> None:
    table = BlurTable("radial", [0.1, 0.2], {"values": [[1.0, 1.0, 0.0], [1.0, 3.0, 1.0]], "radius": [0.1, 0.2]},
                      unit="fraction")  # fmt: skip
    params = table.params(torch.tensor(15.0), 100)
    assert_close(params["values"], torch.tensor([[1.0, 2.0, 0.5]], dtype=torch.float64))
    assert params["radius"].tolist() == [15.0]
    assert table.kernels(torch.tensor([15.0, -20.0]), 100).shape == (2, 1, 41, 41)


@pytest.mark.parametrize("coc_px", [0.3, 4.0, -11.5])
def test_reach_holds_the_kernels_of_both_signs(coc_px: float) -> None:
    width = 2 * math.ceil(TWO_SIDES.reach_px(coc_px, 1) + 20) + 1
    wide = TWO_SIDES.kernels(torch.tensor([coc_px, -coc_px], dtype=torch.float64), 1, size=width)
    axis = torch.arange(width) - width // 2
    beyond = torch.hypot(axis[:, None].double(), axis[None, :].double()) > TWO_SIDES.reach_px(coc_px, 1) + 1
    assert float(wide[..., beyond].sum(-1).max()) < 1e-4


def test_the_shipped_table_is_table_one_of_the_paper() -> None:
    table = BlurTable.load("sato_j15")
    params = table.node_params
    assert table.family == "ring" and table.strength is not None and len(table.coc) == 1
    assert float(table.strength) == pytest.approx(5.8116e-1)
    assert float(params["r_c"]) == pytest.approx(4.2853e-4)
    assert float(params["sigma"]) ** 2 == pytest.approx(5.5114e-6, rel=1e-4)
    assert table.provenance["source"] and table.unit == "relative"
    # its coc is that of the disc with the same second moment
    r = torch.linspace(0.0, 0.03, 300_001, dtype=torch.float64)
    mass = psf.profile("ring", r, {k: float(v) for k, v in params.items()}) * r
    assert float((mass * r**2).sum() / mass.sum()) == pytest.approx(float(table.coc) ** 2 / 2, rel=1e-4)


ROUND_TRIPS = [
    BlurTable.disc(),
    BlurTable.gaussian(0.4),
    BlurTable.load("sato_j15"),
    BlurTable.from_dict(example()),
    BlurTable("disc", [1.0], {"radius": [[1.0], [1.1], [1.2]]}),
    BlurTable("radial", [0.1, 0.2], {"values": [[[1.0, 0.3]] * 2] * 3, "radius": [0.1, 0.2]}, unit="fraction"),
    BlurTable.polygon(5, 7.0, 0.4, rim=2.0, squeeze=1.6, vignetting=(0.3, 0.1)),
    BlurTable.from_aperture(torch.eye(9).cumsum(0)[:, :6], squeeze=0.8),
]


@pytest.mark.parametrize("table", ROUND_TRIPS, ids=repr)
def test_a_table_survives_save_and_load(table: BlurTable, tmp_path: Path) -> None:
    path = tmp_path / "lens.json"
    table.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["lens.json"] and stat.S_IMODE(path.stat().st_mode) == 0o644
    assert json.loads(path.read_text())["name"] == table.name and repr(table.name or "unnamed") in repr(table)
    back = BlurTable.load(path)
    assert back.to_dict() == table.to_dict() and repr(back) == repr(table)
    assert back.fingerprint() == table.fingerprint()
    assert table.aperture is None or table.replace(aperture=None).fingerprint() != table.fingerprint()
    coc = torch.tensor([-30.0, -0.7, 0.0, 12.0])
    assert_close(back.kernels(coc, 64, size=15), table.kernels(coc, 64, size=15), rtol=0.0, atol=0.0)


NOT_FINITE = [1.0, math.nan, 2.0]
SOFT = {"radius": [0.01], "sigma": [0.003], "b": [1.0]}
BARE: dict[str, Any] = {"unit": "fraction", **dict.fromkeys(("sensor_width_mm", "strength", "residual"))}
# family, coc, parameters, message
BAD_PARAMS: list[tuple[str, list[float], dict[str, Any], str]] = [
    ("radial", [0.01], {"values": [[1.0]], "radius": [0.01]}, r".*values must be \[..., P\] with P >= 2"),
    ("radial", [0.01], {"values": [[0.0, 0.0]], "radius": [0.01]}, ".*params.values must not all be 0 at a node"),
    ("softm", [0.01], {**SOFT, "b": [-2.0], "m": [2.0]}, r".*b of softm must be finite and >= -1, got \[-2\]"),
    ("radial", [1.0], {"values": [[1.0, 1e308, 1.0]], "radius": [1.0]}, "params.values must"),
    ("radial", [1.0], {"values": [[0.0, 5e-324, 0.0]], "radius": [1.0]}, "params.values must"),
    ("softm", [1.0], {"radius": [1.0], "sigma": [0.1], "b": [1e308], "m": [4.0]}, "params.b must"),
    ("softm", [0.01], {**SOFT, "m": [1000.0]}, "params.m must be <= 100, got 1000"),
    ("gaussian", [0.01], {"sigma": [1e9]}, ".*params must be lengths in the unit of coc, got a blur that reaches"),
    ("disc", [-0.01, 1e-320], {"radius": [0.01, 0.02]}, ".*coc must reach somewhere from 1e-09 to .* got 9.9"),
    ("disc", [-0.01, 1e-7], {"radius": [0.01, 0.02]}, ".*params must be lengths .* to 0.02 where coc is 1e-07"),
    ("disc", [*range(1, 4098)], {"radius": [1.0] * 4097}, r".*coc must be 1 to 4096 strictly .* of shape \[4097\]"),
    ("disc", [1e90], {"radius": [1e90]}, r".*coc must reach somewhere from 1e-09 to 1e\+06 \(fraction\), got 1e"),
]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": "lut"}, "schema must be 'torchdof/blur-table', got 'lut'"),
        ({"version": 4}, "version must be one of .1, 2, 3., got 4; update torchdof"),
        ({"family": None}, "a blur table must have the fields .*; family is missing"),
        ({"lens": "50 mm"}, "a blur table must have the fields .*; 'lens' is not one"),
        ({"family": "box"}, "family must be one of gaussian, ring"),
        ({"unit": "inch"}, "unit must be one of fraction, mm, relative, got 'inch'"),
        ({"params": {"sigma": [1.0, 2.0, 3.0]}}, "ring takes the parameters sigma, r_c, got sigma"),
        ({"params": {"sigma": [1.0, 2.0, 3.0], "r_c": [1.0]}}, r"params.r_c must be \[N\] .* N = 3, got \[1, 1\]"),
        ({"params": {"sigma": NOT_FINITE, "r_c": [0.0] * 3}}, "sigma must be finite numbers"),
        ({"params": {"sigma": [1.0] * 3, "r_c": [0.0, -0.1, 0.0]}}, r"r_c of ring must be finite and >= 0, got \[0, -"),
        ({"params": {"sigma": [[1.0] * 3] * 3, "r_c": [[1.0] * 3] * 2}}, "parameters of ring must broadcast against e"),
        ({"coc": [0.1, -0.1, 0.3]}, "coc must be 1 to 4096 strictly increasing"),
        ({"coc": [0.0]}, "coc must have a node that is not 0"),
        ({"sensor_width_mm": None}, "sensor_width_mm"),
        ({"sensor_width_mm": 0.0}, "sensor_width_mm must be a number of millimetres > 1e-06"),
        ({"unit": "relative", "sensor_width_mm": None}, "unit 'relative' takes one node on each side"),
        ({"strength": [1.0]}, r"strength must hold one number a node \(3\), got shape \[1\]"),
        *(({**BARE, "family": family, "coc": coc, "params": params}, message)
          for family, coc, params, message in BAD_PARAMS),
    ],
)  # fmt: skip
def test_a_bad_field_is_refused_by_name(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    data = example(**changes)
    with pytest.raises(ValueError, match=f"^{message}"):
        BlurTable.from_dict(data)
    path = tmp_path / "lens.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=f"lens.json: {message}"):
        BlurTable.load(path)


def test_a_file_that_is_not_a_table_or_an_unknown_one_is_refused_by_name(tmp_path: Path) -> None:
    whole, path = json.dumps(example()), tmp_path / "lens.json"
    for content in ("[1, 2]", whole.replace("0.12", "1e999"), json.dumps(example(version=10**400)), "[" * 100_000):
        path.write_text(content)
        with pytest.raises(ValueError, match="lens.json: "):
            BlurTable.load(path)
    with pytest.raises(FileNotFoundError, match=r"no blur table 'sato': .*sato_j15"):
        BlurTable.load("sato")


@pytest.mark.parametrize(("m", "sigma"), [(2.0, 0.003), (8.0, 0.003), (100.0, 0.0005), (100.0, 0.003)])
@pytest.mark.parametrize("coc", [0.0, 1e-6, 0.3, 0.8, 3.0, 40.0])
def test_steep_tilts_have_kernels_at_any_blur(m: float, sigma: float, coc: float) -> None:
    table = BlurTable("softm", [0.01], {**SOFT, "m": [m], "sigma": [sigma]}, unit="fraction")
    kernels = table.kernels(torch.tensor([coc, -coc]), 640)
    assert torch.isfinite(kernels).all() and float(kernels.min()) >= 0
    assert torch.allclose(kernels.sum((-2, -1)), torch.ones(1, dtype=torch.float64))
