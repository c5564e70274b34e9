"""The measurement that all benchmarks use: time of the first picture by a camera, and its error."""

import contextlib
import ctypes
import dataclasses
import functools
import math
import random
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.blur_table import BlurTable
from ..reference import metrics
from ..reference.scenes import posts, waves

__all__ = ["BenchScene", "Renderer", "Seconds", "error", "measure", "peak_mb", "peak_of", "shipped", "timed"]

_MIN_SIDE = 16
_Result = TypeVar("_Result")


class Seconds(NamedTuple):
    """Duration of a call: wall-clock seconds, and processor seconds over all threads of this process."""

    wall: float
    cpu: float = math.nan


Renderer = Callable[[Tensor, Tensor], Any]
"""Renders an image ``[B, C, H, W]`` by its coc ``[B, 1, H, W]``; returns the picture, or (picture, seconds)."""


def timed(work: Callable[..., Any], *arguments: Any) -> tuple[Any, Seconds]:
    """Result and duration of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work(*arguments)
    seconds = Seconds(time.perf_counter() - wall, time.process_time() - cpu)
    if not isinstance(result, tuple):
        return result, seconds
    return result[0], result[1] if isinstance(result[1], Seconds) else Seconds(result[1])


@dataclasses.dataclass(frozen=True, eq=False)
class BenchScene:
    """A scene to be rendered, and the blur table of its lens."""

    name: str
    image: Tensor  # [B, C, H, W], linear light, without alpha
    coc_px: Tensor  # [B, 1, H, W], signed radius in pixels
    remark: str = ""  # camera and focus, in words
    table: BlurTable = dataclasses.field(default_factory=BlurTable.disc)

    def __post_init__(self) -> None:
        height, width = self.image.shape[-2:]
        if min(height, width) < _MIN_SIDE:
            raise ValueError(f"{self.name}: is {width} x {height}; speed is measured from {_MIN_SIDE} pixels a side on")

    def seen(self, focus: float, radius_px: float) -> "BenchScene":
        """The scene by another camera: focused nearer (from -1) or farther (to 1), with another largest radius."""
        # a thin lens's circle of confusion is linear in 1 / distance: focus adds a constant, the opening multiplies
        shifted = self.coc_px - 0.5 * focus * (self.coc_px.max() - self.coc_px.min())
        return dataclasses.replace(self, coc_px=shifted * (radius_px / shifted.abs().max().clamp_min(1e-9)))

    def cameras(self, count: int, seed: str) -> "list[BenchScene]":
        """The scene by ``count`` random cameras, whose largest radius is 0.7 to 1 times that of the scene."""
        rng, widest_px = random.Random(seed), float(self.coc_px.abs().max())
        return [self.seen(rng.uniform(-0.5, 0.5), widest_px * 0.7 ** rng.random()) for _ in range(count)]

    def pull(self, count: int) -> "list[BenchScene]":
        """A sequence of ``count`` pictures whose focus moves through the scene."""
        widest_px = float(self.coc_px.abs().max())
        return [self.seen(2 * k / max(1, count - 1) - 1, widest_px) for k in range(count)]

    def resized(self, scale: float) -> "BenchScene":
        """The scene in a frame of another size; the blur is scaled with the width."""
        height, width = (max(_MIN_SIDE, round(scale * n)) for n in self.image.shape[-2:])
        image = functional.interpolate(self.image, (height, width), mode="area")
        coc_px = functional.interpolate(self.coc_px, (height, width), mode="nearest")  # no radii between two surfaces
        return dataclasses.replace(self, image=image, coc_px=coc_px * (width / self.image.shape[-1]))


def measure(blur: Renderer, scene: BenchScene, again: bool = True) -> tuple[Tensor, dict[str, float]]:
    """The picture of a scene by a new camera, and a row as in :data:`torchdof.bench.report.LEGEND`."""
    frame = torch.ones(1, 16, 540, 960).contiguous(memory_format=torch.channels_last)
    beside = functools.partial(functional.conv2d, frame, torch.ones(16, 1, 17, 17), padding=8, groups=16)
    time.sleep(0.02)  # PyTorch's threads spin for a while after each operation
    picture, new = timed(blur, scene.image, scene.coc_px)
    if not bool(picture.isfinite().all()):
        raise RuntimeError(f"{scene.name}: the picture is not finite")
    row = {"new_ms": 1e3 * new.wall, "spread_ms": 0.0, "cpu_ms": 1e3 * new.cpu}
    if again:
        repeat_time = timed(blur, scene.image, scene.coc_px)[1]
        row |= {"again_ms": 1e3 * repeat_time.wall, "over_again": new.cpu / repeat_time.cpu}
    reference_time = timed(beside)[1]
    return picture, row | {"beside_ms": 1e3 * reference_time.wall, "over_beside": new.cpu / reference_time.cpu}


def error(picture: Tensor, reference: Tensor) -> dict[str, float]:
    """Difference of two pictures as displayed: RMS of 255, PSNR in dB, SSIM."""
    shown, truth = metrics.display(picture), metrics.display(reference)
    rms = math.sqrt(float((shown.double() - truth.double()).square().mean()))
    return {"rms_255": 255 * rms, "psnr_db": metrics.psnr(shown, truth), "ssim": metrics.ssim(shown, truth)}


def peak_of(work: Callable[[], _Result]) -> tuple[_Result, float]:
    """Result of a call, and the growth of resident memory in MiB; frees unused memory first."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)  # memory freed before would otherwise be reused unnoticed
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    start_mb = peak_mb()
    return work(), peak_mb() - start_mb


def peak_mb() -> float:
    """Peak of this process's resident memory in MiB as Linux reports it, without its parent's; NaN elsewhere."""
    try:
        return int(re.findall(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())[0]) / 1024
    except (OSError, IndexError):
        return math.nan


def shipped(height: int = 540, width: int = 960) -> BenchScene:
    """A slope from 1 m to 10 m behind posts at 0.9 m to 1 m; the largest blur radius is 1/60 of the width."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in (height, width)), indexing="ij")
    is_post = posts(width / 6, width / 40)(x, y)
    light = torch.where(is_post, waves(2, (0.6, 0.3, 0.2))(x, y), waves(1)(x, y)).float()[None]
    nearness = torch.where(is_post, 1.0 + 0.1 * x / width, 0.1 + 0.9 * y / height).float()[None, None]
    coc_px = (0.6 - nearness) * (width / 60 / 0.5)  # equally blurred at the far end and at the posts
    return BenchScene("slope with posts", light, coc_px, "a thin lens focused at 1.67 m")
