"""`torchdof fit`: photographs of a dot, or a lens prescription, to a blur table."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from torchdof import BlurTable
from torchdof.cli.arguments import AsJson
from torchdof.cli.printed import json_line
from torchdof.fit.photo.manifest import Captures, read_captures
from torchdof.fit.photo.table import TableFit, fit_captures
from torchdof.fit.problems import FitError, FitWarning

__all__ = ["fit"]

_CAPTURE, _LENS, _OUT = "From photographs", "From a lens prescription", "Result"


def fit(
    captures: Annotated[
        Path | None,
        typer.Argument(help="Folder with photographs of a dot and their capture.toml.", show_default=False),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The table to write (JSON).", rich_help_panel=_OUT)] = Path(
        "table.json"
    ),
    family: Annotated[
        Literal["auto", "gaussian", "ring", "disc", "softm", "radial"],
        typer.Option(help="Kernel family; auto takes the cheapest that is accurate enough.", rich_help_panel=_CAPTURE),
    ] = "auto",
    accuracy_db: Annotated[
        float, typer.Option(help="PSNR on a natural image that auto asks for.", rich_help_panel=_CAPTURE)
    ] = 45.0,
    dots: Annotated[
        Literal["manifest", "one", "centre", "each"],
        typer.Option(
            help="One dot; the centre of a grid; or each dot of it, one table a field position.",
            rich_help_panel=_CAPTURE,
        ),
    ] = "manifest",
    root: Annotated[
        Path | None,
        typer.Option(
            help="Folder that capture.toml and all its pictures must lie in; by default they may lie anywhere.",
            rich_help_panel=_CAPTURE,
        ),
    ] = None,
    lens: Annotated[
        str | None,
        typer.Option(help="Prescription: a file, or the name of a shipped one.", rich_help_panel=_LENS),
    ] = None,
    f_number: Annotated[float, typer.Option(help="Aperture of the lens.", rich_help_panel=_LENS)] = 2.0,
    focus_m: Annotated[float, typer.Option(help="Focus distance in metres; inf allowed.", rich_help_panel=_LENS)] = 2.0,
    nodes: Annotated[int, typer.Option(help="Distances traced.", rich_help_panel=_LENS)] = 33,
    plots: Annotated[
        Path | None, typer.Option(help="Folder for pictures of the fits and the table.", rich_help_panel=_OUT)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a blur table from photographs of a dot, or from a lens prescription.

    Photograph a white dot on black paper in focus and, without refocusing, at other distances; describe the
    pictures in capture.toml (see docs/measuring.md); then

        torchdof fit my-lens/ -o my-lens.json --plots pictures/

    Or trace a lens:

        torchdof fit --lens double_gauss_50mm --f-number 2 --focus-m 2 -o double-gauss.json
    """
    console = Console(soft_wrap=True, quiet=as_json)
    if (captures is None) == (lens is None):
        raise FitError("give either a folder of captures or --lens FILE")
    if root is not None and lens is not None:
        raise FitError("--root is the folder of photographs; leave it out with --lens")
    if out.suffix != ".json":
        raise FitError(f"the table is written as JSON: name it {out.with_suffix('.json')}", file=str(out))
    if plots is not None:
        plots.mkdir(parents=True, exist_ok=True)
    if lens is not None:
        table = _trace(lens, f_number, focus_m, nodes, console)
        _lens_summary(table, console)
        _write(table, out, console)
        if as_json:
            typer.echo(json_line({"out": str(out), "family": table.family, **table.provenance}))
        if plots is not None:
            _draw_table(table, plots, out.stem, console)
        return
    capture_sets = read_captures(str(captures), dots=None if dots == "manifest" else dots, root=root)
    first: TableFit | None = None  # the dot nearest to the centre, whose scale all share
    for i, capture_set in enumerate(capture_sets):
        target = out if len(capture_sets) == 1 else out.with_name(f"{out.stem}_{i:02d}.json")
        if len(capture_sets) > 1:
            console.print(f"dot {i} at {capture_set.notes['position_px']} px from the centre")
        command = f"torchdof fit {Path(str(captures)).name} --family {family} --accuracy-db {accuracy_db:g}"
        result, messages = _fit_with_progress(capture_set, family, accuracy_db, command, first, console)
        first = first or result
        _summary(capture_set, result, messages, console)
        _write(result.table, target, console)
        if as_json:
            typer.echo(json_line({"out": str(target), **_facts(capture_set, result, messages)}))
        if plots is not None:
            _draw_fits(capture_set, result, plots, target.stem, console)
            _draw_table(result.table, plots, target.stem, console)


def _trace(lens: str, f_number: float, focus_m: float, nodes: int, console: Console) -> BlurTable:
    from torchdof.fit.lens.lens import Lens
    from torchdof.fit.lens.trace import trace_table

    with console.status(f"tracing {nodes} distances"):
        return trace_table(Lens.read(lens), f_number=f_number, focus_m=focus_m, nodes=nodes)


