import csv
import dataclasses
import functools
import importlib.metadata
import importlib.util
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner, Result
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField
from torchdof.bench import scaling, speed
from torchdof.bench.inputs import BenchScene, shipped
from torchdof.cli.bench import from_files
from torchdof.cli.main import app
from torchdof.cli.settings import RenderSettings
from torchdof.io.images import Picture, read_image, write_image
from torchdof.reference import metrics

LEVELS = ["8/255", "4/255", "2/255", "1/255", "0.5/255", "exact"]
EXACT = speed.Setting("layered", True, 0.0)
DISC = BlurTable.disc()


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["bench", *map(str, arguments)])


def row(setting: speed.Setting, median_s: float, rms_255: float) -> speed.SettingCost:
    return speed.SettingCost(setting, 20, 20, median_s, 0.0, 1.0, 1.0, 1.0, rms_255, 40.0, 1.0, True)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    image, depth = tmp_path / "image.exr", tmp_path / "depth.exr"
    write_image(image, Picture(shipped(36, 64).image), sample="float")
    metres = torch.linspace(1.0, 4.0, 64).expand(1, 1, 36, 64)
    write_image(depth, Picture(metres, ("Y",)), sample="float")
    return image, depth


@pytest.fixture(scope="module")
def measured() -> tuple[list[speed.SettingCost], BenchScene]:
    subject = shipped(48, 96)
    # blurred enough for coarse layers to show
    subject = BenchScene("wide", subject.image, 5.0 * subject.coc_px)
    return speed.measure_all(subject, repeat=1)[0], subject


def test_every_setting_has_its_row(measured: tuple[list[speed.SettingCost], BenchScene]) -> None:
    rows, _ = measured
    assert [r.setting.name for r in rows] == [*LEVELS, *LEVELS, "1/255 looked at", "fold 1/255", "fold 1/255"]
    assert [r.setting.occlusion for r in rows] == [True] * 6 + [False] * 6 + [True, True, False]
    assert all(r.median_s > 0 and r.units > 0 and r.spread_s == 0 for r in rows)
    assert all(r.megapixels_s == pytest.approx(r.width * r.height / 1e6 / r.median_s) for r in rows)
    assert all(r.keeps for r in rows)


def test_errors_are_those_against_the_exact_rendering(measured: tuple[list[speed.SettingCost], BenchScene]) -> None:
    rows, subject = measured
    for r in (r for r in rows if r.setting.method == "layered" and not r.setting.attention):
        out, wanted = (
            metrics.display(
                speed.blur_by_coc(subject.image, subject.coc_px, tolerance=t, occlusion=r.setting.occlusion)
            )
            for t in (r.setting.tolerance, 0.0)
        )
        assert r.rms_255 == pytest.approx(255 * float((out - wanted).square().mean().sqrt()), abs=1e-5)
        assert r.psnr_db == pytest.approx(metrics.psnr(out, wanted), abs=1e-3)
        assert r.rms_255 > 0.1 or r.setting.tolerance < 4 / 255  # so that there is something to compare


def test_where_the_viewer_looks_the_error_is_that_of_the_tolerance() -> None:
    subject = shipped(192, 320)
    look = speed.Setting("layered", True, 1 / 255, attention=(160.0, 96.0, 12.0))
    wanted = speed.exact(subject, occlusion=True)
    row = speed.measure_setting(subject, look, wanted, 1, 1.0)
    everywhere = speed.measure_setting(subject, speed.Setting("layered", True, 1 / 255), wanted, 1, 1.0)
    assert row.keeps and row.rms_255 > 2 * everywhere.rms_255, "nothing was loosened"
    wrong = wanted + 0.1 * (speed.weight_map(look.attention, wanted) == 1)
    assert not speed.measure_setting(subject, look, wrong, 1, 1.0).keeps


