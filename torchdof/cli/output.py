"""Output of commands: a line for people or JSON for programs, notes, warnings, and a progress bar."""

import contextlib
import json
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..depth.sanity import Mistake

_NOT_FINITE = {"Infinity": "inf", "-Infinity": "-inf", "NaN": "nan"}


def print_result(as_json: bool, facts: Mapping[str, Any], line: str) -> None:
    """Prints ``facts`` as JSON, or ``line`` for people."""
    click.echo(json_line(facts) if as_json else line)


def json_line(facts: Mapping[str, Any]) -> str:
    """Facts as one line of JSON; numbers that are not finite become the strings inf, -inf and nan."""
    text = json.dumps(facts, default=lambda value: value.tolist())  # numpy's numbers and arrays
    return json.dumps(json.loads(text, parse_constant=_NOT_FINITE.__getitem__))


def list_done(files: Collection[Path], text: str, as_json: bool) -> None:
    """Prints which files are there already, one in each line of JSON, or how many: ``text`` begins the line."""
    if files:
        lines = [json_line({"out": str(path), "is_there_already": True}) for path in sorted(files)]
        click.echo("\n".join(lines) if as_json else f"{text} there already")


def rounded(text: str) -> str:
    """A text with its numbers as a person writes them: three significant digits, two of an f-number."""

    def short(match: re.Match[str]) -> str:
        value = float(match[2])
        if not match[1]:
            return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
        return f"f/{value:.0f}" if value >= 10 or value == round(value) else f"f/{value:.{1 if value >= 1 else 2}f}"

    return re.sub(r"(f/)?(?<![\w.])(\d+\.\d+(?:e[-+]?\d+)?)", short, text)


def to_stderr(line: str) -> None:
    """Prints a line on standard error; one that cannot be written must not stop the command."""
    with contextlib.suppress(OSError):
        click.echo(line, err=True)


class Notices:
    """Notes, and warnings of likely mistakes, or errors if ``strict``.

    Each kind is printed once for all frames; with ``each_message``, for pictures that differ, each text once.
    """

    def __init__(self, strict: bool = False, each_message: bool = False, is_printed: bool = True) -> None:
        self._strict, self._each_message, self._is_printed = strict, each_message, is_printed
        self._kinds, self.lines = dict[str, int](), list[str]()  # how often each kind came, and the lines

    def note(self, kind: str, line: str, word: str = "note") -> None:
        """Prints a note: an assumption, or advice, with the options that change it."""
        kind = line.partition(": ")[2] if self._each_message else kind  # a line starts with the name of its file
        if kind not in self._kinds:
            self.lines.append(f"{word}: {line}")
            if self._is_printed:
                to_stderr(self.lines[-1])
        self._kinds[kind] = self._kinds.get(kind, 0) + 1

    def repeated(self) -> list[tuple[str, int]]:
        """With ``each_message``, the texts that came again, and how often."""
        return [(text, count - 1) for text, count in self._kinds.items() if count > 1]

    def warn(self, source: str | os.PathLike[str], mistakes: "Iterable[Mistake]") -> None:
        """Warns of likely mistakes in a file."""
        for mistake in mistakes:
            message = f"{source}: {mistake.message}"
            if self._strict:
                raise ValueError(f"{message} (--strict)")
            self.note(mistake.name, message, "warning")


@contextlib.contextmanager
def progress_bar(what: str, total: float | None = None) -> Iterator[Callable[..., None]]:
    """A bar on a terminal's standard error, as a function of ``what`` (the current step), ``done`` and ``total``."""
    from rich import progress
    from rich.console import Console

    with progress.Progress(
        *(progress.TextColumn("{task.description}", markup=False), progress.BarColumn()),
        *(progress.TimeElapsedColumn(), progress.TimeRemainingColumn()),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
        redirect_stdout=sys.stdout.isatty(),  # prints lines above the bar; a file is unaffected
    ) as bar:
        task = bar.add_task(what, total=total)
        yield lambda what=None, done=None, total=None: bar.update(task, description=what, completed=done, total=total)
