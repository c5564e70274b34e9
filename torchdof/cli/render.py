"""``torchdof render``: its options, and the frames it goes through."""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from torch import Tensor

from ..depth.sanity import Mistake
from ..depth.steady import SteadyFrames
from ..io.sequence import FramePattern, parse_frames
from .arguments import (
    BLUR,
    DEPTH,
    LENS,
    ApertureImage,
    ApertureRadiusM,
    AsJson,
    Blades,
    Curvature,
    DepthChannel,
    DepthEdgesName,
    DepthOffset,
    DepthScale,
    DepthUnknown,
    FarM,
    FillDepth,
    FNumber,
    FocalLengthMm,
    FocusAt,
    FocusRange,
    FovDeg,
    MethodName,
    NearM,
    NoOcclusion,
    RelativeKind,
    Rotation,
    SensorWidthMm,
    Squeeze,
    Swing,
    TableName,
    Tilt,
    ToleranceText,
    ValueRange,
    Vignetting,
)
from .frame import Frame, read_frame, render_frame
from .from_arguments import settings_of
from .printed import json_line
from .settings import RenderSettings
from .warn_once import WarnOnce

__all__ = ["render"]

_EACH_ITS_OWN = Mistake(
    "range",
    "each frame's relative depth is scaled by its own extremes, so that distances pulse; give the values that near and "
    "far have in all frames: --value-range LOW,HIGH",
)
_FILES = "Files and frames"


