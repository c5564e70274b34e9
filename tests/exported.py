"""Modules and their exported files, written once in a test run, because tracing takes long."""

import dataclasses
import functools
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from click.testing import CliRunner
from filelock import FileLock
from torch import Tensor

import torchdof
from torchdof.cli.main import app
from torchdof.export import Verification, to_onnx
from torchdof.export.graph import Layout, Portable
from torchdof.export.verification import session
from torchdof.render.layers.plan import Plan

CAMERA = torchdof.Camera.from_fov(50.0, 0.05, 2.0)
SMALL = torchdof.Camera(sensor_width_mm=4.0)  # 4 px at infinity in the hard cases' small frames
GIVEN: dict[str, Any] = {"depth_edges": "as given"}  # files without the repair are written sooner
MODULES: dict[str, Callable[[], torchdof.DepthOfField]] = {
    # with occlusion, at resolutions down to an eighth; slow to trace
    "layered": lambda: torchdof.DepthOfField(SMALL, **GIVEN, tolerance=64 / 255, max_coc_px=8.0, check=False),
    # one straight graph, with occlusion
    "whole": lambda: torchdof.DepthOfField(CAMERA, **GIVEN, tolerance=64 / 255, max_coc_px=2.5, check=False),
    # without occlusion; traced in a few seconds
    "plain": lambda: torchdof.DepthOfField(
        CAMERA, **GIVEN, tolerance=16 / 255, max_coc_px=2.5, occlusion=False, check=False
    ),
    # the literal scatter: without occlusion in one straight graph of one size, and with it
    "fold": lambda: torchdof.DepthOfField(
        CAMERA, **GIVEN, tolerance=32 / 255, max_coc_px=2.5, occlusion=False, method="fold", check=False
    ),
    "fold with occlusion": lambda: torchdof.DepthOfField(
        CAMERA, **GIVEN, tolerance=16 / 255, max_coc_px=2.5, method="fold", check=False
    ),
}
LAYOUTS: dict[str, Layout] = {"whole": "whole", "fold": "whole"}
SIZES = {"fold": (72, 100)}


@dataclasses.dataclass(frozen=True)
class Exported:
    """A module, its file, and the result of comparing them."""

    dof: torchdof.DepthOfField
    path: Path
    verification: Verification
    layout: Layout

    @property
    def plan(self) -> Plan:
        """The layers of the file, and its rays."""
        return Plan.static(self.dof.options.max_coc_px, self.dof.options.tolerance, rays=True)

    @functools.cached_property
    def runner(self) -> onnxruntime.InferenceSession:
        """The file in onnxruntime, which takes seconds to load a large one."""
        return session(self.path)

    def render(self, *tensors: Tensor) -> Tensor:
        """The picture of the file in onnxruntime."""
        feed = {v.name: t.numpy() for v, t in zip(self.runner.get_inputs(), tensors, strict=True)}
        return torch.from_numpy(np.asarray(self.runner.run(None, feed)[0]))

    def eager(self, *tensors: Tensor) -> Tensor:
        """The picture of the module in PyTorch, with the layers of the file."""
        with torch.no_grad():
            if self.layout == "whole":
                return Portable(self.dof, layout="whole")(*tensors)
            return self.dof(*tensors, plan=self.plan)


def export_once(name: str, folder: Path) -> Exported:
    """The module of that name and its file in a folder; the first process to call this writes it."""
    layout = LAYOUTS.get(name, "tiles")
    dof, path, verification = MODULES[name](), folder / f"{name}.onnx", folder / f"{name}.verification"
    with FileLock(folder / f"{name}.lock"):
        if not verification.exists():
            generator = torch.get_rng_state()
            torch.set_default_dtype(torch.float64 if name == "plain" else torch.float32)  # which changes no file
            try:
                verification.write_bytes(pickle.dumps(to_onnx(dof, path, layout=layout, size=SIZES.get(name))))
            finally:
                torch.set_default_dtype(torch.float32)
            assert torch.equal(torch.get_rng_state(), generator), "the caller's generator has been advanced"
    return Exported(dof, path, pickle.loads(verification.read_bytes()), layout)


def command_once(folder: Path) -> tuple[Path, str]:
    """A file of one channel with blur radii as input, and the output of ``torchdof export``."""
    path, output = folder / "command" / "dof.onnx", folder / "command.json"
    with FileLock(folder / "command.lock"):
        if not output.exists():
            path.parent.mkdir()
            options = "--inputs coc_px --channels 1 --max-coc 2 --no-occlusion --opset 21 --json"
            result = CliRunner().invoke(app, ["export", "-o", str(path), *options.split()], catch_exceptions=False)
            assert result.exit_code == 0, result.output
            output.write_text(result.stdout)
    return path, output.read_text()
