"""What each rule of the picture is worth: scenes with a known depth of field, rendered without one rule at a time."""

import statistics
from collections.abc import Sequence
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress

from ..module import blur_by_coc
from ..reference.degraded import KINDS, degrade
from ..reference.scenes import read_scenes
from ..render.rules import RULES, without
from .measurement import error
from .report import Row, publish, summary

__all__ = ["compare"]


def compare(truth: Path, out: Path, degraded: bool, rules: Sequence[str]) -> None:
    """Scores the plain engine on every scene of a folder, and its change in dB without each of the rules.

    Writes ``ablation.md`` with a row for each rule, and ``ablation.csv`` with one for each scene too; with
    ``degraded``, for depth of every kind.

    Args:
        truth: Folder with scenes.
        out: Folder to write to.
        degraded: Whether depth is degraded in each way, instead of exact.
        rules: Names of :data:`torchdof.render.rules.RULES`.
    """
    console = Console(stderr=True)
    cases = [(scene, kind) for scene in read_scenes(truth) for kind in (KINDS if degraded else ["exact"])]
    details: list[Row] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar, torch.inference_mode():
        task = bar.add_task("", total=len(cases) * (1 + len(rules)))
        for scene, kind in cases:
            coc_px = scene.camera.coc_px(degrade(scene.depth, kind), scene.image.shape[-1])
            whole = 0.0
            for rule in ("", *rules):
                bar.update(task, description=f"{scene.name}: {rule}")
                with without([rule] if rule else []):
                    psnr = error(blur_by_coc(scene.image, coc_px), scene.truth)["psnr_db"]
                whole = whole if rule else psnr
                case = {"without": rule, "depth": kind, "scene": scene.name}
                details.append({**case, "psnr_db": psnr, "change_db": psnr - whole})
                bar.advance(task)
    means, least, most = (summary(details, ["without", "depth"], of) for of in (statistics.fmean, min, max))
    rows = [
        {**mean, "least_db": low["change_db"], "most_db": high["change_db"], "rule": RULES.get(mean["without"], "")}
        for mean, low, high in zip(means, least, most, strict=True)
    ]
    remarks = ["Means over the scenes, by the plain engine; least_db and most_db are the smallest and largest change."]
    publish("What each rule is worth", rows, remarks, out / "ablation", details=details)
