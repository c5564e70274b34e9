"""Tables printed to a terminal."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def print_columns(
    console: Console, title: str, columns: Mapping[str, Sequence[str]], words: Collection[str] = ()
) -> None:
    """Prints cells by heading, a line for each row, however wide the terminal is; ``words`` are aligned left."""
    widths = [max(map(len, (name, *cells))) for name, cells in columns.items()]
    signs = ["<" if name in words else ">" for name in columns]
    console.print(title, markup=False, highlight=False, style="italic")
    for row in (columns, ["─" * width for width in widths], *zip(*columns.values(), strict=True)):
        cells = [f"{cell:{sign}{width}}" for cell, sign, width in zip(row, signs, widths, strict=True)]
        console.print("  ".join(cells).rstrip(), soft_wrap=True, markup=False, highlight=False)
