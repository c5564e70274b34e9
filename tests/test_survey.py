import pytest
import torch

import torchdof
from torchdof.plan import Plan
from torchdof.survey import survey

DISC = torchdof.BlurTable.disc()


def two_planes() -> torch.Tensor:
    """A strip of 64 px at the left, blurred in front of a plane in focus."""
    coc = torch.zeros(1, 1, 192, 320)
    coc[..., :64] = -6.0
    return coc


def test_each_layer_tells_its_pixels_place_and_kernel() -> None:
    coc = two_planes()
    found = survey(Plan((-5.5, 0.0), 1 / 255), coc, DISC, layered=True, occlusion=True)
    near, sharp = found.layers
    assert near.coc_px == -6.0 and near.pixels == pytest.approx(0.2) and sharp.pixels == pytest.approx(0.8)
    assert near.box == (0, 0, 128, 192)  # its light reaches into the second column of tiles
    assert near.frame == pytest.approx(2 / 5) and near.kernel_px == 13 and near.scale == 1
    assert sharp.box == (64, 0, 320, 192) and sharp.kernel_px == 1
    assert found.in_focus == pytest.approx(0.8)


def test_shares_of_time_sum_to_one_and_the_blurred_layer_costs_more_than_the_copy() -> None:
    for occlusion in (True, False):
        found = survey(Plan((-5.5, 0.0), 1 / 255), two_planes(), DISC, layered=True, occlusion=occlusion)
        assert sum(layer.time for layer in found.layers) + found.hidden_time == pytest.approx(1.0)
        assert found.layers[0].time > 2 * found.layers[1].time
        assert (found.hidden_time > 0) == occlusion


def test_layers_that_nothing_lies_in_cost_nothing() -> None:
    found = survey(Plan((-5.5, -2.0, 0.0, 9.0), 1 / 255), two_planes(), DISC, layered=True, occlusion=True)
    assert [layer.box is None and layer.time == 0 for layer in found.layers] == [False, True, False, True]


def test_a_larger_blur_is_spread_at_a_coarser_resolution_unless_folded() -> None:
    coc = 8 * two_planes()
    plan = Plan.of_scene(coc, 1 / 255)
    assert survey(plan, coc, DISC, layered=True, occlusion=True).layers[0].scale > 1
    assert survey(plan, coc, DISC, layered=False, occlusion=True).layers[0].scale == 1


def test_one_plane_and_a_frame_in_focus_have_no_error() -> None:
    coc = torch.full((1, 1, 40, 50), 3.3)
    for scene in (coc, 0 * coc):
        found = survey(Plan.of_scene(scene, 1 / 255), scene, DISC, layered=True, occlusion=True)
        assert found.rms_error == 0 and found.hidden_time == 0 and len(found.layers) == 1


def test_the_module_gives_a_plan_that_prints_why_it_costs_what_it_costs() -> None:
    dof = torchdof.DepthOfField(torchdof.Camera(focus_m=2.0, f_number=1.0, sensor_width_mm=6.0), tolerance="preview")
    image = torch.rand(1, 3, 128, 256)
    depth = torch.where(torch.arange(256) < 128, 1.2, 2.0).expand(1, 1, 128, 256)
    plan = dof.plan(image, depth)
    text = str(plan)
    assert text.startswith("256 x 128, tolerance 4/255, predicted error ")
    assert "50% in focus" in text and "copy" in text and "mixed and hidden surfaces" in text
    assert len(text.splitlines()) == 3 + len(plan.nodes)
    assert torch.equal(dof(image, depth, plan=plan), dof(image, depth))


def test_a_batch_and_depths_that_are_not_numbers_are_surveyed() -> None:
    coc = torch.cat([two_planes(), two_planes().flip(3)])
    coc[0, 0, 0, 0] = torch.nan
    found = survey(Plan.of_scene(coc, 1 / 255), coc, DISC, layered=True, occlusion=True)
    near = found.layers[0]
    assert near.box == (0, 0, 320, 192) and near.frame == pytest.approx(2 / 5)
    assert sum(layer.pixels for layer in found.layers) == pytest.approx(1.0)
