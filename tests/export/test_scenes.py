"""Eager, exported and, in the sweep, compiled render the same picture of the ray-traced scenes."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchdof.export.verification import TOLERANCE, local_range
from torchdof.reference.scenes import read_scenes

DATA = Path(__file__).parents[1] / "data" / "scenes"
SIZE = (72, 100)


def inputs(name: str, max_coc_px: float) -> tuple[Tensor, ...]:
    """A part of a scene, with the aperture at which its largest circle of confusion is a file's largest."""
    scene = {scene.name: scene for scene in read_scenes(DATA)}[name]
    image, depth = (t[..., : SIZE[0], : SIZE[1]].contiguous() for t in (scene.image[:, :3], scene.depth))
    camera = scene.camera.replace(focus_m=float(depth.median()), f_number=1.0)
    return image, depth, torch.tensor([float(camera.focus_m)]), torch.tensor([max_coc_px])


SCENES = ["highlights/0", "planes/0", "room/1"]


def compared(exported: Any, name: str) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """What a scene is rendered from, its eager picture, and what errors are told in parts of."""
    image, depth, focus, reach = inputs(name, exported.dof.options.max_coc_px)
    camera = exported.dof.camera.replace(focus_m=float(focus), f_number=1.0)
    f_number = camera.coc_px(depth, SIZE[1]).abs().amax().reshape(1) / reach
    tensors = (image, depth, focus, f_number)
    eager = exported.eager(*tensors)
    assert float((eager - image).abs().max()) > 0.05, "nothing is blurred"
    return tensors, eager, local_range(image, 8)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("module", ["layered", "fold"])
def test_eager_and_exported_agree(module: str, name: str, request: pytest.FixtureRequest) -> None:
    exported = request.getfixturevalue(module)
    tensors, eager, unit = compared(exported, name)
    assert float(((exported.render(*tensors) - eager).abs() / unit).max()) <= TOLERANCE


@pytest.mark.sweep
@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")  # from within inductor
@pytest.mark.parametrize("module", ["layered", "fold", "fold_with_occlusion"])
def test_eager_compiled_and_exported_agree(module: str, request: pytest.FixtureRequest) -> None:
    exported = request.getfixturevalue(module)
    # what is compiled is the traced graph; the code that inductor writes for it is the module's tests' matter
    compiled = torch.compile(exported.dof, fullgraph=True, backend="aot_eager")
    for name in SCENES:
        tensors, eager, unit = compared(exported, name)
        with torch.no_grad():
            assert float(((compiled(*tensors) - eager).abs() / unit).max()) <= TOLERANCE
        assert float(((exported.render(*tensors) - eager).abs() / unit).max()) <= TOLERANCE
