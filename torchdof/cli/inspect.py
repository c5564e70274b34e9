"""``torchdof inspect``: what a depth map holds, what a camera makes of it, and whether that makes sense."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import typer

from ..depth.holes import resolve_holes
from ..depth.inspect import inspect_depth, panels
from ..depth.sanity import depth_mistakes
from ..io.images import read_image
from ..io.sheet import write_sheet
from ..optics.camera import CAMERA_NUMBERS
from .arguments import (
    DEPTH,
    ApertureRadiusM,
    AsJson,
    DepthChannel,
    DepthOffset,
    DepthScale,
    DepthUnknown,
    FarM,
    FillDepth,
    FNumber,
    FocalLengthMm,
    FocusAt,
    FocusMOrMedian,
    FocusRange,
    FovDeg,
    NearM,
    RelativeKind,
    SensorWidthMm,
    Swing,
    Tilt,
    ValueRange,
)
from .frame import read_metres
from .from_arguments import settings_of
from .printed import json_line
from .warn_once import WarnOnce

__all__ = ["inspect"]


def inspect(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="All-in-focus image, as for torchdof render.")],
    depth: Annotated[
        Path | None, typer.Argument(metavar="[DEPTH]", help="Its depth; not needed if IMAGE has a Z channel.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Picture to write; default: IMAGE's name with .inspect.png, in this folder."),
    ] = None,
    focus_m: FocusMOrMedian = None,
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
        Literal["z", "distance", "disparity", "inverse", "relative"],
        typer.Option(help="What the numbers are, as for torchdof render.", rich_help_panel=DEPTH),
    ] = "z",
    depth_scale: DepthScale = None,
    depth_offset: DepthOffset = 0.0,
    near_m: NearM = None,
    far_m: FarM = None,
    relative_kind: RelativeKind = None,
    value_range: ValueRange = None,
    depth_unknown: DepthUnknown = None,
    fill_depth: FillDepth = None,
    depth_channel: DepthChannel = None,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="End with an error where something looks like a mistake.", rich_help_panel=DEPTH),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Tell what a depth map holds and what a camera makes of it, before anything is rendered.

    Ranges, the histogram of the blur radius, the share in focus, holes, how many of the map's edges lie where the image
    has them; and a picture of depth, blur and doubtful edges. Wrong units are said on standard error.

        torchdof inspect photo.jpg depth.png --depth-scale 0.001 --focus-at 320,200 --f-number 1.8

    The lens is found as for torchdof render.
    """
    settings = settings_of(locals())
    target = Path(f"{image.stem}.inspect.png") if out is None else out
    if any(source is not None and source.resolve() == target.resolve() for source in (image, depth)):
        raise ValueError(f"{target}: is one of the inputs; write to another file")
    picture = read_image(image)
    metres = read_metres(image, depth, picture, settings)
    known = metres[metres > 0]
    if not known.numel():
        raise ValueError(f"{depth or image}: no pixel has a depth; check the kind, scale and offset of the depth map")
    filled = 0
    if settings.fill is not None:
        metres, filled = resolve_holes(metres, str(depth or image), settings.fill)
    notes = []
    if focus_m is None and focus_at is None and focus_range is None:
        notes = ["focus at the median depth"]
        settings = dataclasses.replace(settings, focus=[(0, float(known.median()))])
    width = picture.pixels.shape[-1]
    camera, remarks = settings.camera(picture.metadata, width, 0)
    if settings.focus_at is not None:
        camera = camera.focus_at(metres, *settings.focus_at)
    light = picture.pixels[:, :-1] if picture.has_alpha else picture.pixels
    report = inspect_depth(light, metres, camera)
    notes = [*notes, *remarks]
    write_sheet(target, panels(light, report))
    if as_json:
        numbers = {name: float(getattr(camera, name)) for name in CAMERA_NUMBERS}
        facts = {"image": str(image), "width": width, "height": picture.pixels.shape[-2], "camera": numbers}
        facts |= {"assumed": notes, **report.facts(), "filled_px": filled, "picture": str(target)}
        typer.echo(json_line(facts))
    else:
        typer.echo(f"image         {width} x {picture.pixels.shape[-2]} px, {', '.join(picture.channels)}")
        typer.echo(f"camera        {camera!r}" + (f" [{', '.join(notes)}]" if notes else ""))
        typer.echo(str(report))
        if filled:
            typer.echo(f"filled        {filled} holes ({100 * filled / metres.numel():.1f} %), {settings.fill}")
        typer.echo(f"picture       {target}")
    WarnOnce(strict).warn(depth or image, depth_mistakes(metres, camera, depth_kind, depth_scale))
