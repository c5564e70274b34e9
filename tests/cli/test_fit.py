"""``torchdof fit``: captures or a lens in, a table and pictures out."""

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from torch import Tensor

from torchdof import BlurTable, blur_by_coc
from torchdof.fit.lens import trace

Run = Callable[..., str]


def kernel(distance: float) -> tuple[str, dict[str, float]]:
    return "disc", {"radius": 10.0 * abs(1 / 0.5 - 1 / distance)}


@pytest.fixture(scope="module")
def folder(simulator: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    fields = 'focal_length_mm = 50.0\nf_number = 1.543\nsensor_width_mm = 36.0\nname = "my lens"'
    written = tmp_path_factory.mktemp("lens")
    return simulator.write_captures(written, camera, 0.5, [0.4, 0.8, 1.0], kernel, camera_fields=fields)


def test_a_folder_becomes_a_table_with_pictures(run: Run, folder: Path, tmp_path: Path) -> None:
    output = run("fit", folder, "-o", tmp_path / "mine.json", "--plots", tmp_path / "pictures")
    table = BlurTable.load(tmp_path / "mine.json")
    assert table.family == "disc" and len(table.coc) == 3 and table.name == "my lens"
    assert table.provenance["command"].startswith("torchdof fit ")
    assert all(words in output for words in ("±", "family: disc", "x noise")) and "warning" not in output
    assert sorted(f.name for f in (tmp_path / "pictures").iterdir()) == [
        "mine_1000mm.png", "mine_400mm.png", "mine_800mm.png",
    ]  # fmt: skip


def test_pictures_without_a_stated_transfer_give_a_warning(run: Run, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "lens")
    manifest = tmp_path / "lens" / "capture.toml"
    manifest.write_text(manifest.read_text().replace('transfer = "srgb"', ""))
    options = ("-o", tmp_path / "mine.json", "--family", "disc", "--colours", "each", "--json")
    facts = json.loads(run("fit", tmp_path / "lens", *options))
    assert facts["name"] == "my lens" and facts["focus_m"] == 0.5 and facts["family"] == "disc"
    assert [fit["distance_m"] for fit in facts["fits"]] == [0.4, 0.8, 1.0]
    assert all(fit["stderr"]["radius"] > 0 for fit in facts["fits"])
    assert [colour["name"] for colour in facts["colours"]] == ["red", "green", "blue"]
    assert "the encoding of 0500mm.png and 3 more is not stated" in facts["warnings"][0]


def test_a_warning_about_a_grid_of_dots_is_printed_once(run: Run, simulator: ModuleType, tmp_path: Path) -> None:
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=7.0, black=0.02)
    grid = [(-60, 0), (60, 0)]
    folder = simulator.write_captures(tmp_path / "lens", camera, 0.5, [0.8], kernel, grid=grid, width=240, height=120)
    manifest = folder / "capture.toml"
    manifest.write_text(manifest.read_text().replace('transfer = "srgb"', ""))
    options = ("-o", tmp_path / "mine.json", "--family", "disc", "--dots", "each")
    told = run("fit", folder, *options)
    assert "dot 1 at" in told and "warning: " in told and told.count("the encoding of") == 1
    lines = run("fit", folder, *options, "--json").splitlines()  # each is for a table of its own
    assert ["the encoding of" in json.loads(line)["warnings"][0] for line in lines] == [True, True]


def test_a_lens_becomes_a_table(run: Run, tmp_path: Path) -> None:
    arguments = ("--lens", "double_gauss_50mm", "--f-number", "4", "--nodes", "5", "-o", tmp_path / "lens.json")
    output = run("fit", *arguments)
    facts = json.loads(run("fit", *arguments, "--json"))
    assert facts["out"] == str(tmp_path / "lens.json") and facts["f_number"] == 4.0 and facts["family"] == "radial"
    assert BlurTable.load(tmp_path / "lens.json").unit == "mm"
    output = " ".join(output.split())
    assert "50.3582 mm, f/4, focus 2.0 m; 5 distances from" in output and "family: radial, residual" in output


def test_the_target_is_written_and_nothing_else(run: Run, tmp_path: Path) -> None:
    output = run("fit", "--target", tmp_path / "target.pdf", "--paper", "letter")
    assert (tmp_path / "target.pdf").read_bytes().startswith(b"%PDF") and "print it at 100 %" in output


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_photographs_of_the_target_become_a_table_and_a_sheet(
    run: Run, simulator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator.write_photographs(tmp_path / "phone", 0.2, [0.4], width=560, tone=0.0, noise=0.004)
    rendered = []

    def recorded(image: Tensor, coc_px: Tensor, *, table: BlurTable) -> Tensor:
        rendered.append((image, coc_px))
        return blur_by_coc(image, coc_px, table=table)

    monkeypatch.setattr("torchdof.cli.fit_tables.blur_by_coc", recorded)
    output = run("fit", tmp_path / "phone", "-o", tmp_path / "phone.json", "--family", "disc")
    output = " ".join(output.split())
    assert "in focus" in output and "better: 1 distances out of focus: five to nine" in output
    table = BlurTable.load(tmp_path / "phone.json")
    assert table.unit == "mm" and table.provenance["sharp"] == "img_0000.jpg"
    assert (tmp_path / "phone.png").stat().st_size > 20_000
    ((picture, lights),) = rendered  # lights at every CoC
    assert lights.min() == 0 and lights.max() > 1 and picture.shape == lights.shape


def test_a_lens_is_traced_in_its_colours_and_across_its_field(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_few_rays = functools.partial(trace.trace_table, field_nodes=2, field_rays=2000)
    monkeypatch.setattr(trace, "trace_table", with_few_rays)
    (tmp_path / "single.txt").write_text("50 5 1.5168/64.17 20\n0 1 0 8\n-50 0 1 20\n")
    file = tmp_path / "lens.json"
    options = ("--lens", tmp_path / "single.txt", "--f-number", "8", "--nodes", "5", "-o", file)
    run("fit", *options, "--wavelengths", "rgb")
    assert BlurTable.load(file).channels == 3
    output = run("fit", *options, "--field", "0,6,12")
    assert "across the field: [0.0, 6.0, 12.0] mm" in output
    assert "distances to 12" in run("tables", file)
    field = BlurTable.load(file).field
    assert field is not None and field.radius.tolist() == [0.0, 6.0, 12.0]
    assert 1.02 * field.box[0, 0, 1] < field.box[0, 2, 1]  # a single lens blurs more off its axis
