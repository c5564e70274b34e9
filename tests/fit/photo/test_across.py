"""A grid of dots becomes one table whose blur varies across the field."""

import math

import pytest
import torch
from click.testing import CliRunner

from torchdof import BlurTable
from torchdof.cli.main import app
from torchdof.fit import FitError
from torchdof.fit.photo.across import field_of_dots, table_of_dots
from torchdof.optics.field import deviations


def radii(table: BlurTable, coc_px: float, away_px: list[float], width: int) -> list[float]:
    """Radius in px of the disc with the spot's second moment, the mean of u and v, at `away_px` from the centre."""
    box, light = table.field.spots(coc_px / table.px_per_unit(width), torch.tensor(away_px) / table.px_per_unit(width))
    return (2.0 * deviations(box, light) * table.px_per_unit(width)).mean(-1).tolist()


def test_a_grid_of_dots_gives_the_blur_across_the_field(simulator, tmp_path):
    far, focus = 120.0, 0.5

    def radius(distance, away):  # curvature of field: the corners focus nearer
        return 20.0 * (1 / (focus * (1.0 - 0.1 * (away / far) ** 2)) - 1 / distance)

    def kernel(distance, x, y):
        return "disc", {"radius": abs(radius(distance, math.hypot(x, y)))}

    camera = simulator.Simulator(level=0.7, snr_db=50, dot_radius=7.0)
    grid = [(0, 0), (60, 0), (-120, 0)]
    folder = simulator.write_captures(tmp_path, camera, focus, [0.42, 0.6], kernel, grid=grid, width=340, height=120)
    out = tmp_path / "lens.json"
    run = CliRunner().invoke(app, ["fit", str(folder), "--dots", "field", "--family", "disc", "-o", str(out)])
    assert run.exit_code == 0, run.output
    assert sorted(tmp_path.glob("*.json")) == [out]
    table = BlurTable.load(out)
    assert table.provenance["dots"] == "field" and len(table.provenance["dots_px"]) == 3
    for distance, coc_px in zip((0.42, 0.6), (table.coc * 340.0).tolist(), strict=True):
        expected = [abs(radius(distance, away)) for away in (0.0, 60.0, 120.0)]
        places = [away * focus / distance for away in (0.0, 60.0, 120.0)]  # in this picture
        assert radii(table, coc_px, places, 340) == pytest.approx(expected, rel=0.02)


def eye(x: float, y: float) -> torch.Tensor:
    """Aperture mask of a dot at (x, y): a disc whose side away from the frame's centre is cut off."""
    place = (torch.arange(64) + 0.5) / 32 - 1.0
    down, right = place[:, None], place[None, :]
    outwards = (down * y + right * x) / math.hypot(x, y)
    return ((torch.hypot(down, right) < 1.0) & (outwards < 0.4)).double()


def test_apertures_of_dots_are_rotated_to_a_common_direction():
    places = [(0.0, 0.0), (10.0, 0.0), (-6.0, 8.0), (0.0, -20.0)]
    openings = [torch.ones(64, 64), *(eye(*place) for place in places[1:])]
    arguments = {"coc": [-1.0, 1.0], "params": {"radius": [1.0, 1.0]}, "unit": "mm", "sensor_width_mm": 36.0}
    tables = [BlurTable("disc", **arguments, aperture=BlurTable.from_aperture(o).aperture) for o in openings]
    field = field_of_dots(tables, places, [1.0, 1.0])
    assert field.radius.tolist() == [0.0, 10.0, 20.0] and field.coc.tolist() == [-1.0, 0.0, 1.0]
    assert float(field.box[1].max()) < 1e-4  # interpolated to focus, the spot is a point
    u = (torch.arange(field.light.shape[-2]) + 0.5) / field.light.shape[-2] * 2.0 - 1.0
    for k, turned in ((0, -1.0), (2, 1.0)):  # in front of the focus the image of the aperture is rotated by 180 degrees
        for f in (1, 2):
            along = field.light[0, k, f].sum(-1)
            cut = (u * turned * float(field.box[k, f, 1])) > 0.45
            assert float(along[cut].sum()) < 0.005
            assert float(along[~cut].sum()) > 0.995
    one_sided = [
        BlurTable("disc", **{**arguments, "coc": [1.0], "params": {"radius": [1.0]}}, aperture=t.aperture)
        for t in tables
    ]
    mirrored = field_of_dots(one_sided, places, [1.0])
    torch.testing.assert_close(mirrored.light[:, 0], field.light[:, 0], rtol=0, atol=2e-3 * float(field.light.max()))


def test_dots_at_one_distance_and_an_empty_list_are_refused():
    table = BlurTable("disc", coc=[1.0], params={"radius": [1.0]}, unit="fraction")
    with pytest.raises(FitError, match="at two distances from the middle"):
        field_of_dots([table], [(0.0, 0.0)], [1.0])
    with pytest.raises(FitError, match=r"two dots of a grid at least, got \[\]"):
        table_of_dots([])
