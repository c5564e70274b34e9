"""``torchdof fit``: makes a blur table from photographs of a dot or from a lens prescription."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import click

from torchdof.cli.command import Command, Group, Parsed, argument, numbers, option, refuse
from torchdof.io.atomic import check_writable


def _wavelengths(text: str) -> tuple[float, ...]:
    """Reads wavelengths; () stands for rgb."""
    return () if text == "rgb" else numbers()(text)


class _Target(Group):
    """With the printed target."""

    target: Path | None = option("Write the target to print (PDF), and nothing else.")
    paper: Literal["a4", "letter"] = option("Its paper.", "a4")
    square_mm: float = option("Side of the target's square as printed.", 100.0)


class _Photographs(Group):
    """From photographs."""

    family: Literal["auto", "gaussian", "ring", "disc", "softm", "radial", "polygon", "image"] = option(
        "Kernel family; auto takes the cheapest that is accurate enough, image any shape.", "auto", basic=True
    )
    accuracy_db: float = option("PSNR on a natural image that auto asks for.", 45.0)
    dots: Literal["one", "centre", "each", "field"] | None = option(
        "One dot; the centre of a grid; each dot of it, a table a place; or one table across the field. Default: as "
        "capture.toml says."
    )
    colours: Literal["mean", "each"] | None = option(
        "Fit the mean of the colours, or each: a table with a kernel a colour. Default: as capture.toml, or mean."
    )
    root: Path | None = option("Folder that capture.toml and all pictures must lie in. Default: anywhere.")


class _Lens(Group):
    """From a lens prescription."""

    lens: str | None = option("Prescription or Zemax file (.zmx), or the name of a shipped lens.", basic=True)
    f_number: float = option("Aperture of the lens.", 2.0)
    focus_m: float = option("Focus distance in metres; inf allowed.", 2.0)
    nodes: int | None = option("Distances traced; by default as many as keep pictures to 50 dB.")
    field_deg: float = option(
        "Angle from the axis, degrees: 0 is the frame's centre.", 0.0, type=click.FloatRange(0, 90, max_open=True)
    )
    field: tuple[float, ...] | None = option(
        "One table across the field, of spots at these distances from the middle; to 21.6 for full frame.",
        type=Parsed("0,MM,MM,...", numbers(), "0,7,14,21.6"),
    )
    wavelengths: tuple[float, ...] | None = option(
        "One table a colour, of wavelengths in micrometres; for lenses with Abbe numbers.",
        type=Parsed("rgb|UM,UM,...", _wavelengths, "0.65,0.55,0.45"),
    )


class Fit(_Photographs, _Target, _Lens, Command):
    """Make a blur table from photographs of a dot, or from a lens prescription.

    From photographs of a white dot on black paper, described in capture.toml (see docs/measuring.md):

        torchdof fit my-lens/ -o my-lens.json --plots pictures/

    From photographs of a printed target (see docs/phone.md):

        torchdof fit --target target.pdf

        torchdof fit photographs/ -o my-phone.json

    From a lens, on its axis, or from the middle to the corner with cat's eyes and coma:

        torchdof fit --lens double_gauss_50mm --f-number 2 --focus-m 2 -o double-gauss.json

        torchdof fit --lens double_gauss_50mm --field 0,4,8,12,16,20,21.6 -o across-the-field.json
    """

    captures: Path | None = argument(
        "Folder with photographs: of a dot with their capture.toml, or of the printed target.", "[CAPTURES]", None
    )
    out: Path = option("The table to write (JSON).", Path("table.json"), names=("--out", "-o"))
    plots: Path | None = option("Folder for pictures of the fits to photographs.")

    def run(self) -> None:
        """Checks the options, then makes the table, or writes the target to print."""
        target, of_both = self.target, self.lens and (self.root or self.plots)
        is_one = bool(self.captures) != bool(self.lens)
        refuse(
            (target and (self.captures or self.lens), "--target writes the page to print; give it alone"),
            (not target and not is_one, "give either a folder of captures or --lens FILE"),
            (of_both, "--root is the folder of photographs, --plots of their fits; leave them out with --lens"),
            (self.out.suffix != ".json", f"{self.out}: a table is JSON: name it {self.out.with_suffix('.json')}"),
            (self.field and self.field_deg, "--field-deg averages one place, --field traces several; give one of them"),
        )
        if self.target is not None:
            from torchdof.fit.photo.target import write_target

            write_target(self.target, self.paper)
            if not self.as_json:
                advice = "print it at 100 %, photograph it as it says, then: torchdof fit FOLDER -o table.json"
                click.echo(f"{self.target}: {advice}")
            return
        check_writable(self.out)
        if self.plots is not None:
            check_writable(self.plots / "table.png")
        from rich.console import Console

        from torchdof.cli.fit_tables import fit_photographs, trace_lens
        from torchdof.fit.problems import FitWarning

        console = Console(soft_wrap=True, quiet=self.as_json, markup=False, highlight=False)
        if self.lens is not None:
            trace_lens(self, self.lens, console)
        elif self.captures is not None:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", FitWarning)
                fit_photographs(self, self.captures, console, caught)
