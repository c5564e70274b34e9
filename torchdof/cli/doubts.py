"""Warnings of the command line: one line each on standard error, once in a sequence; errors with ``--strict``."""

import os
import warnings
from collections.abc import Iterable
from typing import Any

import typer

from ..depth.sanity import DepthWarning, Doubt

__all__ = ["Said"]


class Said:
    """What was warned of already: what is wrong with a sequence is wrong with each of its frames.

    Args:
        strict: Raise instead of warning.
    """

    def __init__(self, strict: bool = False) -> None:
        self._strict = strict
        self._names: set[str] = set()

    def say(self, source: str | os.PathLike[str], doubts: Iterable[Doubt]) -> None:
        """Warns of each doubt of a kind that was not warned of before.

        ``PYTHONWARNINGS=ignore`` silences them; what makes errors of them is strictness alone.

        Raises:
            ValueError: If there is a doubt, and strictness is asked for.
        """
        for doubt in doubts:
            if self._strict:
                raise ValueError(f"{source}: {doubt.message} (--strict)")
            if doubt.name in self._names:
                continue
            self._names.add(doubt.name)
            with warnings.catch_warnings():
                warnings.showwarning = _one_line
                try:
                    warnings.warn(f"{source}: {doubt.message}", DepthWarning, stacklevel=2)
                except DepthWarning as warning:
                    _one_line(warning)


def _one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    typer.echo(f"warning: {message}", err=True)
