"""Clipped lamps get light above white; other pixels are unchanged."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

import torchdof
from tests.refused import refuses
from torchdof.io.highlights import expand_highlights
from torchdof.reference.metrics import display, psnr
from torchdof.reference.scenes import read_scenes

SCENES = Path(__file__).parents[1] / "data" / "scenes"


def night(level: float = 1.0, side: int = 3, colour: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Tensor:
    """A dark picture with a lamp whose rim, a pixel wide, shows its colour."""
    light = torch.full((1, 3, 90, 160), 0.01)
    light[..., 39 : 41 + side, 79 : 81 + side] = 0.6 * torch.tensor(colour).reshape(1, 3, 1, 1)
    light[..., 40 : 40 + side, 80 : 80 + side] = level
    return light


def test_unclipped_pixels_are_bit_exact() -> None:
    light = torch.rand(2, 3, 60, 80)
    risen = expand_highlights(light)
    is_dark = light <= 0.87
    assert torch.equal(risen[is_dark], light[is_dark])
    assert bool((risen >= light).all())


def test_a_small_lamp_rises_by_the_stops_and_a_white_area_stays() -> None:
    assert float(expand_highlights(night(), 2.0).max()) == pytest.approx(4.0)
    lamp = night()
    assert expand_highlights(lamp, 0.0) is lamp
    paper = torch.full((1, 3, 90, 160), 0.3)
    paper[..., :45, :] = 1.0
    assert torch.equal(expand_highlights(paper), paper)


def test_a_clipped_lamp_has_the_hue_of_its_rim() -> None:
    risen = expand_highlights(night(colour=(1.0, 0.6, 0.3)))[0, :, 41, 81]
    torch.testing.assert_close(risen / risen[0], torch.tensor([1.0, 0.6, 0.3]), rtol=0, atol=0.02)


def test_one_clipped_channel_follows_from_the_others_and_the_hue_of_the_rim() -> None:
    light = night(colour=(1.0, 0.2, 0.2))
    light[..., 40:43, 80:83] = torch.tensor([1.0, 0.5, 0.5]).reshape(1, 3, 1, 1)
    red, green, _ = expand_highlights(light)[0, :, 41, 81].tolist()
    assert red == pytest.approx(2.5, rel=0.05) and green == 0.5


def test_light_is_monotone_and_continuous_in_the_level_of_a_lamp_and_in_the_stops() -> None:
    levels = torch.linspace(0.8, 1.0, 401)
    risen = torch.stack([expand_highlights(night(float(level)))[0, :, 41, 81] for level in levels])
    steps = risen.diff(dim=0)
    assert bool((steps >= 0).all()) and float(steps.max()) < 0.1  # of 7, for a 2000th of white
    assert bool((steps[levels[1:] <= 0.97] > 0).all())
    by_stops = torch.stack([expand_highlights(night(), stops)[0, 0, 41, 81] for stops in (0.0, 1e-4, 1.0, 3.0, 5.0)])
    assert bool((by_stops.diff() > 0).all()) and float(by_stops[1]) < 1.001


test_wrong_input_is_refused = refuses(
    (lambda: expand_highlights(torch.ones(3, 4, 4), 3.0), r"light must be \[B, C, H, W\]"),
    (lambda: expand_highlights(torch.ones(1, 3, 0, 4), 3.0), "at least one pixel"),
    (lambda: expand_highlights(torch.ones(1, 3, 4, 4, dtype=torch.uint8), 3.0), "floating point"),
    (lambda: expand_highlights(torch.ones(1, 3, 4, 4), -1.0), "stops must be a finite number from 0 on, got -1.0"),
)


@pytest.mark.parametrize(("name", "gain_db"), [("highlights", 0.5), ("room", -0.02), ("planes", -0.02)])
def test_psnr_rises_with_lamps_and_does_not_fall_without(name: str, gain_db: float) -> None:
    for scene in read_scenes(SCENES / name):
        clipped, truth = scene.image.clamp(max=1.0), display(scene.truth)
        before, after = (
            psnr(display(torchdof.blur_by_coc(light, scene.coc_px)), truth)
            for light in (clipped, expand_highlights(clipped))
        )
        print(f"{scene.name}: {before:.2f} dB clipped, {after:.2f} dB with lights of 3 stops")
        assert after - before >= gain_db
