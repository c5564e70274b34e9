"""``torchdof bench``: speed against error on a scene; or how close to the truth each renderer comes."""

import contextlib
import dataclasses
import importlib.util
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import torch.nn.functional as functional
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from . import goals, metrics, peers, speed
from .files import Picture, whole_file, write_image
from .growth import lines, measure_growth, show_growth
from .module import DepthOfField
from .reference import lens_views
from .render_frame import RenderSettings
from .report import csv_of, markdown
from .scenes import Scene, read_scenes
from .subject import from_files, shipped
from .table import BlurTable
from .transfer import decode

__all__ = ["Score", "bench", "ikoma", "layered_fft", "measure", "renderers"]

Renderer = Callable[[Scene], Tensor]

_SPEED, _ACCURACY, _PEERS = "Speed", "Accuracy", "Other tools"
_TILE_PX = 128
_ERROR_GAIN = 4.0
_MEASURES = {
    "psnr_display": "PSNR in dB, display-encoded (clipped to [0, 1], sRGB curve), peak 1",
    "psnr_known": "the same where nothing hidden is uncovered: where every view of the reference sees a surface",
    "psnr_linear": "PSNR in dB, linear light, peak 1",
    "ssim": "SSIM, display-encoded",
    "flip": "mean FLIP, display-encoded (less is better)",
}


@dataclasses.dataclass(frozen=True)
class Score:
    """What one renderer reached on one scene; NaN is what cannot be computed."""

    scene: str
    renderer: str
    psnr_display: float
    psnr_known: float
    psnr_linear: float
    ssim: float
    flip: float


def renderers() -> dict[str, Renderer]:
    """What is compared with the reference, by name, as functions of a scene; disc kernels, each at its finest.

    Example:
        >>> list(renderers())
        ['untouched', 'scatter', 'ikoma', 'torchdof']
    """

    def layered(**options: Any) -> Renderer:
        return lambda scene: DepthOfField(scene.camera, tolerance=0, **options)(scene.image, scene.depth)

    return {
        "untouched": lambda scene: scene.image,
        "scatter": layered(occlusion=False),
        "ikoma": ikoma,
        "torchdof": layered(),
    }


def ikoma(scene: Scene, spacing_px: float = 0.75) -> Tensor:
    """:func:`layered_fft` of a scene, in float64: what torchdof builds on, with dense layers and exact discs."""
    return layered_fft(scene.image.double(), scene.coc_px, spacing_px).to(scene.image.dtype)


