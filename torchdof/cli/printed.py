"""What commands print: JSON for programs, warnings, and a bar while something takes long."""

import json
import math
import os
import sys
import threading
import time
import warnings
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..depth.sanity import Mistake

__all__ = ["Bar", "WarnOnce", "json_line"]

_PATIENCE_S = 3.0


def json_line(facts: Mapping[str, Any]) -> str:
    """Facts as JSON on one line. JSON has no infinity: numbers that are not finite are the texts inf, -inf and nan.

    Example:
        >>> json_line({"focus_m": float("inf"), "size": (3, 2)})
        '{"focus_m": "inf", "size": [3, 2]}'
    """
    return json.dumps(_finite(facts), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _finite(part) for name, part in value.items()}
    if hasattr(value, "tolist"):  # numpy's numbers and arrays
        return _finite(value.tolist())
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


class WarnOnce:
    """Warns of likely mistakes, a line each on standard error: what is wrong with a sequence is so in each frame.

    Args:
        strict: Raise instead of warning.
    """

    def __init__(self, strict: bool = False) -> None:
        self._strict = strict
        self._names: set[str] = set()

    def warn(self, source: str | os.PathLike[str], mistakes: "Iterable[Mistake]") -> None:
        """Warns of each mistake of a kind that was not warned of before; ``PYTHONWARNINGS=ignore`` silences them.

        Raises:
            ValueError: If there is one, and strictness is asked for.
        """
        from ..depth.sanity import DepthWarning

        for mistake in mistakes:
            if self._strict:
                raise ValueError(f"{source}: {mistake.message} (--strict)")
            if mistake.name in self._names:
                continue
            self._names.add(mistake.name)
            with warnings.catch_warnings():
                warnings.showwarning = _one_line
                try:
                    warnings.warn(f"{source}: {mistake.message}", DepthWarning, stacklevel=2)
                except DepthWarning as warning:  # only strictness makes errors of them
                    _one_line(warning)


def _one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    click.echo(f"warning: {message}", err=True)


class Bar:
    """A bar with an estimate on standard error, from the third second on, where that is a terminal.

    Args:
        what: What is being done.
        total: How many steps there are; None where nobody knows.

    Attributes:
        what: What is being done now.
        done: Steps done.
    """

    def __init__(self, what: str, total: float | None = None) -> None:
        self.what, self.done, self.total = what, 0.0, total
        self._start = self._expected_from = time.monotonic()
        self._expected_s: float | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._show, name="bar", daemon=True)

    @property
    def is_seen(self) -> bool:
        """Whether there is a terminal to show it on."""
        return sys.stderr.isatty()

    def tell(self, what: str) -> None:
        """Says what is done now."""
        self.what = what

    def step(self, done: int, total: int, what: str) -> None:
        """Says how many steps are done, and what is done now."""
        self.done, self.total, self.what = done, total, what

    def expect(self, seconds: float) -> None:
        """Says how long the step that begins now takes."""
        self._expected_from, self._expected_s, self.total = time.monotonic(), seconds, self.total or 1.0

    def __enter__(self) -> "Bar":
        if self.is_seen:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _show(self) -> None:
        if self._ended.wait(_PATIENCE_S):
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        columns = TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.fields[told]}")
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task(self.what, total=None, told="")
            while not self._ended.wait(0.1):
                elapsed, done = time.monotonic() - self._start, self.done
                if self._expected_s:
                    done += min((time.monotonic() - self._expected_from) / self._expected_s, 0.98)
                told = f"{elapsed:.0f} s"
                if self.total and done:
                    told += f", about {elapsed / done * (self.total - done):.0f} s left"
                progress.update(task, description=self.what, total=self.total, completed=done, told=told)
