"""Checks that memory does not grow over many renderings: ``make soak``, or ``python -m tests.hard.soak --help``.

Sizes, cameras, tables and options are random, and every second rendering computes gradients. Afterwards threads with a
module each and spawned workers must render the same pictures with the same gradients, and forked workers, in which
PyTorch refuses gradients after those of the parent, the same pictures.
"""

import argparse
import ctypes
import functools
import gc
import multiprocessing
import os
import random
import sys
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import torch

from tests.scenes import lens_with_a_field
from torchdof import BlurTable, Camera, DepthOfField
from torchdof.optics.kernel_cache import KernelCache

LEAK_KB = 25.0
"""Growth of memory in kB for each rendering above which it counts as a leak. With a leak of 50 kB it is 61."""

TABLES = [
    BlurTable.disc(),
    BlurTable.gaussian(),
    BlurTable.load("sato_j15"),
    BlurTable.load("wide_22mm_f4"),
    BlurTable.polygon(7, 15.0, vignetting=0.4),
    lens_with_a_field(colours=1),
]


def resident_mb() -> float:
    """Resident memory of this process without freed memory, of which the C library keeps more than 1 GB for a while."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def growth_kb(renderings: int) -> float:
    """Growth of resident memory in kB for each rendering, after the first two fifths of ``renderings``.

    A leak grows for ever. Caches grow up to a limit, which is made low enough to be reached by then: images have at
    most 100 x 130 pixels, so that the engine keeps little scratch memory; the caches of kernels get a limit of 1 MB
    each; oneDNN, which keeps up to 1024 compiled operations, one for each size of image, is switched off.
    """
    for cache in gc.get_objects():
        if type(cache) is KernelCache:
            cache.limit_bytes = 2**20
    sizes = []
    torch.backends.mkldnn.set_flags(_enabled=False)
    for seed in range(renderings):
        assert torch.isfinite(rendering(seed, largest=(100, 130))).all(), f"seed {seed}"
        if (seed + 1) % (renderings // 5) == 0:
            sizes.append(resident_mb())
            print(f"{seed + 1:6} renderings, {sizes[-1]:.1f} MB", flush=True)
    torch.backends.mkldnn.set_flags(_enabled=True)
    return (max(sizes[-2:]) - sizes[1]) * 1024 / (3 * (renderings // 5))


def rendering(seed: int, gradients: bool = True, largest: tuple[int, int] = (200, 260)) -> torch.Tensor:
    """A picture of random size up to ``largest``, camera, table and options; of odd seeds with gradients."""
    rng, draw = random.Random(seed), torch.Generator().manual_seed(seed)
    height, width = (rng.randint(1, pixels) for pixels in largest)
    image = torch.rand(rng.choice((1, 1, 2)), 3, height, width, generator=draw)
    image = image ** rng.choice((1, 8))  # with highlights
    depth = 0.5 + 6.0 * torch.rand(1, 1, height, width, generator=draw).cumsum(-1) / width
    camera = Camera(rng.uniform(20, 90), rng.uniform(1.2, 8), rng.uniform(0.4, 6), rng.uniform(5, 36))
    dof = DepthOfField(
        camera,
        rng.choice(TABLES),
        tolerance=rng.choice(("draft", "preview", "final")),
        occlusion=rng.random() < 0.7,
        check=rng.random() < 0.7,
        depth_edges=rng.choice(("auto", "repair", "as given")),
    )
    if not gradients or seed % 2 == 0:
        with torch.inference_mode():
            return dof(image, depth).flatten()
    inputs = [image.requires_grad_(), depth.requires_grad_()]
    out = dof(*inputs)
    found = torch.autograd.grad(out.square().sum(), inputs)
    return torch.cat([t.detach().flatten() for t in (out, *found)])


def main() -> None:
    """Renders; exit code 1 if memory grew by more than ``LEAK_KB`` for each rendering or a picture differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--renderings", type=int, default=1000)
    parser.add_argument("--pictures", type=int, default=64, help="For threads and workers.")
    arguments = parser.parse_args()
    start, growth = time.monotonic(), growth_kb(arguments.renderings)
    print(f"{growth:+.1f} kB for each rendering")
    pools: dict[str, Executor] = {"8 threads": ThreadPoolExecutor(8)}
    for kind in ("spawn", "fork"):  # forked workers come from this process, which has rendered before
        pools[f"workers by {kind}"] = ProcessPoolExecutor(2, multiprocessing.get_context(kind))
    equal = True
    for name, pool in pools.items():
        render = functools.partial(rendering, gradients="fork" not in name)
        truth = list(map(render, range(arguments.pictures)))
        with pool:
            pictures = list(pool.map(render, range(arguments.pictures), timeout=300))
        same = all(map(torch.allclose, pictures, truth))  # up to rounding: sums depend on PyTorch's number of threads
        print(f"{name}: {len(truth)} pictures {'are the same' if same else 'DIFFER'}")
        equal = equal and same
    print(f"{time.monotonic() - start:.0f} s")
    sys.exit(0 if growth <= LEAK_KB and equal else 1)


if __name__ == "__main__":
    main()
