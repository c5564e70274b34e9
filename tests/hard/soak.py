"""Checks that memory does not grow over many renderings: ``make soak``, or ``python -m tests.hard.soak --help``.

Sizes, cameras, tables and options are random. Afterwards threads with a module each, spawned and forked workers must
render the same pictures.
"""

import argparse
import gc
import multiprocessing
import os
import random
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
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
    """Resident memory of this process without the kernel caches, which are bounded."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return (pages * os.sysconf("SC_PAGE_SIZE") - sum(cache.bytes for cache in CACHES)) / 2**20


def rendering(seed: int) -> torch.Tensor:
    """A picture of random size, camera, table and options."""
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
    with torch.inference_mode():
        return dof(image, depth)


def same(pictures: list[torch.Tensor], truth: list[torch.Tensor]) -> bool:
    """Whether pictures agree up to rounding; PyTorch's sums depend on its number of threads."""
    return len(pictures) == len(truth) and all(map(torch.allclose, pictures, truth))


def memory_growth(count: int, verbose: bool = False) -> tuple[float, float]:
    """Memory in MB after the first fifth of `count` renderings, and the larger one after the last two fifths."""
    sizes = []
    for seed in range(count):
        assert torch.isfinite(rendering(seed)).all(), f"seed {seed}"
        if (seed + 1) % (count // 5) == 0:
            sizes.append(resident_mb())
            if verbose:
                print(f"{seed + 1:6} renderings, {sizes[-1]:.1f} MB", flush=True)
    return sizes[0], max(sizes[-2:])


def in_threads(seeds: range, threads: int) -> list[torch.Tensor]:
    """Pictures rendered by several threads at once."""
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(rendering, seeds))


def in_workers(seeds: range, kind: str) -> list[torch.Tensor]:
    """Pictures rendered by processes that are spawned, or forked from this one, which has rendered before."""
    context = multiprocessing.get_context(kind)
    with ProcessPoolExecutor(2, context) as pool:
        return list(pool.map(rendering, seeds, timeout=300))


def main() -> None:
    """Renders; exit code 1 if memory grew by more than 3 % or a picture differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--renderings", type=int, default=1000)
    parser.add_argument("--pictures", type=int, default=64, help="For threads and workers.")
    arguments = parser.parse_args()
    start = time.monotonic()
    before, after = memory_growth(arguments.renderings, verbose=True)
    print(f"{before:.1f} to {after:.1f} MB: {after / before - 1:+.2%}")
    seeds = range(arguments.pictures)
    truth = [rendering(seed) for seed in seeds]
    pictures = {"8 threads": in_threads(seeds, 8)}
    pictures |= {f"{kind}ed workers": in_workers(seeds, kind) for kind in ("spawn", "fork")}
    equal = {name: same(made, truth) for name, made in pictures.items()}
    for name in equal:
        print(f"{name}: {len(truth)} pictures {'are the same' if equal[name] else 'DIFFER'}")
    print(f"{time.monotonic() - start:.0f} s")
    sys.exit(0 if after <= 1.03 * before and all(equal.values()) else 1)


if __name__ == "__main__":
    main()
