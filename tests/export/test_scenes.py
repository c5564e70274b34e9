"""Eager, compiled and exported render the same picture of the ray-traced scenes."""

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


@pytest.fixture(scope="module", params=["layered", "fold"])
def three_ways(request: pytest.FixtureRequest) -> tuple[Any, Any]:
    exported = request.getfixturevalue(request.param)
    # what is compiled is the traced graph; the code that inductor writes for it is the module's tests' matter
    return exported, torch.compile(exported.dof, fullgraph=True, backend="aot_eager")


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")  # from within inductor
@pytest.mark.parametrize("name", ["highlights/0", "planes/0", "room/1"])
def test_eager_compiled_and_exported_agree(three_ways: tuple[Any, Any], name: str) -> None:
    exported, compiled = three_ways
    image, depth, focus, reach = inputs(name, exported.dof.options.max_coc_px)
    camera = exported.dof.camera.replace(focus_m=float(focus), f_number=1.0)
    f_number = camera.coc_px(depth, SIZE[1]).abs().amax().reshape(1) / reach
    tensors = (image, depth, focus, f_number)
    eager = exported.eager(*tensors)
    unit = local_range(image, 8)
    assert float((eager - image).abs().max()) > 0.05, "nothing is blurred"
    with torch.no_grad():
        assert float(((compiled(*tensors) - eager).abs() / unit).max()) <= TOLERANCE
    assert float(((exported.render(*tensors) - eager).abs() / unit).max()) <= TOLERANCE