def layered_fft(image: Tensor, coc_px: Tensor, spacing_px: float = 0.75) -> Tensor:
    """The formula that torchdof builds on, as published: nothing hidden, no mixed pixels, exact discs, by FFT.

    The frame is continued outwards as it is at its border; where a hole is left the rest is scaled up.

    Args:
        image: ``[1, C, H, W]``, linear light; its type is the one that is computed in.
        coc_px: ``[1, 1, H, W]``, signed circle of confusion.
        spacing_px: Largest distance between layers, in circle of confusion.

    Returns:
        ``[1, C, H, W]``, linear light.

    Reference:
        Ikoma, Nguyen, Metzler, Peng, Wetzstein, "Depth from defocus with learned optics", ICCP 2021.
    """
    low, high = float(coc_px.min()), float(coc_px.max())
    nodes = torch.linspace(low, high, 2 + int((high - low) / spacing_px), dtype=torch.float64)
    place = ((coc_px.double() - low) / max(high - low, 1e-9) * (len(nodes) - 1)).to(image.dtype)
    kernels = BlurTable.disc().kernels(nodes, coc_px.shape[-1])[:, 0].to(image.dtype)
    half = kernels.shape[-1] // 2
    light, place = (functional.pad(x, (half,) * 4, mode="replicate") for x in (image, place))
    height, width = (n + 2 * half for n in image.shape[-2:])
    size = [-(-(n + 2 * half) // 16) * 16 for n in image.shape[-2:]]  # of small factors, which is fast
    out, room, covered = torch.zeros_like(image), torch.zeros_like(place), torch.zeros_like(image[:, :1])
    least = 1e-6 if image.dtype == torch.float64 else 1e-3  # what is less is the noise of an FFT in float32
    for k in reversed(range(len(nodes))):  # far to near
        share = (1.0 - (place - k).abs()).clamp_min(0.0)
        room = room + share
        stack = torch.cat([light * share, share, room], 1)
        spectrum = torch.fft.rfft2(stack, size) * torch.fft.rfft2(kernels[k], size)
        blurred = torch.fft.irfft2(spectrum, size)[..., 2 * half : height, 2 * half : width]
        seen = blurred[:, -1:].clamp_min(least)
        left = 1.0 - (blurred[:, -2:-1] / seen).clamp(0.0, 1.0)
        out = blurred[:, :-2].clamp_min(0.0) / seen + left * out
        covered = 1.0 - left + left * covered
    return out / covered.clamp_min(1e-6)


def measure(name: str, image: Tensor, scene: Scene, margin_px: int = 0, known: Tensor | None = None) -> Score:
    """Compares a rendering with the scene's truth.

    Args:
        name: Name of the renderer.
        image: ``[1, C, H, W]``, linear light.
        scene: The scene.
        margin_px: Border that is left out.
        known: Pixels ``[1, 1, H, W]`` (bool) that ``psnr_known`` is taken over; None: none.

    Returns:
        The score.

    Raises:
        ValueError: If the margin leaves nothing, or the shapes differ.
    """
    height, width = scene.truth.shape[-2:]
    if not 0 <= margin_px < min(height, width) // 2 - 5:
        raise ValueError(
            f"a margin of {margin_px} pixels leaves too little of {width} x {height}; compare whole frames"
        )
    image, truth = (functional.pad(x, (-margin_px,) * 4) for x in (image, scene.truth))
    shown, wanted = metrics.display(image), metrics.display(truth)
    flip = metrics.flip(shown, wanted) if metrics.has_flip() and shown.shape[1] == 3 else math.nan
    whole, linear, partly = metrics.psnr(shown, wanted), metrics.psnr(image, truth), math.nan
    if known is not None:
        known = functional.pad(known, (-margin_px,) * 4)
        partly = metrics.psnr(shown, wanted, known) if bool(known.any()) else math.nan
    return Score(scene.name, name, whole, partly, linear, metrics.ssim(shown, wanted), flip)


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
        typer.Option(
            "--out", "-o", help="Folder for speed.csv, .md and .png, accuracy.csv, .md and .png, goals.* or peers.*."
        ),
    ] = None,
    repeat: Annotated[int, typer.Option(help="Timed renderings of each setting or tool.", min=1)] = 5,
    focus_m: Annotated[
        float | None, typer.Option(help="Distance in focus in metres; default: the median.", rich_help_panel=_SPEED)
    ] = None,
    f_number: Annotated[float | None, typer.Option(help="Smaller is blurrier.", rich_help_panel=_SPEED)] = None,
    focal_length_mm: Annotated[float | None, typer.Option(help="Focal length.", rich_help_panel=_SPEED)] = None,
    sensor_width_mm: Annotated[float | None, typer.Option(help="36 for full frame.", rich_help_panel=_SPEED)] = None,
    depth_kind: Annotated[
        Literal["z", "disparity", "inverse", "coc"],
        typer.Option(help="What the numbers are, as for torchdof render.", rich_help_panel=_SPEED),
    ] = "z",
    depth_scale: Annotated[
        float | None, typer.Option(help="0.001 for maps in millimetres.", rich_help_panel=_SPEED)
    ] = None,
    depth_offset: Annotated[float, typer.Option(help="Added to each value first.", rich_help_panel=_SPEED)] = 0.0,
    fill_depth: Annotated[
        Literal["nearest", "far"] | None,
        typer.Option(help="Fill pixels without depth; else they are refused.", rich_help_panel=_SPEED),
    ] = None,
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
    inner: Annotated[
        bool,
        typer.Option(
            "--inner",
            help="Leave out the border that light from outside the frame reaches.",
            rich_help_panel=_ACCURACY,
        ),
    ] = False,
    compared: Annotated[
        Path | None,
        typer.Option(
            "--peers",
            metavar="SCENES",
            help="Folder with scenes as for --truth: time and distance from the truth, beside other tools.",
            rich_help_panel=_PEERS,
        ),
    ] = None,
    costs: Annotated[
        Path | None,
        typer.Option(
            "--goals",
            metavar="SCENES",
            help="Folder with scenes as for --truth: what whole frames, crops, batches and gradients cost, beside the "
            "goals of this project; takes minutes, and 8 GB of memory.",
            rich_help_panel=_SPEED,
        ),
    ] = None,
    peers_folder: Annotated[
        Path,
        typer.Option(help="Where the other tools are described, a Python file each.", rich_help_panel=_PEERS),
    ] = Path("examples/peers"),
) -> None:
    """Measure speed against error on your own scene, or accuracy where the truth is known.

    Each tolerance against the exact rendering: time, memory, RMS error, PSNR and SSIM, on the CPU; with --onnx also an
    exported file, with --compile also torch.compile, with --scan also how cost grows with blur and frame:

        torchdof bench photo.png depth.exr --f-number 1.8 --out results

    torchdof and simpler renderers against scenes whose depth of field is known:

        torchdof bench --truth scenes --out results

    The picture of the latter shows, for each scene, the place where torchdof is farthest from the truth: sharp, truth,
    each renderer with its error below it, four times enlarged.

    What whole frames, crops, batches and gradients cost, beside what this project wants them to cost at most:

        torchdof bench --goals scenes --out results

    torchdof and what else is installed, GEGL, FFmpeg or Blender, in one run on the same scenes:

        torchdof bench --peers scenes --out results
    """
    if out is not None and not out.is_dir():
        raise FileNotFoundError(f"{out}: there is no such folder; make it first")
    if compared is not None or costs is not None:
        name = "--goals" if compared is None else "--peers"
        if image is not None or truth is not None or views or inner or onnx or compiled or scan or (compared and costs):
            raise ValueError(f"{name} measures the scenes of its folder; of the other options it takes --out, --repeat")
        if compared is not None:
            peers.compare(compared, peers_folder, out, repeat)
        if costs is not None:
            goals.compare(costs, out, repeat)
        return
    if truth is not None:
        if image is not None or onnx or compiled or scan:
            raise ValueError(
                "--truth measures the scenes of its folder; leave IMAGE and DEPTH out, and --onnx, --compile and --scan"
            )
        if out is None:
            raise ValueError("--truth writes tables and pictures; give a folder with --out")
        _accuracy(truth, out, views, inner)
        return
    if views or inner:
        raise ValueError("--views and --inner compare with a truth; name its folder with --truth")
    how = RenderSettings(
        focus=None if focus_m is None else [(0, focus_m)],
        f_number=f_number,
        focal_length_mm=focal_length_mm,
        sensor_width_mm=sensor_width_mm,
        depth_kind=depth_kind,
        depth_scale=depth_scale,
        depth_offset=depth_offset,
        fill=fill_depth,
    )
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
    subject = shipped() if image is None else from_files(image, depth, how)
    console = Console(stderr=True)
    runtimes: list[speed.Runtime] = []
    if onnx:
        runtimes.append("onnxruntime")
    if compiled:
        runtimes.append("compiled")
    rows, unit = speed.measure_all(subject, repeat, console, runtimes)
    speed.show(rows, subject, unit)
    grown = measure_growth(subject, repeat, unit, console) if scan else []
    if grown:
        show_growth(grown)
    if out is not None:
        speed.write(out, rows, subject, unit, repeat, lines(grown) if grown else ())


