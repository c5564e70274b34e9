"""A file is written whole or not at all: under another name in the same folder, renamed once it is complete."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

__all__ = ["whole_file"]


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
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {target.parent}; make it first")
    if target.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; name a file in it")
    if not os.access(target.parent, os.W_OK):
        raise PermissionError(f"{path}: may not write to the folder {target.parent}")
    part = target.with_name(f".{target.stem[:80]}.{uuid.uuid4().hex[:8]}.part{target.suffix}")
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)
