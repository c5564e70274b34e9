"""Eager and exported modules render the same pictures of scenes and lamps."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.exported import SIZES
from torchdof import BlurTable
from torchdof.export import rays
from torchdof.export.verification import TOLERANCE, local_range
from torchdof.reference.scenes import read_scenes
from torchdof.render.layers.plan import Plan

DATA = Path(__file__).parents[1] / "data" / "scenes"
SIZE = SIZES["fold"]


SCENES = ["highlights/0", "planes/0", "room/1"]


def compared(exported: Any, name: str) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """Inputs of a part of a scene, its eager picture, and the local range of light that errors are divided by.

    The f-number is the one at which the scene's largest circle of confusion is the file's largest.
    """
    scene = {scene.name: scene for scene in read_scenes(DATA)}[name]
    image, depth = (t[..., : SIZE[0], : SIZE[1]].contiguous() for t in (scene.image[:, :3], scene.depth))
    focus = depth.median().reshape(1)
    camera = exported.dof.camera.replace(focus_m=float(focus), f_number=1.0)
    f_number = camera.coc_px(depth, SIZE[1]).abs().amax().reshape(1) / exported.dof.options.max_coc_px
    tensors = (image, depth, focus, f_number)
    eager = exported.eager(*tensors)
    assert float((eager - image).abs().max()) > 0.05, "nothing is blurred"
    return tensors, eager, local_range(image, 8)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("module", ["layered", "fold", pytest.param("fold_with_occlusion", marks=pytest.mark.sweep)])
def test_eager_and_exported_agree(module: str, name: str, request: pytest.FixtureRequest) -> None:
    exported = request.getfixturevalue(module)
    tensors, eager, unit = compared(exported, name)
    assert float(((exported.render(*tensors) - eager).abs() / unit).max()) <= TOLERANCE


def street(exported: Any, lamps: int) -> tuple[Tensor, ...]:
    """Lamps behind and in front of a post, blurred by up to the largest radius of a file: two items of two tiles."""
    depth = torch.full((2, 1, 90, 120), 6.0) + 0.1 * torch.rand(2, 1, 90, 120)
    depth[..., 50:58], depth[..., 70:, :] = 0.8, 1.2
    image = 0.1 * torch.rand(2, 3, 90, 120)
    image.flatten(2)[..., torch.randperm(90 * 120)[:lamps]] = 40.0 * torch.rand(3, lamps)
    widest = exported.dof.camera.replace(focus_m=2.0, f_number=1.0).coc_px(depth, 120).abs().amax()
    return image, depth, torch.tensor([2.0]), (widest / exported.dof.options.max_coc_px).reshape(1)


@pytest.mark.parametrize("lamps", [20, 1500], ids=["few", "more than rays are splatted for"])
@pytest.mark.parametrize("module", ["layered", "plain"])
def test_lamps_are_splatted_ray_by_ray(module: str, lamps: int, request: pytest.FixtureRequest) -> None:
    exported = request.getfixturevalue(module)
    tensors = street(exported, lamps)
    eager = exported.eager(*tensors)
    with torch.no_grad():
        without_rays = exported.dof(*tensors, plan=dataclasses.replace(exported.plan, rays=False))
    assert float((eager - without_rays).abs().max()) > 0.05, "no lamp is splatted ray by ray"
    assert float(((exported.render(*tensors) - eager).abs() / local_range(tensors[0], 16)).max()) <= TOLERANCE


@pytest.mark.parametrize("shape", ["disc", "polygon", "sato_j15"])
def test_kernels_of_a_file_equal_those_of_its_table(shape: str) -> None:
    made = {"disc": BlurTable.disc, "polygon": lambda: BlurTable.polygon(blades=5, rotation_deg=10.0)}
    table = made[shape]() if shape in made else BlurTable.load(shape)
    plan = Plan.static(3.0, 1 / 255, rays=True)
    kernels = rays.kernels_of(table, plan, 1)
    for coc_px in (-2.75, 0.5, 3.0):
        expected = table.kernels(torch.tensor([coc_px]), 1).float()[0, :, None]
        half = expected.shape[-1] // 2 + 2  # 2 px of zeros around the kernel
        node = torch.tensor([len(kernels.halves) // 2 + round(coc_px * kernels.per_px)])
        got = rays._values_at(kernels, node, torch.arange(-half, half + 1))
        torch.testing.assert_close(got, torch.nn.functional.pad(expected, (2, 2, 2, 2)), rtol=1e-6, atol=1e-9)
