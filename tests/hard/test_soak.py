"""Many renderings in one process: memory does not grow, and forked workers render."""

import sys
from pathlib import Path

import pytest
import torch

from tests.processes import output_of
from torchdof.io.images import Picture, write_image

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
@pytest.mark.parametrize("engine", ["native", pytest.param("torch", marks=pytest.mark.sweep)], indirect=True)
def test_a_forked_worker_renders_whatever_its_parent_has_done(engine: str, tmp_path: Path) -> None:
    """Each of the steps, after which the parent forks, starts OpenMP's threads, which do not survive the fork."""
    write_image(tmp_path / "shared.exr", Picture(torch.rand(1, 3, 200, 300)))
    assert output_of(FORKED, engine, cwd=tmp_path) == "2 [True, True, True]\n"


MANY = """
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
    early, late = (int(x) for x in output_of(MANY).split())
    assert late < 1.017 * early
