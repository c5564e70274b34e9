"""Frames that ``torchdof render`` renders, and their files: one image, a sequence, or a focus pull in a still image."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..io.sequence import FramePattern
from .command import refuse
from .options import check_files

if TYPE_CHECKING:
    from .render import Render

_MOST_FRAMES = 1_000_000  # of one run; a larger number is a slip of the finger, and would not fit into memory
_ARRAYS = (".npy", ".npz")  # files that may hold the maps of all frames


@dataclasses.dataclass(frozen=True)
class Frames:
    """Frames to render, and the patterns of their files; a pattern is None where a file is the same for all."""

    command: "Render"
    images: FramePattern | None
    depths: FramePattern | None
    outputs: FramePattern | None
    mattes: FramePattern | None

    @classmethod
    def of(cls, command: "Render") -> "Frames":
        """The frames of a command; refuses options that do not fit their kind."""
        paths = (command.image, command.depth, command.out, command.matte)
        frames = cls(command, *map(FramePattern.of, paths))
        images, depths, out, is_single = frames.images, frames.depths, frames.outputs, frames.is_single
        has_number = out and FramePattern.is_padded(command.out) and not FramePattern.is_padded(command.image)
        of_sequences = (images is None and (command.steady or depths)) or (is_single and (command.frames or has_number))
        no_number = f"{command.out}: expected one place for the frame number, such as pull.##.png; ffmpeg joins frames"
        of_single = f"{command.matte}: masks of frames are for a sequence; IMAGE is a single image"
        are_exr = {command.image.suffix.lower(), command.out.suffix.lower()} == {".exr"}
        no_metres, other_types = command.steady and command.depth_kind == "coc", command.keep_layers and not are_exr
        refuse(
            (other_types, "--keep-layers is for an EXR that is written to an EXR; leave it out"),
            (not is_single and not out, no_number),
            (command.sheet and not is_single, "--sheet is of one picture; leave it out where there are more"),
            (frames.mattes and not images, of_single),
            (of_sequences, f"{command.image}: is a single image; for a sequence write it as shot.####.exr"),
            (images and command.blur, "--blur would open the lens anew in each frame of a sequence; give --f-number"),
            (no_metres, "--steady filters depth in metres; --depth-kind coc has none"),
        )
        return frames

    @property
    def is_single(self) -> bool:
        """Whether one image is rendered once."""
        return self.images is None and len(self.command.focus_m or []) < 2

    def numbers(self) -> Sequence[int]:
        """Numbers of the frames, of which there is at least one."""
        command = self.command
        if self.is_single:
            return [0]
        if self.images and not command.frames:
            numbers: Sequence[int] = self.images.frames()
        else:
            keys = (command.focus_m or []) if self.images is None else []
            first, last = command.frames or (keys[0][0], keys[-1][0])
            numbers = range(first, last + 1)
            for pattern in filter(None, (self.images, self.depths, self.mattes)):
                pattern.refuse_missing(numbers)
            refuse((len(numbers) > _MOST_FRAMES, f"{first}-{last} are {len(numbers)} frames, more than {_MOST_FRAMES}"))
        if not numbers:
            raise FileNotFoundError(f"{command.image}: there are no such files")
        return numbers

    def files(self) -> dict[int, Path]:
        """The file that each frame is written to; refuses those that are also read."""
        files: dict[int, Path] = {}
        for n in self.numbers():
            files[n] = self.outputs.name(n) if self.outputs and not self.is_single else self.command.out
            check_files(*self.sources(n), files[n], self.command.sheet, matte=self.matte(n))
        return files

    def sources(self, n: int) -> tuple[Path, Path | None]:
        """The image of a frame, and its depth."""
        image = self.images.name(n) if self.images else self.command.image
        return image, self.depths.name(n) if self.depths else self.command.depth

    def matte(self, n: int) -> Path | None:
        """The mask of a frame; None if all have the same, or none has one."""
        return self.mattes.name(n) if self.mattes else None

    def read_for(self, numbers: Sequence[int]) -> list[int]:
        """The frames on which those depend: with steady depth, all of the sequence."""
        if not (self.images and self.command.steady):
            return list(numbers)
        return [n for n in self.images.frames() if self.depths is None or self.depths.name(n).is_file()]

    def places(self) -> Mapping[int, tuple[int, int]]:
        """Place of each frame in an array that holds the depth of all, and their number; empty without one."""
        depth = self.command.depth
        if not self.images or self.depths or not depth or depth.suffix.lower() not in _ARRAYS:
            return {}
        every = self.images.frames()
        return {n: (k, len(every)) for k, n in enumerate(every)}
