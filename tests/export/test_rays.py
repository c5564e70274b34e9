"""Highlights of a file are splatted ray by ray, as the plain engine does it."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchdof import BlurTable
from torchdof.export import ray_splats
from torchdof.export.rays import kernels_of
from torchdof.export.verification import TOLERANCE, local_range
from torchdof.render.plan import Plan


def street(exported: Any, lamps: int) -> tuple[Tensor, ...]:
    """Lamps behind a post, and in front of it, that are blurred up to the largest radius of a file."""
    depth = torch.full((1, 1, 90, 120), 6.0) + 0.1 * torch.rand(1, 1, 90, 120)
    depth[..., 50:58] = 0.8
    depth[..., 70:, :] = 1.2
    image = 0.1 * torch.rand(1, 3, 90, 120)
    image.flatten(2)[..., torch.randperm(90 * 120)[:lamps]] = 40.0 * torch.rand(3, lamps)
    camera = exported.dof.camera.replace(focus_m=2.0, f_number=1.0)
    widest = camera.coc_px(depth, 120).abs().amax()
    return image, depth, torch.tensor([2.0]), (widest / exported.dof.options.max_coc_px).reshape(1)


@pytest.mark.parametrize("lamps", [20, 1500], ids=["few", "more than rays are splatted for"])
@pytest.mark.parametrize("module", ["layered", "plain"])
def test_lamps_are_what_the_module_makes_of_them(module: str, lamps: int, request: pytest.FixtureRequest) -> None:
    exported = request.getfixturevalue(module)
    tensors = street(exported, lamps)
    eager = exported.eager(*tensors)
    plan = Plan.all(exported.dof.options.max_coc_px, exported.dof.options.tolerance)
    with torch.no_grad():
        softer = exported.dof(*tensors, plan=plan)
    assert float((eager - softer).abs().max()) > 0.05, "no rays"
    error = (exported.render(*tensors) - eager).abs() / local_range(tensors[0], 16)
    assert float(error.max()) <= TOLERANCE


@pytest.mark.parametrize("shape", ["disc", "polygon", "sato_j15"])
def test_kernels_of_a_file_are_those_of_its_table(shape: str) -> None:
    made = {"disc": BlurTable.disc, "polygon": lambda: BlurTable.polygon(blades=5, rotation_deg=10.0)}
    table = made[shape]() if shape in made else BlurTable.load(shape)
    plan = Plan.all(3.0, 1 / 255, rays=True)
    values, origins, halves, is_round, per_px, *_ = kernels_of(table, plan, 1)
    middle = len(halves) // 2
    values_at: Any = ray_splats.values_at
    for coc_px in (-2.75, 0.5, 3.0):
        expected = table.kernels(torch.tensor([coc_px]), 1).float()[0, :, None]
        half = expected.shape[-1] // 2 + 2  # what lies beyond a kernel is 0
        node = np.array([middle + round(coc_px * per_px)])
        arrays = [t.numpy() for t in (values, origins, halves, is_round)]
        got = torch.from_numpy(values_at(*arrays, node, np.arange(-half, half + 1)))
        torch.testing.assert_close(got, torch.nn.functional.pad(expected, (2, 2, 2, 2)), rtol=1e-6, atol=1e-9)