def _fit_with_progress(
    captures: Captures, family: str, accuracy_db: float, command: str, scale_of: TableFit | None, console: Console
) -> tuple[TableFit, list[str]]:
    """Fits one set of captures behind a progress bar; returns the fit and the warnings, each once."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with warnings.catch_warnings(record=True) as caught, Progress(*columns, console=console, transient=True) as bar:
        warnings.simplefilter("always", FitWarning)
        job = bar.add_task("fitting", total=None)
        result = fit_captures(
            captures,
            family,
            accuracy_db=accuracy_db,
            progress=lambda done, total, what: bar.update(job, completed=done, total=total, description=what),
            command=command,
            scale_of=scale_of,
        )
    # "auto" fits a picture several times; what it says twice is said once
    return result, list(dict.fromkeys(str(w.message) for w in caught))


def _summary(captures: Captures, result: TableFit, messages: list[str], console: Console) -> None:
    """Prints a table of the fits at all distances, why the family was chosen, and the warnings."""
    shown = Table(
        title=f"{captures.name or 'captures'}: {result.table.family}, focus {captures.focus_m:g} m",
        title_justify="left",
    )
    names = [n for n in result.fits[0].params if n != "values"]
    for column in ("distance m", "coc px", "measured", *names, "residual %", "x noise", "magnification"):
        shown.add_column(column, justify="right")
    for pair, fitted, coc in zip(captures, result.fits, result.coc_px, strict=True):
        values = [f"{fitted.params[n]:.3f} ± {fitted.stderr[n]:.2g}" for n in names]
        ratio = fitted.residual_over_noise
        shown.add_row(
            f"{pair.distance_m:g}", f"{coc:+.2f}", f"{fitted.radius:.2f}", *values, f"{100 * fitted.residual:.2f}",
            "" if math.isnan(ratio) else f"{ratio:.2f}", f"{fitted.magnification:.4f}",
        )  # fmt: skip
    console.print(shown)
    console.print(f"family: {result.why}", markup=False, highlight=False)
    console.print(
        "circles of confusion: "
        + ("from focal length and f-number" if result.scale == "camera" else "measured, the thin lens in between"),
        highlight=False,
    )
    for message in messages:
        console.print(f"warning: {message}", style="yellow", markup=False, highlight=False)


def _facts(captures: Captures, result: TableFit, messages: list[str]) -> dict[str, Any]:
    """What :func:`_summary` prints, for programs."""
    fits = [
        {
            "distance_m": pair.distance_m,
            "coc_px": coc,
            "params": fitted.params,
            "stderr": fitted.stderr,
            "residual": fitted.residual,
            "residual_over_noise": fitted.residual_over_noise,
            "magnification": fitted.magnification,
        }
        for pair, fitted, coc in zip(captures, result.fits, result.coc_px, strict=True)
    ]
    chosen = {"name": captures.name, "family": result.table.family, "why": result.why, "scale": result.scale}
    return {**chosen, "focus_m": captures.focus_m, "fits": fits, "warnings": messages}


def _lens_summary(table: BlurTable, console: Console) -> None:
    """Prints what was traced and how well the kernels fit the spots."""
    facts, places = table.provenance, table.coc.tolist()
    console.print(
        f"{facts['lens']}: {facts['focal_length_mm']:g} mm, f/{facts['f_number']:g}, focus {facts['focus_m']} m; "
        f"{len(places)} distances from {facts['nearest_m']:.3g} m to infinity, circles of confusion "
        f"from {places[0]:+.3f} to {places[-1]:+.3f} mm",
        markup=False,
        highlight=False,
    )
    if table.residual is not None:
        middle, most = 100 * float(table.residual.median()), 100 * float(table.residual.max())
        console.print(f"family: {table.family}, residual {middle:.2f} %, {most:.2f} % at most", highlight=False)


def _write(table: BlurTable, target: Path, console: Console) -> None:
    table.save(target)
    console.print(f"{target}: {table!r}", markup=False, highlight=False)


def _draw_fits(captures: Captures, result: TableFit, folder: Path, stem: str, console: Console) -> None:
    from torchdof.fit.plots import picture_of_fit

    for pair, fitted in zip(captures, result.fits, strict=True):
        target = folder / f"{stem}_{pair.distance_m * 1000:.0f}mm.png"
        picture_of_fit(fitted).savefig(target)
        console.print(str(target), markup=False, highlight=False)


def _draw_table(table: BlurTable, folder: Path, stem: str, console: Console) -> None:
    """Draws a table over depth, and the blur texture of its largest circle of confusion, to PNG files."""
    from torchdof.fit.plots import picture_of_table, picture_of_texture

    target = folder / f"{stem}_table.png"
    picture_of_table(table).savefig(target)
    console.print(str(target), markup=False, highlight=False)
    width = 1920
    largest = float(table.coc[table.coc.abs().argmax()])
    scale = {"fraction": float(width), "mm": width / (table.sensor_width_mm or 36.0), "relative": 16.0}[table.unit]
    target = folder / f"{stem}_texture.png"
    picture_of_texture(table, largest * scale, width).savefig(target)
    console.print(str(target), markup=False, highlight=False)
