import csv
import dataclasses
import functools
import json
import math
import shutil
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path

import pytest
import torch
import typer
from typer.testing import CliRunner, Result

from examples.benchmarks import goals
from examples.benchmarks.goals import Figure
from torchdof.bench import speed
from torchdof.bench.inputs import BenchScene, shipped
from torchdof.bench.timer import in_turns, processor_seconds
from torchdof.reference.scenes import read_scenes

DATA = Path(__file__).parents[1] / "data" / "scenes"

app = typer.Typer()
app.command()(goals.main)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments)])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {
        "_FOLD_PX": 32,
        "_FRAME": (72, 128),
        "_HALF": (36, 64),
        "_DOUBLE": (144, 256),
        "_LARGEST": (288, 512),
        "_CROP_PX": 48,
    }
    for name, size in sizes.items():
        monkeypatch.setattr(goals, name, size)


@pytest.mark.parametrize(
    ("value", "goal", "at_least", "missed"),
    [
        (2.0, 2.0, False, False),
        (2.1, 2.0, False, True),
        (2.0, 2.0, True, False),
        (1.9, 2.0, True, True),
        (9.0, math.nan, False, False),
        (9.0, math.nan, True, False),
    ],
)
def test_a_goal_is_missed_beyond_it(value: float, goal: float, at_least: bool, missed: bool) -> None:
    assert Figure("a", "b", "Y", value, 0.0, goal, at_least).missed == missed


def test_large_figures_are_written_out() -> None:
    written = [goals._measured(Figure("a", "b", "ms", *pair)) for pair in ((1716.4, 472.2), (3.14159, 0.123))]
    assert written == ["1716 ± 472", "3.14 ± 0.12"]


def test_ratios_are_taken_within_a_turn() -> None:
    found: Mapping[Hashable, list[float]] = {"a": [2.0, 40.0, 6.0], "Y": [1.0, 10.0, 2.0]}
    assert goals._ratios(found, "a", "Y") == [2.0, 4.0, 3.0]
    figure = goals._figure("a", "Y", goals._ratios(found, "a", "Y"))
    assert (figure.value, figure.spread) == (3.0, 1.0)


def test_of_each_scene_the_setting_in_the_middle_is_measured(tmp_path: Path, small: None) -> None:
    shutil.copytree(DATA, tmp_path / "scenes")
    meta = tmp_path / "scenes" / "room" / "meta.json"
    data = json.loads(meta.read_text())
    (only,) = data["truths"]
    data["truths"] = [{**only, "index": k, "aperture_radius_m": (k + 1) * only["aperture_radius_m"]} for k in range(3)]
    meta.write_text(json.dumps(data))
    found = {scene.name: scene for scene in goals.bench_scenes(tmp_path / "scenes")}
    assert "room/1" in found and len(found) == 1 + len(list(DATA.rglob("meta.json")))
    assert all(scene.image.shape[-2:] == (72, 128) for scene in found.values())
    twice = next(scene for scene in read_scenes(tmp_path / "scenes") if scene.name == "room/1")
    wide = float(twice.coc_px.abs().max()) * 128 / twice.image.shape[-1]
    assert found["room/1"].radius_px == pytest.approx(wide, rel=0.01)


def test_a_number_of_turns_is_asked_for_before_anything_is_rendered() -> None:
    with pytest.raises(ValueError, match="--repeat"):
        goals.compare(DATA, None, 0)


