"""A folder of photographs for ``torchdof render``: what belongs together, and rendering them all in one process."""

import dataclasses
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..io.atomic import check_writable
from ..io.paths import IMAGE_SUFFIXES, MAP_SUFFIXES, OPTIONAL_SUFFIXES
from .command import refuse
from .options import check_files
from .output import Notices, list_done, progress_bar, to_stderr
from .resume import Record

if TYPE_CHECKING:
    from .frame import Frame
    from .render import Render

# what tools add to the photograph's name
_DEPTH_WORDS = "depth|depths|disp|disparity|dispmap|depthmap|raw|pred"
_MATTE_WORDS = "mask|masks|matte|alpha|rgba|out|nobg|no_bg|cutout"


class Picture(NamedTuple):
    """A photograph, its depth map (None: what the photograph holds), and the file to write."""

    image: Path
    depth: Path | None
    out: Path
    matte: Path | None = None


def pictures_in(images: Path, depths: Path | None, out: Path, mattes: Path | None = None) -> list[Picture]:
    """The photographs of a folder, by name.

    The depth of ``a.jpg`` is the map ``a``, ``a_depth`` or ``depth_a`` of any type in ``depths``, or ``a/depth``, as
    MoGe writes it, and its mask likewise ``a``, ``a_mask`` or ``a_rgba`` in ``mattes``. The result is ``a.jpg`` in
    ``out``; types that cannot be written become JPEG.
    """
    found = [path for path in _files(images) if path.suffix.lower() in (*IMAGE_SUFFIXES, *OPTIONAL_SUFFIXES)]
    maps = {path: _map_of(path, depths) for path in found} if depths else dict[Path, Path | None]()
    masks = {path: _map_of(path, mattes, _MATTE_WORDS) for path in found} if mattes else dict[Path, Path | None]()
    others = {*maps.values(), *masks.values()}  # they may lie beside the photographs
    found = [path for path in found if path not in others]
    suffixes = {path: path.suffix if path.suffix.lower() in IMAGE_SUFFIXES else ".jpg" for path in found}
    counts = Counter(path.stem + suffixes[path] for path in found)
    names = {path: path.stem + suffixes[path] for path in found}
    names |= {path: path.name + suffixes[path] for path, name in names.items() if counts[name] > 1}
    return [Picture(path, maps.get(path), out / names[path], masks.get(path)) for path in found]


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))


def _map_of(image: Path, depths: Path, words: str = _DEPTH_WORDS) -> Path | None:
    """The map of a photograph: of the same name before longer ones, and never the photograph itself."""
    name, maps = re.escape(image.stem), [path for path in _files(depths) if path.suffix.lower() in MAP_SUFFIXES]
    inside = depths / image.stem
    patterns = (name, f"{name}[-_. ]?({words})", f"({words})[-_. ]?{name}")
    for pattern in patterns:
        for path in maps:
            if path != image and re.fullmatch(pattern, path.stem, re.IGNORECASE):
                return path
    return next((path for path in (_files(inside) if inside.is_dir() else []) if path.stem in words.split("|")), None)


def render_folder(command: "Render", options: dict[str, object]) -> None:
    """Renders every photograph of a folder; one that fails does not stop the others, and is named at the end.

    Raises:
        ValueError: If an option is for single pictures or sequences, or a photograph failed.
        FileNotFoundError: If there is no photograph.
    """
    images, depths, out = command.image, command.depth, command.out
    mattes = command.matte if command.has_matte_file else None
    is_folder = depths is None or depths.is_dir()
    refuse(
        (not is_folder, f"{depths}: with a folder of images, DEPTH is the folder of their maps"),
        (out.is_file() or out.suffix.lower() in IMAGE_SUFFIXES, f"{out}: with a folder of images, OUT is a folder"),
        (out.resolve() in (images.resolve(), depths and depths.resolve()), f"{out}: write to another folder"),
        (command.sheet, "--sheet is of one picture; leave it out with a folder"),
        (mattes and not mattes.is_dir(), f"{mattes}: with a folder of images, --matte is the folder of their masks"),
        (command.frames or command.steady, "--frames and --steady are for sequences, such as shot.####.exr"),
        (len(command.focus_m or []) > 1, "--focus-m has keyframes; a folder takes one distance in metres"),
    )
    pictures = pictures_in(images, depths, out, mattes)
    if not pictures:
        raise FileNotFoundError(f"{images}: holds no image that can be read ({' '.join(IMAGE_SUFFIXES)})")
    record = Record(out, options)
    existing = {n: picture.out for n, picture in enumerate(pictures)}
    done = set[Path]()
    if command.resume and not record.difference():
        done = record.kept(
            existing, {n: [p.image, p.depth, p.matte, *command.files()] for n, p in enumerate(pictures)}, False
        )
    list_done(done, f"{len(done)} of {len(pictures)} pictures are", command.as_json)
    todo = [picture for picture in pictures if picture.out not in done]
    failed = dict(_render_each(command, todo, record)) if todo else {}
    if failed:
        listed = "".join(f"\n  {message}" for message in failed.values())
        raise ValueError(f"{len(failed)} of {len(todo)} pictures failed:{listed}")


def _render_each(command: "Render", todo: Sequence[Picture], record: Record) -> Iterator[tuple[Path, str]]:
    """Renders pictures in order; while one is rendered, the next is read. Gives each that failed, and why."""
    from .renderer import Renderer

    one_by_one = dataclasses.replace(command, matte=None) if command.has_matte_file else command
    renderer = Renderer(one_by_one, is_still=True)
    renderer.notices = Notices(command.strict, each_message=True)

    def read(picture: Picture) -> "Frame":
        check_files(*picture[:3], matte=picture.matte)
        check_writable(picture.out)
        frame = renderer.read(picture.image, picture.depth, matte=picture.matte)
        if command.has_matte_file and frame.matte is None:
            raise FileNotFoundError(f"{picture.image}: {command.matte} holds no mask of this name")
        return frame

    is_first = True
    with progress_bar(f"rendering {command.image.name}", len(todo)) as update, ThreadPoolExecutor(1) as pool:
        reading = pool.submit(read, todo[0])
        for k, picture in enumerate(todo):
            update(f"{picture.image.name}, {k + 1} of {len(todo)}", k)
            try:
                try:
                    frame = reading.result()
                finally:
                    reading = pool.submit(read, todo[k + 1]) if k + 1 < len(todo) else reading
                write = renderer.render(frame, picture.out, 0)
                record.write(is_first)
                is_first = False
                write()
            except (OSError, ValueError) as error:
                message = str(error) if str(picture.image) in str(error) else f"{picture.image}: {error}"
                if command.depth and picture.depth is None and "no depth channel" in message:
                    message += f" ({command.depth} holds no map of this name)"
                to_stderr(f"failed: {message}")
                yield picture.image, message
    for line, count in renderer.notices.repeated():
        to_stderr(f"note: the same for {count} more: {line}")
