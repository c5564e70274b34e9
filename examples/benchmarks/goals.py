"""What whole frames, crops, batches and gradients cost, beside the goals of this project.

    python examples/benchmarks/goals.py SCENES --out results

``SCENES`` is a folder of scenes as for ``torchdof bench --truth``. It takes minutes, and 8 GB of memory.

What is compared is timed in turns, so that whatever else the machine does meets both sides alike; each figure is the
median, and the interquartile range, of the ratios within the turns.
"""

import dataclasses
import functools
import importlib.util
import itertools
import math
import subprocess
import sys
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import track
from torch import Tensor

from torchdof.bench import memory
from torchdof.bench.inputs import BenchScene, shipped
from torchdof.bench.report import Report, ReportTable, csv_of, existing_folder, machine
from torchdof.bench.speed import Setting, exact, render_scene, unit_work
from torchdof.bench.timer import in_turns, median_and_spread, timed, times
from torchdof.cli.errors import told_in_one_sentence
from torchdof.module import blur_by_coc
from torchdof.reference import metrics
from torchdof.reference.scenes import read_scenes
from torchdof.validation import whole

__all__ = ["Figure", "compare", "measure_goals", "bench_scenes"]

_FRAME, _HALF, _DOUBLE, _LARGEST = (1080, 1920), (540, 960), (2160, 3840), (4320, 7680)  # height, width
_CROP_PX, _FOLD_PX = 512, 64
_FINE, _LOOSE, _DRAFT = 1 / 255, 4 / 255, 8 / 255
_RADII = (8.0, 16.0, 32.0, 64.0)
_OCCLUSION_Y = {"foliage": (5.0, 6.0, 6.5), "highlights": (4.5, 6.0, 7.0)}  # goals by radius, in Y, of hard scenes
_USUAL_Y, _WITHOUT_Y, _DRAFT_Y = (4.0, 4.5, 5.0), 2.0, 1.0
_OVER_GEGL = ", over GEGL's lens-blur"
_GEGL_TIMES = 1.5  # on average over all scenes and radii
_BUSY_TIMES = 3.0  # beside two processes that each keep a core busy
_USUAL_PX, _WIDE_PX, _CROP_RADIUS_PX = 16.0, 64.0, 8.0
_WITHIN = 8.0  # tolerances: the error of all but a thousandth of the pixels


@dataclasses.dataclass(frozen=True)
class Figure:
    """What was measured on one scene: the median of the turns, their interquartile range, and the goal.

    Args:
        scene: Its name.
        what: What was measured.
        unit: Unit of the next three; ``times`` for a ratio.
        value: Median.
        spread: Interquartile range.
        goal: What it should be at most, or at least; NaN where none was set.
        at_least: Which of the two.
    """

    scene: str
    what: str
    unit: str
    value: float
    spread: float
    goal: float = math.nan
    at_least: bool = False

    @property
    def missed(self) -> bool:
        """Whether there is a goal and it was not reached."""
        return self.value < self.goal if self.at_least else self.value > self.goal


