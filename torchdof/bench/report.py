"""What every report of ``torchdof bench`` has: the machine it is from, tables as CSV and as Markdown."""

import contextlib
import csv
import dataclasses
import importlib.metadata
import io
import os
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from ..io.atomic import whole_file

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["csv_of", "existing_folder", "machine", "markdown", "write"]


def existing_folder(out: Path | None) -> Path | None:
    """The folder for a report, or None for none.

    Raises:
        FileNotFoundError: If it is not there.
    """
    if out is not None and not out.is_dir():
        raise FileNotFoundError(f"{out}: there is no such folder; make it first")
    return out


def machine(threads: str = "") -> str:
    """Hardware, threads and versions; ``threads`` says more of the threads than their number."""
    threads = threads or f"{torch.get_num_threads()} threads"
    return (
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} CPUs, {threads}; "
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


def write(folder: Path, name: str, texts: dict[str, str]) -> None:
    """Writes files of one name, a text for each suffix: all of them or none.

    Raises:
        OSError: If a file cannot be written.
    """
    with contextlib.ExitStack() as files:
        for suffix, text in texts.items():
            files.enter_context(whole_file(folder / f"{name}.{suffix}")).write_text(text, encoding="utf-8")


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
