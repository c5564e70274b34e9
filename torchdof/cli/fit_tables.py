"""Makes, prints and draws the tables of ``torchdof fit``."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from torchdof import BlurTable, blur_by_coc
from torchdof.cli.output import json_line, progress_bar
from torchdof.extras import missing
from torchdof.fit.lens import trace
from torchdof.fit.lens.lens import RGB_UM, Lens
from torchdof.fit.photo.across import table_of_dots
from torchdof.fit.photo.captures import Captures
from torchdof.fit.photo.manifest import MANIFEST, read_captures
from torchdof.fit.photo.photographs import read_photographs
from torchdof.fit.photo.table import TableFit, fit_captures
from torchdof.io.atomic import atomic_file
from torchdof.io.columns import print_columns
from torchdof.validation import number

if TYPE_CHECKING:
    from torchdof.cli.fit import Fit


def trace_lens(command: Fit, source: str, console: Console) -> None:
    """Traces the table of a lens, prints a summary, and writes the table."""
    lens = Lens.read(source)
    focal = lens.paraxial().focal_length
    number("--focus-m", command.focus_m, low=focal / 1000, unit="metres", infinite=True)
    image_mm = focal / (1 - focal / 1000 / command.focus_m)
    with progress_bar(f"tracing {source}"):
        table = trace.trace_table(
            lens,
            f_number=command.f_number,
            focus_m=command.focus_m,
            nodes=command.nodes,
            field_mm=image_mm * math.tan(math.radians(command.field_deg)),
            wavelengths_um=RGB_UM if command.wavelengths == () else command.wavelengths,
            field=command.field,
        )
    facts, coc = table.provenance, table.coc.tolist()
    console.print(
        f"{facts['lens']}: {facts['focal_length_mm']:g} mm, f/{facts['f_number']:g}, focus {facts['focus_m']} m; "
        f"{len(coc)} distances from {facts['nearest_m']:.3g} m to infinity, circles of confusion "
        f"from {coc[0]:+.3f} to {coc[-1]:+.3f} mm"
    )
    if table.residual is not None:
        median, largest = 100 * float(table.residual.median()), 100 * float(table.residual.max())
        console.print(f"family: {table.family}, residual {median:.2f} %, {largest:.2f} % at most")
    if table.field is not None:
        console.print(f"across the field: {table.field.radius.tolist()} mm from the middle")
    _write(console, table, command.out)
    if command.as_json:
        print(json_line({"out": str(command.out), "family": table.family, **facts}))


def fit_photographs(command: Fit, folder: Path, console: Console, caught: list[warnings.WarningMessage]) -> None:
    """Fits photographs of the target, or the dots of a manifest; ``caught`` is the list of Python's warnings."""
    photographs, printed, fitted = None, set[str](), list[tuple[Captures, TableFit]]()
    if folder.is_dir() and not (folder / MANIFEST).is_file():
        colours = command.colours or "mean"
        photographs = read_photographs(folder, square_mm=command.square_mm, colours=colours, root=command.root)
        capture_sets = [photographs.captures]
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
            console.print(f"better: {sentence}", style="cyan")
    else:
        capture_sets = read_captures(str(folder), dots=command.dots, colours=command.colours, root=command.root)
    across_field = photographs is None and capture_sets[0].notes["dots"] == "field"
    of_reading = len(caught)
    for i, captures in enumerate(capture_sets):
        out = command.out
        if len(capture_sets) > 1:
            out = out.with_name(f"{out.stem}_{i:02d}.json")
            console.print(f"dot {i} at {captures.notes['position_px']} px from the centre")
        del caught[of_reading:]  # the warnings of other dots
        with progress_bar("fitting") as update:
            result = fit_captures(
                captures,
                command.family,
                accuracy_db=command.accuracy_db,
                progress=lambda done, total, what, update=update: update(what, done, total),  # type: ignore[misc]
                command=f"torchdof fit {folder.name} --family {command.family} --accuracy-db {command.accuracy_db:g}",
                scale_of=fitted[0][1] if fitted else None,  # all dots use the scale of the one nearest to the centre
            )
        fitted.append((captures, result))
        facts = {"out": str(out), **_report(console, captures, result)}
        messages = list(dict.fromkeys(str(warning.message) for warning in caught))
        for message in (message for message in messages if message not in printed):
            console.print(f"warning: {message}", style="yellow")
        printed.update(messages)
        if not across_field:
            _write(console, result.table, out)
        if photographs is not None:
            try:
                from torchdof.fit.plots import sheet_of_photographs

                _save(console, sheet_of_photographs(photographs, result, blur_by_coc), out.with_suffix(".png"))
            except ModuleNotFoundError as error:
                console.print(f"no sheet of pictures: {missing('it', error.name) or error}", markup=False)
        elif command.plots is not None:
            from torchdof.fit.plots import picture_of_fit

            for pair, fit in zip(captures.pairs, result.fits, strict=True):
                picture = command.plots / f"{out.stem}_{1000 * pair.distance_m:.0f}mm.png"
                _save(console, picture_of_fit(fit), picture)
        if command.as_json:
            facts |= {"warnings": messages, **({"advice": photographs.advice} if photographs else {})}
            print(json_line(facts), flush=True)
    if across_field:
        _write(console, table_of_dots(fitted), command.out)