def bench_scenes(scenes: Path) -> list[BenchScene]:
    """What is measured: the built-in scene, and of each scene of a folder the setting in the middle.

    Raises:
        OSError: If there is no scene.
        ValueError: If one is not as :func:`torchdof.reference.scenes.read_scenes` takes it.
    """
    measured = [shipped(*_FRAME)]
    for _, settings in itertools.groupby(read_scenes(scenes), lambda scene: scene.name.rpartition("/")[0]):
        cases = list(settings)
        middle = cases[len(cases) // 2]
        scene = BenchScene(middle.name, middle.image, middle.coc_px).resized(*_FRAME)
        if not scene.radius_px > 0:
            raise ValueError(f"{scene.name}: is all in focus; goals are for scenes with blur, leave it out")
        measured.append(scene)
    return measured


def compare(scenes: Path, out: Path | None, repeat: int) -> None:
    """Measures every figure on every scene, prints and writes the tables.

    Args:
        scenes: Folder of scenes, as :func:`torchdof.reference.scenes.read_scenes` takes it.
        out: Folder for ``goals.csv`` and ``goals.md``; None: the table is printed only.
        repeat: How many turns, after one more.

    Raises:
        ValueError: If input is wrong.
        OSError: If there is no scene, or a file cannot be written.
    """
    whole("--repeat", repeat, 1, 10000)
    progress, figures = Console(stderr=True), []
    works = [
        *(functools.partial(measure_goals, scene, repeat) for scene in bench_scenes(scenes)),
        functools.partial(_quad, repeat),
    ]
    for work in track(works, "scenes", console=progress, transient=True, disable=not progress.is_terminal):
        of_scene = work()
        _show(of_scene)  # the next one takes a minute
        figures += of_scene
    over = [figure.value for figure in figures if figure.what.endswith(_OVER_GEGL)]
    if over:
        mean = dataclasses.replace(_figure("mean of all" + _OVER_GEGL, "times", over, _GEGL_TIMES), scene="all scenes")
        figures.append(dataclasses.replace(mean, value=sum(over) / len(over)))
        _show(figures[-1:])
    if out is not None:
        remark = f"{_remark(figures, repeat)} They are bold."
        table = ReportTable("Figures", _lines(figures))
        Report("goals", "Cost beside the goals", [f"{machine()}.", remark, table], csv_of(figures)).write(out)
    Console().print(f"{machine()}. {_remark(figures, repeat)}", markup=False, highlight=False)


def measure_goals(scene: BenchScene, repeat: int) -> list[Figure]:
    """Every figure of one scene.

    Args:
        scene: A frame of 1920 x 1080, not all in focus.
        repeat: How many turns, after one more.
    """
    parts = (
        _errors(scene),
        _frames(scene, repeat),
        _beside_gegl(scene, repeat),
        _busy(scene, repeat),
        _crops(scene, repeat),
        _sizes(scene, repeat),
    )
    return [dataclasses.replace(figure, scene=scene.name) for part in parts for figure in part]


def _errors(scene: BenchScene) -> Iterator[Figure]:
    """Whether the renderings that are timed are right."""
    scene, size = scene.blurred(_USUAL_PX), _size(_FRAME)
    for occlusion in (True, False):
        shown, wanted = (
            metrics.display(image)
            for image in (render_scene(scene, Setting("layered", occlusion, _FINE)), exact(scene, occlusion))
        )
        error = (shown.double() - wanted.double()).abs()
        rms, rare = math.sqrt(float(error.square().mean())), float(torch.quantile(error, 0.999))
        what = f"{size}, {_USUAL_PX:g} px{_without(occlusion)}: error at 1/255"
        yield _figure(f"{what}, RMS", "of 255", [255 * rms], 255 * _FINE)
        yield _figure(f"{what}, of 99.9 % of all values", "of 255", [255 * rare], 255 * _FINE * _WITHIN)


def _frames(scene: BenchScene, repeat: int) -> Iterator[Figure]:
    """A frame by its radius, in Y and beside other tolerances, radii and methods."""
    works: dict[Hashable, Callable[[], object]] = {"Y": unit_work()}
    works["in focus"] = functools.partial(render_scene, scene.blurred(0.0), Setting("layered", True, _FINE))
    usual = scene.blurred(_USUAL_PX)
    part = usual.crop(_FOLD_PX, widest=True)  # its kernels are as large as the frame's
    for occlusion in (True, False):
        setting = Setting("layered", occlusion, _FINE)
        for radius in _RADII:
            works[radius, occlusion] = functools.partial(render_scene, scene.blurred(radius), setting)
        works["loose", occlusion] = functools.partial(render_scene, usual, Setting("layered", occlusion, _LOOSE))
        works["fold", occlusion] = functools.partial(render_scene, part, Setting("fold", occlusion, _FINE))
    for radius in _RADII[:3]:
        works[radius, "draft"] = functools.partial(
            render_scene, scene.blurred(radius), Setting("layered", False, _DRAFT)
        )
    timings = in_turns(works, repeat)
    frame = _size(_FRAME)
    yield _figure("Y", "ms", [1e3 * seconds for seconds in timings["Y"]])
    yield _figure(f"{frame}, all in focus", "Y", _ratios(timings, "in focus", "Y"), 0.2)
    usual_y = _OCCLUSION_Y.get(scene.name.partition("/")[0], _USUAL_Y)
    for occlusion, goals in ((True, usual_y), (False, (_WITHOUT_Y,) * 3)):
        for radius, goal in zip(_RADII, (*goals, math.nan), strict=True):
            what = f"{frame}, {radius:g} px{_without(occlusion)}"
            yield _figure(what, "Y", _ratios(timings, (radius, occlusion), "Y"), goal)
    for radius in _RADII[:3]:
        what = f"{frame}, {radius:g} px{_without(False)}, draft"
        yield _figure(what, "Y", _ratios(timings, (radius, "draft"), "Y"), _DRAFT_Y)
    for occlusion in (True, False):
        wide = _ratios(timings, (_WIDE_PX, occlusion), (_USUAL_PX, occlusion))
        yield _figure(f"radius {_WIDE_PX:g} over {_USUAL_PX:g} px{_without(occlusion)}", "times", wide, 1.3)
        loose = _ratios(timings, (_USUAL_PX, occlusion), ("loose", occlusion))
        yield _figure(f"4/255 faster than 1/255{_without(occlusion)}", "times", loose, 1.5, at_least=True)
        share = usual.coc_px.numel() / part.coc_px.numel()
        fold = [share * ratio for ratio in _ratios(timings, ("fold", occlusion), (_USUAL_PX, occlusion))]
        yield _figure(f"layered faster than fold, by pixel{_without(occlusion)}", "times", fold, 50.0, at_least=True)


def _beside_gegl(scene: BenchScene, repeat: int) -> Iterator[Figure]:
    """A frame with occlusion beside GEGL's lens-blur, where that is installed."""
    spec = importlib.util.spec_from_file_location("gegl", Path(__file__).parent / "tools" / "gegl.py")
    if spec is None or spec.loader is None:
        return
    gegl = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gegl)
    if gegl.available() is not None:
        return
    for radius in _RADII[:3]:
        blurred = scene.blurred(radius)
        render = functools.partial(render_scene, blurred, Setting("layered", True, _FINE))
        works: dict[Hashable, Callable[[], float]] = {
            "ours": functools.partial(lambda work: timed(work)[1], render),
            "GEGL": functools.partial(lambda s: gegl.blur(s.image, s.coc_px)[1], blurred),
        }
        timings = in_turns(works, repeat, seconds_of=lambda work: work())
        yield _figure(f"{radius:g} px{_OVER_GEGL}", "times", _ratios(timings, "ours", "GEGL"))


