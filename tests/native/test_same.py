"""The compiled engine finds the same ends, circles of confusion and layers as the plain one, with its own threads."""

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tests.scenes import slope, whole
from torchdof import Camera, blur_by_coc, native
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.edges import mended

pytestmark = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built")

STRANGE_M = torch.tensor([0.0, 2.0, math.inf, -math.inf, math.nan, 1e-30, 3e38])
DEPTH = torch.cat([torch.linspace(-1.0, 9.0, 2003), STRANGE_M]).reshape(1, 1, 30, 67)

CAMERAS = [
    *(Camera(focus_m=2.0, f_number=1.4), Camera(focus_m=math.inf), Camera(focus_m=torch.tensor(2.0))),
    *(Camera(focus_range_m=(1.5, far)) for far in (2.2, math.inf)),
    Camera.from_fov(fov_x_deg=40.0, aperture_radius_m=0.012, focus_m=2.0),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=str)
def test_both_engines_compute_the_same_circle_of_confusion(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = camera.coc_px(DEPTH, 640)
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    torch.testing.assert_close(compiled, camera.coc_px(DEPTH, 640), rtol=0.0, atol=0.0, equal_nan=True)


def maps() -> dict[str, Tensor]:
    noise = torch.rand(1, 1, 97, 131, generator=torch.Generator().manual_seed(2))
    holes, beyond = 500.0 * noise**3, 3.0 * noise
    holes[0, 0, :2], beyond[..., 5, 5] = math.nan, -math.inf
    return {
        "noise": 20.0 * noise - 10.0,
        "slope": slope(-20.0, 50.0, 90, 160).repeat(2, 1, 1, 1),
        "two planes": torch.where(noise[..., :48, :64] < 0.5, -7.3, 12.5),
        "one plane": whole(-3.25, 16, 20),
        "in focus": whole(0.0, 16, 20),
        "holes": holes,
        "beyond the frame": beyond,
    }


@pytest.mark.parametrize("tolerance", [0.0, 0.5 / 255, 1 / 255, 8 / 255, 0.3])
@pytest.mark.parametrize("coc", maps().values(), ids=maps())
def test_both_engines_plan_the_same_layers(coc: Tensor, tolerance: float) -> None:
    compiled, plain = Plan.for_scene(coc, tolerance), Plan.for_scene(coc.double(), tolerance)
    assert compiled.tolerance == pytest.approx(plain.tolerance, rel=1e-6)
    assert len(compiled.nodes) == len(plain.nodes)
    assert compiled.nodes == pytest.approx(plain.nodes, rel=1e-5, abs=1e-5)


SIZES = (1, 7, 8, 9, 2**16 - 1, 2**16, 2**16 + 1, 3 * 2**16 + 5)


@pytest.mark.parametrize("size", SIZES)
def test_ends_are_minimum_and_maximum_and_a_single_nan_or_infinity_is_found(size: int) -> None:
    values = torch.randn(size, generator=torch.Generator().manual_seed(size))
    assert native.ends(values) == (float(values.min()), float(values.max()))
    assert native.ends(values.repeat(2, 1).T) == (float(values.min()), float(values.max()))
    for place in (0, (size - 1) // 2, size - 1):
        values = torch.zeros(size)
        values[place] = -math.inf
        assert native.ends(values)[0] == -math.inf
        values[place] = math.nan
        assert all(map(math.isnan, native.ends(values)))


class LargeReads(TorchDispatchMode):
    """Records PyTorch's operators that read tensors large enough for several threads."""

    names: list[str]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        reads = not func.is_view and func is not torch.ops.aten.empty_like.default
        if reads and any(isinstance(a, torch.Tensor) and a.numel() >= 2**15 for a in args):
            self.names.append(str(func))
        return result


@pytest.mark.parametrize("occlusion", [True, False])
def test_no_operator_of_pytorch_reads_a_whole_frame(occlusion: bool) -> None:
    """PyTorch's threads would spin afterwards and compete with those of the engine."""
    image, coc = torch.rand(1, 3, 256, 256), slope(-6.0, 9.0, 256, 256)
    reads = LargeReads()
    reads.names = []
    with torch.inference_mode(), reads:
        blur_by_coc(image, coc, occlusion=occlusion)
    assert reads.names == []


@pytest.mark.parametrize("seed", range(6))
def test_both_engines_repair_an_enlarged_map_alike(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """An enlarged map is linear between its samples: pixels lie at exact quarters of the step between two surfaces."""
    generator = torch.Generator().manual_seed(seed)
    image, coarse = torch.rand(1, 3, 40, 50, generator=generator), torch.rand(1, 1, 3, 4, generator=generator)
    coc = functional.interpolate(40.0 * coarse - 20.0, (40, 50), mode="bilinear", align_corners=True)
    compiled = mended(image, coc, "repair")
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    torch.testing.assert_close(compiled, mended(image, coc, "repair"), rtol=0.0, atol=5e-3)


@pytest.mark.parametrize(("seed", "height", "width"), [(0, 37, 61), (1, 29, 76), (2, 12, 88), (3, 5, 73), (4, 70, 90)])
def test_both_engines_blur_patches_farther_than_a_tile_alike(
    seed: int, height: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a tile lie blocks that kernels of the layers near the focus do not reach, and wider ones do."""
    generator = torch.Generator().manual_seed(seed)
    patches = 90.0 * torch.rand(4, 1, 3, 6, generator=generator) - 45.0
    coc = functional.interpolate(patches, (height, width))
    image = torch.rand(4, 1, height, width, generator=generator)
    pictures = []
    for engine in ("native", "torch"):
        monkeypatch.setenv("TORCHDOF_ENGINE", engine)
        pictures.append(blur_by_coc(image, coc, depth_edges="as given", tolerance=1e-3))
    torch.testing.assert_close(*pictures, rtol=0.0, atol=1e-5)
