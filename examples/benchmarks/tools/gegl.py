"""GEGL's lens-blur (the engine of GIMP), float32: a disc with its own radius for each pixel.

GEGL's disc extends half a pixel beyond its radius, so the radius is reduced by half a pixel. Its time is that of the
graph a second time, from buffer to buffer. The system's Python, which has GEGL's bindings and may lack PyTorch, runs
``gegl.py FOLDER WIDTH HEIGHT RADIUS``.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

NAME = "GEGL lens-blur"
PYTHON = shutil.which("python3", path=os.defpath) or sys.executable


def available() -> str | None:
    """None, or what to install."""
    check = [PYTHON, "-c", "import gi; gi.require_version('Gegl', '0.4')"]
    has_gegl = subprocess.run(check, capture_output=True).returncode == 0
    return None if has_gegl else "Debian and Ubuntu: apt install gir1.2-gegl-0.4 python3-gi"


def blur(image: "Tensor", coc_px: "Tensor") -> "tuple[Tensor, float]":
    """Blurs ``image`` ``[1, 3, H, W]`` by ``coc_px`` ``[1, 1, H, W]``; returns it and the seconds that GEGL took."""
    import numpy as np
    import torch

    height, width = image.shape[-2:]
    radius = (coc_px.abs() - 0.5).clamp_min(0.0)
    largest = max(float(radius.max()), 1e-3)
    with tempfile.TemporaryDirectory() as folder:
        image[0].permute(1, 2, 0).contiguous().numpy().astype(np.float32).tofile(f"{folder}/image")  # [H, W, 3]
        (radius / largest).numpy().astype(np.float32).tofile(f"{folder}/radius")
        command = [PYTHON, __file__, folder, str(width), str(height), str(largest)]
        environment = {**os.environ, "GEGL_THREADS": str(torch.get_num_threads())}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise ChildProcessError(f"GEGL failed: {done.stderr[-500:]}")
        out = np.fromfile(f"{folder}/out", np.float32).reshape(height, width, 3)
    return torch.from_numpy(out).permute(2, 0, 1)[None], float(done.stdout)


def _run_gegl(folder: Path, width: int, height: int, largest: float) -> None:
    """Reads ``image`` and ``radius``, writes ``out``, and prints seconds."""
    import gi

    gi.require_version("Gegl", "0.4")
    from gi.repository import Gegl

    Gegl.init([])
    frame = Gegl.Rectangle.new(0, 0, width, height)
    image, radius, out = (Gegl.Buffer.new(f"{kind} float", 0, 0, width, height) for kind in ("RGB", "Y", "RGB"))
    image.set(frame, "RGB float", (folder / "image").read_bytes())
    radius.set(frame, "Y float", (folder / "radius").read_bytes())
    for _ in range(2):  # the first one warms up
        graph = Gegl.Node.new()
        source, aux = (graph.create_child("gegl:buffer-source") for _ in range(2))
        source.set_property("buffer", image)
        aux.set_property("buffer", radius)
        lens_blur, sink = graph.create_child("gegl:lens-blur"), graph.create_child("gegl:write-buffer")
        lens_blur.set_property("radius", largest)
        lens_blur.set_property("linear-mask", True)
        sink.set_property("buffer", out)
        source.link(lens_blur)
        aux.connect_to("output", lens_blur, "aux")
        lens_blur.link(sink)
        start = time.perf_counter()
        sink.process()
        seconds = time.perf_counter() - start
    (folder / "out").write_bytes(out.get(frame, 1.0, "RGB float", Gegl.AbyssPolicy.NONE))
    print(seconds)


if __name__ == "__main__":
    _run_gegl(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
