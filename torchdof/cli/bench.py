"""``torchdof bench``: speed against error on a scene; or how close to the truth each renderer comes."""

import dataclasses
import importlib.util
import os
import shutil
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from ..bench import accuracy, speed
from ..bench.measurement import BenchScene, shipped
from .arguments import (
    DEPTH,
    ApertureImage,
    ApertureRadiusM,
    AsJson,
    Blades,
    Curvature,
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
    Rotation,
    SensorWidthMm,
    Squeeze,
    Swing,
    TableName,
    Tilt,
    ValueRange,
    Vignetting,
)
from .frame import read_frame
from .from_arguments import settings_of
from .printed import json_line
from .settings import RenderSettings

__all__ = ["bench", "from_files"]

_SPEED, _ACCURACY = "Speed", "Accuracy"


def bench(
    image: Annotated[
        Path | None,
        typer.Argument(metavar="[IMAGE]", help="Image to measure the speed on; without one, a scene that is built in."),
    ] = None,
    depth: Annotated[
        Path | None, typer.Argument(metavar="[DEPTH]", help="Its depth; not needed if IMAGE has a Z channel.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for speed.csv, .md and .png, or accuracy.csv, .md and .png; is made."),
    ] = None,
    repeat: Annotated[int, typer.Option(help="Cameras that each setting is timed with.", min=1)] = 5,
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
        Literal["z", "distance", "disparity", "inverse", "relative", "coc"],
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
    table: TableName = "disc",
    blades: Blades = 0,
    rotation: Rotation = 0.0,
    curvature: Curvature = 0.0,
    squeeze: Squeeze = 1.0,
    aperture: ApertureImage = None,
    vignetting: Vignetting = 0.0,
    onnx: Annotated[
        bool,
        typer.Option(
            "--onnx", help="Also export and time the file in onnxruntime; takes minutes.", rich_help_panel=_SPEED
        ),
    ] = False,
    compiled: Annotated[
        bool,
        typer.Option("--compile", help="Also time torch.compile; takes minutes.", rich_help_panel=_SPEED),
    ] = False,
    scan: Annotated[
        bool,
        typer.Option("--scan", help="Also show how cost grows with radius and frame size.", rich_help_panel=_SPEED),
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth",
            help="Folder with scenes: meta.json, sharp.exr, depth.exr and truth_K.exr, at any depth below it.",
            rich_help_panel=_ACCURACY,
        ),
    ] = None,
    views: Annotated[
        list[int] | None,
        typer.Option(
            help="Points on the lens for the reference renderer; repeat it to see how it converges.",
            min=1,
            rich_help_panel=_ACCURACY,
        ),
    ] = None,
    degrade: Annotated[
        bool,
        typer.Option(
            "--degrade",
            help="Instead, what depth costs that is soft, displaced, too coarse or noisy; writes degraded.csv and .md.",
            rich_help_panel=_ACCURACY,
        ),
    ] = False,
    peer: Annotated[
        list[Path] | None,
        typer.Option(
            help="A Python file with another renderer, blur(image, coc_px); may be repeated.",
            rich_help_panel=_ACCURACY,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure speed against error on your own scene, or accuracy where the truth is known.

    Each tolerance against the exact rendering, on the CPU: time of pictures by cameras that were not rendered before,
    and of the same again; memory; RMS error, PSNR and SSIM. Also a focus pull and fresh processes; with --onnx an
    exported file, with --compile torch.compile, with --scan how cost grows with blur and frame:

        torchdof bench photo.png depth.exr --f-number 1.8 --out results

    Camera, depth and blur are told as to torchdof render.

    torchdof and simpler renderers against scenes whose depth of field is known, beside GEGL:

        torchdof bench --truth scenes --peer examples/benchmarks/tools/gegl.py --out results

    The same with depth as bad as real depth is:

        torchdof bench --truth scenes --degrade --out results

    The picture that --truth alone writes shows, for each scene, the place where torchdof is farthest from the truth:
    sharp, truth, each renderer.
    """
    how = settings_of(locals())
    if truth is not None:
        if image is not None or onnx or compiled or scan:
            raise ValueError(
                "--truth measures the scenes of its folder; leave IMAGE and DEPTH out, and --onnx, --compile and --scan"
            )
        if how != RenderSettings(table=how.table) or how.table.aperture is not None or table != "disc":
            raise ValueError(
                "the scenes of --truth have their own lens and depth; leave options of these and of blur out"
            )
        if as_json:
            raise ValueError("--truth writes its numbers as CSV to the folder --out; leave --json out")
        if out is None:
            raise ValueError("--truth writes tables and pictures; give a folder with --out")
        if degrade and views:
            raise ValueError("--degrade compares without the reference; leave --views out")
        out.mkdir(parents=True, exist_ok=True)
        accuracy.compare(truth, out, [] if degrade else views or [256], degrade, peer or [])
        return
    if views or degrade or peer:
        raise ValueError("--views, --degrade and --peer compare with a truth; name its folder with --truth")
    if (onnx or compiled) and how.table.depends_on_place:
        raise ValueError("compiled and exported graphs have one kernel a layer; leave --onnx and --compile out")
    if image is None and how != RenderSettings(table=how.table):
        raise ValueError("the built-in scene has its own camera and depth; name an IMAGE for these options")
    if out is not None and importlib.util.find_spec("matplotlib") is None:  # before the time is spent
        raise ModuleNotFoundError("no matplotlib", name="matplotlib")
    if onnx and importlib.util.find_spec("onnxruntime") is None:
        raise ModuleNotFoundError("no onnxruntime", name="onnxruntime")
    if compiled and not any(map(shutil.which, (os.environ.get("CXX", ""), "g++", "clang++", "c++"))):
        raise FileNotFoundError(
            "torch.compile needs a C++ compiler, and none was found; install g++ or leave --compile out"
        )
    scene = dataclasses.replace(shipped(), table=how.table) if image is None else from_files(image, depth, how)
    console = Console(stderr=True)
    runtimes: list[speed.Runtime] = []
    if onnx:
        runtimes.append("onnxruntime")
    if compiled:
        runtimes.append("compiled")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    rows = speed.compare(scene, repeat, console, runtimes, scan)
    if as_json:
        facts = {"scene": scene.name, "remark": scene.remark, "table": repr(scene.table)}
        typer.echo(json_line({**facts, "settings": rows}))
    speed.report(rows, scene, out, quiet=as_json)


def from_files(image: Path, depth: Path | None, how: RenderSettings) -> BenchScene:
    """An image and its depth from files; alpha is left out.

    Args:
        image: Image file.
        depth: Depth file; None takes the depth channel of the image.
        how: Camera, depth and table as for ``torchdof render``; without a focus it is at the median depth, so that
            there is blur on both sides.

    Raises:
        ValueError: If input is wrong or missing.
        OSError: If a file cannot be read.
    """
    frame = read_frame(image, depth, how)
    picture, values = frame.picture, frame.values
    light = picture.pixels[:, :-1] if picture.has_alpha else picture.pixels
    if how.depth_kind == "coc":
        return BenchScene(image.name, light, values, "blur as given", how.table)
    focus = "focus as stated"
    if how.focus is None and how.focus_at is None and how.focus_range is None:
        focus, how = "focus at the median depth", dataclasses.replace(how, focus=[(0, float(values.median()))])
    camera, remarks = how.camera(picture.metadata, light.shape[-1], 0)
    if how.focus_at is not None:
        camera = camera.focus_at(values, *how.focus_at)
    words = f"{camera!r}; {', '.join([focus, *remarks])}"
    return BenchScene(image.name, light, camera.coc_px(values, light.shape[-1]), words, how.table)
