"""Exported once, used by many tests: tracing takes longer than everything else here."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import torchdof
from torchdof.export import Verification, to_onnx
from torchdof.export.verification import session
from torchdof.render.plan import Plan


@dataclasses.dataclass(frozen=True)
class Exported:
    """A module, its file and how they compare."""

    dof: torchdof.DepthOfField
    path: Path
    verification: Verification

    def render(self, *tensors: Tensor) -> Tensor:
        """What onnxruntime makes of the file."""
        runner = session(self.path)
        feed = {v.name: t.numpy() for v, t in zip(runner.get_inputs(), tensors, strict=True)}
        return torch.from_numpy(np.asarray(runner.run(None, feed)[0]))

    def eager(self, *tensors: Tensor) -> Tensor:
        """What PyTorch makes of the module, with the layers of the file."""
        with torch.no_grad():
            return self.dof(*tensors, plan=Plan.all(self.dof.options.max_coc_px, self.dof.options.tolerance))


def _exported(tmp_path_factory: pytest.TempPathFactory, dof: torchdof.DepthOfField) -> Exported:
    path = tmp_path_factory.mktemp("onnx") / "dof.onnx"
    return Exported(dof, path, to_onnx(dof, path))


CAMERA = torchdof.Camera.from_fov(50.0, 0.05, 2.0)


@pytest.fixture(scope="session")
def layered(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """With occlusion, by convolution at resolutions down to a sixteenth."""
    return _exported(tmp_path_factory, torchdof.DepthOfField(CAMERA, tolerance=64 / 255, max_coc_px=32.0, check=False))


@pytest.fixture(scope="session")
def fold(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """With occlusion, by the literal scatter."""
    dof = torchdof.DepthOfField(CAMERA, tolerance=16 / 255, max_coc_px=2.5, method="fold", check=False)
    return _exported(tmp_path_factory, dof)


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Without occlusion, which is traced in a few seconds."""
    return _exported(
        tmp_path_factory,
        torchdof.DepthOfField(CAMERA, tolerance=16 / 255, max_coc_px=2.5, occlusion=False, check=False),
    )
