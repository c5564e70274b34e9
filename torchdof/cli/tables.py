"""``torchdof tables``: which blur tables there are, and pictures of their kernels."""

from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as functional
import typer
from torch import Tensor

from ..io.sheet import write_sheet
from ..optics import table_file
from ..optics.blur_table import BlurTable
from .arguments import ApertureImage, Blades, Curvature, Rotation, Squeeze
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
        typer.echo(_line(name, table))
        if out is not None:
            panels[Path(name).stem] = _column(table)
    if out is not None:
        write_sheet(out, panels, caption=34)
        radii = ", ".join(f"{coc:g}" for coc in _COC_PX)
        typer.echo(f"{out}: blur radii from top to bottom {radii} px in an image of {_WIDTH} px")


def _line(name: str, table: BlurTable) -> str:
    """What there is to say of a table in one line."""
    parts = [f"{table.family}, {len(table.coc)} node{'s' if len(table.coc) > 1 else ''}"]
    if table.unit != "relative":
        unit = "mm" if table.unit == "mm" else "of the width"
        parts.append(f"coc {float(table.coc.min()):.3g} to {float(table.coc.max()):.3g} {unit}")
    if table.channels > 1:
        parts.append(f"{table.channels} colours")
    if table.aperture is not None:
        parts.append(repr(table.aperture))
    source = str(table.provenance.get("source", "")).partition(";")[0]
    return f"{name:24s} {'; '.join(parts)}" + (f" ({source})" if source else "")


def _column(table: BlurTable) -> Tensor:
    """Kernels of a table below each other, ``[1, 3, rows, columns]`` in linear light."""
    size = _CELL[0] // _ZOOM // 2 * 2 - 1
    kernels = table.kernels(torch.tensor(_COC_PX), _WIDTH, size=size).float()  # [n, 1 or C, size, size]
    kernels = kernels / kernels.amax((1, 2, 3), keepdim=True)
    shown = kernels[:, :3] if kernels.shape[1] >= 3 else kernels[:, :1].expand(-1, 3, -1, -1)
    shown = functional.interpolate(shown, scale_factor=float(_ZOOM), mode="nearest")
    below, beside = _CELL[0] - shown.shape[-1], _CELL[1] - shown.shape[-1]
    return functional.pad(shown, (beside // 2, beside - beside // 2, below, 0)).transpose(0, 1).flatten(1, 2)[None]
