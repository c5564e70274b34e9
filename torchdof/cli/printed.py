"""What commands print: a line for people or JSON for programs, warnings, and a bar while something takes long."""

import contextlib
import json
import math
import os
import sys
import threading
import warnings
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..depth.sanity import Mistake

__all__ = ["Bar", "WarnOnce", "json_line", "note", "tell"]

_PATIENCE_S = 3.0


def tell(as_json: bool, facts: Mapping[str, Any], line: str) -> None:
    """Prints facts as JSON, or the line that says the same to people."""
    click.echo(json_line(facts) if as_json else line)


def note(*lines: str) -> None:
    """Prints what was taken for granted, and what to do about it, on standard error."""
    for line in lines:
        click.echo(f"note: {line}", err=True)


def json_line(facts: Mapping[str, Any]) -> str:
    """Facts as JSON on one line. JSON has no infinity: numbers that are not finite are the texts inf, -inf and nan.

    Example:
        >>> json_line({"focus_m": float("inf"), "size": (3, 2)})
        '{"focus_m": "inf", "size": [3, 2]}'
    """

    def finite(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {str(name): finite(part) for name, part in value.items()}
        if hasattr(value, "tolist"):  # numpy's numbers and arrays
            return finite(value.tolist())
        if isinstance(value, list | tuple):
            return [finite(part) for part in value]
        return str(value) if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(finite(facts), allow_nan=False)


class WarnOnce:
    """Warns of likely mistakes, a line each on standard error: what is wrong with a sequence is so in each frame.

    With ``strict`` a mistake is a ``ValueError``; else ``PYTHONWARNINGS=ignore`` silences them.
    """

    def __init__(self, strict: bool = False) -> None:
        self._strict, self._names = strict, set[str]()

    def warn(self, source: str | os.PathLike[str], mistakes: "Iterable[Mistake]") -> None:
        """Warns of each mistake of a kind that was not warned of before."""
        from ..depth.sanity import DepthWarning

        for mistake in mistakes:
            message = f"{source}: {mistake.message}"
            if self._strict:
                raise ValueError(f"{message} (--strict)")
            if mistake.name in self._names:
                continue
            self._names.add(mistake.name)
            with warnings.catch_warnings():
                warnings.showwarning = _one_line
                try:
                    warnings.warn(message, DepthWarning, stacklevel=2)
                except DepthWarning as warning:  # only strictness makes errors of them
                    _one_line(warning)


def _one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    with contextlib.suppress(OSError):  # a warning that cannot be written costs no picture
        click.echo(f"warning: {message}", err=True)


def _is_terminal() -> bool:
    return sys.stderr.isatty()


class Bar:
    """A bar with an estimate on standard error, from the third second on, where that is a terminal.

    It says what is being done, of how many steps in total; None where nobody knows.
    """

    def __init__(self, what: str, total: float | None = None) -> None:
        self.is_seen = _is_terminal()
        if self.is_seen:
            from rich import progress
            from rich.console import Console

            elapsed, remaining = progress.TimeElapsedColumn(), progress.TimeRemainingColumn()
            self._progress = progress.Progress(
                *(progress.TextColumn("{task.description}", markup=False), progress.BarColumn(), elapsed, remaining),
                console=Console(stderr=True),
                transient=True,
                redirect_stdout=sys.stdout.isatty(),  # lines go above the bar; to a file they go as ever
            )
            self._task = self._progress.add_task(what, total=total)
            self._timer = threading.Timer(_PATIENCE_S, self._progress.start)
            self._timer.daemon = True

    def update(self, what: str | None = None, done: float | None = None, total: float | None = None) -> None:
        """Says what is done now, how many steps are done, and how many there are."""
        if self.is_seen:
            self._progress.update(self._task, description=what, completed=done, total=total)

    def __enter__(self) -> "Bar":
        if self.is_seen:
            self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.is_seen:
            self._timer.cancel()
            self._timer.join()
            if self._progress.live.is_started:
                self._progress.stop()
