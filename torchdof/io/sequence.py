"""Numbered frames: file names such as ``shot.####.exr``, and focus keyframes."""

import math
import re
from pathlib import Path

_MAX_DIGITS = 18  # of a frame number


class FramePattern:
    """A file name with a placeholder for the frame number: ``####`` or ``%04d``, zero-padded to that many digits."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        parts = re.split(r"(#+|%0?\d*d)", self.path.name)  # folders are taken literally
        if len(parts) != 3:
            raise ValueError(f"{path}: expected one place for the frame number in the file's name, as shot.####.exr")
        self._before, place, self._after = parts
        self._digits = len(place) if place[0] == "#" else int(place[1:-1][:9] or 1)
        if self._digits > _MAX_DIGITS:
            raise ValueError(f"{path}: the frame number must have at most {_MAX_DIGITS} digits, got {self._digits}")

    @classmethod
    def of(cls, path: Path | None) -> "FramePattern | None":
        """The pattern of a path with a placeholder, unless a file has literally this name; None for other paths."""
        return None if path is None or not re.search(r"#|%\d*d", path.name) or path.is_file() else cls(path)

    @staticmethod
    def is_padded(path: str | Path) -> bool:
        """Whether a path has a placeholder of several digits, which is unlikely in the name of a single file."""
        return re.search(r"##|%0?\d+d", Path(path).name) is not None

    def name(self, frame: int) -> Path:
        """The path of one frame."""
        return self.path.with_name(f"{self._before}{frame:0{self._digits}d}{self._after}")

    def frames(self) -> list[int]:
        """Numbers of the existing frames, in order."""
        if not self.path.parent.is_dir():
            return []
        pattern = re.compile(re.escape(self._before) + r"(\d+)" + re.escape(self._after))
        numbers = {int(match[1]) for path in self.path.parent.iterdir() if (match := pattern.fullmatch(path.name))}
        return sorted(n for n in numbers if self.name(n).is_file())

    def refuse_missing(self, numbers: range) -> None:
        """Refuse a part of the sequence with frames that do not exist; the message counts them."""
        existing = self.frames()
        missing = len(numbers) - sum(n in numbers for n in existing)
        if missing:
            have = f"there are {existing[0]} to {existing[-1]}" if existing else "there are no such files"
            first = self.name(next(n for n in numbers if n not in existing)).name
            count = f"{missing} of {len(numbers)} frames are missing"
            raise FileNotFoundError(f"{self.path}: {count}, {first} first; {have}")


def parse_frames(text: str) -> tuple[int, int]:
    """Reads ``first-last`` or a single number; ``ValueError`` if it is neither."""
    match = re.fullmatch(r"\s*(\d{1,18})(?:\s*-\s*(\d{1,18}))?\s*", text)
    if match is None or int(match[2] or match[1]) < int(match[1]):
        raise ValueError(text)
    return int(match[1]), int(match[2] or match[1])


def parse_focus(text: str) -> list[tuple[int, float]]:
    """Reads a focus distance in metres, ``2.0``, as one keyframe, or keyframes ``frame:metres``, sorted by frame."""
    keys: dict[int, float] = {}
    for part in text.split(","):
        frame, colon, metres = part.strip().removesuffix("m").partition(":")  # as in 2.3 m
        key, distance = (int(frame), float(metres)) if colon else (0, float(frame))
        if not distance > 0 or key in keys or (not colon and "," in text):
            raise ValueError(text)
        keys[key] = distance
    return sorted(keys.items())


def focus_at_frame(keys: list[tuple[int, float]], frame: int) -> float:
    """Focus distance in metres at a frame: linear in 1/distance, as blur is, between keyframes, constant beyond."""
    import numpy as np

    from ..validation import number  # imports PyTorch, which parsing of arguments must not need

    distances = dict(keys)
    dioptres = float(np.interp(number("frame", frame), [*distances], [1.0 / metres for metres in distances.values()]))
    return distances[frame] if frame in distances else 1.0 / dioptres if dioptres > 0 else math.inf
