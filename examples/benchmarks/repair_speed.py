"""What the repair of depth edges costs: processor time at 1920 x 1080, by scene and kind of damage.

Usage: python examples/benchmarks/repair_speed.py SCENES [--repeat 5]

``SCENES`` is a folder of scenes with known truth, as ``torchdof bench --truth`` takes it; they are enlarged, the depth
by its nearest pixels, before it is made worse. Times are of this process's processor, over all its threads, in
milliseconds, and as a share of unit Y of ``torchdof bench``, which takes turns with them.
"""

import argparse
import functools
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.bench.speed import unit_work
from torchdof.bench.timer import in_turns, processor_seconds
from torchdof.depth.edges import STEP_PX, repair
from torchdof.reference.degraded import KINDS, degrade
from torchdof.reference.scenes import Scene, read_scenes

SIZE = (1080, 1920)


def enlarged(scene: Scene, kind: str) -> tuple[Tensor, Tensor]:
    """Image and nearness of a scene at :data:`SIZE`, its depth made worse."""
    image = functional.interpolate(scene.image, size=SIZE, mode="bilinear")
    depth = functional.interpolate(scene.depth, size=SIZE, mode="nearest")
    return image, -scene.camera.coc_px(degrade(depth, kind), SIZE[1])


def table(scenes: Sequence[Scene], repeat: int) -> None:
    """Prints a row for each scene: milliseconds and share of the unit by kind of damage."""
    print("| | " + " | ".join(KINDS) + " |\n" + "| --- " * (len(KINDS) + 1) + "|")
    for scene in scenes:
        works: dict[str, Callable[[], Tensor]] = {"unit": unit_work()}
        for kind in KINDS:
            works[kind] = functools.partial(repair, *enlarged(scene, kind), STEP_PX, auto=True)
        seconds = {name: statistics.median(times) for name, times in in_turns(works, repeat, processor_seconds).items()}
        told = [f"{1e3 * seconds[kind]:.0f} ({seconds[kind] / seconds['unit']:.2f})" for kind in KINDS]
        print(f"| {scene.name} | " + " | ".join(told) + " |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scenes", type=Path, help="folder of scenes, as torchdof bench --truth takes it")
    parser.add_argument("--repeat", type=int, default=5, help="turns; by default %(default)s")
    arguments = parser.parse_args()
    with torch.no_grad():
        table(list(read_scenes(arguments.scenes)), arguments.repeat)


if __name__ == "__main__":
    main()
