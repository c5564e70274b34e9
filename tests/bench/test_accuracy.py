import csv
import dataclasses
import math
import shutil
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner, Result

from torchdof.bench import accuracy
from torchdof.cli.main import app
from torchdof.io.images import read_image
from torchdof.reference import metrics
from torchdof.reference.scenes import Plane, Scene, camera_of, plane_scene, posts, read_scenes, waves

DATA = Path(__file__).parents[1] / "data" / "scenes"
CAMERA = camera_of(200.0, 96, aperture_radius_m=0.04, focus_m=2.0)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["bench", *map(str, arguments)])


def test_ikoma_renders_two_planes_focused_on_the_near_one() -> None:
    planes = [Plane(2.0, waves(1, (0.6, 0.3, 0.2)), posts(40, 15)), Plane(6.0, waves(2))]
    camera = camera_of(200.0, 96, aperture_radius_m=0.1, focus_m=2.0)
    scene = plane_scene(planes, camera, (60, 96), samples=512)
    out = metrics.display(accuracy.ikoma(scene))
    assert metrics.psnr(metrics.display(scene.image), metrics.display(scene.truth), scene.inner) < 32
    assert metrics.psnr(out, metrics.display(scene.truth), scene.inner) > 36


def test_ikoma_leaves_a_scene_in_focus_alone() -> None:
    image, depth = torch.rand(1, 3, 20, 30), torch.full((1, 1, 20, 30), 2.0)
    out = accuracy.ikoma(Scene("flat", image, depth, CAMERA, image))
    torch.testing.assert_close(out, image, rtol=1e-6, atol=1e-6)


def test_a_score_tells_the_inner_frame_apart() -> None:
    truth = torch.full((1, 3, 40, 50), 0.5)
    image = truth.clone()
    image[..., :3, :] = 0.9
    known = truth[:, :1] == 0.5
    known[..., :2, :] = False
    scene = Scene("flat", truth, truth[:, :1], CAMERA, truth, margin_px=3)
    score = accuracy.score("a", image, scene, known)
    assert score.psnr_inner == math.inf and score.psnr_known > score.psnr_display > 20
    wider = dataclasses.replace(scene, margin_px=2)
    assert accuracy.score("a", image, wider).psnr_inner < 40 and math.isnan(
        accuracy.score("a", image, wider).psnr_known
    )
    nothing_left = dataclasses.replace(scene, margin_px=20)
    assert math.isnan(accuracy.score("a", image, nothing_left).psnr_inner)


def test_bench_writes_a_table_and_a_picture(tmp_path: Path) -> None:
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    shutil.copytree(DATA / "room", scenes / "room")
    out.mkdir()
    result = run("--truth", scenes, "--out", out, "--views", 128, "--views", 4)
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in out.iterdir()) == ["accuracy.csv", "accuracy.md", "accuracy.png"]
    with (out / "accuracy.csv").open() as file:
        rows = {row["renderer"]: row for row in csv.DictReader(file)}
    assert list(rows) == [*accuracy.renderers(), "reference 4", "reference 128"]
    scene = next(read_scenes(scenes))
    assert float(rows["reference 128"]["psnr_known"]) > float(rows["reference 4"]["psnr_known"]) + 3
    score = accuracy.score("untouched", scene.image, scene)
    assert float(rows["untouched"]["psnr_display"]) == pytest.approx(score.psnr_display, rel=1e-5)
    assert float(rows["torchdof"]["psnr_display"]) > float(rows["untouched"]["psnr_display"]) + 10
    assert f"| room/1 | {score.psnr_display:.2f} |" in (out / "accuracy.md").read_text()
    assert read_image(out / "accuracy.png").pixels.shape == (1, 3, 2 * 128, 9 * 128)


def test_bench_without_scenes_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    result = run("--truth", tmp_path, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "no scene here" in result.output
    assert not list((tmp_path / "out").iterdir())


def test_bench_asks_for_its_folder_before_it_renders(tmp_path: Path) -> None:
    result = run("--truth", DATA, "--out", tmp_path / "missing")
    assert result.exit_code == 2
    assert "no such folder" in result.output