def test_a_wrong_exact_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = shipped(36, 64)
    right = speed.exact
    monkeypatch.setattr(speed, "exact", lambda part, occlusion: right(part, occlusion) + 0.2 * (not occlusion))
    rows, unit = speed.measure_all(subject, repeat=1)
    assert [r.keeps for r in rows] == [r.setting.occlusion for r in rows]
    assert min(r.rms_255 for r in rows if not r.keeps) > 10
    speed.write(tmp_path, rows, subject, unit, 1)
    text = (tmp_path / "speed.md").read_text()
    assert "**The tolerance was not kept by: 8/255 without occlusion; 4/255 without" in text
    assert text.count("| NO |") == 7


def test_a_rendering_that_is_not_finite_breaks_the_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = shipped(36, 64)
    wanted = speed.exact(subject, True).clone()
    assert speed.measure_setting(subject, EXACT, wanted, 1, 1.0).keeps

    def broken(*_: Any, **__: Any) -> Tensor:
        out = wanted.clone()
        out[..., 5, 5] = torch.inf  # a display clips it
        return out

    wanted[..., 5, 5] = 1.0
    monkeypatch.setattr(speed, "blur_by_coc", broken)
    found = speed.measure_setting(subject, EXACT, wanted, 1, 1.0)
    assert found.rms_255 == 0
    assert not found.keeps


def test_median_and_spread_are_those_of_the_timed_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = shipped(36, 64)
    wanted = speed.exact(subject, True)
    ticks = iter([-9.0, -8.0, -5.0, -4.0, 0.0, 1.0, 10.0, 12.0, 20.0, 23.0, 30.0, 34.0, 40.0, 60.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(ticks))
    found = speed.measure_setting(subject, EXACT, wanted, 5, 2.0)
    assert (found.median_s, found.spread_s, found.units) == (3.0, 2.0, 1.5)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="this system does not tell its peak memory")
def test_peak_memory_is_that_of_the_setting_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = shipped(36, 64)
    wanted = speed.exact(subject, True)
    sizes = [64, 8]

    def greedy(*_: Any, **__: Any) -> Tensor:
        torch.ones(sizes[0] * 2**18).sum()
        return wanted

    monkeypatch.setattr(speed, "blur_by_coc", greedy)
    large = speed.measure_setting(subject, EXACT, wanted, 1, 1.0).peak_mb
    sizes.pop(0)
    small = speed.measure_setting(subject, EXACT, wanted, 1, 1.0).peak_mb
    assert 60 < large < 80
    assert 6 < small < 20


def test_the_front_is_what_nothing_like_it_beats() -> None:
    other, crop = speed.Setting("layered", False, 0.0), speed.Setting("fold", True, 0.0, 16)
    a, b, c = row(EXACT, 1.0, 3.0), row(EXACT, 2.0, 1.0), row(EXACT, 2.0, 3.0)
    d, e = row(other, 3.0, 4.0), row(crop, 0.1, 0.1)
    assert speed.pareto([c, b, e, a, d]) == [a, b, d]
    assert speed.pareto([a, a]) == [a, a]


def test_the_built_in_scene_is_blurred_alike_before_and_behind_the_focus() -> None:
    subject = shipped()
    assert subject.image.shape == (1, 3, 540, 960)
    assert float(subject.coc_px.min()) == pytest.approx(-16, abs=0.5)
    assert float(subject.coc_px.max()) == pytest.approx(16, abs=0.5)
    sharp = (subject.coc_px.abs() < 0.5).float().mean()
    assert 0 < sharp < 0.1


