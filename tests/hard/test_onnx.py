"""The hard cases through onnxruntime: one exported file renders them as the module does, and bad pixels stay alone."""

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch


def _beside(name: str) -> ModuleType:
    full = f"torchdof_hard_onnx_{name}"
    spec = importlib.util.spec_from_file_location(full, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


cases, exported_module = _beside("cases"), _beside("exported")
pytestmark = pytest.mark.hard


@pytest.fixture(scope="module")
def exported(layered: Any) -> Any:
    return exported_module.Exported(layered.path, layered.dof)


@pytest.mark.parametrize("case", cases.CASES, ids=lambda case: f"{case.group}: {case.name}")
def test_the_file_renders_every_hard_case_as_the_module(exported: Any, case: Any) -> None:
    assert exported_module.worst_error(exported, cases, case) <= case.onnx_limit


@pytest.mark.parametrize("bad", [math.nan, 0.0, -1.0, -math.inf])
def test_a_bad_depth_passes_sharp_and_touches_nothing_else(exported: Any, bad: float) -> None:
    depth = torch.linspace(1.2, 6.0, cases.WIDTH).expand(1, 1, cases.HEIGHT, cases.WIDTH).clone()
    depth[0, 0, 9:11, 8:10] = bad
    hole = ~(depth[0, 0] > 0)
    image, other = cases.texture(torch.float32), cases.texture(torch.float32)
    other[..., hole] = 1e6
    out, _ = exported.run(image, depth, 2.0, 2.0)
    assert torch.equal(out[..., hole], image[..., hole])
    assert torch.equal(exported.run(other, depth, 2.0, 2.0)[0][..., ~hole], out[..., ~hole])
    assert torch.isfinite(out).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_bad_light_stays_where_it_is(exported: Any, bad: float) -> None:
    depth = torch.linspace(1.2, 6.0, cases.WIDTH).expand(1, 1, cases.HEIGHT, cases.WIDTH)
    image = cases.texture(torch.float32)
    image[0, 1, 12, 20] = bad
    out, truth = exported.run(image, depth, 2.0, 2.0)
    here = torch.zeros(cases.HEIGHT, cases.WIDTH, dtype=torch.bool)
    here[12, 20] = True
    assert torch.equal(torch.isfinite(out).all(1)[0], ~here)
    torch.testing.assert_close(out.double()[..., ~here], truth[..., ~here], rtol=1e-5, atol=0.0)
