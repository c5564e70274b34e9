"""`torchdof fit`: photographs of a dot, or a lens prescription, to a blur table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from torchdof.cli.command import argument, numbers, option
from torchdof.cli.options import json_option
from torchdof.cli.printed import Bar, json_line

if TYPE_CHECKING:
    from torchdof import BlurTable
    from torchdof.cli.fitted import Shown
    from torchdof.fit.photo.manifest import Captures
    from torchdof.fit.photo.table import TableFit

__all__ = ["Fit"]


_micrometres = numbers(None, "--wavelengths takes rgb, or micrometres like 0.65,0.55,0.45")
_WANTED = "--field takes distances in mm from the middle of the frame, rising from 0, like 0,7,14,21.6"


def _wavelengths(text: str) -> tuple[float, ...]:
    """Micrometres; none stands for red, green and blue."""
    return () if text == "rgb" else _micrometres(text)


def _radii(text: str) -> tuple[float, ...]:
    """Distances from the middle of the frame, in mm, rising from 0."""
    radii_mm = numbers(None, _WANTED)(text)
    if len(radii_mm) < 2 or radii_mm[0] != 0 or not all(low < high < math.inf for low, high in pairwise(radii_mm)):
        raise ValueError(f"{_WANTED}, got {text!r}")
    return radii_mm


@dataclass(frozen=True, kw_only=True)
class _Target:
    """With the printed target."""

    target: Path | None = option("Write the target to print (PDF), and nothing else.")
    paper: Literal["a4", "letter"] = option("Its paper.", "a4")
    square_mm: float = option("Side of the target's square as printed.", 100.0)


@dataclass(frozen=True, kw_only=True)
class _Photographs:
    """From photographs."""

    family: Literal["auto", "gaussian", "ring", "disc", "softm", "radial", "polygon", "image"] = option(
        "Kernel family; auto takes the cheapest that is accurate enough, image any shape.", "auto", basic=True
    )
    accuracy_db: float = option("PSNR on a natural image that auto asks for.", 45.0)
    dots: Literal["manifest", "one", "centre", "each", "field"] = option(
        "One dot; the centre of a grid; each dot of it, a table a place; or one table across the field.", "manifest"
    )
    colours: Literal["manifest", "mean", "each"] = option(
        "Fit the mean of the colours; or each, which makes a table with a kernel a colour.", "manifest"
    )
    root: Path | None = option(
        "Folder that capture.toml and all pictures must lie in; by default they may lie anywhere."
    )


@dataclass(frozen=True, kw_only=True)
class _Lens:
    """From a lens prescription."""

    lens: str | None = option("Prescription or Zemax file (.zmx), or the name of a shipped lens.", basic=True)
    f_number: float = option("Aperture of the lens.", 2.0)
    focus_m: float = option("Focus distance in metres; inf allowed.", 2.0)
    nodes: int | None = option("Distances traced; by default as many as keep pictures to 50 dB.")
    field_deg: float = option("Angle from the axis, degrees: 0 is the frame's centre.", 0.0)
    field: tuple[float, ...] | None = option(
        "Trace spots at these distances from the frame's middle: one table across the field; from 0 to 21.6 for full "
        "frame.",
        metavar="0,MM,MM,...",
        read=_radii,
    )
    wavelengths: tuple[float, ...] | None = option(
        "One table a colour: rgb, or micrometres like 0.65,0.55,0.45; for lenses with Abbe numbers.", read=_wavelengths
    )

    def trace(self, source: str) -> BlurTable:
        """The table of a lens."""
        from torchdof.fit.lens.lens import RGB_UM, Lens
        from torchdof.fit.lens.trace import trace_table
        from torchdof.validation import number

        if not 0 <= self.field_deg < 90:
            raise ValueError(f"--field-deg must be 0 to 90 degrees from the axis, got {self.field_deg:g}")
        if self.field is not None and self.field_deg:
            raise ValueError("--field-deg averages one place, --field traces several; give one of them")
        lens = Lens.read(source)
        focal = lens.paraxial().focal_length
        number("--focus-m", self.focus_m, low=focal / 1000, unit="metres", infinite=True)
        image_mm = focal / (1 - focal / 1000 / self.focus_m)
        with Bar(f"tracing {source}"):
            return trace_table(
                lens,
                f_number=self.f_number,
                focus_m=self.focus_m,
                nodes=self.nodes,
                field_mm=image_mm * math.tan(math.radians(self.field_deg)),
                wavelengths_um=RGB_UM if self.wavelengths == () else self.wavelengths,
                field=self.field,
            )


@dataclass(frozen=True, kw_only=True)
class Fit:
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

    captures: Path | None = argument(
        "Folder with photographs: of a dot with their capture.toml, or of the printed target as they come.",
        "[CAPTURES]",
        None,
    )
    out: Path = option("The table to write (JSON).", Path("table.json"), names=("--out", "-o"))
    plots: Path | None = option("Folder for pictures of the fits and the table.")
    photographs: _Photographs
    target: _Target
    lens: _Lens
    as_json: bool = json_option()

    def run(self) -> None:
        """Makes the table and says what it is made of; or writes the target."""
        lens, target = self.lens.lens, self.target.target
        if target is not None and (self.captures is not None or lens is not None):
            raise ValueError("--target writes the page to print; give it alone, and the photographs afterwards")
        if target is None and (self.captures is None) == (lens is None):
            raise ValueError("give either a folder of captures or --lens FILE")
        if self.photographs.root is not None and lens is not None:
            raise ValueError("--root is the folder of photographs; leave it out with --lens")
        if self.out.suffix != ".json":
            raise ValueError(f"{self.out}: the table is written as JSON: name it {self.out.with_suffix('.json')}")
        from torchdof.cli.fitted import Shown
        from torchdof.fit.photo.target import write_target

        shown = Shown(quiet=self.as_json)
        if self.plots is not None and target is None:
            self.plots.mkdir(parents=True, exist_ok=True)
        if target is not None:
            write_target(target, self.target.paper)
            shown.say(f"{target}: print it at 100 %, photograph it as it says, then: torchdof fit FOLDER -o table.json")
        elif lens is not None:
            table = self.lens.trace(lens)
            shown.lens(table)
            shown.write(table, self.out)
            self._print_json({"family": table.family, **table.provenance})
            if self.plots is not None:
                shown.draw(table, self.plots, self.out.stem)
        elif self.captures is not None:
            self._fit(self.captures, shown)

    def _print_json(self, facts: dict[str, Any], out: Path | None = None) -> None:
        """What is printed for programs, if it is asked for."""
        if self.as_json:
            click.echo(json_line({"out": str(out or self.out), **facts}))

    def _fit(self, folder: Path, shown: Shown) -> None:
        """Fits photographs of the target, or the dots of a manifest."""
        from torchdof.cli.fitted import facts_of, heard
        from torchdof.fit.photo.across import table_of_dots
        from torchdof.fit.photo.manifest import MANIFEST, read_captures
        from torchdof.fit.photo.photographs import read_photographs
        from torchdof.fit.photo.table import fit_captures

        said, photographs = self.photographs, None
        with heard() as doubts:
            if folder.is_dir() and not (folder / MANIFEST).is_file():
                colours: Literal["mean", "each"] = "each" if said.colours == "each" else "mean"
                photographs = read_photographs(folder, square_mm=self.target.square_mm, colours=colours, root=said.root)
                capture_sets = [photographs.captures]
            else:
                dots = None if said.dots == "manifest" else said.dots
                colour = None if said.colours == "manifest" else said.colours
                capture_sets = read_captures(str(folder), dots=dots, colours=colour, root=said.root)
        if photographs is not None:
            shown.photographs(photographs)
        across = photographs is None and capture_sets[0].notes["dots"] == "field"
        command = f"torchdof fit {folder.name} --family {said.family} --accuracy-db {said.accuracy_db:g}"
        told = set[str]()
        fitted: list[tuple[Captures, TableFit]] = []
        for i, captures in enumerate(capture_sets):
            table_file = self.out if len(capture_sets) == 1 else self.out.with_name(f"{self.out.stem}_{i:02d}.json")
            if len(capture_sets) > 1:
                shown.say(f"dot {i} at {captures.notes['position_px']} px from the centre")
            with heard() as warnings, Bar("fitting") as bar:
                result = fit_captures(
                    captures,
                    said.family,
                    accuracy_db=said.accuracy_db,
                    progress=bar.step,
                    command=command,
                    scale_of=fitted[0][1] if fitted else None,  # the dot nearest to the centre, whose scale all share
                )
            messages = [*doubts, *warnings]
            fitted.append((captures, result))
            shown.fit(captures, result, [message for message in messages if message not in told])
            told.update(messages)
            if not across:
                shown.write(result.table, table_file)
            facts = facts_of(captures, result, messages)
            if photographs is not None:
                shown.sheet(photographs, result, self.out.with_suffix(".png"))
                facts["advice"] = list(photographs.advice)
            self._print_json(facts, table_file)
            if self.plots is not None and photographs is None:
                shown.draw_fits(captures, result, self.plots, table_file.stem)
                shown.draw(result.table, self.plots, table_file.stem)
        if across:
            shown.write(table_of_dots(fitted), self.out)
