"""How close to the truth each renderer comes, on scenes whose depth of field is known."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from rich.console import Console
from rich.progress import track
from torch import Tensor

from ..io.images import Picture, write_image
from ..io.transfer import decode
from ..module import DepthOfField
from ..optics.blur_table import BlurTable
from ..reference import metrics
from ..reference.lens_views import lens_views
from ..reference.scenes import Scene, read_scenes
from .report import Report, ReportTable, csv_of

__all__ = ["Score", "compare_with_truth", "ikoma", "layered_fft", "renderers", "score"]

Renderer = Callable[[Scene], Tensor]

_TILE_PX = 128
_ERROR_GAIN = 4.0
_MEASURES = {
    "psnr_display": "PSNR in dB, display-encoded (clipped to [0, 1], sRGB curve), peak 1",
    "psnr_inner": "the same without the border that light from outside the frame reaches",
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
    psnr_inner: float
    psnr_known: float
    psnr_linear: float
    ssim: float
    flip: float


def renderers() -> dict[str, Renderer]:
    """What is compared with the reference, by name, as functions of a scene; disc kernels.

    Each at its finest, and torchdof also at its default tolerance of 1/255.

    Example:
        >>> list(renderers())
        ['untouched', 'scatter', 'ikoma', 'torchdof', 'torchdof dense']
    """

    def layered(**options: Any) -> Renderer:
        return lambda scene: DepthOfField(scene.camera, **options)(scene.image, scene.depth)

    return {
        "untouched": lambda scene: scene.image,
        "scatter": layered(tolerance=0, occlusion=False),
        "ikoma": ikoma,
        "torchdof": layered(),
        "torchdof dense": layered(tolerance=0),
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
    out, at_or_behind, covered = torch.zeros_like(image), torch.zeros_like(place), torch.zeros_like(image[:, :1])
    least = 1e-6 if image.dtype == torch.float64 else 1e-3  # what is less is the noise of an FFT in float32
    for k in reversed(range(len(nodes))):  # far to near
        weight = (1.0 - (place - k).abs()).clamp_min(0.0)
        at_or_behind = at_or_behind + weight
        stack = torch.cat([light * weight, weight, at_or_behind], 1)
        spectrum = torch.fft.rfft2(stack, size) * torch.fft.rfft2(kernels[k], size)
        blurred = torch.fft.irfft2(spectrum, size)[..., 2 * half : height, 2 * half : width]
        visibility = blurred[:, -1:].clamp_min(least)
        transmitted = 1.0 - (blurred[:, -2:-1] / visibility).clamp(0.0, 1.0)
        out = blurred[:, :-2].clamp_min(0.0) / visibility + transmitted * out
        covered = 1.0 - transmitted + transmitted * covered
    return out / covered.clamp_min(1e-6)


def score(name: str, image: Tensor, scene: Scene, known: Tensor | None = None) -> Score:
    """Compares a rendering with the scene's truth.

    Args:
        name: Name of the renderer.
        image: ``[1, C, H, W]``, linear light.
        scene: The scene.
        known: Pixels ``[1, 1, H, W]`` (bool) that ``psnr_known`` is taken over; None: none.

    Returns:
        The score.

    Raises:
        ValueError: If the shapes differ.
    """
    shown, wanted = metrics.display(image), metrics.display(scene.truth)

    def partly(mask: Tensor | None) -> float:
        return metrics.psnr(shown, wanted, mask) if mask is not None and bool(mask.any()) else math.nan

    flip = metrics.flip(shown, wanted) if metrics.has_flip() and shown.shape[1] == 3 else math.nan
    whole, linear = metrics.psnr(shown, wanted), metrics.psnr(image, scene.truth)
    ssim = metrics.ssim(shown, wanted)
    return Score(scene.name, name, whole, partly(scene.inner), partly(known), linear, ssim, flip)


def compare_with_truth(truth: Path, out: Path, views: Sequence[int] | None) -> None:
    """Scores every renderer on every scene of a folder, prints and writes the tables and a picture of the worst places.

    Args:
        truth: Folder of scenes, as :func:`torchdof.reference.scenes.read_scenes` takes it.
        out: Folder for ``accuracy.csv``, ``accuracy.md`` and ``accuracy.png``.
        views: Points on the lens for the reference renderer, one rendering each; None: 256.

    Raises:
        ValueError: If a scene is not as described.
        OSError: If there is no scene, or a file cannot be written.
    """
    console = Console(stderr=True)
    scenes = list(read_scenes(truth))
    compared, counts = renderers(), sorted(set(views or [256]))
    reference = {n: f"reference {n}" for n in counts}
    scores, rows = [], []
    for scene in track(scenes, "scenes", console=console, transient=True, disable=not console.is_terminal):
        images = {name: render(scene) for name, render in compared.items()}
        known = torch.ones_like(scene.depth, dtype=torch.bool)
        for count, name in reference.items():
            images[name], known_share = lens_views(scene.image, scene.depth, scene.camera, views=count)
            known &= known_share == 1
        scores += [score(name, image, scene, known) for name, image in images.items()]
        rows.append(_worst(scene, images))
    names = [*compared, *reference.values()]
    cases = [scene.name for scene in scenes]
    tables = [
        ReportTable(meaning, [["scene", *names], *_cells(scores, names, cases, what)], words=("scene",))
        for what, meaning in _MEASURES.items()
        if not all(math.isnan(getattr(score, what)) for score in scores)
    ]
    report = Report(
        "accuracy",
        "Accuracy against the truth",
        [
            "Over the whole frame but where a table says otherwise. torchdof is at its default tolerance of 1/255, the "
            "other layered renderers at their finest. The reference renderer averages as many views through the lens "
            "as its name says.",
            *tables,
            "## accuracy.png",
            f"A row a scene, in the order above: {_TILE_PX} pixels around the place where torchdof is worst. From the "
            f"left: sharp, truth, {', '.join(names)}; below each, its error in the display-encoded picture times "
            f"{_ERROR_GAIN:g}.",
        ],
        csv_of(scores),
    )
    sheet = Picture(torch.cat(rows, 2), transfer="srgb", sample="8")
    report.write(out, picture=lambda path: write_image(path, sheet))
    for table in tables[:2]:
        table.show()


def _cells(scores: Sequence[Score], names: Sequence[str], scenes: Sequence[str], what: str) -> list[list[str]]:
    """Rows of a table, a scene each, and their mean."""
    values: Mapping[tuple[str, str], float] = {(s.scene, s.renderer): getattr(s, what) for s in scores}
    digits = 2 if what.startswith("psnr") else 4
    rows = [[scene, *(f"{values[scene, name]:.{digits}f}" for name in names)] for scene in scenes]
    means = [sum(values[scene, name] for scene in scenes) / len(scenes) for name in names]
    return [*rows, ["mean", *(f"{mean:.{digits}f}" for mean in means)]]


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
