"""``torchdof render``: its options, and the order in which it reads, renders and writes frames."""

import dataclasses
import functools
import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from ..io.atomic import check_writable, remove_unfinished
from ..io.sequence import parse_frames
from .command import Command, Group, Parsed, argument, numbers, option, refuse
from .frames import Frames
from .options import Accuracy, Blur, Scene
from .output import list_done, progress_bar, to_stderr
from .resume import Record

if TYPE_CHECKING:
    from .frame import Frame
    from .renderer import Renderer

_OWN_EXTREMES = (
    "each frame's relative depth is scaled by its own extremes, so that distances pulse; give the values that near and "
    "far have in all frames: --value-range LOW,HIGH"
)
Encoding = Literal["linear", "srgb"]
_NOT_OF_FRAMES = ("out", "sheet", "frames", "resume", "strict", "device", "as_json")  # options that change no frame


class _Effects(Group):
    """Blur."""

    attention: tuple[float, float, float] | None = option(
        "Where the viewer looks, in pixels from the top left: elsewhere a draft's tolerance is enough.",
        type=Parsed("X,Y,RADIUS", numbers(3), "320,200,80"),
    )
    lights: float = option(
        "Brighten lamps that a photograph clipped at white, by up to this many stops, such as 3.",
        0.0,
        metavar="STOPS",
        type=click.FloatRange(min=0),
    )
    matte: Path | None = option(
        "A subject's mask, in which white is the subject: decides where hair and other soft edges end. One for all "
        "frames, mask.####.png, or a folder. Default: that of a phone's portrait; none leaves it out.",
        metavar="MASK|none",
    )
    show_focus: bool = option("Don't blur: tint the grey image: near orange, in focus green, far blue.", False)
    device: str = option("auto, cpu, cuda, cuda:1, ...", "auto")


class _Files(Group):
    """Files and frames."""

    transfer: Encoding | None = option("How IMAGE is encoded. Default: as it states; integers srgb, floats linear.")
    out_transfer: Encoding | None = option("How OUT is encoded. Default: as IMAGE, else by type.")
    bits: Literal["8", "16", "half", "float"] | None = option("What OUT stores. Default: as IMAGE, where the type can.")
    layer: str | None = option("Layer or part of an EXR that is the image.")
    keep_layers: bool = option("Keep other layers, depth and parts of an EXR, unblurred.", False)
    sheet: Path | None = option("Also write the image, its depth and the result side by side to this file.")
    frames: tuple[int, int] | None = option("Part of a sequence.", type=Parsed("FIRST-LAST", parse_frames, "1-48"))
    steady: bool = option("Filter depth of a sequence along time, where neither image nor depth moved.", False)
    resume: bool = option("Render only frames that are missing, cut short, or older than files or options.", False)


