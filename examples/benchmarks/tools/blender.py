"""Blender's Defocus node, float32: a disc with its own radius for each pixel; it gets the radius map unchanged."""

import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

NAME = "Blender Defocus"
NOTE = (
    "float32, full precision, on the CPU; |coc| as Z with 'no z-buffer'. Time: the compositor with the node minus the "
    "compositor without it; without process start and file i/o."
)
_WORKER = Path(__file__).with_name("_blender_worker.py")


def available() -> str | None:
    """None, or what to install."""
    return None if version() else "pip install 'bpy>=5' (which wants NumPy 1); BPY_PYTHON names the interpreter with it"


@functools.cache
def version() -> str:
    """Version of Blender, 5 or newer; empty if it is not installed."""
    script = "import bpy; bpy.types.Scene.bl_rna.properties['compositing_node_group']; print(bpy.app.version_string)"
    done = subprocess.run([_python(), "-c", script], capture_output=True, text=True)
    return "" if done.returncode else done.stdout.split()[-1]


def blur(image: Tensor, coc_px: Tensor) -> tuple[Tensor, float]:
    """Blurs ``image`` ``[1, 3, H, W]`` by ``coc_px`` ``[1, 1, H, W]``; returns it and the seconds that Blender took."""
    height, width = image.shape[-2:]
    with tempfile.TemporaryDirectory() as folder:
        image[0].permute(1, 2, 0).contiguous().numpy().astype(np.float32).tofile(f"{folder}/image")  # [H, W, 3]
        coc_px.abs().numpy().astype(np.float32).tofile(f"{folder}/radius")
        numbers = [str(n) for n in (width, height, torch.get_num_threads())]
        done = subprocess.run([_python(), str(_WORKER), folder, *numbers], capture_output=True, text=True)
        if done.returncode:
            raise ChildProcessError(f"Blender failed: {done.stderr[-500:]}")
        seconds = float(Path(folder, "seconds").read_text())
        out = np.fromfile(f"{folder}/out", np.float32).reshape(height, width, 4)[..., :3]
    return torch.from_numpy(out.copy()).permute(2, 0, 1)[None], seconds


def _python() -> str:
    return os.environ.get("BPY_PYTHON", sys.executable)
