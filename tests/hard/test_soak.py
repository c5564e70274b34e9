"""Many renderings in one process: memory does not grow; threads and worker processes render the same pictures."""

import multiprocessing
import random
import sys
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from tests.processes import output_of
from tests.scenes import lens_with_a_field
from torchdof import BlurTable, Camera, DepthOfField
from torchdof.io.images import Picture, write_image

TABLES = [
    BlurTable.disc(),
    BlurTable.gaussian(),
    BlurTable.load("sato_j15"),
    BlurTable.load("wide_22mm_f4"),
    BlurTable.polygon(7, 15.0, vignetting=0.4),
    lens_with_a_field(colours=1),
]


def rendering(seed: int) -> torch.Tensor:
    """A picture of random size, camera, table and options; of odd seeds with gradients."""
    rng, draw = random.Random(seed), torch.Generator().manual_seed(seed)
    height, width = rng.randint(1, 100), rng.randint(1, 130)
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
    if seed % 2 == 0:
        with torch.inference_mode():
            return dof(image, depth).flatten()
    inputs = [image.requires_grad_(), depth.requires_grad_()]
    out = dof(*inputs)
    found = torch.autograd.grad(out.square().sum(), inputs)
    return torch.cat([t.detach().flatten() for t in (out, *found)])


# a leak grows for ever, caches up to a limit, which is made low enough to be reached after two fifths; oneDNN keeps up
# to 1024 compiled operations, one for each size of image, and the C library 1 GB of freed memory
MANY = """
import ctypes, gc, os, sys, torch
from tests.hard.test_soak import rendering
from torchdof.optics.kernel_cache import KernelCache
for cache in gc.get_objects():
    if type(cache) is KernelCache:
        cache.limit_bytes = 2**20
torch.backends.mkldnn.set_flags(_enabled=False)
for seed in range(1000):
    assert torch.isfinite(rendering(seed)).all(), seed
    if seed % 200 == 199:
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        print(int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1024)
"""


@pytest.mark.sweep
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_does_not_grow_over_1000_renderings_of_which_half_have_gradients() -> None:
    _, start, *later = map(float, output_of(MANY, timeout=1200).split())
    assert max(later) - start < 600 * 25.0  # kB; with a leak of 50 kB a rendering it is 600 * 61


@pytest.mark.sweep
@pytest.mark.parametrize("kind", ["threads", "workers"])
def test_threads_and_workers_render_the_same_pictures(kind: str) -> None:
    pool: Executor = ThreadPoolExecutor(8)
    if kind == "workers":
        pool = ProcessPoolExecutor(2, multiprocessing.get_context("spawn"))
    with pool:
        pictures = pool.map(rendering, range(64), timeout=300)
        assert all(map(torch.allclose, pictures, map(rendering, range(64))))  # sums depend on the number of threads


FORKED = """
import os, signal, sys, torch
os.environ["TORCHDOF_ENGINE"] = sys.argv[1]
torch.set_num_threads(2)
signal.alarm(200)
from torchdof.io import images
image, coc_px = torch.rand(1, 3, 200, 300), torch.linspace(-9.0, 9.0, 300).expand(1, 1, 200, 300)
def render():
    from torchdof import blur_by_coc
    return blur_by_coc(image, coc_px)
files = {"read": lambda: images.read_image("shared.exr"), "import": lambda: __import__("torchdof.module"),
         "render": render}
for file, call in files.items():
    call()
    child = os.fork()
    if child == 0:
        signal.alarm(100)
        torch.save(render(), file)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
print(torch.get_num_threads(), [torch.allclose(torch.load(file), render()) for file in files])
"""


@pytest.mark.hard
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fork")
def test_a_forked_worker_renders_whatever_its_parent_has_done(engine: str, tmp_path: Path) -> None:
    """Each of the steps, after which the parent forks, starts OpenMP's threads, which do not survive the fork."""
    write_image(tmp_path / "shared.exr", Picture(torch.rand(1, 3, 200, 300)))
    assert output_of(FORKED, engine, cwd=tmp_path) == "2 [True, True, True]\n"


FEW = """
import gc, resource, sys, torch, torchdof
images = torch.rand(1, 3, 24, 32), torch.rand(1, 3, 24, 32, requires_grad=True)
dof = torchdof.DepthOfField(torchdof.Camera(sensor_width_mm=6.0))
def rss():
    gc.collect()
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()
def shoot(count):
    for i in range(count):
        for image in images:
            out = dof(image, 1.0 + 0.01 * i + torch.rand(1, 1, 24, 32).requires_grad_(image.requires_grad))
            if image.requires_grad:
                out.square().sum().backward()
shoot(60)
early = rss()
shoot(150)
print(early, rss())
"""


@pytest.mark.hard
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_does_not_grow_over_300_frames_of_which_half_have_gradients() -> None:
    early, late = (int(x) for x in output_of(FEW).split())
    assert late < 1.017 * early
