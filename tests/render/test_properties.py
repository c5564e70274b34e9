"""Properties of any scene: pictures are continuous, stay in the range of the light, and commute with flips."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.scenes import TURNS, made, random_scene
from torchdof.reference import metrics
from torchdof.render.highlights import threshold

ENGINES = {
    "native float32": ("native", torch.float32),
    "torch float32": ("torch", torch.float32),  # test_engines.py compares it with both others
    "torch float64": ("torch", torch.float64),
}
STEP_PX = 1e-4


def seeds(count: int) -> Any:
    """``count`` seeds in every run, 500 in `make sweep`."""
    chunks = [pytest.param(range(count), id=f"{count} scenes")]
    chunks += [pytest.param(range(i, i + 50), id=f"from {i}", marks=pytest.mark.sweep) for i in range(0, 500, 50)]
    return pytest.mark.parametrize("seeds", chunks)


@pytest.fixture(
    params=[pytest.param(name, marks=[pytest.mark.sweep] if name == "torch float32" else []) for name in ENGINES]
)
def dtype(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.dtype:
    """The dtype; the fixture also selects the engine."""
    engine, dtype = ENGINES[request.param]
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    return dtype


def rms(difference: Tensor) -> float:
    return float(difference.square().mean().sqrt())


@seeds(6)
@pytest.mark.parametrize(
    ("depth_edges", "tolerance", "most_rms", "most"),
    [("as given", 0.0, 0.05 / 255, 5e-3), ("auto", 0.0, 0.05 / 255, 5e-3), ("auto", 1 / 255, 0.25 / 255, torch.inf)],
    ids=["as given 0", "0", "1/255"],
)
def test_the_picture_is_continuous_in_depth(
    seeds: range, depth_edges: str, tolerance: float, most_rms: float, most: float, dtype: torch.dtype
) -> None:
    """It is continuous with repaired edges too: decisions fade in, or their thresholds avoid frequent values."""
    for seed in seeds:
        scene = random_scene(seed)
        scene.options["depth_edges"] = depth_edges
        noise = torch.rand(scene.coc_px.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        still = scene.blurred(dtype, tolerance=tolerance)
        for step_px in (STEP_PX, (2.0 * noise - 1.0) * STEP_PX):
            change = scene.blurred(dtype, step_px, tolerance=tolerance) - still
            change = change / max(1.0, float(scene.image.max()))
            assert rms(change) < most_rms and float(change.abs().max()) < most, f"scene {seed}"


@seeds(12)
@pytest.mark.parametrize("tolerance", [0.0, 1 / 255], ids=["0", "1/255"])
def test_ordinary_light_stays_within_its_range(seeds: range, tolerance: float, dtype: torch.dtype) -> None:
    for seed in seeds:
        scene = random_scene(seed, lamps=False)
        if bool((scene.image > threshold(scene.image)).any()):
            continue
        light = torch.stack([scene.image, scene.options.get("background", scene.image)])
        out = scene.blurred(dtype, tolerance=tolerance)
        assert float(light.min()) - 1e-3 <= float(out.min()) and float(out.max()) <= float(light.max()) + 1e-3, seed


@seeds(12)
def test_the_picture_scales_with_the_exposure(seeds: range, dtype: torch.dtype) -> None:
    for seed in seeds:
        scene = random_scene(seed)
        if dtype == torch.float64:
            scene.options["depth_edges"] = "as given"  # the repair works in float32
        picture = scene.blurred(dtype, tolerance=1 / 255)
        for times in (1e-6, 1e6):
            difference = scene.exposed(times).blurred(dtype, tolerance=1 / 255) / times - picture
            most = 1e-9 if dtype == torch.float64 else 1e-4
            assert float(difference.abs().max()) < most * max(1.0, float(scene.image.max())), f"scene {seed}"


@seeds(6)
@pytest.mark.parametrize(("tolerance", "multiple"), [(0.0, 1), (1 / 255, 16), (1 / 255, 1)])
@pytest.mark.parametrize("depth_edges", ["as given", pytest.param("auto", marks=pytest.mark.sweep)])
def test_rendering_commutes_with_flips_and_turns(
    seeds: range, depth_edges: str, tolerance: float, multiple: int, dtype: torch.dtype
) -> None:
    """Coarse layers average blocks from the first pixel: a flip changes those of other sides, within the tolerance."""
    for seed in seeds:
        scene = random_scene(seed, multiple=multiple)
        scene.options["depth_edges"] = depth_edges
        out = scene.blurred(dtype, tolerance=tolerance)
        for turn in TURNS.values():
            change = scene.turned(turn).blurred(dtype, tolerance=tolerance) - turn(out)
            change = change / max(1.0, float(scene.image.max()))
            if tolerance > 0 and multiple == 1:
                assert rms(change) < 2.0 * tolerance, f"scene {seed}"
            else:
                assert float(change.abs().max()) < 1e-4, f"scene {seed}"


@pytest.mark.parametrize("size", [16, pytest.param(40, marks=pytest.mark.sweep), 56])
def test_the_tolerance_holds_for_blurs_as_large_as_the_frame(size: int) -> None:
    for seed in range(6):
        scene = made("smooth", size, size, 20.0, seed=seed)
        scene.coc_px[..., size // 3 : 2 * size // 3, size // 3 : 2 * size // 3] = -20.0
        exact, fast = (metrics.display(scene.blurred(tolerance=tolerance)) for tolerance in (0, 1 / 255))
        assert 255 * rms(fast - exact) < 1.0
