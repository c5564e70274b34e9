"""Tables printed to a terminal, folded to its width."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["print_columns"]

_UNBOUNDED = 10_000  # characters; line width at which a table is not folded, to measure it


def print_columns(
    console: Console, title: str, columns: Mapping[str, Sequence[str]], words: Collection[str] = ()
) -> None:
    """Prints a table; columns that do not fit are printed below in further tables, each starting with the first column.

    ``columns`` maps headings to cells, the same number in each. Numbers are aligned right, columns of ``words`` left.
    """
    from rich.box import SIMPLE_HEAD
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    def table_of(names: Sequence[str]) -> Table:
        table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left")
        for name in names:
            table.add_column(Text(name), justify="left" if name in words else "right")
        for cells in zip(*(columns[name] for name in names), strict=True):
            table.add_row(*map(Text, cells))
        return table

    unbounded = console.options.update(max_width=_UNBOUNDED)
    first, *others = columns
    parts: list[list[str]] = [[first]]
    for name in others:
        width = Measurement.get(console, unbounded, table_of([*parts[-1], name])).maximum
        if width > console.width and len(parts[-1]) > 1:
            parts.append([first])
        parts[-1].append(name)
    console.print(title, markup=False, highlight=False, style="italic")
    for i, part in enumerate(parts):
        if i > 0:
            console.print()
        console.print(table_of(part))
