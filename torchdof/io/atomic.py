"""A file is written whole or not at all: under another name in the same folder, renamed once it is complete.

What is written goes by the name ``.NAME.OWNER.part.SUFFIX``. It vanishes on any error, Ctrl-C and SIGTERM included. A
process that is killed outright leaves it behind: the next one that writes to the folder removes it.
"""

import contextlib
import hashlib
import os
import re
import signal
import socket
import threading
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

__all__ = ["whole_file"]

_PART = re.compile(r"\..*\.(?P<place>[0-9a-f]{8})-(?P<pid>\d+)-(?P<start>\d+)-[0-9a-f]{8}\.part(\.[^.]*)?", re.DOTALL)
_ENDS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
_tidied: set[str] = set()
_unfinished: set[Path] = set()


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
    if str(target.parent) not in _tidied:  # once: a folder of many frames takes long to list
        _tidied.add(str(target.parent))
        _tidy(target.parent)
    owner = f"{_place()}-{os.getpid()}-{_start(os.getpid())}-{uuid.uuid4().hex[:8]}"
    part = target.with_name(f".{target.stem[:80]}.{owner}.part{target.suffix}")
    try:
        with _removed_on_termination(part):
            yield part
            with part.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def _removed_on_termination(part: Path) -> Iterator[None]:
    """While it lasts, SIGTERM and SIGHUP remove a file before they end the process, unless somebody handles them."""
    _unfinished.add(part)
    heard = []
    if threading.current_thread() is threading.main_thread():  # no other hears of signals
        heard = [number for number in _ENDS if signal.getsignal(number) == signal.SIG_DFL]
    try:
        for number in heard:
            signal.signal(number, _end)
        yield
    finally:
        for number in heard:
            signal.signal(number, signal.SIG_DFL)
        _unfinished.discard(part)


def _end(number: int, _: FrameType | None) -> None:
    """Removes what is being written, then ends the process as the signal would have."""
    for part in list(_unfinished):
        part.unlink(missing_ok=True)
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _tidy(folder: Path) -> None:
    """Removes what processes of this machine that are gone had not finished writing."""
    if os.name != "posix":  # elsewhere nobody can be asked whether they live
        return
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            named = _PART.fullmatch(entry.name)
            if named is None or named["place"] != _place() or int(named["pid"]) == os.getpid():
                continue
            if not _alive(int(named["pid"])) or _start(int(named["pid"])) != named["start"]:
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)


def _place() -> str:
    """Where a process number means something: this machine and, in a container, its own numbering."""
    numbering = ""
    with contextlib.suppress(OSError):
        numbering = os.readlink("/proc/self/ns/pid")
    return hashlib.sha256(f"{socket.gethostname()} {numbering}".encode()).hexdigest()[:8]


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _start(process: int) -> str:
    """When a process began, in ticks since the machine started, which tells two of one number apart; 0 if unknown."""
    with contextlib.suppress(OSError, IndexError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    return "0"
