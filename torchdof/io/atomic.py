"""A file is written whole or not at all: under another name in the same folder, renamed once it is complete.

That name vanishes on any error, Ctrl-C, SIGTERM and SIGHUP included. A process that is killed outright leaves it
behind; the first that writes to the folder a day later removes it.
"""

import contextlib
import functools
import os
import signal
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import NoReturn

__all__ = ["unwound_on_termination", "whole_file", "write_text"]

_DAY_S = 86_400.0


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name to write to, in the folder of ``path``, that becomes ``path`` at the end, or vanishes on any error.

    Raises:
        OSError: If the folder does not exist or may not be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_file(folder + "/note.txt") as part:
        ...         _ = part.write_text("complete")
        ...     Path(folder + "/note.txt").read_text()
        'complete'
    """
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise OSError(f"{path}: is a link that leads back to itself; name a file")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {target.parent}; make it first")
    if target.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; name a file in it")
    if not os.access(target.parent, os.W_OK):
        raise PermissionError(f"{path}: may not write to the folder {target.parent}")
    _remove_abandoned(target.parent)
    part = target.with_name(f".{uuid.uuid4().hex}.part{target.suffix}")
    with unwound_on_termination():
        try:
            yield part
            with part.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(part, target)
        finally:
            part.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes a text file in UTF-8, whole or not at all."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


@functools.cache  # once: a folder of many frames takes long to list
def _remove_abandoned(folder: Path) -> None:
    """Removes what processes that were killed had not finished writing."""
    for part in folder.glob("." + "[0-9a-f]" * 32 + ".part*"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime > _DAY_S:
                part.unlink()


@contextlib.contextmanager
def unwound_on_termination() -> Iterator[None]:
    """SIGTERM and SIGHUP as ``SystemExit``, which tidies up behind itself, unless somebody handles them."""

    def leave(number: int, _: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)  # as shells tell of a process that a signal ended

    ends = {getattr(signal, name, signal.SIGTERM) for name in ("SIGTERM", "SIGHUP")}
    main = threading.current_thread() is threading.main_thread()  # no other hears of signals
    heard = [number for number in ends if main and signal.getsignal(number) == signal.SIG_DFL]
    try:
        for number in heard:
            signal.signal(number, leave)
        yield
    finally:
        for number in heard:
            signal.signal(number, signal.SIG_DFL)
