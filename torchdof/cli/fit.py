"""`torchdof fit`: photographs of a dot, or a lens prescription, to a blur table."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from torchdof import BlurTable, blur_by_coc
from torchdof.cli.arguments import AsJson
from torchdof.cli.printed import json_line
from torchdof.fit.photo.across import table_of_dots
from torchdof.fit.photo.manifest import MANIFEST, Captures, read_captures
from torchdof.fit.photo.photographs import Photographs, read_photographs
from torchdof.fit.photo.table import TableFit, fit_captures
from torchdof.fit.photo.target import SQUARE_MM, Paper, write_target
from torchdof.fit.problems import FitError, FitWarning
from torchdof.io.atomic import whole_file
from torchdof.io.columns import print_columns
from torchdof.validation import number

__all__ = ["fit"]

_TARGET, _CAPTURE, _LENS, _OUT = "With the printed target", "From photographs", "From a lens prescription", "Result"


def fit(
    captures: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with photographs: of a dot with their capture.toml, or of the printed target as they come.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The table to write (JSON).", rich_help_panel=_OUT)] = Path(
        "table.json"
    ),
    family: Annotated[
        Literal["auto", "gaussian", "ring", "disc", "softm", "radial", "polygon", "image"],
        typer.Option(
            help="Kernel family; auto takes the cheapest that is accurate enough, image any shape.",
            rich_help_panel=_CAPTURE,
        ),
    ] = "auto",
    accuracy_db: Annotated[
        float, typer.Option(help="PSNR on a natural image that auto asks for.", rich_help_panel=_CAPTURE)
    ] = 45.0,
    dots: Annotated[
        Literal["manifest", "one", "centre", "each", "field"],
        typer.Option(
            help="One dot; the centre of a grid; each dot of it, a table a place; or one table across the field.",
            rich_help_panel=_CAPTURE,
        ),
    ] = "manifest",
    colours: Annotated[
        Literal["manifest", "mean", "each"],
        typer.Option(
            help="Fit the mean of the colours; or each, which makes a table with a kernel a colour.",
            rich_help_panel=_CAPTURE,
        ),
    ] = "manifest",
    target: Annotated[
        Path | None,
        typer.Option(help="Write the target to print (PDF), and nothing else.", rich_help_panel=_TARGET),
    ] = None,
    paper: Annotated[Paper, typer.Option(help="Its paper.", rich_help_panel=_TARGET)] = "a4",
    square_mm: Annotated[
        float, typer.Option(help="Side of the target's square as printed.", rich_help_panel=_TARGET)
    ] = SQUARE_MM,
    root: Annotated[
        Path | None,
        typer.Option(
            help="Folder that capture.toml and all pictures must lie in; by default they may lie anywhere.",
            rich_help_panel=_CAPTURE,
        ),
    ] = None,
    lens: Annotated[
        str | None,
        typer.Option(help="Prescription or Zemax file (.zmx), or the name of a shipped lens.", rich_help_panel=_LENS),
    ] = None,
    f_number: Annotated[float, typer.Option(help="Aperture of the lens.", rich_help_panel=_LENS)] = 2.0,
    focus_m: Annotated[float, typer.Option(help="Focus distance in metres; inf allowed.", rich_help_panel=_LENS)] = 2.0,
    nodes: Annotated[
        int | None,
        typer.Option(help="Distances traced; by default as many as keep pictures to 50 dB.", rich_help_panel=_LENS),
    ] = None,
    field_deg: Annotated[
        float, typer.Option(help="Angle from the axis, degrees: 0 is the frame's centre.", rich_help_panel=_LENS)
    ] = 0.0,
    field: Annotated[
        str | None,
        typer.Option(
            metavar="0,MM,MM,...",
            help="Trace spots at these distances from the frame's middle: one table across the field; from 0 to 21.6 "
            "for full frame.",
            rich_help_panel=_LENS,
        ),
    ] = None,
    wavelengths: Annotated[
        str | None,
        typer.Option(
            help="One table a colour: rgb, or micrometres like 0.65,0.55,0.45; for lenses with Abbe numbers.",
            rich_help_panel=_LENS,
        ),
    ] = None,
    plots: Annotated[
        Path | None, typer.Option(help="Folder for pictures of the fits and the table.", rich_help_panel=_OUT)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a blur table from photographs of a dot, or from a lens prescription.

    Photograph a white dot on black paper in focus and, without refocusing, at other distances; describe the
    pictures in capture.toml (see docs/measuring.md); then

        torchdof fit my-lens/ -o my-lens.json --plots pictures/

    Or print a target, photograph it, and let the pictures tell the rest (see docs/phone.md):

        torchdof fit --target target.pdf

        torchdof fit photographs/ -o my-phone.json

    Or trace a lens:

        torchdof fit --lens double_gauss_50mm --f-number 2 --focus-m 2 -o double-gauss.json

    Or all of its frame, from the middle to the corner, cat's eyes and coma included:

        torchdof fit --lens double_gauss_50mm --field 0,4,8,12,16,20,21.6 -o across-the-field.json
    """
    console = Console(soft_wrap=True, quiet=as_json)
    if target is not None:
        if captures is not None or lens is not None:
            raise FitError("--target writes the page to print; give it alone, and the photographs afterwards")
        write_target(target, paper)
        console.print(f"{target}: print it at 100 %, photograph it as it says, then: torchdof fit FOLDER -o table.json")
        return
    if (captures is None) == (lens is None):
        raise FitError("give either a folder of captures or --lens FILE")
    if root is not None and lens is not None:
        raise FitError("--root is the folder of photographs; leave it out with --lens")
    if out.suffix != ".json":
        raise FitError(f"the table is written as JSON: name it {out.with_suffix('.json')}", file=str(out))
    if plots is not None:
        plots.mkdir(parents=True, exist_ok=True)
    if lens is not None:
        table = _trace(lens, f_number, focus_m, nodes, field_deg, field, wavelengths, console)
        _lens_summary(table, console)
        _write(table, out, console)
        if as_json:
            typer.echo(json_line({"out": str(out), "family": table.family, **table.provenance}))
        if plots is not None:
            _draw_table(table, plots, out.stem, console)
        return
    if captures is not None and captures.is_dir() and not (captures / MANIFEST).is_file():
        wanted: Literal["mean", "each"] = "each" if colours == "each" else "mean"
        with _heard() as doubts:
            photographs = read_photographs(captures, square_mm=square_mm, colours=wanted, root=root)
        _tell(photographs, console)
        command = f"torchdof fit {captures.name} --family {family} --accuracy-db {accuracy_db:g}"
        result, messages = _fit_with_progress(photographs.captures, family, accuracy_db, command, None, console)
        messages = [*doubts, *messages]
        _summary(photographs.captures, result, messages, console)
        _write(result.table, out, console)
        _draw_sheet(photographs, result, out.with_suffix(".png"), console)
        if as_json:
            facts = _facts(photographs.captures, result, messages)
            typer.echo(json_line({"out": str(out), **facts, "advice": list(photographs.advice)}))
        return
    with _heard() as doubts:
        capture_sets = read_captures(
            str(captures),
            dots=None if dots == "manifest" else dots,
            colours=None if colours == "manifest" else colours,
            root=root,
        )
    first: TableFit | None = None  # the dot nearest to the centre, whose scale all share
    said = set[str]()
    across = capture_sets[0].notes["dots"] == "field"
    fitted = []
    for i, capture_set in enumerate(capture_sets):
        table_file = out if len(capture_sets) == 1 else out.with_name(f"{out.stem}_{i:02d}.json")
        if len(capture_sets) > 1:
            console.print(f"dot {i} at {capture_set.notes['position_px']} px from the centre")
        command = f"torchdof fit {Path(str(captures)).name} --family {family} --accuracy-db {accuracy_db:g}"
        result, messages = _fit_with_progress(capture_set, family, accuracy_db, command, first, console)
        messages = [*doubts, *messages]
        first = first or result
        fitted.append((capture_set, result))
        _summary(capture_set, result, [message for message in messages if message not in said], console)
        said.update(messages)
        if not across:
            _write(result.table, table_file, console)
        if as_json:
            typer.echo(json_line({"out": str(table_file), **_facts(capture_set, result, messages)}))
        if plots is not None:
            _draw_fits(capture_set, result, plots, table_file.stem, console)
            _draw_table(result.table, plots, table_file.stem, console)
    if across:
        _write(table_of_dots(fitted), out, console)


