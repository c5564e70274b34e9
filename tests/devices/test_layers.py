"""The layers by kernels are those of the plain engine, forward and backward; kernels and host code run on the CPU."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from tests import on_cpu
from tests.scenes import CAMERA, CASES, Case, assert_same_picture, post_before_lamps, random_scene
from torchdof import BlurTable, DepthOfField, blur_by_coc
from torchdof.kernels import edges, layers, loader, matting, rays
from torchdof.render import pipeline
from torchdof.render.engines import on_gpu
from torchdof.render.layers import composite
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.frame import PaddedFrame, maps_of, surfaces_of
from torchdof.tensors import TRACEABLE

Padded = tuple[PaddedFrame, on_gpu.Kernels]


@pytest.fixture
def frames(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> list[Padded]:
    """The padded frames that kernels composite, and the kernels of their layers."""
    found: list[Padded] = []

    def composited(frame: PaddedFrame, kernels: on_gpu.Kernels, plain: Any) -> Tensor | None:
        found.append((frame, kernels))
        return render(frame, kernels, plain)

    render = on_gpu.composited
    monkeypatch.setattr(on_gpu, "composited", composited)
    return found


def computed(frame: PaddedFrame, kernels: on_gpu.Kernels, render: Callable[..., Tensor]) -> list[Tensor]:
    """A picture, and the gradients of a random sum over it by the surfaces."""
    leaves = [t.detach().requires_grad_() for t in maps_of(frame.surfaces)]
    picture = render(dataclasses.replace(frame, surfaces=surfaces_of(leaves, len(frame.surfaces))), kernels)
    weight = torch.rand(picture.shape, generator=torch.Generator().manual_seed(1)) - 0.3
    return [picture.detach(), *torch.autograd.grad((picture * weight).sum(), leaves)]


def assert_same_layers(frames: Sequence[Padded]) -> None:
    """Pictures differ by 1e-5 of the light nearby, gradients by 1e-4 of their norm."""
    assert frames
    plain = composite._by_convolution
    for frame, kernels in frames:
        picture, *gradients = computed(frame, kernels, functools.partial(on_gpu._by_kernels, plain=plain))
        expected, *others = computed(frame, kernels, plain)
        light, weights = picture[:, : frame.colours], picture[:, frame.colours :]
        assert_same_picture(expected[:, : frame.colours], light, light)
        assert float((weights - expected[:, frame.colours :]).abs().max()) <= 1e-5
        each = len(gradients) // len(frame.surfaces)
        for i, (gradient, other) in enumerate(zip(gradients, others, strict=True)):
            if i % each == 1:  # in focus the place does not depend on the coc
                moves = frame.surfaces[i // each].x != 0
                gradient, other = gradient * moves, other * moves
            assert float((gradient - other).norm()) <= 1e-4 * float(other.norm()), i


TABLES = {
    "disc": BlurTable.disc(),
    "triangle": BlurTable.polygon(3, 20.0, squeeze=1.6),
    "by colour": BlurTable("gaussian", [1.0], {"sigma": torch.tensor([[0.4], [0.5], [0.6]])}, name="by colour"),
}


@pytest.mark.parametrize("radius_px", [1.0, 4.0, 8.0, 16.0, 64.0])
def test_layers_of_any_radius_are_the_plain_engines(radius_px: float, frames: list[Padded]) -> None:
    light, coc = (t[..., :50, :75] for t in post_before_lamps())
    coc = coc * radius_px / 11.0
    spanned = 1.01 * coc  # ends between nodes: at a node the plain engine may leave out the layer beside it
    blur_by_coc(light, coc, depth_edges="as given", plan=Plan.for_scene(spanned, 1 / 255, adapt=False))
    assert_same_layers(frames)


@pytest.mark.parametrize("tolerance", [0.0, 8 / 255])
@pytest.mark.parametrize("table", TABLES)
def test_layers_of_any_table_and_tolerance_are_the_plain_engines(
    table: str, tolerance: float, frames: list[Padded]
) -> None:
    light, coc = (t[..., :30, 30:80] for t in post_before_lamps())
    blur_by_coc(light, (0.5 * coc).requires_grad_(), table=TABLES[table], tolerance=tolerance)
    assert_same_layers(frames)


@pytest.mark.parametrize("seed", range(6))
def test_layers_of_random_scenes_are_the_plain_engines(seed: int, frames: list[Padded]) -> None:
    """Images alone and in front of a known background, of 1 or 3 channels."""
    scene = random_scene(seed, ["filled", "background"], side=40)
    scene.coc_px = scene.coc_px.float().requires_grad_()
    scene.blurred()
    assert_same_layers(frames)


def test_layers_of_eight_channels_are_the_plain_engines_and_of_more_are_not_taken(frames: list[Padded]) -> None:
    light, coc = (t[..., :24, 40:70] for t in post_before_lamps())
    light = torch.cat([light, light.flip(-1), light.flip(-2)], 1)
    blur_by_coc(light[:, :8], coc.requires_grad_())
    assert_same_layers(frames)
    assert not on_gpu.takes([light], 9, 2)


@pytest.mark.parametrize("count", [1, 3])
def test_stacks_are_the_plain_engines(count: int, frames: list[Padded]) -> None:
    dice = torch.Generator().manual_seed(count)
    rgba = torch.rand(1, count, 4, 24, 40, generator=dice)
    rgba[:, :, -1] = (2.0 * rgba[:, :, -1] - 0.5).clamp(0.0, 1.0)
    DepthOfField(CAMERA).layers(rgba, 0.8 + 4.0 * torch.rand(1, count, 1, 24, 40, generator=dice))
    assert_same_layers(frames)


@pytest.mark.parametrize("case", [case for case in CASES if not case.options], ids=lambda case: case.name)
def test_the_error_of_a_hostile_scene_is_within_its_limit(case: Case, launched: list[str]) -> None:
    assert case.error(torch.float32) <= case.float32
    assert launched or case.float32 == 0.0  # in focus


def test_invalid_pixels_are_those_of_the_plain_engine(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    light, coc = (t[..., :40, 30:90].clone() for t in post_before_lamps())
    light[..., 5:8, 9:12], light[0, 1, 30, 40], coc[..., 20:24, 30:33] = torch.nan, torch.inf, torch.nan
    found = blur_by_coc(light, coc, check=False)
    assert launched
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    assert_same_picture(blur_by_coc(light, coc, check=False), found, torch.nan_to_num(light, 0.0, 0.0))


def test_a_batch_is_rendered_as_its_items_are_alone(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Items with layers and kernels of their own, in one launch; the last one has fewer layers."""
    light, coc = (t[..., :40, 30:90] for t in post_before_lamps(3))
    coc[2] = coc[2].clamp(-2.0, 3.0)
    for table in (BlurTable.disc(), TABLES["by colour"]):
        items = zip(light.split(1), coc.split(1), strict=True)
        alone = torch.cat([blur_by_coc(*item, table=table) for item in items])
        with monkeypatch.context() as patched:
            patched.setattr(pipeline, "_is_in_memory", lambda maps: False)
            together = blur_by_coc(light, coc, table=table)
        assert launched
        assert_same_picture(alone, together, light)


