"""The scripts of ``examples`` run and print or draw the right things."""

import math
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
import torch.nn.functional as functional

from tests import on_cpu
from torchdof.cli.command import command_of
from torchdof.cli.render import Render
from torchdof.io.images import read_image
from torchdof.reference.metrics import display

Run = Callable[..., tuple[dict[str, Any], str]]
ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
DATA = EXAMPLES / "data" / "motorcycle"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a script with arguments as the main module, and returns its globals and its output."""

    def run(script: str, *arguments: object) -> tuple[dict[str, Any], str]:
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        names = runpy.run_path(str(EXAMPLES / script), run_name="__main__")
        return names, capsys.readouterr().out

    return run


def test_the_sheet_of_bokeh_shows_six_lenses(tmp_path: Path, run: Run) -> None:
    run("bokeh.py", "--out", tmp_path / "bokeh.png", "--height", 96)
    picture = read_image(tmp_path / "bokeh.png").pixels
    assert picture.shape == (1, 3, 96 + 34 + 8, 6 * (72 + 8) + 8)
    panels = [picture[..., 34:130, 8 + 80 * k : 80 + 80 * k] for k in range(6)]
    for k, panel in enumerate(panels):
        assert panel.std() > 0.03
        assert all(float((panel - other).abs().mean()) > 2e-3 for other in panels[:k])


def test_steps_prints_the_cost_of_a_step(run: Run) -> None:
    threads = ("--threads", torch.get_num_threads())
    names, printed = run("benchmarks/steps.py", ROOT / "tests/data/scenes/planes", "--repeat", 1, *threads)
    _, *rows = printed.splitlines()
    assert [row[:46].strip() for row in rows] == [f"planes/0, {name}, 8 px" for name in names["RENDERERS"]]
    for row in rows:
        picture, step, ratio, memory, of_step, operations, reads = map(float, re.findall(r"-?[\d.]+|nan", row[46:]))
        assert picture > 0 and step > 0 and ratio == pytest.approx(step / picture, abs=0.06)
        assert (memory <= of_step < 1000 or math.isnan(memory)) and operations > reads > 0
    made = [(light.shape, near.shape) for _, light, near in names["pictures"](None, "cpu")]
    assert made == [((n, 3, *size), (n, 1, *size)) for *size, n in names["SIZES"]["cpu"]]


@pytest.mark.skipif(on_cpu.COMPILER is None, reason="there is no C++ compiler")
def test_the_run_for_a_gpu_compares_and_counts_without_one() -> None:
    """In a process of its own, because it takes the CPU for a device.

    In these two pictures, the pixel with the darkest light lies away from edges: there rounding decides on the gradient
    of either engine.
    """
    script = """
import examples.benchmarks.gpu as gpu
gpu.SMALL_CASES = gpu.CASES = [((24, 32, 2), 3.0)]
gpu.main()
"""
    printed = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert "no CUDA device: the kernels run on the CPU" in printed and "failed" not in printed
    apart = re.findall(r"picture (\S+) of the light nearby, gradients by light (\S+), coc (\S+)", printed)
    assert apart and all(float(value) < limit for value, limit in zip(apart[0], (1e-5, 1e-4, 1e-4), strict=True))
    counts = re.findall(r"kernels of a picture: (\d+) launches, (\d+) MB, by the model", printed)
    launches, mib = map(float, counts[0])
    assert launches > 8 and mib > 0 and "composite" in printed and "split_back" in printed


MAX_OUTLIERS = {"near": 680, "middle": 1070, "far": 390}
"""Largest number of pixels with a blur radius above 2 px that differ from the median of their 3 x 3 by over 8/255."""


def test_few_pixels_differ_from_their_blurred_surroundings(tmp_path: Path, run: Run) -> None:
    demo, _ = run("demo.py", "--data", DATA, "--out", tmp_path)
    for name, focus_m in demo["FOCUS_M"].items():
        shown = display(read_image(tmp_path / f"{name}.png").pixels).mean(1, keepdim=True)
        around = functional.unfold(functional.pad(shown, (1,) * 4, mode="replicate"), 3)
        median = around.median(1).values.view_as(shown)
        _, depth, camera = demo["motorcycle"](DATA, focus_m)
        coc_px = camera.coc_px(depth, depth.shape[-1])
        outliers = int((((shown - median).abs() > 8 / 255) & (coc_px.abs() > 2)).sum())
        assert outliers <= MAX_OUTLIERS[name], f"{name}: {outliers}"


@pytest.mark.filterwarnings("ignore:.*one distance was measured")  # as in the paper
def test_the_paper_s_experiment_reaches_its_figure_4(tmp_path: Path, run: Run) -> None:
    _, printed = run("paper.py", "--out", tmp_path)
    for name in ("sato_fig2", "sato_fig3", "sato_fig4", "traced_fig2_ratio", "traced_fig3", "traced_fig4"):
        picture = np.asarray(oiio.ImageBuf(str(tmp_path / f"{name}.png")).get_pixels())
        assert picture.std() > 0.02, name
    # a thin lens gives 0.318 mm on a sensor of 9 mm and 480 px, 17.0 px; the traced lens is slightly larger
    assert 16.9 < float(re.findall(r"radius = ([\d.]+)", printed)[0]) < 17.3
    assert "sigma = 0.0023476 m" in printed
    assert "samples of its own curve" in printed
    of_ratio, of_forward = map(float, re.findall(r"rms radius [\d.]+ px, ([+-][\d.]+) %", printed))
    assert abs(of_forward) < 2 < abs(of_ratio)
    assert float(re.findall(r"spot itself: ([\d.]+) dB", printed)[0]) > 45


def test_gradient_descent_finds_the_blur_and_with_a_known_lens_the_metres(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The script runs with fewer steps at full size."""
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "solve_scale.py"))
    main = example["main"]
    *coarse, (factor, steps, rate) = example["STAGES"]
    monkeypatch.setitem(main.__globals__, "STAGES", (*coarse, (factor, 8, rate)))
    scene = ROOT / "tests" / "data" / "scenes" / "room"
    monkeypatch.setattr(
        "sys.argv", ["solve_scale.py", "--scene", str(scene), "--out", str(tmp_path), "--known", "f_number", "focus_m"]
    )
    main()
    printed = capsys.readouterr().out
    rows = {line.split()[0]: [float(x) for x in line.split()[1:]] for line in re.findall(r"  \w+ +[\d. ]+", printed)}
    (*_, radius_px, depth_percent, close_db), guess = rows["found"], rows["guess"]
    assert radius_px < 0.15 < 1.0 < guess[4]
    assert close_db > rows["true"][6] - 0.3
    assert depth_percent < 4
    assert (tmp_path / "room_1_scale.png").is_file()


def test_the_template_for_render_farms_uses_existing_options() -> None:
    text = (EXAMPLES / "farm" / "openjd.yaml").read_text()
    called = set(re.findall(r"^ +- (--[a-z-]+)$", text, flags=re.MULTILINE))
    existing = {option for parameter in command_of("render", Render).params for option in parameter.opts}
    assert {"--frames", "--resume", "--out", "--focus-m"} <= called <= existing
    declared = set(re.findall(r"^  - name: (\w+)$", text, flags=re.MULTILINE)) - {"Render"}
    assert set(re.findall(r"\{\{Param\.(\w+)\}\}", text)) == declared