def test_fold_gets_a_crop_whose_columns_fit() -> None:
    image, coc = torch.rand(1, 3, 200, 300), torch.full((1, 1, 200, 300), 60.0)
    subject = BenchScene("x", image, coc)
    crops = [s for s in speed.settings(subject) if s.method == "fold"]
    assert [s.occlusion for s in crops] == [True, False]
    side = crops[0].side
    assert side is not None and 16 <= side < 128
    assert side**2 * 123**2 * 3 * 4 <= 256 * 2**20
    part = subject.crop(20)
    assert torch.equal(part.image, image[..., 90:110, 140:160])
    assert part.coc_px.shape == (1, 1, 20, 20)
    coc[..., 3, 297] = -61.0
    part = subject.crop(20, widest=True)
    assert torch.equal(part.image, image[..., :20, 280:]) and part.radius_px == 61.0


def test_bench_measures_ones_own_scene_and_writes(files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    result = run(*files, "--repeat", 1, "--out", out, "--f-number", 1.4, "--sensor-width-mm", 6)
    assert result.exit_code == 0, result.output
    assert "image.exr, 64 x 36, blur radius -" in result.output
    assert "focus at the median depth" in " ".join(result.output.split())
    assert sorted(p.name for p in out.iterdir()) == ["speed.csv", "speed.md", "speed.png"]
    with (out / "speed.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["setting"] for r in rows] == [*LEVELS, *LEVELS, "1/255 looked at", "fold 1/255", "fold 1/255"]
    assert [r["crop"] for r in rows] == ["False"] * 13 + ["True"] * 2
    text = (out / "speed.md").read_text()
    for fact in (f"torchdof {importlib.metadata.version('torchdof')}", f"torch {torch.__version__}", " threads; "):
        assert fact in text
    picture = read_image(out / "speed.png").pixels
    assert picture.shape[-1] > 500
    assert float(picture.std()) > 0.05
    # the figures are those of this image, this depth and this camera
    image = read_image(files[0]).pixels
    depth = torch.linspace(1.0, 4.0, 64).expand(1, 1, 36, 64)
    camera = Camera(50.0, 1.4, float(depth.median()), 6.0)
    shown = [metrics.display(DepthOfField(camera, tolerance=t)(image, depth)) for t in (8 / 255, 0.0)]
    assert float(rows[0]["psnr_db"]) == pytest.approx(metrics.psnr(*shown), abs=0.01)
    assert math.isinf(float(rows[5]["psnr_db"]))


def test_json_holds_the_rows_that_are_printed(files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    measured = [row(EXACT, 0.5, 0.0), row(speed.Setting("layered", False, 1 / 255), 0.1, math.nan)]
    monkeypatch.setattr(speed, "measure_all", lambda *_: (measured, 0.02))
    facts = json.loads(run(*files, "--json", "--focus-m", 2).stdout)
    assert facts["scene"] == "image.exr" and facts["unit_s"] == 0.02 and facts["scans"] == []
    assert [cost["median_s"] for cost in facts["settings"]] == [0.5, 0.1]
    assert facts["settings"][0]["setting"]["tolerance"] == 0.0 and facts["settings"][1]["rms_255"] == "nan"


def test_bench_focuses_where_it_is_told(files: tuple[Path, Path], tmp_path: Path) -> None:
    how = RenderSettings(focus=[(0, 1.0)])
    subject = from_files(*files, how)
    assert float(subject.coc_px.min()) == pytest.approx(0.0, abs=1e-5)
    assert "focus as stated" in subject.remark
    given = from_files(*files, RenderSettings(depth_kind="coc", depth_scale=2.0))
    assert float(given.coc_px.max()) == pytest.approx(8.0)


def test_bench_measures_the_lens_that_it_is_told(files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[BenchScene] = []

    def kept(scene: BenchScene, *_: Any) -> tuple[list[speed.SettingCost], float]:
        measured.append(scene)
        return [row(EXACT, 0.5, 0.0)], 0.02

    monkeypatch.setattr(speed, "measure_all", kept)
    lens = ("--fov-deg", 40, "--aperture-radius-m", 0.02, "--focus-at", "0,0", "--table", "gaussian", "--blades", 5)
    result = run(*files, *lens, "--json")
    assert result.exit_code == 0, result.output
    assert "5 blades" in json.loads(result.stdout)["table"]
    depth = torch.linspace(1.0, 4.0, 64).expand(1, 1, 36, 64)
    camera = Camera.from_fov(40.0, 0.02, 1.0).focus_at(depth, 0.0, 0.0)
    torch.testing.assert_close(measured[0].coc_px, camera.coc_px(depth, 64))
    smooth, even = (speed.exact(dataclasses.replace(measured[0], table=t), True) for t in (measured[0].table, DISC))
    assert float((smooth - even).abs().max()) > 0.01


def test_alpha_is_left_out(tmp_path: Path) -> None:
    pixels = torch.full((1, 4, 20, 24), 0.5)
    write_image(tmp_path / "a.exr", Picture(pixels, ("R", "G", "B", "A")))
    write_image(tmp_path / "d.exr", Picture(torch.full((1, 1, 20, 24), 2.0), ("Y",)))
    assert from_files(tmp_path / "a.exr", tmp_path / "d.exr", RenderSettings()).image.shape[1] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.exr"], "missing.exr"),
        (["IMAGE"], "has no depth channel; name a depth file"),
        (["IMAGE", "IMAGE"], "which of the channels"),
        (["IMAGE", "DEPTH", "--truth", "."], "leave IMAGE and DEPTH out"),
        (["IMAGE", "DEPTH", "--out", "nowhere"], "no such folder"),
        (["--truth", ".", "--out", ".", "--f-number", "2"], "have their own lens and depth"),
        (["--truth", ".", "--out", ".", "--blades", "5"], "have their own lens and depth"),
        (["--vignetting", "0.4", "--onnx"], "one kernel a layer"),
        (["IMAGE", "DEPTH", "--views", "4"], "name its folder with --truth"),
        (["IMAGE", "DEPTH", "--f-number", "-1"], "--f-number must be positive"),
        (["IMAGE", "DEPTH", "--depth-kind", "coc", "--focus-m", "2"], "takes no camera"),
        (["IMAGE", "SMALL"], "must have the same aspect ratio"),
        (["TINY", "TINY", "--depth-kind", "z"], "from 16 pixels a side on"),
        (["--focus-m", "2"], "the built-in scene has its own camera"),
        (["--truth", "."], "give a folder with --out"),
        (["--truth", ".", "--json"], "leave --json out"),
        (["IMAGE", "DEPTH", "--fill-depth", "x"], "--fill-depth expects nearest, far or metres"),
        (["--truth", ".", "--scan"], "leave IMAGE and DEPTH out, and --onnx, --compile and --scan"),
    ],
)
def test_bad_arguments_are_refused_in_a_sentence(
    files: tuple[Path, Path], tmp_path: Path, arguments: list[str], message: str
) -> None:
    write_image(tmp_path / "small.exr", Picture(torch.ones(1, 1, 20, 20), ("Y",)))
    write_image(tmp_path / "tiny.exr", Picture(torch.ones(1, 1, 8, 8), ("Y",)))
    names = {"IMAGE": files[0], "DEPTH": files[1], "SMALL": tmp_path / "small.exr", "TINY": tmp_path / "tiny.exr"}
    result = run(*(names.get(a, a) for a in arguments))
    assert result.exit_code == 2
    assert message in result.output
    assert result.output.count("\n") == 1


def test_an_exported_file_has_its_row(exported_by_command: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    def copied(dof: DepthOfField, path: str, inputs: str, channels: int, width: int | None) -> None:
        assert dof.options.max_coc_px == 2.0 and not dof.options.occlusion and (inputs, channels) == ("coc_px", 3)
        shutil.copyfile(exported_by_command[0], path)

    monkeypatch.setattr("torchdof.export.to_onnx", copied)
    subject = shipped(64, 96)
    found = [s for s in speed.settings(subject, ["onnxruntime"]) if s.runtime == "onnxruntime"]
    assert [(s.name, s.occlusion) for s in found] == [("onnx 1/255", True), ("onnx 1/255", False)]
    wanted = speed.exact(subject, occlusion=False)
    exported = speed.renderer(subject, found[1])
    monkeypatch.setattr(speed, "renderer", lambda *_: exported)
    here = speed.measure_setting(subject, found[1], wanted, 1, 1.0)
    assert here.keeps and 0 < here.rms_255 < 1
    assert not speed.measure_setting(subject, found[1], wanted + 0.1, 1, 1.0).keeps


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")  # from within inductor
@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.sweep)])
def test_a_compiled_module_has_its_row_and_tells_what_compiling_took(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=backend))
    subject = shipped(64, 96)
    found = [s for s in speed.settings(subject, ["compiled"]) if s.runtime == "compiled"]
    assert [(s.name, s.occlusion) for s in found] == [("compiled 1/255", True), ("compiled 1/255", False)]
    here = speed.measure_setting(subject, found[1], speed.exact(subject, occlusion=False), 1, 1.0)
    assert here.keeps and here.ready_s > here.median_s > 0
    assert f"compiled 1/255 without occlusion: ready after {here.ready_s:.0f} s" in speed._remarks([here])


