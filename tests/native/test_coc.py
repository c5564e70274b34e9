"""The circle of confusion by the compiled engine equals PyTorch's bit for bit."""

import math

import pytest
import torch

from torchdof import Camera, native

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
