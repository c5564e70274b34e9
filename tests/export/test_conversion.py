"""One exported file renders what the module renders, at sizes and scenes other than the traced one."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

import torchdof
from torchdof.export import Verification, to_onnx
from torchdof.plan import Plan

DOF = torchdof.DepthOfField(torchdof.Camera.from_fov(50.0, 0.05, 2.0), tolerance=8 / 255, max_coc_px=4.0, check=False)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Verification]:
    path = tmp_path_factory.mktemp("onnx") / "dof.onnx"
    return path, to_onnx(DOF, path)


def test_file_is_small_and_every_case_agrees_to_1e_5(exported: tuple[Path, Verification]) -> None:
    path, verification = exported
    assert path.stat().st_size < 1_000_000
    assert len(verification.cases) > 10


def test_file_renders_another_size_focus_and_aperture(exported: tuple[Path, Verification]) -> None:
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(2, 3, 45, 71, generator=generator)
    coarse = torch.rand(2, 1, 5, 7, generator=generator) * 4 + 1
    depth = torch.nn.functional.interpolate(coarse, (45, 71))
    focus, f_number = torch.tensor([1.4, 3.0]), torch.tensor([0.5, 0.9])
    session = onnxruntime.InferenceSession(exported[0], providers=["CPUExecutionProvider"])
    tensors = {"image": image, "depth": depth, "focus_m": focus, "f_number": f_number}
    (got,) = session.run(None, {name: tensor.numpy() for name, tensor in tensors.items()})
    expected = DOF(image, depth, focus, f_number, plan=Plan.all(DOF.max_coc_px, DOF.tolerance)).numpy()
    assert np.abs(expected - image.numpy()).max() > 0.1
    np.testing.assert_allclose(got, expected, atol=1e-5, rtol=0)


def test_nothing_is_written_when_the_module_is_not_one(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"dof must be a torchdof\.DepthOfField"):
        to_onnx(torch.nn.Identity(), tmp_path / "dof.onnx")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
