"""What a picture and a step of gradient descent cost: time, memory, operations, and how often values are read.

python examples/benchmarks/steps.py [SCENES] [--device cuda] [--threads 1] [--radius 4 8 16] [--repeat 7]

Parts of a photograph are rendered or, if SCENES is given, the scenes of a folder
(:func:`torchdof.reference.scenes.read_scenes`), each alone and four of one size together. A step renders, and takes the
gradients by light and radius. Each row is a process of its own, and every picture and step has a new focus. Times on
the CPU are processor time, which other programs change less. Memory is the most that a picture and a step take, on the
CPU that of the process beyond that before the first picture. A GPU starts each operation of a picture separately, and
waits for all of them wherever values are read; `TORCHDOF_ENGINE=torch` counts those of the same engine on the CPU.
Rows with `splat` blur each pixel with its own kernel.
"""

import argparse
import functools
import itertools
import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchdof import blur_by_coc
from torchdof.depth.reading import read_depth
from torchdof.functional import splat
from torchdof.io.images import read_image
from torchdof.reference.scenes import Scene, read_scenes

DATA = Path(__file__).parents[1] / "data" / "motorcycle"
RENDERERS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "with occlusion": blur_by_coc,
    "without occlusion": functools.partial(blur_by_coc, occlusion=False),
    "splat": splat,
}
SIZES = {"cpu": [(256, 256, 1), (256, 256, 8), (480, 480, 1)], "cuda": [(256, 256, 8), (512, 512, 8), (1080, 1920, 1)]}
READS = ("_local_scalar_dense", "nonzero", "equal", "_unique2")
Made = Callable[[], tuple[Tensor, Tensor]]
"""Light ``[B, C, H, W]`` and nearness ``[B, 1, H, W]``, which is linear in the circle of confusion."""


class Counted(TorchDispatchMode):
    """Counts operations other than views, and those that read values."""

    operations = reads = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations += not function.is_view
        self.reads += function.overloadpacket.__name__ in READS
        return function(*args, **(kwargs or {}))


def parts(height: int, width: int, batch: int) -> tuple[Tensor, Tensor]:
    """Light and dioptres of parts of the photograph, which is enlarged if it is smaller."""
    calibration = json.loads((DATA / "camera.json").read_text())
    image = read_image(DATA / "motorcycle_left.png").pixels
    dioptres = 1.0 / read_depth(DATA / "motorcycle_disp.npz", **calibration["depth"])
    factor = max(1.0, height / image.shape[-2], width / image.shape[-1])
    size = [round(factor * n) for n in image.shape[-2:]]
    image = functional.interpolate(image, size, mode="bilinear", align_corners=False)
    dioptres = functional.interpolate(dioptres, size, mode="nearest")
    corners = [(97 * i % (size[0] - height + 1), 211 * i % (size[1] - width + 1)) for i in range(batch)]
    light, near = (torch.cat([t[..., y : y + height, x : x + width] for y, x in corners]) for t in (image, dioptres))
    return light, near


def together(scenes: tuple[Scene, ...]) -> tuple[Tensor, Tensor]:
    """Light and nearness of scenes of one size."""
    return torch.cat([scene.image for scene in scenes]), torch.cat([-scene.coc_px for scene in scenes])


def pictures(folder: Path | None, device: str) -> dict[str, Made]:
    """The pictures to render, by name."""
    if folder is None:
        sizes = SIZES[device.split(":")[0]]
        return {
            f"{batch} of {width} x {height}": functools.partial(parts, height, width, batch)
            for height, width, batch in sizes
        }
    made: dict[str, Made] = {}
    for _, of_size in itertools.groupby(read_scenes(folder), lambda scene: scene.image.shape):
        scenes = tuple(of_size)
        for count in (1, 4):
            for start in range(0, len(scenes) - count + 1, count):
                some = scenes[start : start + count]
                made[" to ".join(dict.fromkeys((some[0].name, some[-1].name)))] = functools.partial(together, some)
    return made


def measure(name: str, made: Made, renderer: str, radius_px: float, device: str, repeat: int) -> None:
    """Print one row."""
    image, near = (t.to(device).contiguous() for t in made())
    low, high = near.aminmax()
    near = (near - low) / (high - low)
    focus_positions = itertools.cycle(0.05 + 0.9 * torch.rand(97, generator=torch.Generator().manual_seed(0)))
    render = RENDERERS[renderer]
    is_cpu = device == "cpu"
    clock = time.process_time if is_cpu else time.perf_counter
    wait = (lambda: None) if is_cpu else torch.cuda.synchronize

    def coc_px() -> Tensor:
        return radius_px * (float(next(focus_positions)) - near)

    def picture() -> None:
        with torch.no_grad():
            render(image, coc_px())

    def step() -> None:
        light, radius = image.clone().requires_grad_(), coc_px().requires_grad_()
        torch.autograd.grad(render(light, radius).square().mean(), (light, radius))

    def most_bytes() -> int:
        if is_cpu:
            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        return torch.cuda.max_memory_allocated()

    def measured(call: Callable[[], None]) -> tuple[float, float]:
        """Median milliseconds of some calls after a first one, and the most MiB taken since the start."""
        if not is_cpu:
            torch.cuda.reset_peak_memory_stats()
        durations = []
        for _ in range(repeat + 1):
            wait()
            start = clock()
            call()
            wait()
            durations.append(clock() - start)
        return 1e3 * statistics.median(durations[1:]), (most_bytes() - before) / 2**20

    before = most_bytes()
    (frame_ms, frame_mib), (step_ms, step_mib) = measured(picture), measured(step)
    with Counted() as counted:
        picture()
    print(
        f"{f'{name}, {renderer}, {radius_px:g} px':46} {frame_ms:8.2f} ms {step_ms:8.2f} ms {step_ms / frame_ms:6.1f} "
        f"{frame_mib:7.0f} MiB {step_mib:7.0f} MiB {counted.operations:10} {counted.reads:5}"
    )


def main() -> None:
    """Print the table, each row by a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="?", help="folder of scenes, as torchdof bench --truth takes it")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--radius", type=float, nargs="+", default=[8.0], help="largest blur radii in pixels")
    parser.add_argument("--repeat", type=int, default=7, help="calls of which the median is taken")
    parser.add_argument("--row", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    made = pictures(arguments.scenes, arguments.device)
    rows = list(itertools.product(made.items(), RENDERERS, arguments.radius))
    if arguments.row is not None:
        (name, of_name), renderer, radius_px = rows[arguments.row]
        measure(name, of_name, renderer, radius_px, arguments.device, arguments.repeat)
        return
    titles = (
        f"{'picture':>11} {'step':>11} {'ratio':>6} {'memory':>11} {'of a step':>11} {'operations':>10} {'reads':>5}"
    )
    print(f"{'':46} {titles}")
    for row in range(len(rows)):
        sys.stdout.flush()
        subprocess.run([sys.executable, __file__, *sys.argv[1:], "--row", str(row)], check=True)


if __name__ == "__main__":
    main()
