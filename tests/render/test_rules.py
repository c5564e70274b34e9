"""Each rule of the picture can be switched off, and then the picture changes."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.scenes import furry_post, overshoots, wavy_post
from torchdof import blur_by_coc, native
from torchdof.options import DepthEdges
from torchdof.reference.degraded import degrade
from torchdof.reference.scenes import read_scenes
from torchdof.render.rules import RULES, without
from torchdof.render.surfaces.windows import highest, mean_around

SCENES = {scene.name: scene for scene in read_scenes(Path(__file__).parents[1] / "data" / "scenes")}
# what each rule needs to be seen; all others are seen on depth of half the size
ON_LAMPS_BEHIND_HAIR = ("emitters", "own_emitters", "rays", "occluders", "whole_highlights")


def scene_for(rule: str) -> tuple[Tensor, Tensor]:
    """An image and its coc in px, on which the rule has an effect."""
    if rule == "rounding":  # levels of a compressed file, half a px apart; some pixels are two levels off
        generator = torch.Generator().manual_seed(0)
        levels = torch.arange(100.0).repeat_interleave(8).expand(1, 1, 32, -1)
        levels = levels + 2.0 * (torch.rand(levels.shape, generator=generator) < 0.1)
        return torch.rand(1, 3, *levels.shape[-2:], generator=generator), 0.53 * levels
    if rule == "stand_ins":  # a dark surface with steps, before a bright one far behind
        coc = torch.full((1, 1, 64, 96), 60.0)
        coc[..., 24:], coc[..., 40:] = -1.0, -0.5
        return torch.where(coc > 0, 1.0, 0.01).expand(-1, 3, -1, -1).contiguous(), coc
    if rule == "missed_parts":
        return furry_post()[:2]
    if rule == "in_doubt":
        return wavy_post()[:2]
    if rule == "one_side":
        return overshoots()
    if rule in ("own_slope", "fewer_rays"):
        light = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
        y, x = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 96), indexing="ij")
        if rule == "own_slope":  # two steep slopes, one on each side of the focus
            return light, torch.where(x < 0.5, 8 * y - 24, 10 * y + 12)[None, None]
        light[..., ::5, ::5] *= 200  # many lamps in front of noise
        noise = torch.rand(1, 1, 64, 96, generator=torch.Generator().manual_seed(1))
        return light, 24 * noise
    name, kind = "planes/0", "half-res"
    if rule in ON_LAMPS_BEHIND_HAIR:
        name = "portrait/0"
    elif rule == "soft_lamps":
        name, kind = "highlights/0", "blur 1.5"
    elif rule == "third_surfaces":
        kind = "quarter-res"
    scene = SCENES[name]
    depth = scene.depth if rule == "whole_highlights" else degrade(scene.depth, kind)
    coc_px = scene.camera.coc_px(depth, scene.image.shape[-1])
    if rule == "registration":
        coc_px = -highest(-coc_px, 3)
    if rule == "dilated":
        coc_px = -mean_around(highest(-coc_px, 2), 1)
    side = None if rule in ("soft_lamps", "few_samples", "third_surfaces") else 96
    return scene.image[..., :side, :side], coc_px[..., :side, :side]


@pytest.mark.parametrize("rule", RULES)
def test_the_picture_changes_without_a_rule(rule: str) -> None:
    image, coc_px = scene_for(rule)
    mode: DepthEdges = "repair" if rule == "rounding" else "auto"  # "auto" does not change this map
    with torch.inference_mode():
        with without([]):
            whole = blur_by_coc(image, coc_px, depth_edges=mode)
        with without([rule]):
            changed = blur_by_coc(image, coc_px, depth_edges=mode)
    assert float((whole - changed).abs().max()) > 1e-3 * float(whole.max())


def test_a_block_without_rules_runs_the_plain_engine_and_ends() -> None:
    before = native.chosen()
    with without(["filling"]), without(["border"]):
        assert not native.chosen()
    assert native.chosen() == before


def test_an_unknown_rule_is_named_with_the_known_ones() -> None:
    with (
        pytest.raises(ValueError, match="there is no rule 'fill'; the rules are matting, mixed_neighbours"),
        without(["fill"]),
    ):
        pass