class Render(Scene, Blur, Accuracy, _Effects, _Files, Command):
    """Blur IMAGE by its DEPTH as a lens would.

    A photograph and its depth map of any kind; the assumptions are printed:

        torchdof render photo.jpg depth.png -o out.jpg

    Depth in millimetres, with the focus on the pixel at column 320, row 200:

        torchdof render photo.jpg depth.png -o out.jpg --depth-scale 0.001 --focus-at 320,200 --f-number 1.8

    A rendered image with a Z channel:

        torchdof render shot.exr -o out.exr --fov-deg 40 --aperture-radius-m 0.012 --focus-m 2

    A sequence with a focus pull; --resume continues after an interruption, and compares options with OUT.json:

        torchdof render shot.####.exr -o out.####.exr --focus-m 1:2,48:5.5 --f-number 2 --resume

    A folder of photographs and one of their depth maps, matched by name; portraits of phones need no map:

        torchdof render photos/ depths/ -o out/

    A photograph with a focus pull:

        torchdof render photo.jpg depth.png -o pull.##.png --focus-m 1:1,24:5

    A stereo disparity map with holes (scale: baseline in metres * focal length in pixels):

        torchdof render l.png disp.npz -o out.png --focus-m 2 --depth-kind disparity --depth-scale 192 --fill-depth far

    The lens is the one you state, else that of the EXIF data, else 50 mm at f/2.8 on a sensor of 36 mm. If you state
    neither focus nor lens, a single image is focused on the subject nearest its middle, and the lens is opened until
    the largest blur radius is 2 % of the width, unless the file's lens blurs enough.
    """

    image: Path = argument("All-in-focus image, shot.####.exr, or a folder.", "IMAGE")
    depth: Path | None = argument("Its depth; not needed if IMAGE has a Z channel or is a portrait.", "[DEPTH]", None)
    out: Path = option("File to write, out.####.exr, or a folder.", ..., names=("--out", "-o"), metavar="OUT")

    @property
    def has_matte_file(self) -> bool:
        """Whether a file with a matte is named."""
        return self.matte is not None and str(self.matte) != "none"

    def files(self) -> list[Path]:
        """The files besides image and depth that all frames share."""
        return super().files() + [path for path in [self.matte] if path and path.is_file()]

    def run(self) -> None:
        """Renders one image, the frames of a sequence, a focus pull in a still image, or a folder."""
        context = click.get_current_context()
        parameters = context.command.params
        options = {p.opts[0]: getattr(self, p.name) for p in parameters if p.name and p.name not in _NOT_OF_FRAMES}
        options |= {"files": self.files(), "torchdof": importlib.metadata.version("torchdof")}
        both = self.keep_layers and self.show_focus
        refuse((both, "--keep-layers keeps what is not blurred; leave --show-focus out"))
        if self.image.is_dir():
            from .folder import render_folder

            return render_folder(self, options)
        frames, record = Frames.of(self), Record(self.out, options)
        files = frames.files()
        done, reason = self._done(frames, files, record)
        todo = {n: out for n, out in files.items() if out not in done}
        if not todo:
            return
        for out in filter(None, [*todo.values(), self.sheet]):
            check_writable(out)
        renderer = self._renderer(frames)
        again = len([out for out in files.values() if out.is_file()]) - len(done)
        if self.resume and again:
            renderer.notices.note("again", f"{self.out}: {again} of {len(files)} frames are rendered again: {reason}")
        if frames.images and self.depth_kind == "relative" and self.value_range is None and len(files) > 1:
            from ..depth.sanity import Mistake

            renderer.notices.warn(self.depth or self.image, [Mistake("range", _OWN_EXTREMES)])
        is_recorded = self.resume or not frames.is_single or record.path.is_file()
        self._render_each(renderer, todo, self._reader(renderer, frames, [*files]), record if is_recorded else None)

    def _done(self, frames: Frames, files: Mapping[int, Path], record: Record) -> tuple[set[Path], str]:
        """The files that --resume keeps, which are listed, and why others are rendered again."""
        if not self.resume:
            return set(), ""
        removed, young = remove_unfinished(self.out.parent)
        if removed:
            to_stderr(f"note: {self.out.parent}: removed {removed} unfinished files (.part) of killed runs")
        if young:
            writer = "another run is writing, or was killed a moment ago"
            to_stderr(f"note: {self.out.parent}: {young} unfinished files (.part) stay, which {writer}")
        if reason := record.difference():
            return set(), reason
        sources = {n: [*frames.sources(n), frames.matte(n), *self.files()] for n in frames.read_for([*files])}
        done = record.kept(files, sources, self.steady)
        share = f"{self.out}: is" if frames.is_single else f"{len(done)} of {len(files)} frames are"
        list_done(done, share, self.as_json)
        return done, "they are older than their files or options, or they are cut short"

    def _renderer(self, frames: Frames) -> "Renderer":
        """Renders the frames; of a sequence, depth is not guessed, as a guess could differ from frame to frame."""
        from .renderer import Renderer

        source = click.get_current_context().get_parameter_source("depth_kind")
        is_sequence = frames.images is not None
        is_auto = is_sequence and self.depth_kind == "auto"
        is_stated = source is not click.core.ParameterSource.DEFAULT or self.depth_scale is not None
        is_implied = is_sequence and self.strict and self.depth_kind == "z" and not is_stated
        of_frames = dataclasses.replace(self, depth_kind="z") if is_auto else self
        renderer = Renderer(of_frames, not is_sequence, is_auto or is_implied)
        renderer.has_table = frames.is_single
        return renderer

    def _reader(self, renderer: "Renderer", frames: Frames, numbers: Sequence[int]) -> "Callable[[int], Frame]":
        """Reads a frame, with its depth filtered along time if that is wanted."""
        read_files, places = functools.lru_cache(maxsize=1)(renderer.read), frames.places()

        def as_stored(n: int) -> "Frame":  # a focus pull reads one image many times
            return read_files(*frames.sources(n), places.get(n), frames.matte(n))

        if not (frames.images and self.steady):
            return as_stored
        from ..depth.steady import SteadyFrames

        whole = frames.read_for(numbers)
        steady = SteadyFrames(lambda k: (as_stored(whole[k]).picture.pixels, as_stored(whole[k]).values))

        def steadied(n: int) -> "Frame":
            values = steady.depth(whole.index(n))  # reads frame n last, so that it is still in the cache
            return dataclasses.replace(as_stored(n), values=values)

        return steadied

    def _render_each(
        self, renderer: "Renderer", files: Mapping[int, Path], read: "Callable[[int], Frame]", record: Record | None
    ) -> None:
        """Renders frames in order; while one is rendered, the next is read and the previous one is written.

        The record is written before the first frame, but after it is rendered: an error in it leaves no file. Before
        each later frame it is read: the run ends if another one has begun to write other frames of these names. A
        frame that another run wrote in the meantime is named at the end.
        """
        count, written = len(files), dict[Path, tuple[int, int]]()

        def write_and_note(write: Callable[[], None], out: Path) -> None:
            write()
            written[out] = _version(out)

        with (
            progress_bar(f"rendering {self.out.name}", count if count > 1 else None) as update,
            ThreadPoolExecutor(2) as pool,
        ):
            frames = (pool.submit(read, n) for n in files)
            reading, writing = next(frames), pool.submit(lambda: None)
            try:
                for k, (n, out) in enumerate(files.items()):
                    if count > 1:
                        update(f"frame {k + 1} of {count}", k)
                    frame = reading.result()
                    reading = next(frames, reading)  # starts to read the next frame
                    write = renderer.render(frame, out, n)
                    writing.result()
                    if record is not None:
                        record.write(is_first=k == 0)
                    writing = pool.submit(write_and_note, write, out)  # Ctrl-C does not stop this thread
            finally:  # a rendered frame is written even if the next one fails
                writing.result()
        if record is not None:
            record.write(is_first=False)
        foreign = [out for out, version in written.items() if _version(out) != version]
        if foreign:
            names = f"{len(foreign)} of {count} frames, {foreign[0].name} first,"
            remedy = "end the other run, and render these frames again"
            raise ValueError(f"{self.out}: another run replaced {names} while this one went on; {remedy}")


def _version(path: Path) -> tuple[int, int]:
    """Numbers that change when a file is written again; zeros if it is missing."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_ino, status.st_mtime_ns
