import functools
import math
import re
from typing import Any

import numpy as np
import pytest
import torch

from tests import loops
from torchdof import BlurTable, Camera
from torchdof.fit import natural_psnr, trace_table
from torchdof.fit.lens.lens import RGB_UM, Lens
from torchdof.fit.lens.spot import focus_sensor, point_spread
from torchdof.optics import psf

WIDTH = 1920
PIXEL = 36.0 / WIDTH
SHARP_PX = 0.34  # smallest |CoC| in px at which a shipped table is not faded to a point
# lens, f-number, focus in m, nodes, least PSNR in dB between nodes with |CoC| of at least SHARP_PX
SHIPPED = {
    "double_gauss_50mm_f2": ("double_gauss_50mm", 2.0, 2.0, 41, 55.0),
    "double_gauss_50mm_f4": ("double_gauss_50mm", 4.0, 2.0, 16, 60.0),
    "telephoto_250mm_f8": ("telephoto_250mm", 8.0, 10.0, 32, 60.0),
    "wide_22mm_f4": ("wide_22mm", 4.0, 0.5, 20, 60.0),
}
DISC = BlurTable.disc()
read = functools.cache(Lens.read)


def coc_mm(z_m: float, lens: Lens, f_number: float, focus_m: float) -> float:
    depth = torch.full((1, 1, 1, 1), z_m, dtype=torch.float64)
    return Camera(lens.paraxial().focal_length, f_number, focus_m, 36.0).coc_px(depth, width=36).item()


@functools.cache
def traced_kernel(lens: Lens, f_number: float, focus_m: float, coc: float) -> np.ndarray:
    """Kernel of a traced fan, rotated about the axis on a grid of 1/8 px and integrated over pixels."""
    per_dioptre = coc_mm(math.inf, lens, f_number, focus_m) * focus_m
    dioptres = 1.0 / focus_m - coc / per_dioptre
    z_m = 1.0 / dioptres if dioptres > 1e-9 else math.inf
    stopped = lens.with_f_number(f_number)
    spot = point_spread(stopped, z_m, focus_sensor(stopped, focus_m), meridional=True, rays=2_000)
    fine, turns = 8, 96
    r = np.repeat(spot.r / PIXEL, turns)
    turn = 2 * math.pi * (np.arange(len(r)) * (math.sqrt(5) - 1) / 2)
    size = 2 * math.ceil(r.max()) + 1
    n = size * fine
    x, y = (np.floor(r * wave(turn) * fine + n / 2).astype(int) for wave in (np.cos, np.sin))
    counted = np.bincount(y * n + x, np.repeat(spot.weight, turns), n * n).reshape(n, n)
    places = (torch.arange(n, dtype=torch.float64) + 0.5) / fine - size / 2
    return np.asarray(loops.seen_by_pixels(torch.from_numpy(counted), places, size))


def interpolated(table: BlurTable, coc_px: float) -> np.ndarray:
    params = table.params(torch.tensor(coc_px, dtype=torch.float64), WIDTH)
    return psf.pixel_kernels(table.family, {key: value[0] for key, value in params.items()}).numpy()


def between(table: BlurTable, share: float = 0.5) -> np.ndarray:
    coc = table.coc.numpy()
    return coc[:-1] + share * np.diff(coc)


def psnr(table: BlurTable, places: Any, lens: Lens, f_number: float, focus_m: float, *, shown: bool) -> np.ndarray:
    """PSNR at signed CoCs in mm of a table's kernels; with `shown` False without their fade to a point in focus."""
    found = []
    for coc in map(float, places):
        px = coc / PIXEL
        made = table.kernels(torch.tensor([px]), WIDTH)[0, 0].numpy() if shown else interpolated(table, px)
        found.append(natural_psnr(made, traced_kernel(lens, f_number, focus_m, coc)))
    return np.array(found)


@pytest.mark.parametrize(
    "name", ["double_gauss_50mm_f2", *(pytest.param(name, marks=pytest.mark.sweep) for name in list(SHIPPED)[1:])]
)
def test_a_shipped_table_matches_traced_spots_and_states_its_origin(name):
    lens, f_number, focus_m, nodes, least = SHIPPED[name]
    table = BlurTable.load(name)
    assert len(table.coc) == nodes
    shares = [0.15, 0.5, 0.85]
    places = np.concatenate([between(table, share) for share in shares])
    blurs = np.abs(places) >= SHARP_PX * PIXEL
    blurred, is_middle = places[blurs], np.repeat(shares, nodes - 1)[blurs] == 0.5
    shown = psnr(table, blurred, read(lens), f_number, focus_m, shown=True)
    plain = psnr(table, places[~blurs], read(lens), f_number, focus_m, shown=False)
    assert shown[is_middle].min() >= least
    assert shown.min() >= 55.0 and plain.min() >= 50.0
    # near focus a table is at least as good as the thin lens
    px = np.array([-1.3, -0.85, -0.7, -0.35, -0.1, 0.1, 0.35, 0.7, 0.85, 1.3])
    near, thin = (psnr(t, px * PIXEL, read(lens), f_number, focus_m, shown=True) for t in (table, DISC))
    assert (near - np.minimum(thin, 55.0)).min() > 0.0 and near[np.abs(px) > SHARP_PX].min() >= 50.0
    assert table.provenance["prescription"].split("; ") == read(lens).lines()
    assert (table.provenance["f_number"], table.provenance["focus_m"]) == (f_number, focus_m)
    assert "trace_table(" in table.provenance["command"] and re.fullmatch(r"\d{4}-\d\d-\d\d", table.provenance["date"])
    assert table.residual is not None and float(table.residual.max()) < 0.03
    assert len(str(table.to_dict())) < 150_000


