"""``torchdof bench``: speed against error, of the built-in scene or the user's."""

import csv
import dataclasses
import functools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner, Result
from torch import Tensor

from torchdof import Camera, DepthOfField, blur_by_coc
from torchdof.bench import speed
from torchdof.bench.measurement import BenchScene, shipped, timed
from torchdof.cli.main import app
from torchdof.depth.guess import subject_m
from torchdof.io.images import Picture, read_image, write_image
from torchdof.reference import metrics

WAYS = ["8/255", "4/255", "2/255", "1/255", "0.5/255", "exact", "focus pull 1/255", "fresh process 1/255"]
SETTINGS = [way + without for without in ("", " without occlusion") for way in WAYS]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["bench", *map(str, arguments)])


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs the "fresh process" rows in this process."""
    monkeypatch.setattr(speed, "_in_a_fresh_process", lambda blur, *picture: timed(blur, *picture))


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    image, depth = tmp_path / "image.exr", tmp_path / "depth.exr"
    write_image(image, Picture(shipped(36, 64).image), sample="float")
    metres = torch.linspace(1.0, 4.0, 64).expand(1, 1, 36, 64)
    write_image(depth, Picture(metres, ("Y",)), sample="float")
    return image, depth


def test_errors_are_those_of_the_scene_s_own_camera(in_this_process: None) -> None:
    scene = shipped(36, 120).seen(0.0, 13.0)  # blurred enough for coarse layers to show
    rows = {row["setting"]: row for row in speed.compare(scene, repeat=2)}
    assert list(rows) == SETTINGS
    assert all(row["new_ms"] > 0 and row["over_beside"] > 0 and row["kept"] for row in rows.values())
    assert all(("again_ms" in row) != name.startswith("fresh process") for name, row in rows.items())
    for name, row in rows.items():
        if name.split("/")[0] in ("8", "4", "1"):
            options: dict[str, Any] = {"occlusion": "without" not in name}
            out, exact = (
                metrics.display(blur_by_coc(scene.image, scene.coc_px, tolerance=tolerance, **options))
                for tolerance in (row["tolerance"], 0.0)
            )
            assert row["rms_255"] == pytest.approx(255 * float((out - exact).square().mean().sqrt()), abs=1e-4)
            assert row["rms_255"] > 0.1 or row["tolerance"] < 4 / 255


def test_a_fresh_process_renders_the_same_picture_and_reports_its_own_time() -> None:
    scene = shipped(36, 64)
    blur = functools.partial(blur_by_coc, tolerance=4 / 255)
    (picture, seconds), waited = timed(lambda: [speed._in_a_fresh_process(blur, scene.image, scene.coc_px)])[0][0], 0.0
    torch.testing.assert_close(picture, blur(scene.image, scene.coc_px), atol=1e-6, rtol=0)
    assert seconds.wall > 0 and seconds.cpu > waited


def test_the_report_names_a_tolerance_that_was_not_kept(
    in_this_process: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def wrong(*arguments: Any, **options: Any) -> Tensor:
        return blur_by_coc(*arguments, **options) + 0.2 * (options.get("tolerance") == 4 / 255)

    def two(*arguments: Any, works: Any = speed.works) -> list[Any]:
        return [work for work in works(*arguments) if work[0]["setting"].startswith(("8/255", "4/255"))]

    monkeypatch.setattr(speed, "blur_by_coc", wrong)
    monkeypatch.setattr(speed, "works", two)
    scene = shipped(36, 64)
    rows = speed.compare(scene, repeat=1)
    assert [row["setting"] for row in rows if not row["kept"]] == ["4/255", "4/255 without occlusion"]
    speed.report(rows, scene, None)
    assert "tolerance was not kept by: 4/255; 4/255 without occlusion." in " ".join(capsys.readouterr().out.split())


def test_bench_measures_the_users_scene(in_this_process: None, files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    result = run(*files, "--repeat", 1, "--out", out, "--f-number", 1.4, "--sensor-width-mm", 6)
    assert result.exit_code == 0, result.output
    assert "image.exr, blur radius -" in result.output
    assert "focus on what is nearest the middle" in " ".join(result.output.split())
    assert sorted(p.name for p in out.iterdir()) == ["speed.csv", "speed.md"]
    with (out / "speed.csv").open() as file:
        rows = {row["setting"]: row for row in csv.DictReader(file)}
    assert list(rows) == SETTINGS
    text = " ".join((out / "speed.md").read_text().split())
    assert "Every tolerance was kept." in text and "| 8/255 |" in text
    # the rows are of this image, this depth and this camera
    image = read_image(files[0]).pixels
    depth = torch.linspace(1.0, 4.0, 64).expand(1, 1, 36, 64)
    camera = Camera(50.0, 1.4, subject_m(depth), 6.0)
    shown = [metrics.display(DepthOfField(camera, tolerance=t)(image, depth)) for t in (8 / 255, 0.0)]
    assert float(rows["8/255"]["psnr_db"]) == pytest.approx(metrics.psnr(*shown), abs=0.01)
    assert math.isinf(float(rows["exact"]["psnr_db"]))


def test_bench_takes_lens_and_focus_and_prints_json(files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[BenchScene] = []
    row = {"setting": "exact", "new_ms": 0.5, "psnr_db": math.inf, "rms_255": math.nan, "kept": True}
    monkeypatch.setattr(speed, "compare", lambda scene, *_: measured.append(scene) or [row])  # type: ignore[func-returns-value]
    lens = ("--fov-deg", 40, "--aperture-radius-m", 0.02, "--focus-at", "0,0", "--table", "gaussian", "--blades", 5)
    result = run(*files, *lens, "--json")
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert "5 blades" in facts["table"] and facts["scene"] == "image.exr"
    assert facts["settings"] == [row | {"psnr_db": "inf", "rms_255": "nan"}]
    depth = torch.linspace(1.0, 4.0, 64).expand(1, 1, 36, 64)
    camera = Camera.from_fov(40.0, 0.02, 1.0).focus_at(depth, 0.0, 0.0)
    torch.testing.assert_close(measured[0].coc_px, camera.coc_px(depth, 64))
    blur = {f["setting"]: blur for f, blur, _ in speed.works(measured[0], True)}["exact"]
    even = blur_by_coc(measured[0].image, measured[0].coc_px, tolerance=0.0)
    assert float((blur(measured[0].image, measured[0].coc_px) - even).abs().max()) > 0.01
    for options in (("--focus-m", 1.0), ("--depth-kind", "coc", "--depth-scale", 2.0)):
        assert run(*files, *options, "--json").exit_code == 0
    _, stated, given = measured
    assert float(stated.coc_px.min()) == pytest.approx(0.0, abs=1e-5) and "focus as stated" in stated.remark
    assert float(given.coc_px.max()) == pytest.approx(8.0)


def test_an_exported_file_is_a_row(exported_by_command: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    def copied(dof: DepthOfField, path: str, inputs: str, channels: int, width: int | None) -> None:
        assert dof.options.max_coc_px == 2.0 and not dof.options.occlusion and (inputs, channels) == ("coc_px", 1)
        shutil.copyfile(exported_by_command[0], path)

    monkeypatch.setattr("torchdof.export.to_onnx", copied)
    scene = shipped(64, 96)
    scene = dataclasses.replace(scene, image=scene.image[:, :1])
    picture = speed._prepared("onnxruntime", scene, occlusion=False)(scene.image, scene.coc_px)
    exact = blur_by_coc(scene.image, scene.coc_px, occlusion=False, tolerance=0.0)
    error = (metrics.display(picture) - metrics.display(exact)).square().mean().sqrt()
    assert 0 < 255 * float(error) < 1, "the file's tolerance is that of the row"