def _accuracy(truth: Path, out: Path, views: Sequence[int] | None, inner: bool) -> None:
    console = Console(stderr=True)
    scenes = list(read_scenes(truth))
    compared, counts = renderers(), sorted(set(views or [256]))
    reference = {n: f"reference {n}" for n in counts}
    scores, rows = [], []
    for scene in track(scenes, "scenes", console=console, transient=True, disable=not console.is_terminal):
        images = {name: render(scene) for name, render in compared.items()}
        known = torch.ones_like(scene.depth, dtype=torch.bool)
        for count, name in reference.items():
            images[name], share = lens_views(scene.image, scene.depth, scene.camera, views=count)
            known &= share == 1
        margin = scene.margin_px * inner
        scores += [measure(name, image, scene, margin, known) for name, image in images.items()]
        rows.append(_worst(scene, images))
    names = [*compared, *reference.values()]
    text = _markdown(scores, names, [scene.name for scene in scenes], inner)
    sheet = Picture(torch.cat(rows, 2), transfer="srgb", sample="8")
    with contextlib.ExitStack() as files:  # all of them or none
        csv_file, md_file, png_file = (
            files.enter_context(whole_file(out / f"accuracy.{s}")) for s in ("csv", "md", "png")
        )
        csv_file.write_text(csv_of(scores), encoding="utf-8")
        md_file.write_text(text, encoding="utf-8")
        write_image(png_file, sheet)
    _show(scores, names, [scene.name for scene in scenes])


