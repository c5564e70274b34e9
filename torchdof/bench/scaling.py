"""How the cost of a scene grows with its blur and with the size of its frame."""

import dataclasses
import functools
import math
from collections.abc import Sequence

from rich.console import Console
from rich.progress import track

from .inputs import LEAST_PX, BenchScene
from .report import ReportTable
from .speed import Setting, render_scene
from .timer import median_and_spread, times

__all__ = ["ScanCost", "measure_scans", "scenes", "table_of"]

_TOLERANCE = 1 / 255
_RADII_PX = (4.0, 8.0, 16.0, 32.0, 64.0)
_SIZES = (0.25, 0.5, 1.0)
_COLUMNS = ("scan", "frame", "radius px", "ms", "± ms", "Y", "ns a pixel", "without occlusion: ms", "± ms", "Y")


@dataclasses.dataclass(frozen=True)
class ScanCost:
    """What one scene of a scan took, with and without occlusion; times in seconds, units in Y."""

    scan: str
    width: int
    height: int
    radius_px: float
    median_s: float
    spread_s: float
    units: float
    ns_a_pixel: float
    plain_median_s: float
    plain_spread_s: float
    plain_units: float


def scenes(scene: BenchScene) -> list[tuple[str, BenchScene]]:
    """The same scene with other largest radii, and in smaller frames with a blur as large relative to the width.

    Example:
        >>> from torchdof.bench.inputs import shipped
        >>> [(name, s.image.shape[-1], round(float(s.coc_px.abs().max()))) for name, s in scenes(shipped(64, 128))][4:]
        [('radius', 128, 64), ('size', 32, 1), ('size', 64, 1), ('size', 128, 2)]
    """
    if not 0 < scene.radius_px < math.inf:
        return []
    height, width = scene.image.shape[-2:]
    sizes = [(max(LEAST_PX, round(height * factor)), max(LEAST_PX, round(width * factor))) for factor in _SIZES]
    return [
        *(("radius", scene.blurred(radius)) for radius in _RADII_PX),
        *(("size", scene.resized(*size)) for size in sizes),
    ]


def measure_scans(scene: BenchScene, repeat: int, unit: float, console: Console | None = None) -> list[ScanCost]:
    """Times of :func:`scenes` at a tolerance of 1/255.

    Args:
        scene: What is rendered.
        repeat: Timed renderings each, after one more.
        unit: Unit Y in seconds.
        console: Where to show progress; None shows none.

    Returns:
        A row for each; none if all is in focus.
    """
    rows, silent = [], console is None or not console.is_terminal
    for scan, scanned in track(scenes(scene), "scans", console=console, transient=True, disable=silent):
        height, width = scanned.image.shape[-2:]
        medians_and_spreads = []
        for occlusion in (True, False):
            setting = Setting("layered", occlusion, _TOLERANCE)
            medians_and_spreads.append(
                median_and_spread(times(functools.partial(render_scene, scanned, setting), repeat))
            )
        (median, spread), (without, without_spread) = medians_and_spreads
        radius, pixels = scanned.radius_px, width * height
        with_occlusion = (median, spread, median / unit, 1e9 * median / pixels)
        rows.append(ScanCost(scan, width, height, radius, *with_occlusion, without, without_spread, without / unit))
    return rows


def table_of(rows: Sequence[ScanCost]) -> ReportTable:
    """A line for each scene of the scans."""
    lines = [list(_COLUMNS)]
    for r in rows:
        line = [r.scan, f"{r.width} x {r.height}", f"{r.radius_px:.3g}", f"{1e3 * r.median_s:.0f}"]
        line += [f"{1e3 * r.spread_s:.0f}", f"{r.units:.2f}", f"{r.ns_a_pixel:.0f}"]
        lines.append([*line, f"{1e3 * r.plain_median_s:.0f}", f"{1e3 * r.plain_spread_s:.0f}", f"{r.plain_units:.2f}"])
    remark = "The same scene at 1/255 with other largest radii, and in smaller frames, as blurred for their width."
    return ReportTable("How cost grows", lines, words=("scan",), remark=remark)
