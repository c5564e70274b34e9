"""Compares renderers with the truth, on scenes whose depth of field is known, with exact and with degraded depth."""

import functools
import runpy
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from ..io.sheet import write_sheet
from ..module import blur_by_coc
from ..reference import metrics
from ..reference.degraded import KINDS, degrade
from ..reference.ikoma import layered_fft
from ..reference.lens_views import lens_views
from ..reference.scenes import Scene, read_scenes
from .measurement import BenchScene, Renderer, error, measure
from .report import publish, summary

__all__ = ["compare", "read_peer", "renderers"]

_TILE_PX = 128


def renderers(degraded: bool) -> dict[str, Renderer]:
    """The renderers compared, by name, with disc kernels."""
    common: dict[str, Renderer] = {"ikoma": layered_fft, "torchdof": blur_by_coc}
    if degraded:
        return {"as given": functools.partial(blur_by_coc, depth_edges="as given"), **common}
    scatter = functools.partial(blur_by_coc, tolerance=0, occlusion=False)
    dense = functools.partial(blur_by_coc, tolerance=0)
    return {"untouched": lambda image, _: image, "scatter": scatter, **common, "torchdof dense": dense}


def read_peer(path: Path) -> tuple[str, Renderer]:
    """Name with version, and function of another renderer: a Python file as in ``examples/benchmarks/tools``."""
    peer = runpy.run_path(str(path))
    if not callable(peer.get("blur")):
        raise ValueError(f"{path}: has no function blur(image, coc_px)")
    missing = peer.get("available", lambda: None)()
    if missing:
        raise ValueError(f"{path}: cannot run here; {missing}")
    return f"{peer.get('NAME', path.stem)} {peer.get('version', str)()}".strip(), peer["blur"]


def compare(truth: Path, out: Path, views: Sequence[int], degraded: bool, peers: Sequence[Path]) -> None:
    """Scores every renderer, and the reference with each number of ``views``, on every scene of a folder.

    Writes tables and a picture of the worst regions, or with ``degraded`` depth of every kind only tables.
    """
    by_name = renderers(degraded) | dict(map(read_peer, peers))
    for count in sorted({*views}):
        by_name[f"reference {count}"] = lambda *scene, count=count: lens_views(*scene, views=count).image
    scenes, console, rows = list(read_scenes(truth)), Console(stderr=True), []
    tile_px = min(_TILE_PX, *(size for scene in scenes for size in scene.image.shape[-2:]))
    panels: dict[str, list[Tensor]] = {}
    cases = [(scene, kind) for scene in scenes for kind in (KINDS if degraded else ["exact"])]
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        matted = sum(scene.matte is not None for scene, _ in cases)
        task = bar.add_task("", total=len(cases) * len(by_name) + matted)
        for scene, kind in cases:
            coc_px, pictures = scene.camera.coc_px(degrade(scene.depth, kind), scene.image.shape[-1]), {}
            of_scene = dict(by_name)
            if scene.matte is not None:
                of_scene["torchdof, matte"] = functools.partial(blur_by_coc, matte=scene.matte)
            for name, blur in of_scene.items():
                bar.update(task, description=f"{scene.name}: {name}")
                with torch.inference_mode():
                    picture, row = measure(blur, BenchScene(scene.name, scene.image, coc_px), again=False)
                row |= error(picture, scene.truth)
                if bool(scene.inner.any()):
                    displayed = metrics.display(picture), metrics.display(scene.truth)
                    row["psnr_inner"] = metrics.psnr(*displayed, scene.inner)
                rows.append({"scene": scene.name, "depth": kind, "renderer": name, **row})
                pictures[name] = picture
                bar.advance(task)
            window = _worst(pictures["torchdof"], scene, tile_px)
            shown = {name: picture for name, picture in pictures.items() if name in by_name}
            for name, picture in {"sharp": scene.image, "truth": scene.truth, **shown}.items():
                panels.setdefault(name, []).append(picture[window][:, :3].expand(-1, 3, -1, -1))
    means = summary(rows, ["depth", "renderer"], statistics.fmean)
    remark = "psnr_inner: without the border reached by light from outside the frame."
    if degraded:
        return publish("What inexact depth costs", means, [remark], out / "degraded", details=rows)
    remark += f" accuracy.png: for each scene, the {tile_px} x {tile_px} pixels with torchdof's largest error."
    draw = functools.partial(write_sheet, panels={name: torch.cat(parts, 2) for name, parts in panels.items()})
    publish("Accuracy against the truth", means, [remark], out / "accuracy", draw, details=rows)


def _worst(picture: Tensor, scene: Scene, side: int) -> tuple[Any, ...]:
    """The window with the largest squared error of the displayed picture."""
    squared_error = (metrics.display(picture) - metrics.display(scene.truth)).square().mean(1, keepdim=True)
    top, left = divmod(int((means := functional.avg_pool2d(squared_error, side, stride=1)).argmax()), means.shape[-1])
    return ..., slice(top, top + side), slice(left, left + side)
