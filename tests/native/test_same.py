"""The compiled engine computes the same circles of confusion and plans the same layers as the plain one."""

import math

import pytest
import torch
from torch import Tensor

from torchdof import Camera, native
from torchdof.render.plan import Plan

pytestmark = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built")


DEPTH = torch.cat(
    [torch.linspace(-1.0, 9.0, 2003), torch.tensor([0.0, 2.0, math.inf, -math.inf, math.nan, 1e-30, 3e38])]
)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(focus_m=2.0, f_number=1.4),
        Camera(focus_m=math.inf),
        Camera(focus_range_m=(1.5, 2.2)),
        Camera(focus_range_m=(1.5, math.inf)),
        Camera.from_fov(fov_x_deg=40.0, aperture_radius_m=0.012, focus_m=2.0),
        Camera(focus_m=torch.tensor(2.0)),
    ],
    ids=str,
)
def test_both_engines_compute_the_same_circle_of_confusion(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    depth = DEPTH.reshape(1, 1, 30, 67)
    compiled = camera.coc_px(depth, 640)
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    plain = camera.coc_px(depth, 640)
    assert torch.equal(compiled.isnan(), plain.isnan())
    assert torch.equal(compiled.nan_to_num(7.0), plain.nan_to_num(7.0))


def maps() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(2)
    noise = torch.rand(1, 1, 97, 131, generator=generator)
    slope = torch.linspace(-20.0, 50.0, 160).expand(2, 1, 90, 160).clone()
    halves = torch.where(torch.rand(1, 1, 48, 64, generator=generator) < 0.5, -7.3, 12.5)
    holes = 500.0 * noise**3
    holes[0, 0, :2] = math.nan
    beyond = 3.0 * noise
    beyond[..., 5, 5] = -math.inf
    return {
        "noise": 20.0 * noise - 10.0,
        "slope": slope,
        "two planes": halves,
        "one plane": torch.full((1, 1, 16, 20), -3.25),
        "in focus": torch.zeros(1, 1, 16, 20),
        "holes": holes,
        "beyond the frame": beyond,
    }


@pytest.mark.parametrize("tolerance", [0.0, 0.5 / 255, 1 / 255, 8 / 255, 0.3])
@pytest.mark.parametrize("coc", maps().values(), ids=maps())
def test_both_engines_plan_the_same_layers(coc: Tensor, tolerance: float) -> None:
    compiled, plain = Plan.of_frame(coc, tolerance), Plan.of_frame(coc.double(), tolerance)
    assert compiled.tolerance == pytest.approx(plain.tolerance, rel=1e-6)
    assert len(compiled.nodes) == len(plain.nodes)
    assert compiled.nodes == pytest.approx(plain.nodes, rel=1e-5, abs=1e-5)