def _cells(scores: Sequence[Score], names: Sequence[str], scenes: Sequence[str], what: str) -> list[list[str]]:
    """Rows of a table, a scene each, and their mean."""
    found: Mapping[tuple[str, str], float] = {(s.scene, s.renderer): getattr(s, what) for s in scores}
    digits = 2 if what.startswith("psnr") else 4
    rows = [[scene, *(f"{found[scene, name]:.{digits}f}" for name in names)] for scene in scenes]
    means = [sum(found[scene, name] for scene in scenes) / len(scenes) for name in names]
    return [*rows, ["mean", *(f"{mean:.{digits}f}" for mean in means)]]


def _markdown(scores: Sequence[Score], names: Sequence[str], scenes: Sequence[str], inner: bool) -> str:
    where = "the frame without the border that light from outside reaches" if inner else "the whole frame"
    parts = [
        "# Accuracy against the truth\n",
        f"Over {where}. The reference renderer averages as many views through the lens as its name says.\n",
    ]
    for what, meaning in _MEASURES.items():
        if all(math.isnan(getattr(score, what)) for score in scores):
            continue
        parts += [f"## {meaning}\n", markdown([["scene", *names], *_cells(scores, names, scenes, what)]), ""]
    parts += [
        "## accuracy.png\n",
        f"A row a scene, in the order above: {_TILE_PX} pixels around the place where torchdof is worst. From the "
        f"left: sharp, truth, {', '.join(names)}; below each, its error in the display-encoded picture times "
        f"{_ERROR_GAIN:g}.",
    ]
    return "\n".join(parts) + "\n"


def _show(scores: Sequence[Score], names: Sequence[str], scenes: Sequence[str]) -> None:
    table = Table(title=_MEASURES["psnr_display"])
    for column in ("scene", *names):
        table.add_column(column, justify="left" if column == "scene" else "right")
    *rows, mean = _cells(scores, names, scenes, "psnr_display")
    for row in rows:
        table.add_row(*row)
    table.add_section()
    table.add_row(*mean)
    Console().print(table)


def _worst(scene: Scene, images: Mapping[str, Tensor]) -> Tensor:
    """The surroundings of the worst pixels of torchdof: ``[1, 3, 2 tile, n tile]``, linear light."""
    truth = metrics.display(scene.truth)
    error = (metrics.display(images["torchdof"]) - truth).square().mean(1, keepdim=True)
    error = functional.avg_pool2d(error, 9, 1, 4)
    height, width = error.shape[-2:]
    row, column = divmod(int(error.argmax()), width)
    top = min(max(row - _TILE_PX // 2, 0), max(height - _TILE_PX, 0))
    left = min(max(column - _TILE_PX // 2, 0), max(width - _TILE_PX, 0))

    def tile(image: Tensor) -> Tensor:
        part = image[:, :3, top : top + _TILE_PX, left : left + _TILE_PX].expand(-1, 3, -1, -1)
        return functional.pad(part, (0, _TILE_PX - part.shape[-1], 0, _TILE_PX - part.shape[-2]))

    def difference(image: Tensor) -> Tensor:
        return (_ERROR_GAIN * (metrics.display(image) - truth).abs()).clamp(0.0, 1.0)

    pictures = [scene.image, scene.truth, *images.values()]
    upper = torch.cat([metrics.display(tile(image)) for image in pictures], 3)
    lower = torch.cat([tile(difference(image)) for image in pictures], 3)
    return decode(torch.cat([upper, lower], 2), "srgb", has_alpha=False, straight=False)
