"""``torchdof bench --truth``: accuracy with exact and with degraded depth, beside other tools."""

import csv
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from torchdof.bench import accuracy
from torchdof.cli.main import app
from torchdof.io.images import read_image
from torchdof.reference import metrics
from torchdof.reference.ikoma import layered_fft
from torchdof.reference.scenes import Plane, camera_of, plane_scene, posts, read_scenes, waves

DATA = Path(__file__).parents[1] / "data" / "scenes"
TOY = "NAME = 'toy'\ndef version(): return '7'\ndef blur(image, coc_px):\n    return image, 2.5\n"


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["bench", *map(str, arguments)])


def test_ikoma_renders_two_planes_with_the_near_one_in_focus() -> None:
    planes = [Plane(2.0, waves(1, (0.6, 0.3, 0.2)), posts(40, 15)), Plane(6.0, waves(2))]
    camera = camera_of(200.0, 96, aperture_radius_m=0.1, focus_m=2.0)
    scene = plane_scene(planes, camera, (60, 96), samples=128)
    out = metrics.display(layered_fft(scene.image.double(), scene.coc_px).float())
    assert metrics.psnr(metrics.display(scene.image), metrics.display(scene.truth), scene.inner) < 32
    assert metrics.psnr(out, metrics.display(scene.truth), scene.inner) > 36


def test_bench_scores_renderers_peers_and_references_and_draws_the_worst_windows(tmp_path: Path) -> None:
    scenes, out, peer = tmp_path / "scenes", tmp_path / "out", tmp_path / "peer.py"
    shutil.copytree(DATA / "room", scenes / "room")
    peer.write_text(TOY)
    result = run("--truth", scenes, "--out", out, "--views", 64, "--views", 4, "--peer", peer)
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in out.iterdir()) == ["accuracy.csv", "accuracy.md", "accuracy.png"]
    with (out / "accuracy.csv").open() as file:
        rows = {row["renderer"]: row for row in csv.DictReader(file)}
    names = [*accuracy.renderers(degraded=False), "toy 7", "reference 4", "reference 64"]
    assert list(rows) == names
    scene = next(read_scenes(scenes))
    shown, truth = metrics.display(scene.image), metrics.display(scene.truth)
    for name, mask in (("psnr_db", None), ("psnr_inner", scene.inner)):
        assert float(rows["untouched"][name]) == pytest.approx(metrics.psnr(shown, truth, mask), rel=1e-5)
    assert float(rows["torchdof"]["psnr_db"]) > float(rows["untouched"]["psnr_db"]) + 10
    assert float(rows["reference 64"]["psnr_db"]) > float(rows["reference 4"]["psnr_db"])
    assert rows["toy 7"]["psnr_db"] == rows["untouched"]["psnr_db"] and float(rows["toy 7"]["new_ms"]) == 2500.0
    text = " ".join((out / "accuracy.md").read_text().split())
    assert "| toy 7 |" in text and all(name in result.output for name in names)
    assert read_image(out / "accuracy.png").pixels.shape[-1] == (len(names) + 2) * (128 + 8) + 8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "has no function blur"),
        ("def blur(image, coc_px): ...\ndef available(): return 'apt install it'", "cannot run here; apt install it"),
    ],
)
def test_a_peer_that_cannot_run_is_refused(tmp_path: Path, text: str, message: str) -> None:
    peer = tmp_path / "peer.py"
    peer.write_text(text)
    with pytest.raises(ValueError, match=message):
        accuracy.read_peer(peer)
    result = run("--truth", DATA, "--out", tmp_path, "--peer", tmp_path / "none.py")
    assert result.exit_code == 2 and "No such file or directory" in result.output


def test_bench_shows_the_change_without_a_rule_on_every_scene(tmp_path: Path) -> None:
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    for name in ("room", "planes"):
        shutil.copytree(DATA / name, scenes / name)
    result = run("--truth", scenes, "--without", "filling", "--out", out)
    assert result.exit_code == 0, result.output
    with (out / "ablation.csv").open() as file:
        rows = {(row["scene"], row["without"]): row for row in csv.DictReader(file)}
    assert {scene for scene, _ in rows} == {scene.name for scene in read_scenes(scenes)} and len(rows) == 4
    for (name, rule), row in rows.items():
        whole = float(rows[name, ""]["psnr_db"])
        assert float(row["change_db"]) == pytest.approx(float(row["psnr_db"]) - whole, abs=1e-4)
        assert (float(row["change_db"]) == 0) == (rule == "")
    assert "fills hidden surfaces behind blurred foregrounds" in result.output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--without", "fill"], "--without: there is no rule 'fill'; the rules are matting"),
        (["--without", "filling", "--ablation"], "--ablation measures every rule; leave --without out"),
        (["--ablation", "--views", "4"], "leave --views and --peer out"),
    ],
)
def test_options_for_rules_that_do_not_fit_are_refused(tmp_path: Path, options: list[str], message: str) -> None:
    result = run("--truth", DATA, "--out", tmp_path / "out", *options)
    assert result.exit_code != 0 and message in " ".join(result.output.split())
    assert not (tmp_path / "out").exists()
