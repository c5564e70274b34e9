"""Warnings of the command line: one line each on standard error, once in a sequence; errors with ``--strict``."""

import os
import warnings
from collections.abc import Iterable
from typing import Any

import typer

from ..depth.sanity import DepthWarning, Mistake

__all__ = ["WarnOnce"]


class WarnOnce:
    """What was warned of already: what is wrong with a sequence is wrong with each of its frames.

    Args:
        strict: Raise instead of warning.
    """

    def __init__(self, strict: bool = False) -> None:
        self._strict = strict
        self._names: set[str] = set()

    def warn(self, source: str | os.PathLike[str], mistakes: Iterable[Mistake]) -> None:
        """Warns of each likely mistake of a kind that was not warned of before.

        ``PYTHONWARNINGS=ignore`` silences them; what makes errors of them is strictness alone.

        Raises:
            ValueError: If there is one, and strictness is asked for.
        """
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
                except DepthWarning as warning:
                    _one_line(warning)


def _one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    typer.echo(f"warning: {message}", err=True)