def _trace(
    source: str,
    f_number: float,
    focus_m: float,
    nodes: int | None,
    field_deg: float,
    field: str | None,
    wavelengths: str | None,
    console: Console,
) -> BlurTable:
    from torchdof.fit.lens.lens import RGB_UM, Lens
    from torchdof.fit.lens.trace import trace_table

    lens = Lens.read(source)
    try:
        lines = RGB_UM if wavelengths == "rgb" else tuple(map(float, wavelengths.split(","))) if wavelengths else None
    except ValueError:
        raise FitError(f"--wavelengths takes rgb, or micrometres like 0.65,0.55,0.45; got {wavelengths}") from None
    if not 0 <= field_deg < 90:
        raise FitError(f"--field-deg must be 0 to 90 degrees from the axis, got {field_deg:g}")
    if field is not None and field_deg:
        raise FitError("--field-deg averages one place, --field traces several; give one of them")
    try:
        radii_mm = None if field is None else tuple(map(float, field.split(",")))
    except ValueError:
        radii_mm = ()
    rising = radii_mm is None or all(low < high < math.inf for low, high in pairwise(radii_mm))
    if radii_mm is not None and not (len(radii_mm) > 1 and radii_mm[0] == 0 and rising):
        raise FitError(
            f"--field takes distances in mm from the middle of the frame, rising from 0, like 0,7,14,21.6; got {field}"
        )
    focal = lens.paraxial().focal_length
    number("--focus-m", focus_m, low=focal / 1000, unit="metres", infinite=True)
    image_mm = focal / (1 - focal / 1000 / focus_m)
    with console.status("tracing the lens"):
        return trace_table(
            lens,
            f_number=f_number,
            focus_m=focus_m,
            nodes=nodes,
            field_mm=image_mm * math.tan(math.radians(field_deg)),
            wavelengths_um=lines,
            field=radii_mm,
        )