def test_each_work_renders_what_its_figure_says(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = shipped(72, 128)
    rendered: list[tuple[tuple[int, ...], float, speed.Setting]] = []

    def noted(scene: BenchScene, setting: speed.Setting) -> None:
        rendered.append((tuple(scene.image.shape[-2:]), round(scene.radius_px, 3), setting))

    def times(works: Mapping[Hashable, Callable[[], object]], _: int) -> dict[Hashable, list[float]]:
        for name, work in works.items():
            if name not in ("Y", "forward", "both"):
                work()
        return {name: [float(k + 1)] for k, name in enumerate(works)}

    monkeypatch.setattr(goals, "render_scene", noted)
    monkeypatch.setattr(goals, "in_turns", times)
    figures = {figure.what: figure for figure in goals._frames(scene, 1)}
    frame, fine = (72, 128), speed.Setting("layered", True, 1 / 255)
    off = dataclasses.replace(fine, occlusion=False)
    assert rendered[:5] == [(frame, r, fine) for r in (0.0, 8.0, 16.0, 32.0, 64.0)]
    assert rendered[5] == (frame, 16.0, dataclasses.replace(fine, tolerance=4 / 255))
    assert [setting for _, _, setting in rendered[7:11]] == [off] * 4
    folds = [rendered[6], rendered[12]]
    assert [(radius, how.method, how.occlusion) for _, radius, how in folds] == [
        (16.0, "fold", o) for o in (True, False)
    ]
    assert rendered[13:] == [(frame, r, dataclasses.replace(off, tolerance=8 / 255)) for r in (8.0, 16.0, 32.0)]
    assert [size for size, _, _ in folds] == [(32, 32)] * 2
    assert figures["Y"].value == 1000.0 and figures["Y"].unit == "ms"
    assert figures["128 x 72, 16 px"].value == 4.0 and figures["128 x 72, 16 px"].goal == 4.5
    assert figures["128 x 72, 16 px, without occlusion"].goal == 2.0
    assert figures["radius 64 over 16 px"].value == 6 / 4
    assert figures["4/255 faster than 1/255"].value == 4 / 7 and figures["4/255 faster than 1/255"].missed
    assert figures["layered faster than fold, by pixel"].value == pytest.approx(8 / 4 * 72 * 128 / 32**2)

    rendered.clear()
    figures = {figure.what: figure for figure in goals._sizes(scene, 1)}
    assert rendered[:2] == [(frame, 16.0, fine), ((144, 256), 32.0, fine)]
    assert rendered[2:6] == [((36, 64), 16.0, fine)] * 4
    assert rendered[6:] == [((288, 512), 64.0, fine)] * 2
    assert figures["256 x 144 over 128 x 72, twice the radius"].value == 2.0
    assert figures["4 x 64 x 36 over one by one"].value == 3 / 4


def test_errors_are_those_of_what_is_timed(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = shipped(72, 128)
    right = list(goals._errors(scene))
    assert [figure.missed for figure in right] == [False] * 4
    assert 0 < right[0].value < right[1].value
    monkeypatch.setattr(goals, "render_scene", lambda scene, setting: speed.exact(scene, setting.occlusion) + 0.1)
    assert [figure.missed for figure in goals._errors(scene)] == [True] * 4


def test_a_crop_and_its_gradients_are_measured(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    # the clock counts what else the machine does
    monkeypatch.setattr(goals, "in_turns", functools.partial(in_turns, seconds_of=processor_seconds))
    figures = list(goals._crops(shipped(72, 128), 1))
    assert [figure.what for figure in figures] == [
        "48 x 48 crop, 8 px",
        "48 x 48 crop, 8 px, without occlusion",
        "48 x 48 crop, 16 px: forward and backward over forward",
    ]
    assert figures[0].value > 0 and figures[2].value > 1


def test_it_prints_and_writes_every_figure(small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blurs = {"_RADII": (2.0, 4.0, 6.0, 8.0), "_USUAL_PX": 4.0, "_WIDE_PX": 8.0, "_FOLD_PX": 16}
    for name, value in blurs.items():
        monkeypatch.setattr(goals, name, value)
    shutil.copytree(DATA / "room", tmp_path / "scenes" / "room")
    result = run(tmp_path / "scenes", "--repeat", 1, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    with (tmp_path / "goals.csv").open() as file:
        rows = list(csv.DictReader(file))
    beside_gegl = ["all scenes"] if any("GEGL" in row["what"] for row in rows) else []  # where it is installed
    assert {row["scene"] for row in rows} == {"slope with posts", "room/1", "quad on black", *beside_gegl}
    own, room, quad = ([r for r in rows if r["scene"] == s] for s in ("slope with posts", "room/1", "quad on black"))
    assert [row["what"] for row in own] == [row["what"] for row in room]
    assert [row["what"] for row in quad] == ["48 x 48, 8 px everywhere"]
    assert all(float(row["value"]) >= 0 for row in rows)
    text = (tmp_path / "goals.md").read_text()
    table = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(table) == 2 + len(room) + 1 + len(beside_gegl)
    assert f" {torch.get_num_threads()} threads; " in text
    figures = [
        Figure("", "", "", float(r["value"]), 0.0, float(r["goal"]), at_least=r["at_least"] == "True") for r in rows
    ]
    missed = sum(figure.missed for figure in figures)
    asked = sum(not math.isnan(figure.goal) for figure in figures)
    assert f"Goals missed: {missed} of {asked}." in text
    assert sum(line.count("**") for line in table) == 2 * missed
    assert f"Goals missed: {missed} of {asked}." in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["."], "no scene here"),
        ([DATA, "--out", "nowhere"], "no such folder"),
        ([DATA, "--repeat", 0], "--repeat"),
    ],
)
def test_bad_arguments_are_refused(
    arguments: list[object], message: str, small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.output
    assert not list(tmp_path.iterdir())


def test_a_scene_in_focus_has_no_figures(tmp_path: Path, small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BenchScene, "radius_px", 0.0)
    with pytest.raises(ValueError, match="is all in focus"):
        goals.bench_scenes(DATA)