def test_the_number_of_nodes_is_chosen_for_50_db(lens_of):
    lens = lens_of("50 5 1.5168 20\n0 1 0 18\n-50 0 1 20\n")
    given = {"f_number": 6.0, "nodes": None, "points": 33, "rays": 500}
    coarse, fine = (small(lens, **given, width_px=width) for width in (480, WIDTH))
    assert len(coarse.coc) < len(fine.coc) < 33
    places = between(fine)
    places = places[np.abs(places) < 2 * PIXEL]
    assert psnr(fine, places, lens, 6.0, 2.0, shown=False).min() >= 50.0


def small(lens: Lens, **changes: Any) -> BlurTable:
    given = {"f_number": 8.0, "focus_m": 2.0, "nodes": 5, "points": 17, "rays": 300}
    return trace_table(lens, **{**given, **changes})


def test_nodes_reach_from_the_nearest_distance_to_infinity():
    lens = read("double_gauss_50mm")
    table = small(lens, nearest_m=1.0)
    ends = [coc_mm(z_m, lens, 8.0, 2.0) for z_m in (1.0, math.inf)]
    assert table.coc[[0, -1]].tolist() == pytest.approx(ends, rel=1e-6)
    stopped = lens.with_f_number(8.0)
    spots = [point_spread(stopped, z, focus_sensor(stopped, 2.0), meridional=True, rays=300) for z in (1.0, math.inf)]
    radii = table.node_params["radius"][0, [0, -1]].tolist()
    assert radii == pytest.approx([spot.radius for spot in spots], rel=1e-5)
    assert 0.0 in table.coc.tolist() and table.provenance["asymmetry"] == 0.0
    command = table.provenance["command"].removeprefix("torchdof.fit.")
    assert eval(command, {"trace_table": trace_table, "Lens": Lens}).to_dict() == table.to_dict()
    table = small(lens, focus_m=math.inf, nodes=4)  # focused at infinity, everything is in front of the focus
    assert len(table.coc) == 4 and float(table.coc.max()) == 0.0
    assert table.provenance["focus_m"] == "inf"


def test_dispersion_gives_one_kernel_a_channel(lens_of):
    lens = lens_of("50 5 1.5168/64.17 20\n0 1 0 8\n-50 0 1 20\n")
    table = small(lens, focus="paraxial", wavelengths_um=RGB_UM)
    assert table.channels == 3
    # a singlet focuses blue nearer to the lens: blue is blurred more behind the focus and less in front of it
    assert (table.node_params["radius"][:, -1].diff() > 0).all()
    assert (table.node_params["radius"][:, 0].diff() < 0).all()


def test_off_axis_table_states_its_asymmetry():
    asymmetry = small(read("double_gauss_50mm"), f_number=2.0, field_mm=12.0, rays=2_000).provenance["asymmetry"]
    assert len(asymmetry) == 5 and max(asymmetry) > 0.2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"nodes": 4}, "nodes must be a whole number from 5"),
        ({"nodes": 40, "width_px": 20}, "nodes must be at most [0-9]+ for this lens and width_px, got 40"),
        ({"focus_m": 0.04}, "farther than the focal length"),
        ({"sensor_width_mm": 5e-324}, "sensor_width_mm must be a number of millimetres > 1e-06"),
        ({"nearest_m": 3.0}, "nearest_m must be a number of metres > 0 and < 2, got 3.0"),
        ({"wavelengths_um": RGB_UM, "lens": "wide_22mm"}, "wavelengths_um need a lens with Abbe numbers"),
        ({"wavelengths_um": (0.1,)}, "wavelength_um must be a number of micrometres > 0.299"),
        ({"field": (1.0, 20.0)}, "from 0 on"),
        ({"field": (0.0, 20.0, 10.0)}, "must be increasing"),
        ({"field": (0.0, 20.0), "field_mm": 3.0}, "give one of them"),
        ({"field": (0.0, 20.0), "field_nodes": 1}, "field_nodes must be"),
        ({"field": (0.0, 20.0), "field_rays": 5}, "field_rays must be"),
    ],
)
def test_impossible_tables_are_refused(changes, message):  # arguments of the wrong kind: test_arguments.py
    given = {"lens": "double_gauss_50mm", **changes}
    with pytest.raises(ValueError, match=message):
        small(read(given.pop("lens")), **given)
