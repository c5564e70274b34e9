"""GEGL's lens-blur (the engine of GIMP), float32: a disc with its own radius for each pixel.

GEGL's disc extends half a pixel beyond its radius, so the radius is reduced by half a pixel.
"""

import functools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

NAME = "GEGL lens-blur"
NOTE = (
    "float32; a radius map, |coc| - 0.5 over its maximum, as aux. Time: processing the graph a second time, "
    "from buffer to buffer; without process start, file i/o and filling the buffers."
)
_WORKER = Path(__file__).with_name("_gegl_worker.py")


def available() -> str | None:
    """None, or what to install."""
    return None if _python() else "Debian and Ubuntu: apt install gir1.2-gegl-0.4 python3-gi"


def blur(image: Tensor, coc_px: Tensor) -> tuple[Tensor, float]:
    """Blurs ``image`` ``[1, 3, H, W]`` by ``coc_px`` ``[1, 1, H, W]``; returns it and the seconds that GEGL took."""
    height, width = image.shape[-2:]
    radius = (coc_px.abs() - 0.5).clamp_min(0.0)
    largest = max(float(radius.max()), 1e-3)
    with tempfile.TemporaryDirectory() as folder:
        image[0].permute(1, 2, 0).contiguous().numpy().astype(np.float32).tofile(f"{folder}/image")  # [H, W, 3]
        (radius / largest).numpy().astype(np.float32).tofile(f"{folder}/radius")
        command = [_python() or sys.executable, str(_WORKER), folder, str(width), str(height), str(largest)]
        environment = {**os.environ, "GEGL_THREADS": str(torch.get_num_threads())}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise ChildProcessError(f"GEGL failed: {done.stderr[-500:]}")
        out = np.fromfile(f"{folder}/out", np.float32).reshape(height, width, 3)
    return torch.from_numpy(out).permute(2, 0, 1)[None], float(done.stdout)


@functools.cache
def _python() -> str | None:
    """The first interpreter that has GEGL's bindings: this one, or the system's."""
    for python in (sys.executable, shutil.which("python3", path=os.defpath)):
        check = "import gi; gi.require_version('Gegl', '0.4')"
        if python and subprocess.run([python, "-c", check], capture_output=True).returncode == 0:
            return python
    return None
