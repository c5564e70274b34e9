"""Output of commands: a line for people or JSON for programs, notes, warnings, and a progress bar."""

import contextlib
import json
import os
import sys
import threading
import warnings
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..depth.sanity import Mistake

_DELAY_S = 3.0  # s before the bar appears
_NOT_FINITE = {"Infinity": "inf", "-Infinity": "-inf", "NaN": "nan"}


def print_result(as_json: bool, facts: Mapping[str, Any], line: str) -> None:
    """Prints ``facts`` as JSON, or ``line`` for people."""
    click.echo(json_line(facts) if as_json else line)


def json_line(facts: Mapping[str, Any]) -> str:
    """Facts as one line of JSON; numbers that are not finite become the strings inf, -inf and nan.

    Example:
        >>> json_line({"focus_m": float("inf"), "size": (3, 2)})
        '{"focus_m": "inf", "size": [3, 2]}'
    """
    text = json.dumps(facts, default=lambda value: value.tolist())  # numpy's numbers and arrays
    return json.dumps(json.loads(text, parse_constant=_NOT_FINITE.__getitem__))


class Notices:
    """Notes and warnings of likely mistakes, one line each on standard error; each kind is printed once for all frames.

    With ``strict`` a mistake raises ``ValueError``. ``PYTHONWARNINGS=ignore`` silences warnings.
    """

    def __init__(self, strict: bool = False) -> None:
        self._strict, self._kinds = strict, set[str]()

    def note(self, kind: str, line: str) -> None:
        """Prints a note: an assumption, or advice, with the options that change it."""
        if kind not in self._kinds:
            _to_stderr(f"note: {line}")
        self._kinds.add(kind)

    def warn(self, source: str | os.PathLike[str], mistakes: "Iterable[Mistake]") -> None:
        """Warns of likely mistakes in a file."""
        from ..depth.sanity import DepthWarning

        for mistake in mistakes:
            message = f"{source}: {mistake.message}"
            if self._strict:
                raise ValueError(f"{message} (--strict)")
            if mistake.name not in self._kinds:
                with warnings.catch_warnings():
                    warnings.showwarning = lambda warning, *_, **__: _to_stderr(f"warning: {warning}")
                    try:
                        warnings.warn(message, DepthWarning, stacklevel=2)
                    except DepthWarning as warning:  # by PYTHONWARNINGS=error, but only --strict may stop a command
                        _to_stderr(f"warning: {warning}")
            self._kinds.add(mistake.name)


def _to_stderr(line: str) -> None:
    with contextlib.suppress(OSError):  # a message that cannot be written must not stop the command
        click.echo(line, err=True)


def _is_terminal() -> bool:
    return sys.stderr.isatty()


class Bar:
    """A progress bar with the remaining time, shown after three seconds if standard error is a terminal.

    ``what`` describes the current step; ``total`` is the number of steps, or None if it is unknown.
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
                redirect_stdout=sys.stdout.isatty(),  # prints lines above the bar; a file is unaffected
            )
            self._task = self._progress.add_task(what, total=total)
            self._timer = threading.Timer(_DELAY_S, self._progress.start)
            self._timer.daemon = True

    def update(self, what: str | None = None, done: float | None = None, total: float | None = None) -> None:
        """Changes the description, the number of finished steps, or their total."""
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
