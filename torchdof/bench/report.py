"""What every benchmark writes: the machine it ran on, paragraphs and tables to read, and the numbers as CSV."""

import contextlib
import csv
import dataclasses
import importlib.metadata
import io
import os
import platform
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from rich.console import Console

from ..io.atomic import whole_file
from ..io.columns import print_columns

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["Report", "ReportTable", "csv_of", "existing_folder", "machine"]


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


@dataclasses.dataclass(frozen=True)
class ReportTable:
    """One table of a report.

    Args:
        title: Above it.
        lines: Its columns, and a line for each further row.
        words: Columns of words, which are aligned to the left; the others hold numbers.
        remark: A paragraph between title and table, where it is written.
    """

    title: str
    lines: Sequence[Sequence[str]]
    words: Collection[str] = ("",)
    remark: str = ""

    def markdown(self) -> str:
        """The table below its title.

        Example:
            >>> print(ReportTable("Title", [["a", "b"], ["1", "2"]]).markdown())
            ## Title
            <BLANKLINE>
            | a | b |
            | --- | --- |
            | 1 | 2 |
        """
        head, *body = self.lines
        rows = "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *body))
        return "\n\n".join([f"## {self.title}", *([self.remark] * bool(self.remark)), rows])

    def show(self) -> None:
        """Prints it."""
        columns = {name: cells for name, *cells in zip(*self.lines, strict=True)}
        print_columns(Console(), self.title, columns, self.words)


@dataclasses.dataclass(frozen=True)
class Report:
    """What a benchmark writes: paragraphs and tables to read, and the same numbers to compute with.

    Args:
        name: Of its files, without suffix.
        title: Above everything.
        parts: Paragraphs and tables, in order.
        csv: The numbers.
    """

    name: str
    title: str
    parts: Sequence[str | ReportTable]
    csv: str

    def markdown(self) -> str:
        """Title, paragraphs and tables."""
        texts = [part if isinstance(part, str) else part.markdown() for part in self.parts]
        return "\n\n".join([f"# {self.title}", *texts]) + "\n"

    def write(self, folder: Path, picture: Callable[[Path], object] | None = None) -> None:
        """Writes ``name.csv`` and ``name.md``, and ``name.png`` where there is a picture: all of them or none.

        Raises:
            OSError: If a file cannot be written.
        """
        with contextlib.ExitStack() as files:
            if picture is not None:
                picture(files.enter_context(whole_file(folder / f"{self.name}.png")))
            for suffix, text in (("csv", self.csv), ("md", self.markdown())):
                part = files.enter_context(whole_file(folder / f"{self.name}.{suffix}"))
                part.write_text(text, encoding="utf-8")
