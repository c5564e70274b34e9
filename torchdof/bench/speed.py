"""Speed against error: what each tolerance costs on a scene, and how far it stays from the exact rendering."""

import csv
import dataclasses
import functools
import io
import math
import statistics
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as functional
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from ..io.atomic import whole_file
from ..module import DepthOfField, blur_by_coc
from ..optics.camera import Camera
from ..options import Method
from ..reference import metrics
from ..render.attention import weight_map
from ..validation import whole
from . import memory
from .inputs import LEAST_PX, BenchScene
from .report import Report, ReportTable, machine
from .timer import median_and_spread, timed, times

__all__ = [
    "SettingCost",
    "Setting",
    "exact",
    "measure_setting",
    "measure_all",
    "pareto",
    "render_scene",
    "renderer",
    "settings",
    "show",
    "unit_s",
    "unit_work",
    "write",
]

_LEVELS = (8.0, 4.0, 2.0, 1.0, 0.5)  # of 255
_LOOKED_AT = 8  # of the height: radius of what is looked at
Runtime = Literal["torch", "compiled", "onnxruntime"]
_SHORT = {"compiled": "compiled", "onnxruntime": "onnx"}
_FOLD_PX = 128  # largest side of the crop that the literal scatter gets
_FOLD_BYTES = 256 * 2**20  # and the memory of its columns
_ROUNDING = 1e-6
_COLUMNS = ("ms", "± ms", "Y", "MP/s", "MiB", "RMS", "dB", "SSIM", "kept")


@dataclasses.dataclass(frozen=True)
class Setting:
    """One way to render, options as in :class:`torchdof.DepthOfField`.

    Args:
        method: As there.
        occlusion: As there.
        tolerance: As there.
        side: Largest side of a crop; None is the frame.
        attention: Where the viewer looks, as in :meth:`torchdof.DepthOfField.forward`.
        runtime: ``compiled`` renders with ``torch.compile``, ``onnxruntime`` with an exported file.
    """

    method: Method
    occlusion: bool
    tolerance: float
    side: int | None = None
    attention: tuple[float, float, float] | None = None
    runtime: Runtime = "torch"

    @property
    def name(self) -> str:
        """For the report, such as ``1/255`` or ``fold 1/255``."""
        level = f"{self.tolerance * 255:g}/255" if self.tolerance else "exact"
        level += " looked at" if self.attention else ""
        level = level if self.runtime == "torch" else f"{_SHORT[self.runtime]} {level}"
        return level if self.method == "layered" else f"{self.method} {level}"


@dataclasses.dataclass(frozen=True)
class SettingCost:
    """What one setting took and reached; NaN is what could not be measured.

    Times are in seconds, for a picture from its circle of confusion; ``units`` is the median over unit Y (see
    :func:`unit_s`); ``peak_mb`` the growth of the process's resident memory in MiB; errors are display-encoded, against
    the exact rendering with the same occlusion. ``ready_s`` is what compiling or exporting took beforehand.
    """

    setting: Setting
    width: int
    height: int
    median_s: float
    spread_s: float
    units: float
    megapixels_s: float
    peak_mb: float
    rms_255: float
    psnr_db: float
    ssim: float
    keeps: bool
    ready_s: float = 0.0


