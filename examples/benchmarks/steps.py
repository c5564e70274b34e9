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
import multiprocessing
import resource
import statistics
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
from torchdof.reference.scenes import read_scenes

DATA = Path(__file__).parents[1] / "data" / "motorcycle"
RENDERERS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "with occlusion": blur_by_coc,
    "without occlusion": functools.partial(blur_by_coc, occlusion=False),
    "splat": splat,
}
SIZES = {"cpu": [(256, 256, 1), (256, 256, 8), (480, 480, 1)], "cuda": [(256, 256, 8), (512, 512, 8), (1080, 1920, 1)]}
READS = ("_local_scalar_dense", "nonzero", "equal", "_unique2")
Pictures = dict[str, tuple[Tensor, Tensor]]
"""Name -> light ``[B, C, H, W]`` and nearness ``[B, 1, H, W]``, which is linear in the circle of confusion."""


class Counted(TorchDispatchMode):
    """Counts operations other than views, and those that read values."""

    operations = reads = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations += not function.is_view
        self.reads += function.overloadpacket.__name__ in READS
        return function(*args, **(kwargs or {}))


def of_photograph(device: str) -> Pictures:
    """Parts of the photograph, which is enlarged if it is smaller, with their dioptres."""
    calibration = json.loads((DATA / "camera.json").read_text())
    photo = read_image(DATA / "motorcycle_left.png").pixels
    photo = torch.cat([photo, 1.0 / read_depth(DATA / "motorcycle_disp.npz", **calibration["depth"])], 1)
    made: Pictures = {}
    for height, width, batch in SIZES[device.split(":")[0]]:
        factor = max(1.0, height / photo.shape[-2], width / photo.shape[-1])
        large = functional.interpolate(photo, [round(factor * n) for n in photo.shape[-2:]], mode="nearest")
        rows, columns = (n - side + 1 for n, side in zip(large.shape[-2:], (height, width), strict=True))
        corners = [(97 * i % rows, 211 * i % columns) for i in range(batch)]
        parts = torch.cat([large[..., y : y + height, x : x + width] for y, x in corners])
        made[f"{batch} of {width} x {height}"] = parts[:, :3], parts[:, 3:]
    return made


def of_scenes(folder: Path) -> Pictures:
    """The scenes of a folder, each alone, and four of one size together."""
    made: Pictures = {}
    for _, of_size in itertools.groupby(read_scenes(folder), lambda scene: scene.image.shape):
        scenes = list(of_size)
        for count in (1, 4):
            for start in range(0, len(scenes) - count + 1, count):
                some = scenes[start : start + count]
                tensors = torch.cat([scene.image for scene in some]), torch.cat([-scene.coc_px for scene in some])
                made[" to ".join(dict.fromkeys((some[0].name, some[-1].name)))] = tensors
    return made


def measure(case: tuple[str, str, float], arguments: argparse.Namespace) -> str:
    """The row of a picture, a renderer and a radius in pixels."""
    (name, renderer, radius_px), device = case, arguments.device
    torch.set_num_threads(arguments.threads)
    made = of_photograph(device) if arguments.scenes is None else of_scenes(arguments.scenes)
    image, near = (t.to(device).contiguous() for t in made[name])
    low, high = near.aminmax()
    near = (near - low) / (high - low)
    focus_positions = itertools.cycle(0.05 + 0.9 * torch.rand(97, generator=torch.Generator().manual_seed(0)))
    render, is_cpu = RENDERERS[renderer], device == "cpu"
    clock = time.process_time if is_cpu else time.perf_counter

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
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated()

    def measured(call: Callable[[], None]) -> tuple[float, float]:
        """Median milliseconds of some calls after a first one, and the most MiB taken since the start."""
        if not is_cpu:
            torch.cuda.reset_peak_memory_stats()
        durations, most = [], before
        for _ in range(arguments.repeat + 1):
            start = clock()
            call()
            most = most_bytes()  # waits for a GPU
            durations.append(clock() - start)
        return 1e3 * statistics.median(durations[1:]), (most - before) / 2**20

    before = most_bytes()
    (frame_ms, frame_mib), (step_ms, step_mib) = measured(picture), measured(step)
    with Counted() as counted:
        picture()
    return (
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
    arguments = parser.parse_args()
    made = of_photograph(arguments.device) if arguments.scenes is None else of_scenes(arguments.scenes)
    titles = (
        ("picture", 11),
        ("step", 11),
        ("ratio", 6),
        ("memory", 11),
        ("of a step", 11),
        ("operations", 10),
        ("reads", 5),
    )
    print(" " * 46, *(f"{title:>{width}}" for title, width in titles))
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as processes:
        cases = itertools.product(made, RENDERERS, arguments.radius)
        for row in processes.imap(functools.partial(measure, arguments=arguments), cases, chunksize=1):
            print(row, flush=True)


if __name__ == "__main__":
    main()
