"""What every report of ``torchdof bench`` has: the machine it is from, tables as CSV and as Markdown."""

import csv
import dataclasses
import importlib.metadata
import io
import os
import platform
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["csv_of", "machine", "markdown"]


def machine() -> str:
    """Hardware, threads and versions."""
    return (
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} CPUs, {torch.get_num_threads()} threads; "
        f"torchdof {importlib.metadata.version('torchdof')}, torch {torch.__version__}, "
        f"Python {platform.python_version()}, {platform.system()}"
    )


def csv_of(rows: Iterable["DataclassInstance"]) -> str:
    """A line for each row, below the names of their fields."""
    text, head = io.StringIO(), None
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        if head is None:
            head = [field.name for field in dataclasses.fields(row)]
            writer.writerow(head)
        writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in dataclasses.astuple(row)])
    return text.getvalue()


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """A table: its columns, and a line for each further row.

    Example:
        >>> print(markdown([["a", "b"], ["1", "2"]]))
        | a | b |
        | --- | --- |
        | 1 | 2 |
    """
    head, *body = lines
    rows = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
