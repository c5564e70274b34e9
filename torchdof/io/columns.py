"""Tables for people, as wide as the terminal."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["print_columns"]

_UNBOUNDED = 10_000  # characters of a line


def print_columns(
    console: Console, title: str, columns: Mapping[str, Sequence[str]], words: Collection[str] = ()
) -> None:
    """Prints a table; columns that the terminal has no room for are folded below the others, the first before them.

    Args:
        console: To print on.
        title: Above the table.
        columns: Cells below each heading, all as many.
        words: Headings of columns of words, which are aligned to the left; the others hold numbers.

    Example:
        >>> from rich.console import Console
        >>> columns = {"m": ["1", "2"], "radius": ["3.25", "4.5"], "noise": ["1", "1"]}
        >>> print_columns(Console(width=10), "two", columns)
        two
        m   radius
        ──────────
        1     3.25
        2      4.5
        <BLANKLINE>
        m   noise
        ─────────
        1       1
        2       1
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