def _busy(scene: BenchScene, repeat: int) -> Iterator[Figure]:
    """A frame while two other processes each keep a core busy, over the same in quiet."""
    work = functools.partial(render_scene, scene.blurred(_USUAL_PX), Setting("layered", True, _FINE))
    quiet = times(work, repeat)
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        busy = times(work, repeat)
    finally:
        for other in others:
            other.kill()
            other.wait()
    what = f"{_USUAL_PX:g} px beside two busy processes, over quiet"
    yield _figure(what, "times", [a / b for a, b in zip(busy, quiet, strict=True)], _BUSY_TIMES)


def _crops(scene: BenchScene, repeat: int) -> Iterator[Figure]:
    """A crop, and what gradients cost on it."""
    part = scene.blurred(_CROP_RADIUS_PX).crop(_CROP_PX)
    wide = scene.blurred(_USUAL_PX).crop(_CROP_PX)
    image, coc_px = (x.clone().requires_grad_() for x in (wide.image, wide.coc_px))

    def forward() -> Tensor:
        return blur_by_coc(image, coc_px, tolerance=_FINE)

    timings = in_turns(
        {
            **{
                occlusion: functools.partial(render_scene, part, Setting("layered", occlusion, _FINE))
                for occlusion in (True, False)
            },
            "forward": forward,
            "both": lambda: torch.autograd.grad(forward().square().mean(), (image, coc_px)),
        },
        repeat,
    )
    crop = f"{part.image.shape[-1]} x {part.image.shape[-2]} crop"
    for seen in (True, False):
        milliseconds = [1e3 * seconds for seconds in timings[seen]]
        yield _figure(f"{crop}, {_CROP_RADIUS_PX:g} px{_without(seen)}", "ms", milliseconds, 20.0 if seen else math.nan)
    both = _ratios(timings, "both", "forward")
    yield _figure(f"{crop}, {_USUAL_PX:g} px: forward and backward over forward", "times", both, 4.0)


def _sizes(scene: BenchScene, repeat: int) -> Iterator[Figure]:
    """Larger frames, and several of them."""
    setting = Setting("layered", True, _FINE)
    usual = scene.blurred(_USUAL_PX)
    smaller = usual.resized(*_HALF).blurred(_USUAL_PX)
    flips: list[list[int]] = [[], [-1], [-2], [-2, -1]]
    items = [dataclasses.replace(smaller, image=smaller.image.flip(f), coc_px=smaller.coc_px.flip(f)) for f in flips]

    def batch() -> Tensor:
        with torch.inference_mode():
            return blur_by_coc(*(torch.cat([getattr(i, x) for i in items]) for x in ("image", "coc_px")))

    works: dict[Hashable, Callable[[], object]] = {
        "frame": functools.partial(render_scene, usual, setting),
        "double": functools.partial(render_scene, usual.resized(*_DOUBLE), setting),
        "batch": batch,
        "alone": lambda: [render_scene(item, setting) for item in items],
    }
    timings = in_turns(works, repeat)
    yield _figure(
        f"{_size(_DOUBLE)} over {_size(_FRAME)}, twice the radius", "times", _ratios(timings, "double", "frame"), 4.2
    )
    yield _figure(f"{len(items)} x {_size(_HALF)} over one by one", "times", _ratios(timings, "batch", "alone"), 1.0)
    largest = scene.resized(*_LARGEST).blurred(_WIDE_PX)
    peaks, seconds = [], []
    for _ in range(2):
        held = memory.reset_peak()
        seconds.append(timed(functools.partial(render_scene, largest, setting))[1])
        peaks.append((memory.peak_mb() - held) / 1024)
    what = f"{_size(_LARGEST)}, {_WIDE_PX:g} px"
    yield _figure(f"{what}: memory on top of the frame", "GiB", peaks, 5.0)
    yield _figure(f"{what}: time", "s", seconds)