def _report(console: Console, captures: Captures, result: TableFit) -> dict[str, Any]:
    """Prints the fits at all distances, the reason for the family, and the colours; returns them as facts."""
    fits = result.fits
    columns = {
        "distance m": [f"{pair.distance_m:.4g}" for pair in captures.pairs],
        "coc px": [f"{coc:+.2f}" for coc in result.coc_px],
        "measured": [f"{f.radius:.2f}" for f in fits],
        **{n: [f"{f.params[n]:.3f} ± {f.stderr[n]:.2g}" for f in fits] for n in fits[0].params if n != "values"},
        "residual %": [f"{100 * f.residual:.2f}" for f in fits],
        "x noise": [f"{f.residual_over_noise:.2f}".replace("nan", "") for f in fits],
        "magnified": [f"{f.magnification:.4f}" for f in fits],
    }
    print_columns(console, f"{captures.name or 'captures'}: {fits[0].family}, focus {captures.focus_m:.4g} m", columns)
    how = "from focal length and f-number" if result.scale == "camera" else "measured, the thin lens in between"
    console.print(f"family: {result.why}\ncircles of confusion: {how}")
    if result.colours:
        columns = {"": list(result.colours)}
        for i, pair in enumerate(captures.pairs):
            radii = [f"{fits[i].radius:.2f} ± {fits[i].radius_stderr:.2g}" for fits in result.colours.values()]
            columns[f"radius px at {pair.distance_m:g} m"] = radii
        print_columns(console, "colours: the table holds a kernel for each", columns)
    of_fit = ("params", "stderr", "residual", "residual_over_noise", "magnification")
    return {
        **{"name": captures.name, "family": fits[0].family, "why": result.why, "scale": result.scale},
        "focus_m": captures.focus_m,
        "fits": [
            {"distance_m": pair.distance_m, "coc_px": coc, **{name: getattr(fit, name) for name in of_fit}}
            for pair, fit, coc in zip(captures.pairs, fits, result.coc_px, strict=True)
        ],
        "colours": [{"name": name, "radius_px": [fit.radius for fit in each]} for name, each in result.colours.items()],
    }


def _write(console: Console, table: BlurTable, target: Path) -> None:
    """Writes a table and prints its path."""
    table.save(target)
    console.print(f"{target}: {table!r}")


def _save(console: Console, figure: Any, target: Path) -> None:
    """Writes a figure, whole or not at all, and prints its path."""
    with atomic_file(target) as temporary:
        figure.savefig(temporary)
    console.print(str(target))