def render(
    image: Annotated[
        Path,
        typer.Argument(metavar="IMAGE", help="All-in-focus image (EXR, PNG, TIFF, JPEG, HDR, PFM) or shot.####.exr."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, or out.####.exr.")],
    depth: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DEPTH]", help="Its depth (the same types, .npy, .npz); not needed if IMAGE has a Z channel."
        ),
    ] = None,
    focus_m: Annotated[
        str | None,
        typer.Option(
            help="Distance in focus in metres (inf allowed), or keyframes frame:metres such as 1:2.0,48:5.5; between "
            "them 1/distance is linear, so that the blur changes evenly.",
            rich_help_panel=LENS,
        ),
    ] = None,
    focus_at: FocusAt = None,
    focus_range: FocusRange = None,
    tilt: Tilt = 0.0,
    swing: Swing = 0.0,
    f_number: FNumber = None,
    focal_length_mm: FocalLengthMm = None,
    sensor_width_mm: SensorWidthMm = None,
    fov_deg: FovDeg = None,
    aperture_radius_m: ApertureRadiusM = None,
    depth_kind: Annotated[
        Literal["z", "distance", "disparity", "inverse", "relative", "coc"],
        typer.Option(
            help="What the numbers are: z along the optical axis or distance along the ray, in metres after scale * "
            "(value + offset); disparity or inverse depth, in metres after scale / (value + offset); relative, as "
            "estimators give it, between --near-m and --far-m; or coc, the signed blur radius in pixels (negative is "
            "near).",
            rich_help_panel=DEPTH,
        ),
    ] = "z",
    depth_scale: DepthScale = None,
    depth_offset: DepthOffset = 0.0,
    near_m: NearM = None,
    far_m: FarM = None,
    relative_kind: RelativeKind = None,
    value_range: ValueRange = None,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="Refuse what looks like a wrong unit or scale, instead of warning.", rich_help_panel=DEPTH
        ),
    ] = False,
    depth_unknown: DepthUnknown = None,
    fill_depth: FillDepth = None,
    depth_channel: DepthChannel = None,
    depth_edges: DepthEdgesName = "auto",
    table: TableName = "disc",
    blades: Blades = 0,
    rotation: Rotation = 0.0,
    curvature: Curvature = 0.0,
    squeeze: Squeeze = 1.0,
    aperture: ApertureImage = None,
    vignetting: Vignetting = 0.0,
    tolerance: ToleranceText = "final",
    attention: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,RADIUS",
            help="Where the viewer looks, in pixels from the top left: the tolerance is kept there, and elsewhere a "
            "draft's is enough.",
            rich_help_panel=BLUR,
        ),
    ] = None,
    no_occlusion: NoOcclusion = False,
    method: MethodName = "layered",
    show_focus: Annotated[
        bool,
        typer.Option(
            "--show-focus",
            help="Don't blur: draw the outlines of what is near orange, in focus green, far blue.",
            rich_help_panel=BLUR,
        ),
    ] = False,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...", rich_help_panel=BLUR)] = "auto",
    transfer: Annotated[
        Literal["linear", "srgb"] | None,
        typer.Option(help="How IMAGE is encoded. Default: integers srgb, floats linear.", rich_help_panel=_FILES),
    ] = None,
    out_transfer: Annotated[
        Literal["linear", "srgb"] | None,
        typer.Option(
            help="How OUT is encoded. Default: as IMAGE, or by type if one is integers and the other floats.",
            rich_help_panel=_FILES,
        ),
    ] = None,
    bits: Annotated[
        Literal["8", "16", "half", "float"] | None,
        typer.Option(help="What OUT stores. Default: as IMAGE, where the type can.", rich_help_panel=_FILES),
    ] = None,
    layer: Annotated[
        str | None, typer.Option(help="Layer or part of an EXR that is the image.", rich_help_panel=_FILES)
    ] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="FIRST-LAST", help="Part of a sequence.", rich_help_panel=_FILES)
    ] = None,
    steady: Annotated[
        bool,
        typer.Option(
            "--steady",
            help="Filter the depth of a sequence along time, where neither image nor depth moved.",
            rich_help_panel=DEPTH,
        ),
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Render only the frames that OUT lacks.", rich_help_panel=_FILES)
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Blur IMAGE by its DEPTH as a lens would.

    A photograph and its depth in millimetres, focused on what is seen at column 320, row 200:

        torchdof render photo.jpg depth.png -o out.jpg --depth-scale 0.001 --focus-at 320,200 --f-number 1.8

    A rendered image with a Z channel:

        torchdof render shot.exr -o out.exr --fov-deg 40 --aperture-radius-m 0.012 --focus-m 2

    A sequence, its focus pulled from 2 m to 5.5 m; --resume goes on after an interruption:

        torchdof render shot.####.exr -o out.####.exr --focus-m 1:2,48:5.5 --f-number 2 --resume

    --steady filters depth that flickers along time, where neither image nor depth moved; a part of a sequence, or the
    rest of it with --resume, comes out as the whole would: up to 63 frames before it are read first.

    Seven blades on an anamorphic lens, all from 1.5 to 2.2 m in focus:

        torchdof render shot.exr -o out.exr --focus-range 1.5,2.2 --blades 7 --rotation 15 --squeeze 2

    A stereo disparity map with holes (scale: baseline in metres * focal length in pixels):

        torchdof render l.png disp.npz -o out.png --focus-m 2 --depth-kind disparity --depth-scale 192 --fill-depth far

    Depth from an estimator, which knows near from far but no metres:

        torchdof render photo.jpg depth.png -o out.jpg --depth-kind relative --near-m 1.2 --far-m 8 --focus-m 1.5

    The lens is what you state, else what the file's EXIF data state, else 50 mm at f/2.8 on a sensor of 36 mm; the line
    that is printed says which. Alpha and metadata are kept. A file is written whole or not at all. What looks
    like a wrong unit is said on standard error; with --strict it is refused. --json prints one JSON object a frame.
    """
    settings = settings_of(locals())
    if FramePattern.matches(image):
        _render_sequence(image, depth, out, settings, frames, resume, steady, as_json)
        return
    sequences = FramePattern.is_padded(out) and not FramePattern.is_padded(image) and FramePattern.matches(out)
    if sequences or (depth is not None and FramePattern.matches(depth)) or frames is not None or steady:
        raise ValueError(f"{image}: is a single image; for a sequence write it as shot.####.exr")
    if len(settings.focus or []) > 1:
        raise ValueError("--focus-m has keyframes but IMAGE is a single image; give one distance in metres")
    if resume and out.exists():
        typer.echo(_there([out]) if as_json else f"{out}: is there already")
        return
    with _progress() as progress:
        progress.add_task(f"rendering {out.name}", total=None)
        rendered = render_frame(image, depth, out, settings)
    typer.echo(json_line(rendered.facts()) if as_json else str(rendered))


def _render_sequence(
    image: Path,
    depth: Path | None,
    out: Path,
    settings: RenderSettings,
    frames: str | None,
    resume: bool,
    steady: bool,
    as_json: bool,
) -> None:
    """Renders the frames of a numbered sequence, in order; with ``resume`` only those that are missing."""
    source, target = FramePattern(image), FramePattern(out)
    depths = FramePattern(depth) if depth is not None and FramePattern.matches(depth) else None
    numbers: Sequence[int] = source.frames()
    if frames is not None:
        first, last = parse_frames(frames)
        wanted, existing = range(first, last + 1), {n for n in numbers if first <= n <= last}
        if len(existing) < len(wanted):
            missing = source.name(next(n for n in wanted if n not in existing))
            raise FileNotFoundError(
                f"{missing}: there is no such file ({len(wanted) - len(existing)} of {len(wanted)} frames missing)"
            )
        numbers = wanted
    if not numbers:
        raise FileNotFoundError(f"{image}: there are no such files")
    if depths is not None:
        absent = [path for n in numbers if not (path := depths.name(n)).is_file()]
        if absent:
            raise FileNotFoundError(
                f"{absent[0]}: there is no such file ({len(absent)} of {len(numbers)} depths missing)"
            )
    todo = [n for n in numbers if not (resume and target.name(n).is_file())]
    if len(todo) < len(numbers):
        there = [target.name(n) for n in numbers if n not in set(todo)]
        typer.echo(_there(there) if as_json else f"{len(there)} of {len(numbers)} frames are there already")
    warned = WarnOnce(settings.strict)
    if settings.depth_kind == "relative" and settings.value_range is None and len(numbers) > 1:
        warned.warn(depth or image, [_EACH_ITS_OWN])
    steadied = _steadied(source, depths, depth, settings) if steady else None
    with _progress() as progress:
        task = progress.add_task("rendering", total=len(todo))
        for n in todo:
            depth_n = depths.name(n) if depths else depth
            read = steadied(n) if steadied else None
            rendered = render_frame(source.name(n), depth_n, target.name(n), settings, n, warned, read)
            typer.echo(json_line(rendered.facts()) if as_json else str(rendered))
            progress.advance(task)


def _steadied(
    source: FramePattern, depths: FramePattern | None, depth: Path | None, settings: RenderSettings
) -> Callable[[int], Frame]:
    """Reads frames by their number, with the depth that frames before them steadied, whichever are asked for."""
    if settings.depth_kind == "coc":
        raise ValueError("--steady filters depth in metres; --depth-kind coc has none")
    numbers = [n for n in source.frames() if depths is None or depths.name(n).is_file()]
    latest: list[Frame] = []

    def read(place: int) -> tuple[Tensor, Tensor]:
        n = numbers[place]
        latest[:] = [read_frame(source.name(n), depths.name(n) if depths else depth, settings)]
        return latest[0].picture.pixels, latest[0].values

    frames = SteadyFrames(read)

    def steadied(number: int) -> Frame:
        values = frames.depth(numbers.index(number))
        return dataclasses.replace(latest[0], values=values)

    return steadied


def _there(files: Sequence[Path]) -> str:
    """What ``--json`` prints of files that ``--resume`` leaves as they are, a line each."""
    return "\n".join(json_line({"out": str(file), "is_there_already": True}) for file in files)


@contextlib.contextmanager
def _progress() -> Iterator[Progress]:
    """A bar on standard error, where that is a terminal."""
    columns = [SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()]
    columns += [TimeElapsedColumn(), TimeRemainingColumn()]
    progress = Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True)
    with contextlib.nullcontext() if progress.disable else progress:
        yield progress
