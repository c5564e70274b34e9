"""What a step of gradient descent costs, beside a picture without gradients: parts of a photograph.

python examples/benchmarks/steps.py [--device cuda] [--threads 1] [--repeat 7]

A step renders, and takes the gradients by light and radius. Each row is a process of its own, and every picture and
step has a new focus. Times on the CPU are processor time, which other programs change less. The last two columns are
the most memory that a picture and a step take, on the CPU that of the process beyond that before the first picture.
Rows with `splat` blur each pixel with its own kernel.
"""

import argparse
import itertools
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as functional

from examples.benchmarks.operations import seconds
from torchdof import blur_by_coc
from torchdof.depth.reading import read_depth
from torchdof.functional import splat
from torchdof.io.images import read_image

DATA = Path(__file__).parents[1] / "data" / "motorcycle"
WIDEST_PX = 8.0
RENDERERS: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "with occlusion": blur_by_coc,
    "without occlusion": lambda light, coc_px: blur_by_coc(light, coc_px, occlusion=False),
    "splat": splat,
}
SIZES = {"cpu": [(256, 256, 1), (256, 256, 8), (480, 480, 1)], "cuda": [(256, 256, 8), (512, 512, 8), (1080, 1920, 1)]}


def parts(height: int, width: int, batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Light and dioptres of parts of the photograph, which is enlarged if it is smaller."""
    calibration = json.loads((DATA / "camera.json").read_text())
    image = read_image(DATA / "motorcycle_left.png").pixels
    dioptres = 1.0 / read_depth(DATA / "motorcycle_disp.npz", **calibration["depth"])
    factor = max(1.0, height / image.shape[-2], width / image.shape[-1])
    if factor > 1.0:
        size = [round(factor * n) for n in image.shape[-2:]]
        image = functional.interpolate(image, size, mode="bilinear", align_corners=False)
        dioptres = functional.interpolate(dioptres, size, mode="nearest")
    high, wide = image.shape[-2:]
    corners = [(97 * i % (high - height + 1), 211 * i % (wide - width + 1)) for i in range(batch)]
    crops = [torch.cat([t[..., y : y + height, x : x + width] for y, x in corners]) for t in (image, dioptres)]
    return crops[0].contiguous(), crops[1].contiguous()


def measure(size: tuple[int, int, int], renderer: str, device: str, repeat: int) -> None:
    """Print one row."""
    image, dioptres = (t.to(device) for t in parts(*size))
    low, high = float(dioptres.min()), float(dioptres.max())
    focus_positions = itertools.cycle(0.05 + 0.9 * torch.rand(97, generator=torch.Generator().manual_seed(0)))
    render = RENDERERS[renderer]

    def coc_px() -> torch.Tensor:
        return WIDEST_PX * (low + (high - low) * float(next(focus_positions)) - dioptres) / (high - low)

    def picture() -> None:
        render(image, coc_px())

    def step() -> None:
        light, radius = image.clone().requires_grad_(), coc_px().requires_grad_()
        torch.autograd.grad(render(light, radius).square().mean(), (light, radius))

    def most_bytes() -> int:
        if device == "cpu":
            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        return torch.cuda.max_memory_allocated()

    def measured(call: Callable[[], None]) -> tuple[float, float]:
        """Median seconds of some calls, and the most MiB taken since the start; on a GPU since the first call."""
        if device != "cpu":
            torch.cuda.reset_peak_memory_stats()
        clock = time.process_time if device == "cpu" else time.perf_counter
        return seconds(call, repeat, device, clock), (most_bytes() - before) / 2**20

    before = most_bytes()
    (frame_s, frame_mib), (step_s, step_mib) = measured(picture), measured(step)
    height, width, batch = size
    name = f"{batch} of {width} x {height}, {renderer}"
    print(
        f"{name:38} {1e3 * frame_s:8.1f} ms {1e3 * step_s:8.1f} ms {step_s / frame_s:6.1f} "
        f"{frame_mib:7.0f} MiB {step_mib:7.0f} MiB"
    )


def main() -> None:
    """Print the table, each row by a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=7, help="calls of which the median is taken")
    parser.add_argument("--row", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    rows = list(itertools.product(SIZES[arguments.device.split(":")[0]], RENDERERS))
    if arguments.row is not None:
        size, renderer = rows[arguments.row]
        measure(size, renderer, arguments.device, arguments.repeat)
        return
    print(f"{'parts of the photograph':38} {'picture':>11} {'step':>11} {'ratio':>6} {'memory':>11} {'of a step':>11}")
    for row in range(len(rows)):
        sys.stdout.flush()
        subprocess.run([sys.executable, __file__, *sys.argv[1:], "--row", str(row)], check=True)


if __name__ == "__main__":
    main()
