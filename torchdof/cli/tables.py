"""``torchdof tables``: lists blur tables and draws their kernels."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..io.atomic import check_writable
from .command import Command, argument, option
from .options import ApertureOptions
from .output import print_result

if TYPE_CHECKING:
    from torch import Tensor

    from ..optics.blur_table import BlurTable

_WIDTH = 1920  # px; image width for which kernels are drawn
_COC_PX = (-24.0, -12.0, -6.0, 6.0, 12.0, 24.0)  # px; signed blur radii of the rows
_CELL_PX = (200, 230)  # px; height and width of a kernel's picture, wide enough for its caption
_ZOOM = 2  # width in the picture of one pixel of a kernel
_POSITIONS = (0.0, 0.4, 0.7, 0.92)  # distances from the middle of the frame; its corner is at 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tables(ApertureOptions, Command):
    """List blur tables, and draw their kernels.

    The picture has a column for each table and a row for each signed blur radius, from 24 pixels in front of the focus
    plane to 24 behind it. A table whose kernels depend on the place has four columns, from the middle to the corner.

        torchdof tables -o tables.png

        torchdof tables disc my_lens.json --blades 7 --rotation 15 -o seven_blades.png
    """

    names: tuple[str, ...] = argument("Names or JSON files; default: all that ship.", "[TABLE]...", ())
    out: Path | None = option("Picture to write.", names=("--out", "-o"))

    def run(self) -> None:
        """Lists tables, and draws them if a picture is asked for."""
        if self.out is not None:
            check_writable(self.out)
        import torch.nn.functional as functional

        from ..io.sheet import write_sheet
        from ..optics.blur_table import shipped

        panels = {}
        for name in self.names or ["disc", "gaussian", *shipped()]:
            table = self.table_of(name)
            source = str(table.provenance.get("source", "")).partition(";")[0]
            facts = {"table": name, "family": table.family, "nodes": len(table.coc), "coc": table.coc[[0, -1]].tolist()}
            facts |= {"unit": table.unit, "colours": table.channels, "source": source}
            facts |= {"aperture": table.aperture and repr(table.aperture), "field": table.field and repr(table.field)}
            parts = [table.family, f"{len(table.coc)} node{'s' if len(table.coc) > 1 else ''}"]
            parts += [str(part) for part in (table.aperture, table.field) if part is not None]
            line = f"{name:24s} {', '.join(parts)}" + (f" ({source})" if source else "")
            print_result(self.as_json, facts, line)
            if self.out is not None:
                suffix = ": middle to corner" if table.depends_on_place else ""
                panels[f"{Path(name).stem}{suffix}"] = _column(table)
        if self.out is None:
            return
        widest = max(panel.shape[-1] for panel in panels.values())
        panels = {name: functional.pad(panel, (0, widest - panel.shape[-1])) for name, panel in panels.items()}
        write_sheet(self.out, panels, rows=[f"{coc:+g} px" for coc in _COC_PX])
        if not self.as_json:
            click.echo(f"{self.out}: a row a blur radius in an image of {_WIDTH} px; negative is in front of focus")


def _column(table: "BlurTable") -> "Tensor":
    """Kernels of a table, ``[1, 3, H, W]`` in linear light: one row per blur radius, one column per place."""
    import torch
    import torch.nn.functional as functional

    from ..module import blur_by_coc

    half = _CELL_PX[0] // _ZOOM // 2 - 1
    height, places = 2 * half + 1, [(half, _WIDTH // 2)]  # row and column of the dots of light that are blurred
    if table.depends_on_place:
        height = round(_WIDTH / 1.5)
        places = [(round((1 + p) * height / 2), round((1 + p) * _WIDTH / 2)) for p in _POSITIONS]
    dots = torch.zeros(1, max(3, table.channels), height, _WIDTH)
    for y, x in places:
        dots[..., y, x] = 1.0
    cells = []
    for coc_px in _COC_PX:
        blurred = blur_by_coc(dots, torch.full((1, 1, height, _WIDTH), coc_px), table=table, tolerance=0)
        kernels = [blurred[:, :3, y - half : y + half + 1, x - half : x + half + 1] for y, x in places]
        row = torch.cat([kernel / kernel.amax() for kernel in kernels], -1)
        row = functional.interpolate(row, scale_factor=float(_ZOOM), mode="nearest")
        padding_y, padding_x = _CELL_PX[0] - row.shape[-2], max(0, _CELL_PX[1] - row.shape[-1])
        cells.append(functional.pad(row, (padding_x // 2, padding_x - padding_x // 2, padding_y, 0)))
    return torch.cat(cells, 2)