def _tell(photographs: Photographs, console: Console) -> None:
    """What was found in the photographs, and what to do better, on one screen."""
    sharp, pictures = photographs.captures.notes["sharp"], photographs.pictures
    columns = {
        "file": [picture.file for picture in pictures],
        "distance m": [f"{picture.distance_m:.3f}" for picture in pictures],
        "square px": [f"{picture.target.side_px:.0f}" for picture in pictures],
        "paper %": [f"{100 * picture.target.white:.0f}" for picture in pictures],
        "edge px": [f"{1 / picture.sharpness:.1f}" for picture in pictures],
        "": ["in focus" if picture.file == sharp else "" for picture in pictures],
    }
    print_columns(console, "the target in the photographs", columns)
    for sentence in photographs.advice:
        console.print(f"better: {sentence}", style="cyan", markup=False, highlight=False)


def _draw_sheet(photographs: Photographs, result: TableFit, target: Path, console: Console) -> None:
    """Draws what was found, fitted and made of it; without matplotlib it says so."""
    try:
        from torchdof.fit.sheet import sheet_of_photographs

        sheet = sheet_of_photographs(photographs, result, lambda *scene: blur_by_coc(*scene[:2], table=scene[2]))
    except ModuleNotFoundError as error:
        console.print(f"no sheet of pictures: {error.name} is not installed (pip install torchdof[plot])")
        return
    _save(sheet, target, console)


