"""``torchdof tables``: which blur tables there are, and pictures of their kernels."""

from pathlib import Path
from typing import Annotated, Any

import torch
import torch.nn.functional as functional
import typer
from torch import Tensor

from ..io.sheet import write_sheet
from ..optics import table_file
from ..optics.blur_table import BlurTable
from .arguments import ApertureImage, AsJson, Blades, Curvature, Rotation, Squeeze
from .printed import json_line
from .settings import load_aperture, load_table

__all__ = ["tables"]

_WIDTH = 1920  # px of the image that kernels are shown for
_COC_PX = (-24.0, -12.0, -6.0, 6.0, 12.0, 24.0)
_CELL = (120, 230)  # rows and columns of a kernel's picture, as wide as a caption
_ZOOM = 2  # picture's pixels a pixel


def tables(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[TABLE]...", help="Names or JSON files; default: all that ship."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Picture to write: a column of kernels a table, over the blur radius."),
    ] = None,
    blades: Blades = 0,
    rotation: Rotation = 0.0,
    curvature: Curvature = 0.0,
    squeeze: Squeeze = 1.0,
    aperture: ApertureImage = None,
    as_json: AsJson = False,
) -> None:
    """List blur tables, and draw their kernels.

    The picture has a column for each table and a row for each signed blur radius, from 24 pixels in front of the focus
    plane to 24 behind it, in an image of 1920 pixels. Each kernel is as bright as its brightest pixel allows.

        torchdof tables -o tables.png

        torchdof tables disc my_lens.json --blades 7 --rotation 15 -o seven_blades.png
    """
    opening = load_aperture(blades, rotation, curvature, squeeze, aperture)
    panels = {}
    for name in names or ["disc", "gaussian", *table_file.shipped()]:
        table = load_table(name, opening)
        facts = _facts(name, table)
        typer.echo(json_line(facts) if as_json else _line(facts))
        if out is not None:
            panels[Path(name).stem] = _column(table)
    if out is None:
        return
    write_sheet(out, panels, caption=34)
    if not as_json:
        radii = ", ".join(f"{coc:g}" for coc in _COC_PX)
        typer.echo(f"{out}: blur radii from top to bottom {radii} px in an image of {_WIDTH} px")


def _facts(name: str, table: BlurTable) -> dict[str, Any]:
    """What there is to say of a table."""
    return {
        "table": name,
        "family": table.family,
        "nodes": len(table.coc),
        "coc": [float(table.coc.min()), float(table.coc.max())],
        "unit": table.unit,
        "colours": table.channels,
        "aperture": None if table.aperture is None else repr(table.aperture),
        "source": str(table.provenance.get("source", "")).partition(";")[0],
    }


def _line(facts: dict[str, Any]) -> str:
    """The same in one line."""
    parts = [f"{facts['family']}, {facts['nodes']} node{'s' if facts['nodes'] > 1 else ''}"]
    if facts["unit"] != "relative":
        low, high = facts["coc"]
        parts.append(f"coc {low:.3g} to {high:.3g} {'mm' if facts['unit'] == 'mm' else 'of the width'}")
    if facts["colours"] > 1:
        parts.append(f"{facts['colours']} colours")
    if facts["aperture"]:
        parts.append(facts["aperture"])
    return f"{facts['table']:24s} {'; '.join(parts)}" + (f" ({facts['source']})" if facts["source"] else "")


def _column(table: BlurTable) -> Tensor:
    """Kernels of a table below each other, ``[1, 3, rows, columns]`` in linear light."""
    size = _CELL[0] // _ZOOM // 2 * 2 - 1
    kernels = table.kernels(torch.tensor(_COC_PX), _WIDTH, size=size).float()  # [n, 1 or C, size, size]
    kernels = kernels / kernels.amax((1, 2, 3), keepdim=True)
    shown = kernels[:, :3] if kernels.shape[1] >= 3 else kernels[:, :1].expand(-1, 3, -1, -1)
    shown = functional.interpolate(shown, scale_factor=float(_ZOOM), mode="nearest")
    below, beside = _CELL[0] - shown.shape[-1], _CELL[1] - shown.shape[-1]
    return functional.pad(shown, (beside // 2, beside - beside // 2, below, 0)).transpose(0, 1).flatten(1, 2)[None]
