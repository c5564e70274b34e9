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

from ..io.atomic import atomic_file

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
    rows: Sequence[Row],
    remarks: Sequence[str],
    stem: Path | None,
    picture: Callable[[Path], object] | None = None,
    quiet: bool = False,
    details: Sequence[Row] = (),
) -> None:
    """Prints a table and the remarks; writes them to ``stem.md``, and ``.csv`` and ``.png``: all or none.

    Missing values of ``rows`` stay empty. The CSV has the ``details``, or the same rows without them; ``picture``
    writes a picture to a path.
    """
    machine = (
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} CPUs, {torch.get_num_threads()} threads; "
        f"torchdof {importlib.metadata.version('torchdof')}, torch {torch.__version__}, "
        f"Python {platform.python_version()}, {platform.system()}."
    )
    lines = [columns := _columns(rows), *([_cell(row.get(name, "")) for name in columns] for row in rows)]
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    lines = [[f"{cell:>{width}}" for cell, width in zip(line, widths, strict=True)] for line in lines]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    text = "\n\n".join([f"# {title}", table, machine, LEGEND, *remarks])
    if not quiet:
        print(text)
    if stem is None:
        return
    numbers = io.StringIO()
    writer = csv.DictWriter(numbers, _columns(details or rows), lineterminator="\n")
    writer.writeheader()
    for row in details or rows:
        writer.writerow({name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()})
    with contextlib.ExitStack() as files:
        if picture is not None:
            picture(files.enter_context(atomic_file(stem.with_suffix(".png"))))
        for suffix, content in ((".csv", numbers.getvalue()), (".md", text + "\n")):
            files.enter_context(atomic_file(stem.with_suffix(suffix))).write_text(content, encoding="utf-8")


def _columns(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(column for row in rows for column in row))


def _cell(value: object) -> str:
    """A number with four digits; NaN as an empty string."""
    if isinstance(value, float):
        return "" if value != value else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return {True: "yes", False: "NO"}[value] if isinstance(value, bool) else str(value)
