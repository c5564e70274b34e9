"""Checks that memory does not grow over many renderings: ``make soak``, or ``python -m tests.hard.soak --help``.

Sizes, cameras, tables and options are random, and every second rendering computes gradients. Afterwards threads with a
module each and spawned workers must render the same pictures with the same gradients, and forked workers, in which
PyTorch refuses gradients after those of the parent, the same pictures.
"""

import argparse
import ctypes
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
from torchdof.optics import kernel_bank, placed_kernels, psf

CACHES = [kernel_bank._templates, placed_kernels._shares, psf._quadrants]


TABLES = [
    BlurTable.disc(),
    BlurTable.gaussian(),
    BlurTable.load("sato_j15"),
    BlurTable.load("wide_22mm_f4"),
    BlurTable.polygon(7, 15.0, vignetting=0.4),
    lens_with_a_field(colours=1),
]


def resident_mb() -> float:
    """Resident memory of this process without the kernel caches, which are bounded, and without freed memory.

    The C library keeps freed memory for a while, after frames with gradients more than 1 GB.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return (pages * os.sysconf("SC_PAGE_SIZE") - sum(cache.bytes for cache in CACHES)) / 2**20


def rendering(seed: int, gradients: bool = False) -> torch.Tensor:
    """A picture of random size, camera, table and options; with ``gradients`` those of image and depth, after it."""
    rng, draw = random.Random(seed), torch.Generator().manual_seed(seed)
    height, width = rng.randint(1, 200), rng.randint(1, 260)
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
    if not gradients:
        with torch.inference_mode():
            return dof(image, depth).flatten()
    inputs = [image.requires_grad_(), depth.requires_grad_()]
    out = dof(*inputs)
    found = torch.autograd.grad(out.square().sum(), inputs)
    return torch.cat([t.detach().flatten() for t in (out, *found)])


def every_second_with_gradients(seed: int) -> torch.Tensor:
    """The rendering of a seed, with gradients if it is odd."""
    return rendering(seed, seed % 2 == 1)


def main() -> None:
    """Renders; exit code 1 if memory grew by more than 3 % or a picture differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--renderings", type=int, default=1000)
    parser.add_argument("--pictures", type=int, default=64, help="For threads and workers.")
    arguments = parser.parse_args()
    start, sizes = time.monotonic(), []
    for seed in range(arguments.renderings):
        assert torch.isfinite(every_second_with_gradients(seed)).all(), f"seed {seed}"
        if (seed + 1) % (arguments.renderings // 5) == 0:
            sizes.append(resident_mb())
            print(f"{seed + 1:6} renderings, {sizes[-1]:.1f} MB", flush=True)
    growth = max(sizes[-2:]) / sizes[0] - 1
    print(f"{growth:+.2%}")
    pools: dict[str, Executor] = {"8 threads": ThreadPoolExecutor(8)}
    for kind in ("spawn", "fork"):  # forked workers come from this process, which has rendered before
        pools[f"workers by {kind}"] = ProcessPoolExecutor(2, multiprocessing.get_context(kind))
    equal = True
    for name, pool in pools.items():
        render = rendering if "fork" in name else every_second_with_gradients
        truth = list(map(render, range(arguments.pictures)))
        with pool:
            pictures = list(pool.map(render, range(arguments.pictures), timeout=300))
        same = all(map(torch.allclose, pictures, truth))  # up to rounding: sums depend on PyTorch's number of threads
        print(f"{name}: {len(truth)} pictures {'are the same' if same else 'DIFFER'}")
        equal = equal and same
    print(f"{time.monotonic() - start:.0f} s")
    sys.exit(0 if growth <= 0.03 and equal else 1)


if __name__ == "__main__":
    main()