def test_bench_needs_a_compiler_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    result = run("--compile")
    assert result.exit_code == 2 and "install g++ or leave --compile out" in result.output


def test_scans_change_the_radius_or_the_frame_alone() -> None:
    subject = shipped(64, 128)
    scenes = scaling.scenes(subject)
    assert [name for name, _ in scenes] == ["radius"] * 5 + ["size"] * 3
    for radius, (_, scene) in zip((4, 8, 16, 32, 64), scenes, strict=False):
        assert float(scene.coc_px.abs().max()) == pytest.approx(radius)
        assert torch.equal(scene.image, subject.image)
    widest = [float(s.coc_px.abs().max()) / s.image.shape[-1] for _, s in scenes[5:]]
    assert widest == pytest.approx([widest[-1]] * 3, rel=0.05)
    assert torch.equal(scenes[-1][1].image, subject.image)
    assert scaling.scenes(BenchScene("sharp", subject.image, torch.zeros(1, 1, 64, 128))) == []


def test_the_scan_is_printed_and_written(files: tuple[Path, Path], tmp_path: Path) -> None:
    result = run(*files, "--repeat", 1, "--out", tmp_path, "--f-number", 1.4, "--sensor-width-mm", 6, "--scan")
    assert result.exit_code == 0, result.output
    assert "How cost grows" in result.output
    text = (tmp_path / "speed.md").read_text()
    table = text.split("## How cost grows")[1].strip().splitlines()[2:]
    assert len(table) == 2 + 8
    assert [line.split(" | ")[2] for line in table[2:7]] == ["4", "8", "16", "32", "64"]
    assert all(float(line.split(" | ")[3]) > 0 for line in table[2:])


def test_without_matplotlib_it_says_so_before_it_measures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "matplotlib" else find(name, *a))
    result = run("--out", tmp_path)
    assert result.exit_code == 2
    assert "pip install 'torchdof[plot]'" in result.output
    assert not list(tmp_path.iterdir())


def test_a_scene_without_any_error_is_drawn_as_well(tmp_path: Path) -> None:
    speed.write(tmp_path, [row(EXACT, 1.0, 0.0)], shipped(36, 64), 1.0, 1)
    assert float(read_image(tmp_path / "speed.png").pixels.std()) > 0.05


def test_a_table_that_fails_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(speed, "_csv", full)
    (tmp_path / "speed.md").write_text("before")
    subject = shipped(36, 64)
    with pytest.raises(OSError, match="no space"):
        speed.write(tmp_path, [row(EXACT, 1.0, 1.0)], subject, 1.0, 1)
    assert [p.name for p in tmp_path.iterdir()] == ["speed.md"]
    assert (tmp_path / "speed.md").read_text() == "before"
