"""Speed against error: time of each setting for one's own scene, and its difference from the exact rendering."""

import functools
import math
import multiprocessing
import statistics
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from ..module import DepthOfField, blur_by_coc
from ..optics.camera import Camera
from .measurement import BenchScene, Renderer, Seconds, error, measure, peak_of, timed
from .report import Row, publish, summary

__all__ = ["compare", "report", "works"]

_TOLERANCES = (8.0, 4.0, 2.0, 1.0, 0.5, 0.0)  # tolerances, in 1/255
_RADII_PX, _SIZES = (4.0, 8.0, 16.0, 32.0, 64.0), (0.25, 0.5)
_ROUNDING = 1e-6  # RMS error, of 1, by which rounding may exceed the tolerance


def works(
    scene: BenchScene, occlusion: bool, runtimes: Sequence[str] = (), scan: bool = False
) -> list[tuple[dict[str, Any], Renderer, BenchScene]]:
    """The settings: first columns of the row, renderer, and scene; ``scan`` adds other radii and frame sizes."""
    blur = functools.partial(blur_by_coc, table=scene.table, occlusion=occlusion)
    settings: list[tuple[str, float, Renderer, BenchScene]] = [
        *((f"{n:g}/255" if n else "exact", n, functools.partial(blur, tolerance=n / 255), scene) for n in _TOLERANCES),
        *((f"{runtime} 1/255", 1, _prepared(runtime, scene, occlusion), scene) for runtime in runtimes),
        ("focus pull 1/255", 1, blur, scene),
        ("fresh process 1/255", 1, functools.partial(_in_a_fresh_process, blur), scene),
        *((f"{px:g} px 1/255", 1, blur, scene.seen(0.0, px)) for px in _RADII_PX * scan),
        *((f"{share:g} of the frame 1/255", 1, blur, scene.resized(share)) for share in _SIZES * scan),
    ]
    without = " without occlusion" * (not occlusion)
    rows = []
    for name, n, render, view in settings:
        height, width = view.image.shape[-2:]
        columns = {"setting": name + without, "tolerance": n / 255, "frame": f"{width} x {height}"}
        rows.append((columns, render, view))
    return rows


def _prepared(runtime: str, scene: BenchScene, occlusion: bool) -> Renderer:
    """A renderer at 1/255 with ``torch.compile`` or an exported file, compiled or exported beforehand."""
    reach = max(1.0, float(math.ceil(scene.coc_px.abs().max())))
    options: dict[str, Any] = {"table": scene.table, "occlusion": occlusion, "max_coc_px": reach, "check": False}
    if runtime == "compiled":
        compiled: Renderer = torch.compile(functools.partial(blur_by_coc, **options))
        compiled(scene.image, scene.coc_px)
        return compiled
    from torchdof.export import to_onnx
    from torchdof.export.verification import session

    channels, width = scene.image.shape[1], None if scene.table.unit == "relative" else scene.image.shape[-1]
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/dof.onnx"
        to_onnx(DepthOfField(Camera(), **options), path, inputs="coc_px", channels=channels, width=width)
        run = functools.partial(session(path).run, None)
    return lambda image, coc_px: torch.from_numpy(run({"image": image.numpy(), "coc_px": coc_px.numpy()})[0])


def _in_a_fresh_process(blur: Renderer, image: Tensor, coc_px: Tensor) -> tuple[Tensor, Seconds]:
    """The first picture of a new process, timed in it, without its start and imports."""
    spawn, threads = multiprocessing.get_context("spawn"), torch.get_num_threads()
    with ProcessPoolExecutor(1, spawn, torch.set_num_threads, (threads,)) as process:
        return process.submit(timed, blur, image, coc_px).result()


def compare(
    scene: BenchScene, repeat: int, console: Console | None = None, runtimes: Sequence[str] = (), scan: bool = False
) -> list[Row]:
    """Measures every setting of :func:`works`, with and without occlusion; a row for each.

    Errors are of the scene's own camera, times of ``repeat`` others, different ones for each setting.
    """
    hidden, rows = console is None or not console.is_terminal, []
    with torch.no_grad():
        for occlusion in (True, False):
            exact = blur_by_coc(scene.image, scene.coc_px, table=scene.table, occlusion=occlusion, tolerance=0.0)
            cases = works(scene, occlusion, runtimes, scan)
            for columns, blur, view in track(cases, "", console=console, transient=True, disable=hidden):
                setting = columns["setting"]
                again = not setting.startswith("fresh process")
                cameras = view.pull(repeat) if setting.startswith("focus pull") else view.cameras(repeat, setting)
                rows += [columns | measure(blur, camera, again)[1] for camera in cameras]
                if view is scene:
                    (picture, _), peak_mb = peak_of(functools.partial(timed, blur, view.image, view.coc_px))
                    rows.append({**columns, "peak_mb": peak_mb, **error(picture, exact)})
    summaries = summary(rows, ["setting", "tolerance", "frame"], statistics.median)
    return [{**row, "kept": row.get("rms_255", 0.0) <= 255 * (row["tolerance"] + _ROUNDING)} for row in summaries]


def report(rows: Sequence[Row], scene: BenchScene, out: Path | None, quiet: bool = False) -> None:
    """Prints a table unless quiet; writes ``speed.csv`` and ``.md`` to a folder: both or none."""
    low, high = float(scene.coc_px.min()), float(scene.coc_px.max())
    title = f"Speed against error: {scene.name}, blur radius {low:.1f} to {high:.1f} px, {scene.table!r}"
    exceeded = "; ".join(row["setting"] for row in rows if not row["kept"])
    remarks = [
        f"{scene.remark}. A focus pull is a sequence; a fresh process renders its first picture. kept: the RMS error "
        "against the exact rendering with the same occlusion is within the tolerance.",
        f"**The tolerance was not kept by: {exceeded}.**" if exceeded else "Every tolerance was kept.",
    ]
    publish(title, rows, remarks, out and out / "speed", quiet=quiet)
