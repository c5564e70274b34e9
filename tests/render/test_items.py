"""Items of a batch are rendered together, each as it is alone."""

import random
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from examples.benchmarks.steps import Counted
from tests.scenes import TABLES, assert_same_picture, random_scene
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.render.layers.plan import Plan

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
        assert_same_picture(alone.detach(), together[i : i + 1].detach(), torch.nan_to_num(images[i : i + 1]))


OPTIONS: list[dict[str, Any]] = [
    *({"table": table, "occlusion": occlusion} for table in TABLES for occlusion in (True, False)),
    {"background": torch.full((5, 3, *SIZE), 0.3), "background_coc_px": torch.full((5, 1, *SIZE), 31.0)},
    {"matte": (torch.rand(5, 1, *SIZE, generator=torch.Generator().manual_seed(7)) * 1.5).clamp(max=1.0)},
    {"check": False},
    {"tolerance": "draft", "normalize": False, "occlusion": False},
    {"depth_edges": "repair"},
]


@pytest.mark.parametrize("number", range(len(OPTIONS)))
def test_an_item_of_a_batch_is_rendered_as_alone(number: int) -> None:
    options, (images, cocs) = OPTIONS[number], batch(number)
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


RANDOM = [*range(8), *(pytest.param(seed, marks=pytest.mark.sweep) for seed in range(8, 400))]


@pytest.mark.parametrize("seed", RANDOM)
def test_an_item_of_any_batch_with_lamps_is_rendered_as_alone(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With largest radii of 1 to 64 px, planned for each item, by one plan for all, or with gradients."""
    monkeypatch.setenv("TORCHDOF_ENGINE", "auto" if seed % 4 == 1 else "torch")
    draw = random.Random(seed)
    radii = tuple(64.0 ** draw.random() for _ in range(draw.randint(2, 5)))
    images, cocs = batch(seed, radii)
    lamps = torch.rand(len(radii), 1, *SIZE, generator=torch.Generator().manual_seed(seed))
    images = 0.2 * torch.where(lamps < draw.choice([0.0, 0.002, 0.05]), 500.0 * draw.random(), images)
    plan = draw.choice([None, None, Plan.static(draw.choice([max(radii), 24.0]), 1 / 255, rays=True)])
    if plan is None and draw.random() < 0.4:  # grows for items with a larger blur
        plan = Plan.for_scene(0.5 * cocs[:1], 2 / 255, adapt=False)
    options: dict[str, Any] = {"plan": plan, "table": draw.choice(TABLES), "occlusion": draw.random() < 0.7}
    options["depth_edges"] = draw.choice(["auto", "as given"])
    if draw.random() < 0.2:
        options |= {"plan": None, "attention": (40.0, 20.0, 6.0)}
    elif draw.random() < 0.2:
        options["table"] = BlurTable.polygon(5, vignetting=0.4)
    assert_like_alone(images, cocs.requires_grad_(draw.random() < 0.3), **options)


def test_layers_with_gradients_are_those_of_each_item() -> None:
    images, cocs = batch(1, (2.0, 30.0))
    assert_like_alone(images, cocs.requires_grad_())
    dof = DepthOfField(Camera.from_fov(40.0, 0.09, 3.0))
    rgba = torch.rand(2, 2, 4, 24, 32, generator=torch.Generator().manual_seed(0))
    depth = torch.tensor([[2.5, 4.0], [0.6, 30.0]], requires_grad=True)
    together = dof.layers(rgba, depth).detach()
    for i in range(2):
        alone = dof.layers(rgba[i : i + 1], depth[i : i + 1]).detach()
        assert_same_picture(alone, together[i : i + 1], rgba[i : i + 1, 0])


@pytest.mark.parametrize("occlusion", [True, False])
def test_a_batch_takes_hardly_more_operations_than_its_most_expensive_item(occlusion: bool) -> None:
    images, cocs = batch(1, (2.0, 12.0, 30.0, 7.0))

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
