"""Items of a batch are rendered together, each as it is alone."""

from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from examples.benchmarks.steps import Counted
from tests.scenes import TABLES, assert_same_picture, random_scene
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.render.layer_weights import blur_axis, ramps, weights_at_or_behind
from torchdof.render.plan import Plan, joined_layers

SIZE = (48, 64)
RADII = (1.5, 30.0, 4.0, 0.0, 9.0)  # px: different layers, resolutions and pyramids; one item is in focus


def batch(seed: int, radii: tuple[float, ...] = RADII) -> tuple[Tensor, Tensor]:
    """Random scenes ``[B, 3, H, W]`` of which the largest blurs are ``radii``."""
    images, cocs = [], []
    for i, radius in enumerate(radii):
        scene = random_scene(seed + 100 * i)
        maps = (functional.interpolate(t, size=SIZE, mode="nearest") for t in (scene.image, scene.coc_px))
        image, coc = (t.float() for t in maps)
        images.append(image.expand(1, 3, -1, -1))
        cocs.append(coc * radius / float(coc.abs().max()))
    return torch.cat(images), torch.cat(cocs)


def assert_like_alone(images: Tensor, cocs: Tensor, **options: Any) -> None:
    together = blur_by_coc(images, cocs, **options)
    for i in range(len(images)):
        own: dict[str, Any] = {name: t[i : i + 1] if isinstance(t, Tensor) else t for name, t in options.items()}
        alone = blur_by_coc(images[i : i + 1], cocs[i : i + 1], **own)
        assert_same_picture(alone, together[i : i + 1], torch.nan_to_num(images[i : i + 1]))


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name or "unnamed")
@pytest.mark.parametrize("occlusion", [True, False])
def test_an_item_of_a_batch_is_rendered_as_alone(table: BlurTable, occlusion: bool) -> None:
    assert_like_alone(*batch(2 * TABLES.index(table) + occlusion), table=table, occlusion=occlusion)


@pytest.mark.parametrize(
    "options",
    [
        {"check": False},
        {"background": torch.full((5, 3, *SIZE), 0.3), "background_coc_px": torch.full((5, 1, *SIZE), 31.0)},
        {"tolerance": "draft", "normalize": False, "occlusion": False},
        {"depth_edges": "repair"},
    ],
    ids=lambda options: next(iter(options)),
)
def test_an_item_is_rendered_as_alone_with_any_option(options: dict[str, Any]) -> None:
    images, cocs = batch(7)
    if options.get("check") is False:
        images[1, :, 5:9, 5:9], cocs[2, :, 20:, 40:] = torch.nan, torch.nan
    images[4, :, 10:12, 30:33] = 500.0  # a lamp, and light too bright for its powers
    images[1, :, 30, 30] = 1e20
    assert_like_alone(images, cocs, **options)


def test_highlights_of_an_item_do_not_depend_on_those_of_another() -> None:
    """Its number of rays and the blurs of its occluders are those of the item rendered alone."""
    images, cocs = batch(3, (20.0, 17.3, 20.0))
    images = images * 0.01
    images[0, :, ::5, ::5] = 50.0  # more rays than are affordable
    images[1:, :, 4::11, 3::9] = 50.0
    cocs[1], cocs[1, :, :, 20:28] = 17.3, -3.1  # a post in front of lamps
    cocs[2] = 40.0 * torch.rand(SIZE, generator=torch.Generator().manual_seed(1)) - 20.0
    assert_like_alone(images, cocs, depth_edges="as given")


@pytest.mark.parametrize("occlusion", [True, False])
def test_a_batch_takes_hardly_more_operations_than_its_most_expensive_item(occlusion: bool) -> None:
    images, cocs = batch(0, (2.0, 12.0, 30.0, 7.0))

    def operations(images: Tensor, cocs: Tensor) -> int:
        blur_by_coc(images, cocs, occlusion=occlusion)  # some tensors are made once
        with Counted() as counted:
            blur_by_coc(images, cocs, occlusion=occlusion)
        return counted.operations

    alone = [operations(images[i : i + 1], cocs[i : i + 1]) for i in range(4)]
    assert operations(images, cocs) < 1.5 * max(alone) < 0.7 * sum(alone)


@pytest.mark.parametrize("tolerance", ["draft", "final"])
def test_a_stack_in_a_batch_is_rendered_as_alone(tolerance: Any) -> None:
    dof = DepthOfField(Camera.from_fov(40.0, 0.09, 3.0), tolerance=tolerance)
    rgba = torch.rand(2, 2, 4, 24, 32, generator=torch.Generator().manual_seed(0))
    depth = torch.tensor([[1.2, 4.0], [0.6, 30.0]])
    together = dof.layers(rgba, depth)
    for i in range(2):
        assert_same_picture(dof.layers(rgba[i : i + 1], depth[i : i + 1]), together[i : i + 1], rgba[i : i + 1, 0])


def test_layers_of_several_plans_are_joined_by_side_and_resolution() -> None:
    plans = [
        Plan.for_scene(torch.tensor(ends).reshape(1, 1, 1, -1).expand(1, 1, 100, -1), 1 / 255, adapt=False)
        for ends in ([-40.0, 3.0], [-1.0, 0.0, 25.0], [5.0, 9.0])
    ]
    nodes, blurs = joined_layers(plans, BlurTable.disc(), SIZE, torch.empty(0, dtype=torch.float64))
    assert len(blurs) == len(nodes[0]) < sum(len(plan.nodes) for plan in plans)
    for item, (plan, places) in enumerate(zip(plans, nodes, strict=True)):
        x = blur_axis(torch.linspace(-41.0, 26.0, 300).double()).clamp(plan.nodes[0], plan.nodes[-1])
        behind = weights_at_or_behind(x.reshape(1, 1, 1, -1), ramps([places], x))[0, :, 0]
        of_layer = behind[:-1] - behind[1:]
        used = of_layer.sum(1) > 0
        assert [place for place, is_used in zip(places, used, strict=True) if is_used] == list(plan.nodes)
        alone = weights_at_or_behind(x.reshape(1, 1, 1, -1), ramps([plan.nodes], x))[0, :, 0]
        torch.testing.assert_close(of_layer[used], alone[:-1] - alone[1:])
        own = plan.layer_kernels(BlurTable.disc(), SIZE, torch.float64, torch.device("cpu"), True)
        joined = [blur for blur, is_used in zip(blurs, used, strict=True) if is_used]
        for blur, alone_blur in zip(joined, own, strict=True):
            assert blur.scale == alone_blur.scale
            spare = blur.half - alone_blur.half
            inside = slice(spare, blur.kernel.shape[-1] - spare)
            torch.testing.assert_close(blur.kernel[item, :, inside, inside], alone_blur.kernel)
            torch.testing.assert_close(blur.kernel[item].sum(), alone_blur.kernel.sum())