def settings(scene: BenchScene, runtimes: Sequence[Runtime] = ()) -> list[Setting]:
    """What is compared on a scene: from coarse to exact with and without occlusion, and the literal scatter.

    That one holds k * k columns a pixel, so it gets a crop from the middle on which they stay within 256 MiB. Further
    runtimes render at 1/255.
    """
    taps = (2 * math.ceil(scene.radius_px) + 3) ** 2
    bytes_a_pixel = taps * scene.image.shape[1] * scene.image.element_size()
    side = min(_FOLD_PX, max(LEAST_PX, math.isqrt(_FOLD_BYTES // bytes_a_pixel)))
    compared = [Setting("layered", occlusion, level / 255) for occlusion in (True, False) for level in (*_LEVELS, 0.0)]
    height, width = scene.image.shape[-2:]
    compared.append(Setting("layered", True, 1 / 255, attention=(width / 2, height / 2, height / _LOOKED_AT)))
    for runtime in runtimes:
        compared += [Setting("layered", occlusion, 1 / 255, runtime=runtime) for occlusion in (True, False)]
    return [*compared, *(Setting("fold", occlusion, 1 / 255, side) for occlusion in (True, False))]


def exact(scene: BenchScene, occlusion: bool) -> Tensor:
    """The rendering that errors are measured against: exact kernels, dense layers, full resolution."""
    return render_scene(scene, Setting("layered", occlusion, 0.0))


def unit_work() -> Callable[[], Tensor]:
    """What unit Y is the time of: a depthwise 17 x 17 convolution of ``[1, 16, 540, 960]``, channels last.

    Times in it can be compared between machines.
    """
    frame = torch.rand(1, 16, 540, 960).contiguous(memory_format=torch.channels_last)
    weight = torch.rand(16, 1, 17, 17)
    return lambda: functional.conv2d(frame, weight, padding=8, groups=16)


def unit_s(repeat: int = 5) -> float:
    """Seconds of :func:`unit_work`: their median."""
    return statistics.median(times(unit_work(), repeat))


def render_scene(scene: BenchScene, setting: Setting) -> Tensor:
    """A scene as a setting of PyTorch says: ``[1, C, H, W]``."""
    with torch.inference_mode():
        return blur_by_coc(
            scene.image,
            scene.coc_px,
            table=scene.table,
            tolerance=setting.tolerance,
            occlusion=setting.occlusion,
            method=setting.method,
            attention=setting.attention,
        )


def renderer(scene: BenchScene, setting: Setting) -> Callable[[], Tensor]:
    """What renders a scene: a function without arguments, once all is prepared.

    Raises:
        ModuleNotFoundError: If onnxruntime is asked for and missing.
        ValueError: If the exported file does not render as the module does.
    """
    if setting.runtime == "torch":
        return lambda: render_scene(scene, setting)
    reach = max(1.0, float(math.ceil(scene.radius_px)))
    options: dict[str, Any] = {"table": scene.table, "tolerance": setting.tolerance, "occlusion": setting.occlusion}
    if setting.runtime == "compiled":
        compiled = torch.compile(functools.partial(blur_by_coc, max_coc_px=reach, check=False, **options))
        run = torch.no_grad()(lambda: compiled(scene.image, scene.coc_px))
        run()  # compiles
        return run
    from torchdof.bench.exported import session
    from torchdof.export import to_onnx

    dof = DepthOfField(Camera(), max_coc_px=reach, check=False, **options)
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/dof.onnx"
        width = None if scene.table.unit == "relative" else scene.image.shape[-1]
        to_onnx(dof, path, inputs="coc_px", channels=scene.image.shape[1], width=width)
        runner = session(path, torch.get_num_threads())
    feed = {"image": scene.image.numpy(), "coc_px": scene.coc_px.numpy()}
    return lambda: torch.from_numpy(runner.run(None, feed)[0])


def measure_setting(scene: BenchScene, setting: Setting, wanted: Tensor, repeat: int, unit: float) -> SettingCost:
    """Renders once to see that it is right, then ``repeat`` times for the time.

    Args:
        scene: What is rendered, already cropped.
        setting: How.
        wanted: The exact rendering, ``[1, C, H, W]``.
        repeat: How often, at least 1.
        unit: Unit Y in seconds.
    """
    work, ready = timed(lambda: renderer(scene, setting))
    start = memory.reset_peak()
    out = work()
    peak_mb = memory.peak_mb() - start
    shown, truth = metrics.display(out), metrics.display(wanted)
    squares = (shown.double() - truth.double()).square()
    rms = math.sqrt(float(squares.mean()))
    looked_at = squares if setting.attention is None else squares[..., weight_map(setting.attention, out)[0, 0] == 1]
    keeps = bool(torch.isfinite(out).all()) and math.sqrt(float(looked_at.mean())) <= setting.tolerance + _ROUNDING
    median, spread = median_and_spread(times(work, repeat))
    height, width = out.shape[-2:]
    speed = (median, spread, median / unit, width * height / 1e6 / median, peak_mb)
    error = (255 * rms, metrics.psnr(shown, truth), metrics.ssim(shown, truth))
    return SettingCost(setting, width, height, *speed, *error, keeps, 0.0 if setting.runtime == "torch" else ready)


def measure_all(
    scene: BenchScene, repeat: int = 5, console: Console | None = None, runtimes: Sequence[Runtime] = ()
) -> tuple[list[SettingCost], float]:
    """Every setting on a scene.

    Args:
        scene: What is rendered.
        repeat: How often each.
        console: Where to show progress; None shows none.
        runtimes: Others to render with: ``compiled`` needs a C++ compiler, ``onnxruntime`` the extra ``export``;
            both take minutes.

    Returns:
        A row for each setting, and unit Y in seconds.

    Raises:
        ValueError: If ``repeat`` is no positive number.
    """
    whole("--repeat", repeat, 1, 10000)
    unit, rows = unit_s(repeat), []
    references: dict[tuple[int | None, bool], Tensor] = {}
    silent = console is None or not console.is_terminal
    for setting in track(settings(scene, runtimes), "settings", console=console, transient=True, disable=silent):
        part = scene if setting.side is None else scene.crop(setting.side)
        key = (setting.side, setting.occlusion)
        if key not in references:
            references[key] = exact(part, setting.occlusion)
        rows.append(measure_setting(part, setting, references[key], repeat, unit))
    return rows, unit


def pareto(rows: Sequence[SettingCost]) -> list[SettingCost]:
    """Rows that no other row beats in time or error without losing in the other, fastest first.

    Rows with and without occlusion answer different questions, so each is compared with its like; crops and what keeps
    the tolerance in one place only are left out.
    """
    rows = [row for row in rows if row.setting.side is None and row.setting.attention is None]

    def beaten(row: SettingCost, other: SettingCost) -> bool:
        no_worse = other.median_s <= row.median_s and other.rms_255 <= row.rms_255
        return no_worse and (other.median_s, other.rms_255) != (row.median_s, row.rms_255)

    front = [
        row
        for row in rows
        if not any(beaten(row, other) for other in rows if row.setting.occlusion == other.setting.occlusion)
    ]
    return sorted(front, key=lambda row: row.median_s)


def write(
    folder: Path,
    rows: Sequence[SettingCost],
    scene: BenchScene,
    unit: float,
    repeat: int,
    scans: Sequence[ReportTable] = (),
) -> None:
    """Writes ``speed.csv``, ``speed.md`` and ``speed.png``: all of them or none.

    Args:
        folder: Where.
        rows: What was measured.
        scene: On what.
        unit: Unit Y in seconds.
        repeat: How often each.
        scans: Further tables for ``speed.md``, of how cost grows.

    Raises:
        OSError: If a file cannot be written.
        ModuleNotFoundError: If matplotlib is missing.
    """
    broken = [row.setting for row in rows if not row.keeps]
    names = "; ".join(f"{setting.name}{'' if setting.occlusion else ' without occlusion'}" for setting in broken)
    tables = []
    for occlusion in (True, False):
        lines = [["setting", *_COLUMNS], *(cells for row, cells in _lines(rows) if row.setting.occlusion == occlusion)]
        starred = [[cell.replace("*", "\\*") for cell in line] for line in lines]
        tables.append(ReportTable(f"{'With' if occlusion else 'Without'} occlusion", starred))
    report = Report(
        "speed",
        "Speed against error",
        [
            f"{_title(scene)}. {scene.remark}.",
            f"{machine()}.",
            f"Median and spread (interquartile range) of {repeat} renderings after one more. Y is the time of one "
            f"depthwise 17 x 17 convolution of 1 x 16 x 540 x 960, {1e3 * unit:.3g} ms in this run. MiB is the growth "
            "of resident memory. RMS (of 255), PSNR and SSIM are display-encoded, against the exact rendering with the "
            "same occlusion; *kept* says whether RMS is within the stated tolerance, a star that the row is on the "
            f"Pareto front. {_remarks(rows)}",
            f"**The tolerance was not kept by: {names}.**" if broken else "Every tolerance was kept.",
            *tables,
            *scans,
        ],
        _csv(rows),
    )
    report.write(folder, picture=lambda path: _plot(path, rows, scene))


def show(rows: Sequence[SettingCost], scene: BenchScene, unit: float) -> None:
    """Prints the table."""
    console = Console()
    console.print(f"{_title(scene)}; {scene.remark}", markup=False, highlight=False)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("setting", no_wrap=True)
    for column in _COLUMNS:
        table.add_column(column.partition(" ")[0], justify="right", no_wrap=True)
    for occlusion in (True, False):
        table.add_section()
        table.add_row("with occlusion:" if occlusion else "without:", style="bold")
        for row, cells in _lines(rows):
            if row.setting.occlusion == occlusion:
                table.add_row(*cells, style=None if row.keeps else "red")
    console.print(table)
    console.print(f"ms: median and spread; 1 Y = {unit * 1e3:.3g} ms; RMS (of 255), dB and SSIM against exact.")
    console.print(f"* on the Pareto front; kept: RMS within the tolerance. {_remarks(rows)}", markup=False)


def _csv(rows: Iterable[SettingCost]) -> str:
    """The measurements as CSV text, a line a setting."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [field.name for field in dataclasses.fields(SettingCost) if field.name != "setting"]
    writer.writerow(["setting", "method", "runtime", "occlusion", "tolerance", "crop", *names])
    for row in rows:
        setting = row.setting
        values = [
            setting.name,
            setting.method,
            setting.runtime,
            setting.occlusion,
            setting.tolerance,
            setting.side is not None,
        ]
        values += [getattr(row, name) for name in names]
        writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in values])
    return text.getvalue()


def _lines(rows: Sequence[SettingCost]) -> list[tuple[SettingCost, list[str]]]:
    """Each row with the cells of its line."""
    front, lines = pareto(rows), []
    for row in rows:
        cells = [row.setting.name + " *" * (row in front), f"{1e3 * row.median_s:.1f}", f"{1e3 * row.spread_s:.1f}"]
        cells += [f"{row.units:.2f}", f"{row.megapixels_s:.2f}", f"{row.peak_mb:.0f}", f"{row.rms_255:.3f}"]
        lines.append((row, [*cells, f"{row.psnr_db:.1f}", f"{row.ssim:.5f}", "yes" if row.keeps else "NO"]))
    return lines


def _remarks(rows: Sequence[SettingCost]) -> str:
    """What a reader of the table must know of its rows: what is a crop, what was compiled, where a tolerance holds."""
    sizes = {f"{row.width} x {row.height}" for row in rows if row.setting.side is not None}
    crop = f" fold holds k * k columns a pixel: on the {' and '.join(sizes)} pixels in the middle." if sizes else ""
    ready = [
        f" {row.setting.name}{'' if row.setting.occlusion else ' without occlusion'}: ready after {row.ready_s:.0f} s."
        for row in rows
        if row.setting.runtime != "torch"
    ]
    return (
        f"looked at: the tolerance holds in a circle in the middle, of 1/{_LOOKED_AT} of the height in radius, and a "
        f"draft's outside; kept is about the circle.{crop}{''.join(ready)}"
    )


def _title(scene: BenchScene) -> str:
    height, width = scene.image.shape[-2:]
    low, high = float(scene.coc_px.min()), float(scene.coc_px.max())
    return f"{scene.name}, {width} x {height}, blur radius {low:.1f} to {high:.1f} px, {scene.table!r}"


def _plot(path: Path, rows: Sequence[SettingCost], scene: BenchScene) -> None:
    """Draws RMS error over median time, both logarithmic, a line with and one without occlusion, to a PNG file."""
    # no pyplot: it would choose a screen and keep every figure alive
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogFormatter

    figure = Figure(figsize=(7, 4.5), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for occlusion, colour in ((True, "#c2410c"), (False, "#1d4ed8")):
        # a crop's time compares with nothing here
        chosen = [
            r for r in rows if r.setting.occlusion == occlusion and not r.setting.side and not r.setting.attention
        ]
        with_error = [row for row in chosen if row.rms_255 > 0]  # a logarithm has no zero
        front = [row for row in pareto(chosen) if row.rms_255 > 0]
        axes.plot([1e3 * r.median_s for r in front], [r.rms_255 for r in front], color=colour, lw=1)
        for row in with_error:
            point = (1e3 * row.median_s, row.rms_255)
            axes.plot(*point, "o", ms=6, color=colour, mfc=colour if row in front else "none")
            beside = row.setting.runtime != "torch"  # these lie side by side
            place: dict[str, Any] = {"xytext": (0, -11), "ha": "center"} if beside else {"xytext": (5, 4)}
            axes.annotate(row.setting.name, point, textcoords="offset points", fontsize=7, color=colour, **place)
        for row in (row for row in chosen if row.rms_255 == 0):
            axes.axvline(1e3 * row.median_s, color=colour, ls=":", lw=1)
        axes.plot([], [], "o-", color=colour, label="with occlusion" if occlusion else "without")
    axes.plot([], [], ":", color="grey", label="exact: no error")
    if not any(row.rms_255 > 0 for row in rows if row.setting.side is None):  # all in focus, or one plane
        axes.set_ylim(1e-3, 1.0)
    axes.margins(x=0.08)  # room for the names of the outermost
    axes.set(xscale="log", yscale="log", xlabel="median time [ms]", ylabel="RMS error, display-encoded [1/255]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(LogFormatter())
        axis.set_minor_formatter(LogFormatter())
    axes.set_title(_title(scene), fontsize=9)
    axes.grid(True, which="both", lw=0.3)
    axes.legend(fontsize=8, title="filled: Pareto front", title_fontsize=7)
    with whole_file(path) as part:
        figure.savefig(part)