def _quad(repeat: int) -> list[Figure]:
    """The case of the paper: a quad on black, at one depth."""
    n = _CROP_PX
    image = torch.zeros(1, 3, n, n)
    image[..., 2 * n // 5 : 3 * n // 5, 2 * n // 5 : 3 * n // 5] = 1.0
    scene = BenchScene("quad on black", image, torch.full((1, 1, n, n), _CROP_RADIUS_PX))
    timings = in_turns({"": functools.partial(render_scene, scene, Setting("layered", True, _FINE))}, repeat)
    milliseconds = [1e3 * seconds for seconds in timings[""]]
    what = f"{_size((n, n))}, {_CROP_RADIUS_PX:g} px everywhere"
    return [dataclasses.replace(_figure(what, "ms", milliseconds, 26.4), scene=scene.name)]


def _ratios(timings: Mapping[Hashable, Sequence[float]], over: Hashable, under: Hashable) -> list[float]:
    return [a / b for a, b in zip(timings[over], timings[under], strict=True)]


def _figure(what: str, unit: str, values: Sequence[float], goal: float = math.nan, at_least: bool = False) -> Figure:
    return Figure("", what, unit, *median_and_spread(values), goal, at_least)


def _size(size: tuple[int, int]) -> str:
    return f"{size[1]} x {size[0]}"


def _without(occlusion: bool) -> str:
    return "" if occlusion else ", without occlusion"


def _goal(figure: Figure) -> str:
    return "" if math.isnan(figure.goal) else f"at {'least' if figure.at_least else 'most'} {figure.goal:.3g}"


def _measured(figure: Figure) -> str:
    value, spread = (f"{x:.0f}" if x >= 100 else f"{x:.{n}g}" for x, n in ((figure.value, 3), (figure.spread, 2)))
    return f"{value} ± {spread}"


def _lines(figures: Sequence[Figure]) -> list[list[str]]:
    """A line for each figure, a column for each scene; what misses its goal is bold."""
    scenes = list(dict.fromkeys(figure.scene for figure in figures))
    lines: dict[str, list[str]] = {}
    for figure in figures:
        line = lines.setdefault(figure.what, [figure.what, figure.unit, _goal(figure), *("" for _ in scenes)])
        bold = "**" if figure.missed else ""
        line[3 + scenes.index(figure.scene)] = f"{bold}{_measured(figure)}{bold}"
    return [["figure", "in", "goal", *scenes], *lines.values()]


def _remark(figures: Sequence[Figure], repeat: int) -> str:
    with_goal = [figure for figure in figures if not math.isnan(figure.goal)]
    return (
        f"Median and spread (interquartile range) of {repeat} turns after one more, each figure from within the turns; "
        "the errors from one rendering, memory and time of the largest frame from two. Y: one depthwise 17 x 17 "
        f"convolution of 1 x 16 x 540 x 960. Goals missed: {sum(f.missed for f in with_goal)} of {len(with_goal)}."
    )


def _show(figures: Sequence[Figure]) -> None:
    """Prints the figures of one scene."""
    lines = [["figure", "measured", "in", "goal", ""]]
    for figure in figures:
        missed = "missed" if figure.missed else ""
        lines.append([figure.what, _measured(figure), figure.unit, _goal(figure), missed])
    ReportTable(figures[0].scene, lines, words=("figure", "in", "goal", "")).show()


def main(
    scenes: Annotated[Path, typer.Argument(help="Folder with scenes, as for torchdof bench --truth.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for goals.csv and goals.md.")] = None,
    repeat: Annotated[int, typer.Option(help="Timed renderings of each.", min=1)] = 5,
) -> None:
    """What whole frames, crops, batches and gradients cost, beside what this project wants them to cost at most."""
    with told_in_one_sentence():
        compare(scenes, existing_folder(out), repeat)


if __name__ == "__main__":
    typer.run(main)
