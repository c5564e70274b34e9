"""Printed tables have a line for each row."""

import io

from rich.console import Console

from torchdof.io.columns import print_columns


def test_numbers_are_aligned_right_words_left_and_nothing_is_cut() -> None:
    file = io.StringIO()
    columns = {"distance m": ["0.7", "11.5"], "lateral px": ["(+0.29, -0.10)", "[red](+0.00)"]}
    print_columns(Console(file=file, width=20), "colours [x]", columns, words=["lateral px"])
    assert file.getvalue().splitlines() == [
        "colours [x]",
        "distance m  lateral px",
        "──────────  ──────────────",
        "       0.7  (+0.29, -0.10)",
        "      11.5  [red](+0.00)",
    ]
