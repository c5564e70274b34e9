"""What decides the time of the plain engine on a GPU: its operations, and how often it waits for values.

python examples/benchmarks/operations.py SCENES [--occlusion off] [--device cuda]

SCENES is a folder of scenes (:func:`torchdof.reference.scenes.read_scenes`). Every row is a scene, or a batch of four
scenes of one size. A GPU starts each operation separately, and waits for all of them wherever values are read. On a GPU
a row ends with the median time of five pictures.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchdof import blur_by_coc
from torchdof.reference.scenes import read_scenes

READS = ("_local_scalar_dense", "nonzero", "equal", "_unique2")


class Counted(TorchDispatchMode):
    """Counts operations other than views, and those that read values."""

    operations = reads = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations += not function.is_view
        self.reads += function.overloadpacket.__name__ in READS
        return function(*args, **(kwargs or {}))


def seconds(
    call: Callable[[], object], times: int = 5, device: str = "cpu", clock: Callable[[], float] = time.perf_counter
) -> float:
    """Median time of some calls, after one that warms up, with all operations that they start on a GPU."""
    wait = (lambda: None) if device == "cpu" else torch.cuda.synchronize
    call()
    durations = []
    for _ in range(times):
        wait()
        start = clock()
        call()
        wait()
        durations.append(clock() - start)
    return statistics.median(durations)


def main() -> None:
    """Print a row for each scene and batch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--occlusion", choices=["on", "off"], default="on")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    arguments = parser.parse_args()
    os.environ["TORCHDOF_ENGINE"] = "torch"
    sizes: dict[tuple[int, ...], list[tuple[str, torch.Tensor, torch.Tensor]]] = {}
    for scene in read_scenes(arguments.scenes):
        sizes.setdefault(tuple(scene.image.shape), []).append((scene.name, scene.image, scene.coc_px))
    for scenes in sizes.values():
        rows = [*scenes]
        for start in range(0, len(scenes) - 3, 4):
            names, images, cocs = zip(*scenes[start : start + 4], strict=True)
            rows.append((f"{names[0]} to {names[-1]}", torch.cat(images), torch.cat(cocs)))
        for name, image, coc_px in rows:
            image, coc_px = image.to(arguments.device), coc_px.to(arguments.device)

            def render(image: torch.Tensor = image, coc_px: torch.Tensor = coc_px) -> None:
                blur_by_coc(image, coc_px, occlusion=arguments.occlusion == "on")

            with torch.no_grad():
                render()  # some tensors are made once
                with Counted() as counted:
                    render()
                took = (
                    f", {1000 * seconds(render, device=arguments.device):6.1f} ms" if arguments.device != "cpu" else ""
                )
            print(f"{name:28} {counted.operations:6} operations, {counted.reads:3} times values{took}", flush=True)


if __name__ == "__main__":
    main()
