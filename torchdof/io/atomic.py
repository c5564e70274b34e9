"""Writes a file whole or not at all: under a temporary name in the same folder, renamed when it is complete.

The temporary file is removed on any error, including Ctrl-C, SIGTERM and SIGHUP. Only SIGKILL leaves it behind;
:func:`remove_unfinished` removes such files later.
"""

import contextlib
import os
import re
import signal
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

_ABANDONED_S = 60.0  # seconds without a change after which no process writes a temporary file any more


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file in the folder of ``path``, which is made; renamed to ``path`` at the end, removed on errors."""
    check_writable(path)
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; name a file in it")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{uuid.uuid4().hex}.part{target.suffix}")
    with exit_on_signals():
        try:
            yield temporary
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)


def remove_unfinished(folder: str | os.PathLike[str]) -> tuple[int, int]:
    """Removes the temporary files of killed processes from a folder.

    Returns:
        The number of removed files, and of those that changed in the last minute and may still be written.
    """
    parts = [path for path in Path(folder).glob(".*.part*") if re.fullmatch(r"\.[0-9a-f]{32}\.part.*", path.name)]
    removed = 0
    for path in parts:
        with contextlib.suppress(OSError):  # finished or removed by another process
            if time.time() - path.stat().st_mtime > _ABANDONED_S:
                path.unlink()
                removed += 1
    return removed, sum(path.exists() for path in parts)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Refuses a file that is read-only, or whose folder is read-only or cannot be made."""
    target = Path(os.path.realpath(path))
    if target.is_file() and not os.access(target, os.W_OK):
        raise PermissionError(f"{path}: is read-only; make it writable or name another file")
    folder = next(parent for parent in target.parents if parent.exists())
    if not folder.is_dir():
        raise NotADirectoryError(f"{path}: its folder cannot be made, because {folder} is a file")
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{path}: may not write to the folder {folder}")


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes a text file in UTF-8, whole or not at all."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def exit_on_signals() -> Iterator[None]:
    """Turns SIGTERM and SIGHUP into ``SystemExit``, so that ``finally`` blocks run; handlers of the caller stay."""
    signals = {signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}
    is_main_thread = threading.current_thread() is threading.main_thread()  # only this thread may set handlers
    unhandled = [number for number in signals if is_main_thread and signal.getsignal(number) == signal.SIG_DFL]
    try:
        for number in unhandled:
            signal.signal(number, lambda number, _: sys.exit(128 + number))  # as shells count signals
        yield
    finally:
        for number in unhandled:
            signal.signal(number, signal.SIG_DFL)
