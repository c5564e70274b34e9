"""Output of all benchmarks: the machine, tables for reading, and the numbers as CSV."""

import contextlib
import csv
import importlib.metadata
import io
import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from ..io.atomic import atomic_file
from ..io.columns import print_columns

__all__ = ["LEGEND", "Row", "publish", "summary"]

Row = Mapping[str, Any]
"""A row of a table: values by column name."""

LEGEND = (
    "new_ms, spread_ms: median and interquartile range of the clock over pictures by cameras that were not rendered "
    "before; cpu_ms: their processor time over all threads; again_ms: the same camera a second time; beside_ms: a "
    "depthwise 17 x 17 convolution of 1 x 16 x 540 x 960 beside each; over_again, "
    "over_beside: ratios of processor times; peak_mb: growth of resident memory. Errors are as displayed (clipped to "
    "[0, 1], sRGB curve): rms_255 of 255, psnr_db, ssim."
)


def summary(rows: Sequence[Row], keys: Sequence[str], mean: Callable[[list[float]], float]) -> list[dict[str, Any]]:
    """Groups rows by their values under the keys; returns a row for each group with the means of float columns."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    summaries: list[dict[str, Any]] = []
    for values, of_group in groups.items():
        means = dict(zip(keys, values, strict=True))
        for name in dict.fromkeys(name for row in of_group for name in row if name not in keys):
            column = [row[name] for row in of_group if isinstance(row.get(name), float)]
            if name == "spread_ms" and len(new := [row["new_ms"] for row in of_group if "new_ms" in row]) > 1:
                low, _, high = statistics.quantiles(new, n=4, method="inclusive")
                column = [high - low]
            if column:
                means[name] = mean(column)
        summaries.append(means)
    return summaries


def publish(
    title: str,
    tables: Mapping[str, Sequence[Row]],
    remarks: Sequence[str],
    stem: Path | None,
    picture: Callable[[Path], object] | None = None,
    quiet: bool = False,
) -> None:
    """Prints the first table and the remarks; writes ``stem.md``, ``.csv`` of the last table and ``.png``: all or none.

    ``tables`` maps headings to rows, whose missing values stay empty; ``picture`` writes a picture to a path.
    """
    machine = (
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} CPUs, {torch.get_num_threads()} threads; "
        f"torchdof {importlib.metadata.version('torchdof')}, torch {torch.__version__}, "
        f"Python {platform.python_version()}, {platform.system()}."
    )
    console = Console(quiet=quiet)
    text = [f"# {title}", machine, LEGEND, *remarks]
    for number, (name, rows) in enumerate(tables.items()):
        columns = list(dict.fromkeys(column for row in rows for column in row))
        cells = [[_cell(row.get(column, "")) for column in columns] for row in rows]
        if number == 0:
            text_columns = [column for column in columns if isinstance(rows[0].get(column), str)]
            print_columns(console, name, dict(zip(columns, zip(*cells, strict=True), strict=True)), text_columns)
        lines = ["| " + " | ".join(line) + " |" for line in (columns, ["---"] * len(columns), *cells)]
        text.append(f"## {name}\n\n" + "\n".join(lines))
    console.print(*text[1 : 3 + len(remarks)], sep="\n", markup=False, highlight=False)
    if stem is None:
        return
    numbers = io.StringIO()
    writer = csv.DictWriter(numbers, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()} for row in rows)
    with contextlib.ExitStack() as files:
        if picture is not None:
            picture(files.enter_context(atomic_file(stem.with_suffix(".png"))))
        for suffix, content in ((".csv", numbers.getvalue()), (".md", "\n\n".join(text) + "\n")):
            files.enter_context(atomic_file(stem.with_suffix(suffix))).write_text(content, encoding="utf-8")


def _cell(value: object) -> str:
    """A number with four digits; NaN as an empty string."""
    if isinstance(value, float):
        return "" if value != value else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return {True: "yes", False: "NO"}[value] if isinstance(value, bool) else str(value)
