"""What ``torchdof fit`` tells and draws of its results."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from torchdof import BlurTable, blur_by_coc
from torchdof.fit.photo.manifest import Captures
from torchdof.fit.photo.photographs import Photographs
from torchdof.fit.photo.table import TableFit
from torchdof.fit.problems import FitWarning
from torchdof.io.atomic import whole_file
from torchdof.io.columns import print_columns

__all__ = ["Shown", "facts_of", "heard"]

_WIDTH = 1920  # px of the image that a table's texture is drawn for


@contextmanager
def heard() -> Iterator[list[str]]:
    """Collects warnings, which are in the list once the block has ended; what is said twice is in it once."""
    messages = list[str]()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FitWarning)
        yield messages
    messages += dict.fromkeys(str(w.message) for w in caught)


def facts_of(captures: Captures, result: TableFit, messages: Sequence[str]) -> dict[str, Any]:
    """What :meth:`Shown.fit` tells, for programs."""
    of_fit = ("params", "stderr", "residual", "residual_over_noise", "magnification")
    fits = [
        {"distance_m": pair.distance_m, "coc_px": coc, **{name: getattr(fitted, name) for name in of_fit}}
        for pair, fitted, coc in zip(captures, result.fits, result.coc_px, strict=True)
    ]
    colours = [
        {
            "name": colour.name,
            "radius_px": [f.radius for f in colour.fits],
            "focus_shift_dioptres": colour.focus_shift_dioptres,
            "lateral_px": colour.lateral_px,
        }
        for colour in result.colours
    ]
    chosen = {"name": captures.name, "family": result.fits[0].family, "why": result.why, "scale": result.scale}
    return {**chosen, "focus_m": captures.focus_m, "fits": fits, "colours": colours, "warnings": messages}


class Shown:
    """What is told on standard output, and pictures.

    Args:
        quiet: Tell nothing.
    """

    def __init__(self, quiet: bool) -> None:
        self._console = Console(soft_wrap=True, quiet=quiet, markup=False, highlight=False)

    def say(self, text: str, style: str = "") -> None:
        """One line."""
        self._console.print(text, style=style)

    def photographs(self, photographs: Photographs) -> None:
        """What was found in photographs of the target, and what to do better, on one screen."""
        sharp, pictures = photographs.captures.notes["sharp"], photographs.pictures
        columns = {
            "file": [picture.file for picture in pictures],
            "distance m": [f"{picture.distance_m:.3f}" for picture in pictures],
            "square px": [f"{picture.target.side_px:.0f}" for picture in pictures],
            "paper %": [f"{100 * picture.target.white:.0f}" for picture in pictures],
            "edge px": [f"{1 / picture.sharpness:.1f}" for picture in pictures],
            "": ["in focus" if picture.file == sharp else "" for picture in pictures],
        }
        print_columns(self._console, "the target in the photographs", columns)
        for sentence in photographs.advice:
            self.say(f"better: {sentence}", "cyan")

    def fit(self, captures: Captures, result: TableFit, messages: Sequence[str]) -> None:
        """The fits at all distances, why the family was chosen, and warnings."""
        fits = result.fits
        columns = {
            "distance m": [f"{pair.distance_m:.4g}" for pair in captures],
            "coc px": [f"{coc:+.2f}" for coc in result.coc_px],
            "measured": [f"{f.radius:.2f}" for f in fits],
            **{n: [f"{f.params[n]:.3f} ± {f.stderr[n]:.2g}" for f in fits] for n in fits[0].params if n != "values"},
            "residual %": [f"{100 * f.residual:.2f}" for f in fits],
            "x noise": [f"{f.residual_over_noise:.2f}".replace("nan", "") for f in fits],
            "magnified": [f"{f.magnification:.4f}" for f in fits],
        }
        title = f"{captures.name or 'captures'}: {fits[0].family}, focus {captures.focus_m:.4g} m"
        print_columns(self._console, title, columns)
        self.say(f"family: {result.why}")
        how = "from focal length and f-number" if result.scale == "camera" else "measured, the thin lens in between"
        self.say(f"circles of confusion: {how}")
        if result.colours:
            self._colours(captures, result)
        for message in messages:
            self.say(f"warning: {message}", "yellow")

    def _colours(self, captures: Captures, result: TableFit) -> None:
        """What differs between the colours: the size of their blur, their focus, and where they lie."""
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
        print_columns(self._console, "colours, beside green", columns)
        self.say("the table holds a kernel a colour; lateral colour is no blur, and not in it")

    def lens(self, table: BlurTable) -> None:
        """What was traced and how well the kernels fit the spots."""
        facts, places = table.provenance, table.coc.tolist()
        self.say(
            f"{facts['lens']}: {facts['focal_length_mm']:g} mm, f/{facts['f_number']:g}, focus {facts['focus_m']} m; "
            f"{len(places)} distances from {facts['nearest_m']:.3g} m to infinity, circles of confusion "
            f"from {places[0]:+.3f} to {places[-1]:+.3f} mm"
        )
        if table.residual is not None:
            middle, most = 100 * float(table.residual.median()), 100 * float(table.residual.max())
            self.say(f"family: {table.family}, residual {middle:.2f} %, {most:.2f} % at most")
        if table.field is not None:
            self.say(f"across the field: {table.field.radius.tolist()} mm from the middle")

    def write(self, table: BlurTable, target: Path) -> None:
        """Writes a table."""
        table.save(target)
        self.say(f"{target}: {table!r}")

    def sheet(self, photographs: Photographs, result: TableFit, target: Path) -> None:
        """Draws what was found, fitted and made of it; without matplotlib it says so."""
        from torchdof.fit.sheet import sheet_of_photographs

        try:
            sheet = sheet_of_photographs(photographs, result, lambda *scene: blur_by_coc(*scene[:2], table=scene[2]))
        except ModuleNotFoundError as error:
            self.say(f"no sheet of pictures: {error.name} is not installed (pip install torchdof[plot])")
        else:
            self._save(sheet, target)

    def draw_fits(self, captures: Captures, result: TableFit, folder: Path, stem: str) -> None:
        """Draws each distance's fit."""
        from torchdof.fit.plots import picture_of_fit

        for pair, fitted in zip(captures, result.fits, strict=True):
            self._save(picture_of_fit(fitted), folder / f"{stem}_{pair.distance_m * 1000:.0f}mm.png")

    def draw(self, table: BlurTable, folder: Path, stem: str) -> None:
        """Draws a table over depth, and the blur texture of its largest circle of confusion."""
        from torchdof.fit.plots import picture_of_table, picture_of_texture

        self._save(picture_of_table(table), folder / f"{stem}_table.png")
        largest = float(table.coc[table.coc.abs().argmax()])
        scale = {"fraction": float(_WIDTH), "mm": _WIDTH / (table.sensor_width_mm or 36.0), "relative": 16.0}[
            table.unit
        ]
        self._save(picture_of_texture(table, largest * scale, _WIDTH), folder / f"{stem}_texture.png")

    def _save(self, figure: Any, target: Path) -> None:
        """Writes a figure, whole or not at all."""
        with whole_file(target) as part:
            figure.savefig(part)
        self.say(str(target))
