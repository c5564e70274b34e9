"""What a step of gradient descent costs, beside a picture without gradients: parts of a photograph, one thread.

python examples/benchmarks/steps.py [--threads 1] [--repeat 7]

A step renders, and takes the gradients by light and radius. Each row is a process of its own, and every picture and
step has a new focus. The last column is the most memory that the process takes beyond that before the first picture.
"""

import argparse
import itertools
import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from torchdof import blur_by_coc
from torchdof.depth.reading import read_depth
from torchdof.io.images import read_image

DATA = Path(__file__).parents[1] / "data" / "motorcycle"
ROWS = [(side, batch, occlusion) for side, batch in ((256, 1), (256, 8), (480, 1)) for occlusion in (True, False)]
WIDEST_PX = 8.0


def parts(side: int, batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Light and dioptres of parts of the photograph, ``side`` pixels high and wide."""
    calibration = json.loads((DATA / "camera.json").read_text())
    image = read_image(DATA / "motorcycle_left.png").pixels
    dioptres = 1.0 / read_depth(DATA / "motorcycle_disp.npz", **calibration["depth"])
    height, width = image.shape[-2:]
    corners = [(97 * i % (height - side + 1), 211 * i % (width - side + 1)) for i in range(batch)]
    crops = [torch.cat([t[..., y : y + side, x : x + side] for y, x in corners]) for t in (image, dioptres)]
    return crops[0].contiguous(), crops[1].contiguous()


def measure(side: int, batch: int, occlusion: bool, repeat: int) -> None:
    """Print one row."""
    image, dioptres = parts(side, batch)
    low, high = float(dioptres.min()), float(dioptres.max())
    focus_positions = itertools.cycle(0.05 + 0.9 * torch.rand(97, generator=torch.Generator().manual_seed(0)))

    def coc_px() -> torch.Tensor:
        return WIDEST_PX * (low + (high - low) * next(focus_positions) - dioptres) / (high - low)

    def picture() -> None:
        blur_by_coc(image, coc_px(), occlusion=occlusion)

    def step() -> None:
        light, radius = image.clone().requires_grad_(), coc_px().requires_grad_()
        torch.autograd.grad(blur_by_coc(light, radius, occlusion=occlusion).square().mean(), (light, radius))

    def seconds(call: Callable[[], None]) -> float:
        call()
        durations = []
        for _ in range(repeat):
            start = time.perf_counter()
            call()
            durations.append(time.perf_counter() - start)
        return statistics.median(durations)

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    frame_s, step_s = seconds(picture), seconds(step)
    mib = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    name = f"{side} x {side}, {'with' if occlusion else 'without'} occlusion"
    print(f"{name:32} {batch:5} {1e3 * frame_s:8.0f} ms {1e3 * step_s:8.0f} ms {step_s / frame_s:6.1f} {mib:7.0f} MiB")


def main() -> None:
    """Print the table, each row by a process of its own."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=7, help="calls of which the median is taken")
    parser.add_argument("--row", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.row is not None:
        side, batch, occlusion = ROWS[arguments.row]
        measure(side, batch, occlusion, arguments.repeat)
        return
    print(
        f"{'parts of the photograph':32} {'batch':>5} {'picture':>11} {'step':>11} {'ratio':>6} {'memory':>11}",
        flush=True,
    )
    for row in range(len(ROWS)):
        subprocess.run([sys.executable, __file__, *sys.argv[1:], "--row", str(row)], check=True)


if __name__ == "__main__":
    main()
