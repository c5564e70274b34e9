"""What depth that is not exact costs: renderers against the truth, on depth made as bad as real depth is."""

import dataclasses
import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import track
from torch import Tensor

from ..module import blur_by_coc
from ..reference import metrics
from ..reference.degraded import KINDS, degrade
from ..reference.scenes import Scene, read_scenes
from .accuracy import layered_fft
from .report import Report, ReportTable, csv_of

__all__ = ["DepthScore", "compare_degraded", "read_peer"]

Renderer = Callable[[Tensor, Tensor], Tensor]
"""The picture of an image ``[1, 3, H, W]`` with a coc ``[1, 1, H, W]``."""


@dataclasses.dataclass(frozen=True)
class DepthScore:
    """PSNR in dB, display-encoded, whole frame, of one renderer on one scene with one kind of depth."""

    scene: str
    kind: str
    renderer: str
    psnr_display: float


def read_peer(path: Path) -> tuple[str, Renderer]:
    """Another renderer: a Python file with ``blur(image, coc_px)``, such as those in ``examples/benchmarks/tools``.

    Returns:
        Its name and what renders.

    Raises:
        OSError: If there is no such file.
        ValueError: If it holds no renderer, or lacks what it needs.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path}: is no Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, "blur", None)):
        raise ValueError(f"{path}: has no function blur(image, coc_px)")
    missing = module.available() if hasattr(module, "available") else None
    if missing:
        raise ValueError(f"{path}: cannot run here; {missing}")

    def render(image: Tensor, coc_px: Tensor) -> Tensor:
        out = module.blur(image, coc_px)
        picture: Tensor = out[0] if isinstance(out, tuple) else out
        return picture

    return str(getattr(module, "NAME", path.stem)), render


def compare_degraded(truth: Path, out: Path, peers: Sequence[Path]) -> None:
    """Scores renderers on every scene of a folder with every kind of depth; prints and writes a table.

    Args:
        truth: Folder of scenes, as :func:`torchdof.reference.scenes.read_scenes` takes it.
        out: Folder for ``degraded.csv`` and ``degraded.md``.
        peers: Further renderers, as :func:`read_peer` takes them.

    Raises:
        ValueError: If a scene or a peer is not as described.
        OSError: If there is no scene, or a file cannot be read or written.
    """
    console = Console(stderr=True)
    compared: dict[str, Renderer] = {
        "as given": lambda image, coc: blur_by_coc(image, coc, depth_edges="as given"),
        "torchdof": blur_by_coc,
        "ikoma": layered_fft,
        **dict(read_peer(path) for path in peers),
    }
    scenes = list(read_scenes(truth))
    scores = []
    for scene in track(scenes, "scenes", console=console, transient=True, disable=not console.is_terminal):
        for kind in KINDS:
            scores += _scores(scene, kind, compared)
    value = {(s.scene, s.kind, s.renderer): s.psnr_display for s in scores}

    def cell(kind: str, cases: Sequence[str]) -> str:
        means = (sum(value[case, kind, name] for case in cases) / len(cases) for name in compared)
        return " / ".join(f"{mean:.2f}" for mean in means)

    cases = [scene.name for scene in scenes]
    table = ReportTable(
        "PSNR in dB by kind of depth, display-encoded: " + " / ".join(compared),
        [
            ["depth", *cases, "mean"],
            *([kind, *(cell(kind, [case]) for case in cases), cell(kind, cases)] for kind in KINDS),
        ],
        words=("depth",),
    )
    remark = "Every renderer at 1/255. 'as given' is torchdof with depth_edges=\"as given\"."
    Report("degraded", "What inexact depth costs", [remark, table], csv_of(scores)).write(out)
    table.show()


def _scores(scene: Scene, kind: str, compared: dict[str, Renderer]) -> list[DepthScore]:
    coc_px = scene.camera.coc_px(degrade(scene.depth, kind), scene.image.shape[-1])
    wanted = metrics.display(scene.truth)
    return [
        DepthScore(scene.name, kind, name, metrics.psnr(metrics.display(render(scene.image, coc_px)), wanted))
        for name, render in compared.items()
    ]
