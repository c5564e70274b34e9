"""Which existing frames ``torchdof render --resume`` keeps: complete ones of the same options and files."""

import itertools
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..io.atomic import write_text


class Record:
    """The options of the last run, in the file ``OUT.json`` beside the frames; paths in it are absolute.

    The file is written again only if the options differ. So a frame that is older than the file has other options.
    """

    def __init__(self, out: Path, options: Mapping[str, Any]) -> None:
        self.path = out.with_name(f"{out.name}.json")
        self._options = json.loads(json.dumps(options, default=os.path.abspath))

    def difference(self) -> str:
        """The options that differ from those of the last run, as the reason for rendering again; "" if none do."""
        try:
            before = dict(json.loads(self.path.read_bytes()))
        except (OSError, ValueError, TypeError):
            return f"{self.path}, which has the options of existing frames, is missing or cannot be read"
        names = [name for name in {**before, **self._options} if before.get(name) != self._options.get(name)]
        return f"{', '.join(names)} changed" if names else ""

    def kept(
        self, frames: Mapping[int, Path], sources: Mapping[int, Sequence[Path | None]], is_steady: bool
    ) -> set[Path]:
        """The existing frames that are complete, and not older than the record and their sources.

        ``sources`` are the files from which each frame is rendered, in the order of the sequence; with ``is_steady`` a
        frame also depends on those before it.
        """
        from ..io.decode import is_complete  # imports NumPy

        times: Iterable[int] = (max(map(_changed_ns, filter(None, paths))) for paths in sources.values())
        newest = dict(zip(sources, itertools.accumulate(times, max) if is_steady else times, strict=True))
        start = _changed_ns(self.path)
        recent = (out for n, out in frames.items() if out.is_file() and _changed_ns(out) >= max(start, newest[n]))
        return {out for out in recent if is_complete(out)}

    def write(self) -> None:
        """Writes the options, if they differ from those of the last run."""
        if self.difference():
            write_text(self.path, json.dumps(self._options, indent=1))

    def check(self) -> None:
        """Ends the run if another one has recorded other options since :meth:`write`: both would write one folder."""
        if self.path.is_file() and (reason := self.difference()):
            raise ValueError(f"{self.path}: another run renders the same frames with other options ({reason})")


def _changed_ns(path: Path) -> int:
    return path.stat().st_mtime_ns
