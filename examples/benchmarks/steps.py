"""What a picture and a step of gradient descent cost: time, memory, operations, and how often values are read.

python examples/benchmarks/steps.py [SCENES] [--device cuda] [--threads 1] [--radius 4 8 16] [--repeat 7]

Parts of a photograph are rendered or, if SCENES is given, the scenes of a folder
(:func:`torchdof.reference.scenes.read_scenes`), each alone and four of one size together. A step renders, and takes the
gradients by light and radius. Every picture and step has a new focus. Times on the CPU are processor time, which other
programs change less. Memory is the most that a picture or a step takes. A GPU starts each operation of a picture
separately, and waits for all of them wherever values are read; `TORCHDOF_ENGINE=torch` counts those of the same engine
on the CPU. Rows with `splat` blur each pixel with its own kernel.
"""

import argparse
import functools
import itertools
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchdof import blur_by_coc
from torchdof.bench.measurement import peak_of
from torchdof.depth import read_depth
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


class Counted(TorchDispatchMode):
    """Counts operations other than views, and those that read values."""

    operations = reads = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations += not function.is_view
        self.reads += function.overloadpacket.__name__ in READS
        return function(*args, **(kwargs or {}))


def pictures(folder: Path | None, device: str) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Name, light ``[B, C, H, W]`` and nearness ``[B, 1, H, W]``, which is linear in the circle of confusion."""
    if folder is not None:
        for _, of_size in itertools.groupby(read_scenes(folder), lambda scene: scene.image.shape):
            scenes = list(of_size)
            for group in [[scene] for scene in scenes] + [scenes[k : k + 4] for k in range(0, len(scenes) - 3, 4)]:
                name = " to ".join(dict.fromkeys((group[0].name, group[-1].name)))
                yield name, torch.cat([s.image for s in group]), torch.cat([-s.coc_px for s in group])
        return
    yield from crops(SIZES[device.split(":")[0]])


def crops(sizes: Sequence[tuple[int, int, int]]) -> Iterator[tuple[str, Tensor, Tensor]]:
    """As :func:`pictures`, parts of a photograph: height, width and number of each batch; enlarged if it is smaller."""
    calibration = json.loads((DATA / "camera.json").read_text())
    photograph = read_image(DATA / "motorcycle_left.png").pixels
    dioptres = 1.0 / read_depth(DATA / "motorcycle_disp.npz", **calibration["depth"])
    for height, width, batch in sizes:
        factor = max(1.0, height / photograph.shape[-2], width / photograph.shape[-1])
        size = [round(factor * n) for n in photograph.shape[-2:]]
        image = functional.interpolate(photograph, size, mode="bilinear", align_corners=False)
        near = functional.interpolate(dioptres, size, mode="nearest")
        corners = [(97 * i % (size[0] - height + 1), 211 * i % (size[1] - width + 1)) for i in range(batch)]
        light, near = (torch.cat([t[..., y : y + height, x : x + width] for y, x in corners]) for t in (image, near))
        yield f"{batch} of {width} x {height}", light, near


def measure(name: str, render: Callable[[Tensor, Tensor], Tensor], image: Tensor, near: Tensor, repeat: int) -> None:
    """Prints one row; ``near`` is a radius in pixels in front of a focus at the far end."""
    focus_positions = itertools.cycle(0.05 + 0.9 * torch.rand(97, generator=torch.Generator().manual_seed(0)))
    radius_px, is_cpu = near.max(), image.device.type == "cpu"
    clock, wait = (time.process_time, lambda: None) if is_cpu else (time.perf_counter, torch.cuda.synchronize)

    def coc_px() -> Tensor:
        return radius_px * float(next(focus_positions)) - near

    def picture() -> None:
        with torch.no_grad():
            render(image, coc_px())

    def step() -> None:
        light, radius = image.clone().requires_grad_(), coc_px().requires_grad_()
        torch.autograd.grad(render(light, radius).square().mean(), (light, radius))

    def measured(call: Callable[[], None]) -> tuple[float, float]:
        """Median milliseconds of some calls after a first one, and the most MiB that one takes."""
        durations = []
        for _ in range(repeat + 1):
            wait()
            start = clock()
            call()
            wait()
            durations.append(clock() - start)
        if is_cpu:
            return 1e3 * statistics.median(durations[1:]), peak_of(call)[1]
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        call()
        return 1e3 * statistics.median(durations[1:]), (torch.cuda.max_memory_allocated() - before) / 2**20

    (frame_ms, frame_mib), (step_ms, step_mib) = measured(picture), measured(step)
    with Counted() as counted:
        picture()
    print(
        f"{name:46} {frame_ms:8.2f} ms {step_ms:8.2f} ms {step_ms / frame_ms:6.1f} "
        f"{frame_mib:7.0f} MiB {step_mib:7.0f} MiB {counted.operations:10} {counted.reads:5}",
        flush=True,
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="?", help="folder of scenes, as torchdof bench --truth takes it")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--radius", type=float, nargs="+", default=[8.0], help="largest blur radii in pixels")
    parser.add_argument("--repeat", type=int, default=7, help="calls of which the median is taken")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    titles = ("picture", 11), ("step", 11), ("ratio", 6), ("memory", 11), ("of a step", 11), ("operations", 10)
    print(" " * 46, *(f"{title:>{width}}" for title, width in titles), "reads")
    for name, image, near in pictures(arguments.scenes, arguments.device):
        near = ((near - near.min()) / (near.max() - near.min())).contiguous().to(arguments.device)
        for (renderer, render), radius_px in itertools.product(RENDERERS.items(), arguments.radius):
            row = f"{name}, {renderer}, {radius_px:g} px"
            measure(row, render, image.contiguous().to(arguments.device), radius_px * near, arguments.repeat)


if __name__ == "__main__":
    main()
