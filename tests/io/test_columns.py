"""Printed tables are folded to the width of the terminal."""

import io
import re

import pytest
from rich.console import Console

from torchdof.io.columns import print_columns

COLUMNS = {
    "distance m": ["0.7", "1.5"],
    **{f"radius px at {d} m": [f"{d}.25 ± 0.012", f"{d}.5 ± 0.013"] for d in range(5)},
    "lateral px": ["(+0.29, -0.10)", "[red](+0.00, -0.10)"],
}


def printed(width: int) -> list[str]:
    file = io.StringIO()
    print_columns(Console(file=file, width=width, soft_wrap=True), "colours", COLUMNS)
    return file.getvalue().splitlines()


@pytest.mark.parametrize("width", [40, 80, 200])
def test_columns_that_do_not_fit_are_folded_and_not_cut(width: int) -> None:
    lines = printed(width)
    assert max(map(len, lines)) <= width
    cells = [cell.strip() for line in lines for cell in re.split("  +", line)]
    for name, values in COLUMNS.items():
        assert name in cells and all(value in cells for value in values)
    # each part starts with the first column; the title is above the first part only
    assert cells.count("distance m") == sum("──" in line for line in lines) == {40: 6, 80: 2, 200: 1}[width]
    assert sum("colours" in line for line in lines) == 1
