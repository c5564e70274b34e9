"""What commands print: one JSON object a line for programs, tables as wide as the terminal for people."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["json_line", "print_columns"]


def json_line(facts: Mapping[str, Any]) -> str:
    """Facts as JSON on one line. JSON has no infinity: numbers that are not finite are the texts inf, -inf and nan.

    Example:
        >>> json_line({"focus_m": float("inf"), "size": (3, 2)})
        '{"focus_m": "inf", "size": [3, 2]}'
    """
    return json.dumps(_finite(facts), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _finite(part) for name, part in value.items()}
    if hasattr(value, "tolist"):  # numpy's numbers and arrays
        return _finite(value.tolist())
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def print_columns(console: Console, title: str, columns: Mapping[str, Sequence[str]]) -> None:
    """Print a table; columns that the terminal has no room for are folded below the others, the first before them.

    Args:
        console: to print on.
        title: above the table.
        columns: cells `[rows]` below each heading, all as many.

    Example:
        >>> from rich.console import Console
        >>> print_columns(Console(width=20), "two", {"m": ["1", "2"], "radius": ["3.25", "4.5"], "noise": ["1", "1"]})
        two
        ┏━━━┳━━━━━━━━┓
        ┃ m ┃ radius ┃
        ┡━━━╇━━━━━━━━┩
        │ 1 │   3.25 │
        │ 2 │    4.5 │
        └───┴────────┘
        ┏━━━┳━━━━━━━┓
        ┃ m ┃ noise ┃
        ┡━━━╇━━━━━━━┩
        │ 1 │     1 │
        │ 2 │     1 │
        └───┴───────┘
    """
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    first, *others = columns
    # with a border, and a space on each side
    taken = {name: 3 + max(map(cell_len, (name, *columns[name]))) for name in columns}
    parts: list[list[str]] = [[first]]
    for name in others:
        full = 1 + sum(taken[n] for n in parts[-1]) + taken[name] > console.width
        if full and len(parts[-1]) > 1:
            parts.append([first])
        parts[-1].append(name)
    for i, part in enumerate(parts):
        shown = Table(title=None if i else title, title_justify="left")
        for name in part:
            shown.add_column(name, justify="right")
        for cells in zip(*(columns[name] for name in part), strict=True):
            shown.add_row(*map(Text, cells))
        console.print(shown)