def _fit_with_progress(
    captures: Captures, family: str, accuracy_db: float, command: str, scale_of: TableFit | None, console: Console
) -> tuple[TableFit, list[str]]:
    """Fits one set of captures behind a progress bar; returns the fit and the warnings."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with _heard() as doubts, Progress(*columns, console=console, transient=True) as bar:
        job = bar.add_task("fitting", total=None)
        result = fit_captures(
            captures,
            family,
            accuracy_db=accuracy_db,
            progress=lambda done, total, what: bar.update(job, completed=done, total=total, description=what),
            command=command,
            scale_of=scale_of,
        )
    return result, doubts


@contextmanager
def _heard() -> Iterator[list[str]]:
    """Collects warnings, which are in the list once the block has ended; what is said twice is in it once."""
    messages = list[str]()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FitWarning)
        yield messages
    messages += dict.fromkeys(str(w.message) for w in caught)


def _summary(captures: Captures, result: TableFit, messages: list[str], console: Console) -> None:
    """Prints a table of the fits at all distances, why the family was chosen, and the warnings."""
    fits = result.fits
    ratios = ["" if math.isnan(f.residual_over_noise) else f"{f.residual_over_noise:.2f}" for f in fits]
    columns = {
        "distance m": [f"{pair.distance_m:.4g}" for pair in captures],
        "coc px": [f"{coc:+.2f}" for coc in result.coc_px],
        "measured": [f"{f.radius:.2f}" for f in fits],
        **{n: [f"{f.params[n]:.3f} ± {f.stderr[n]:.2g}" for f in fits] for n in fits[0].params if n != "values"},
        "residual %": [f"{100 * f.residual:.2f}" for f in fits],
        "x noise": ratios,
        "magnified": [f"{f.magnification:.4f}" for f in fits],
    }
    title = f"{captures.name or 'captures'}: {fits[0].family}, focus {captures.focus_m:.4g} m"
    print_columns(console, title, columns)
    console.print(f"family: {result.why}", markup=False, highlight=False)
    console.print(
        "circles of confusion: "
        + ("from focal length and f-number" if result.scale == "camera" else "measured, the thin lens in between"),
        highlight=False,
    )
    if result.colours:
        _tell_colours(captures, result, console)
    for message in messages:
        console.print(f"warning: {message}", style="yellow", markup=False, highlight=False)


def _tell_colours(captures: Captures, result: TableFit, console: Console) -> None:
    """Prints what differs between the colours: the size of their blur, their focus, and where they lie."""
    focuses = []
    for colour in result.colours:
        vergence = 1 / captures.focus_m + colour.focus_shift_dioptres
        focuses.append("" if math.isnan(vergence) else f"{1 / vergence:.4g}" if vergence > 0 else "beyond infinity")
    columns = {"": [colour.name for colour in result.colours], "focus m": focuses}
    for i, pair in enumerate(captures):
        fits = [colour.fits[i] for colour in result.colours]
        columns[f"radius px at {pair.distance_m:g} m"] = [f"{f.radius:.2f} ± {f.radius_stderr:.2g}" for f in fits]
    lateral = [colour.lateral_px[0] for colour in result.colours]
    columns["lateral px in focus"] = [f"({x:+.2f}, {y:+.2f})" for x, y in lateral]
    print_columns(console, "colours, beside green", columns)
    console.print("the table holds a kernel a colour; lateral colour is no blur, and not in it", highlight=False)


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
    chosen = {"name": captures.name, "family": result.fits[0].family, "why": result.why, "scale": result.scale}
    colours = [
        {
            "name": colour.name,
            "radius_px": [f.radius for f in colour.fits],
            "focus_shift_dioptres": colour.focus_shift_dioptres,
            "lateral_px": colour.lateral_px,
        }
        for colour in result.colours
    ]
    return {**chosen, "focus_m": captures.focus_m, "fits": fits, "colours": colours, "warnings": messages}


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
    if table.field is not None:
        console.print(f"across the field: {table.field.radius.tolist()} mm from the middle", highlight=False)


def _write(table: BlurTable, target: Path, console: Console) -> None:
    table.save(target)
    console.print(f"{target}: {table!r}", markup=False, highlight=False)


def _draw_fits(captures: Captures, result: TableFit, folder: Path, stem: str, console: Console) -> None:
    from torchdof.fit.plots import picture_of_fit

    for pair, fitted in zip(captures, result.fits, strict=True):
        target = folder / f"{stem}_{pair.distance_m * 1000:.0f}mm.png"
        _save(picture_of_fit(fitted), target, console)


def _draw_table(table: BlurTable, folder: Path, stem: str, console: Console) -> None:
    """Draws a table over depth, and the blur texture of its largest circle of confusion, to PNG files."""
    from torchdof.fit.plots import picture_of_table, picture_of_texture

    target = folder / f"{stem}_table.png"
    _save(picture_of_table(table), target, console)
    width = 1920
    largest = float(table.coc[table.coc.abs().argmax()])
    scale = {"fraction": float(width), "mm": width / (table.sensor_width_mm or 36.0), "relative": 16.0}[table.unit]
    target = folder / f"{stem}_texture.png"
    _save(picture_of_texture(table, largest * scale, width), target, console)


def _save(figure: Any, target: Path, console: Console) -> None:
    """Writes a figure, whole or not at all."""
    with whole_file(target) as part:
        figure.savefig(part)
    console.print(str(target), markup=False, highlight=False)