def test_layers_of_a_batch_are_the_plain_engines(frames: list[Padded], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "_is_in_memory", lambda maps: False)
    light, coc = (t[..., :40, 30:90] for t in post_before_lamps(2))
    for table in (BlurTable.disc(), TABLES["by colour"]):
        blur_by_coc(light, coc, table=table)
    assert [len(frame.nodes) for frame, _ in frames] == [2, 2]
    assert_same_layers(frames)


def with_gradients() -> list[Tensor]:
    leaves = [t[..., :40, 40:80].clone().requires_grad_() for t in post_before_lamps()]
    picture = blur_by_coc(*leaves)
    return [picture.detach(), *torch.autograd.grad(picture.square().sum(), leaves)]


def test_pictures_and_gradients_have_the_same_bits_each_time(launched: list[str]) -> None:
    """Whatever new memory contains."""
    first = with_gradients()
    with on_cpu.new_memory_of_nan():
        second = with_gradients()
    assert all(map(torch.equal, first, second))
    assert {"composite", "walk_back", "stand_ins_back", "upsample_back"} <= {*launched}


def test_the_gradient_of_a_gradient_is_the_plain_engines(launched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def curvature() -> Tensor:
        light, coc = (t[..., :20, 40:70].clone().requires_grad_() for t in post_before_lamps())
        (first,) = torch.autograd.grad(blur_by_coc(light, coc).square().sum(), coc, create_graph=True)
        (second,) = torch.autograd.grad(first.square().sum(), light)
        return second

    found = curvature()
    assert launched
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    expected = curvature()
    assert float((found - expected).norm()) <= 1e-4 * float(expected.norm())


# Where the plain engine takes over


def rendered(**options: Any) -> Tensor:
    return blur_by_coc(*(t[..., :24, 40:70] for t in post_before_lamps()), **options)


def test_inference_mode_and_offloaded_gradients_work(launched: list[str]) -> None:
    with torch.inference_mode():
        inference = rendered()
    assert torch.equal(inference, rendered()) and launched
    plain = with_gradients()
    with torch.autograd.graph.saved_tensors_hooks(lambda t: t.clone(), lambda t: t.clone()):
        offloaded = with_gradients()
    assert all(map(torch.equal, plain, offloaded))


def test_float64_and_torch_func_take_the_plain_engine_and_autocast_the_kernels(launched: list[str]) -> None:
    expected = rendered()
    launched.clear()
    light, coc = (t[..., :24, 40:70] for t in post_before_lamps())
    assert_same_picture(blur_by_coc(light.double(), coc.double()).float(), expected, light)
    if TRACEABLE:  # older PyTorch is refused by name
        torch.func.grad(lambda light: blur_by_coc(light, coc).sum())(light)
    assert not launched
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(rendered(), expected)
    assert launched


def test_without_kernels_there_is_one_warning_and_the_plain_engines_picture(
    launched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(*variant: Any) -> loader.Launch:
        raise OSError("NVRTC of CUDA 12.8 was not found")

    for kernels in (edges, layers, matting, rays):
        monkeypatch.setattr(kernels, "module", missing)
    monkeypatch.setenv("TORCHDOF_ENGINE", "auto")
    with pytest.warns(RuntimeWarning, match="slower: NVRTC of CUDA 12.8 was not found") as warned:
        found = rendered()
    assert len(warned) == 1
    rendered(background=torch.rand(1, 3, 24, 30), background_coc_px=torch.full((1, 1, 24, 30), 20.0))  # no second one
    monkeypatch.setenv("TORCHDOF_ENGINE", "gpu")
    with pytest.raises(ValueError, match="TORCHDOF_ENGINE is gpu, but NVRTC of CUDA 12.8 was not found; leave it out"):
        rendered()
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    assert_same_picture(rendered(), found, found)


@pytest.mark.parametrize(
    ("of", "wrong", "first"),
    [
        *((layers, wrong, "terms") for wrong in ("composite", "convolve_back")),
        *((matting, wrong, "find_edges") for wrong in ("split", "gather")),
    ],
)
def test_kernels_that_compute_something_else_are_not_used(
    of: Any, wrong: str, first: str, launched: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of, "module", on_cpu.without(wrong, of.module))
    monkeypatch.setenv("TORCHDOF_ENGINE", "auto")
    with pytest.warns(RuntimeWarning, match=on_cpu.OTHER_PICTURE), on_cpu.new_memory_of_nan():
        rendered()
    launched.clear()
    rendered()
    assert launched and first not in launched
