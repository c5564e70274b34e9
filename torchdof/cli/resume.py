"""Which existing frames ``torchdof render --resume`` keeps: complete ones of the same options and files."""

import itertools
import json
import os
from collections.abc import Mapping, Sequence
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
        """The complete existing frames not older than the record and their sources (if steady, those of all before)."""
        from ..io.decode import is_complete  # imports NumPy

        def changed_ns(*paths: Path | None) -> int:
            return max(path.stat().st_mtime_ns for path in paths if path is not None)

        times = [changed_ns(self.path, *paths) for paths in sources.values()]
        newest = dict(zip(sources, itertools.accumulate(times, max) if is_steady else times, strict=True))
        existing = ((n, out) for n, out in frames.items() if out.is_file())
        return {out for n, out in existing if changed_ns(out) >= newest[n] and is_complete(out)}

    def write(self, is_first: bool) -> None:
        """Before the first frame, writes the options if they differ; later refuses those of another run."""
        reason = self.difference()
        if reason and is_first:
            write_text(self.path, json.dumps(self._options, indent=1))
        elif reason and self.path.is_file():
            raise ValueError(f"{self.path}: another run renders the same frames with other options ({reason})")
