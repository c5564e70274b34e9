"""Exported files repair depth edges and render the pictures of the PyTorch engine."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from tests.scenes import furry_post, resized_post, shifted_disc, wavy_post
from torchdof import Camera, blur_by_coc
from torchdof.export import describe
from torchdof.export.verification import TOLERANCE, local_range, session
from torchdof.options import DepthEdges
from torchdof.reference.degraded import degrade
from torchdof.reference.scenes import Plane, plane_scene, posts, waves
from torchdof.render.layers.plan import Plan
from torchdof.render.rules import without
from torchdof.render.surfaces import edges

KINDS = ("half-res", "near -1px", "exact")


@pytest.fixture(scope="module")
def tensors() -> tuple[Tensor, Tensor]:
    """Posts and lamps in front of a wall in focus, CoC from -2 px: edges soft, foreground 1 px too thin, exact."""
    planes = [
        Plane(6.0, waves(1, mean=(0.5, 0.4, 0.3))),
        Plane(1.2, waves(3, mean=(0.35, 0.1, 0.1)), posts(67.0, 9.0, -0.4, 11.0)),
    ]
    scene = plane_scene(planes, Camera.from_fov(fov_x_deg=40.0, aperture_radius_m=0.02, focus_m=6.0), (90, 141), 4)
    image, depth = scene.image[:, 1:2].float(), scene.depth.clone()
    for row in range(10, 90, 16):
        lamp = (..., slice(row, row + 3), slice(57 + row // 3, 60 + row // 3))
        image[lamp], depth[lamp] = 50.0, 1.2
    near = [1.0 / degrade(depth, kind) for kind in KINDS]
    coc = [-2.0 * (n - 1.0 / 6.0) / (1.0 / 1.2 - 1.0 / 6.0) for n in near]
    return image.repeat(len(KINDS), 1, 1, 1), torch.cat(coc).float()


@pytest.fixture(scope="module")
def runner(exported_by_command: tuple[Path, str]) -> onnxruntime.InferenceSession:
    return session(exported_by_command[0])


def rendered(image: Tensor, coc: Tensor, treatment: DepthEdges) -> Tensor:
    """The picture of the PyTorch engine with the layers of the file."""
    plan = Plan.static(2.0, 1 / 255, rays=True)
    with torch.no_grad():
        return blur_by_coc(image, coc, plan=plan, max_coc_px=2.0, occlusion=False, check=False, depth_edges=treatment)


def error(got: np.ndarray, expected: Tensor, image: Tensor) -> float:
    return float(((torch.from_numpy(np.array(got)) - expected).abs() / local_range(image, 4)).max())


def test_a_file_repairs_the_same_edges_as_the_module(
    runner: onnxruntime.InferenceSession, tensors: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    image, coc = tensors
    expected, given = (rendered(image, coc, treatment) for treatment in ("auto", "as given"))
    assert [bool(d > 0.05) for d in (expected - given).abs().amax((1, 2, 3))] == [True, True, False]
    got = runner.run(None, {"image": image.numpy(), "coc_px": coc.numpy()})[0]
    assert error(got, expected, image) <= TOLERANCE


def test_a_file_estimates_the_step_from_the_same_part_of_a_frame_as_the_module(
    runner: onnxruntime.InferenceSession, tensors: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    image, (_, thin, exact) = tensors[0][:1].repeat(1, 1, 3, 4), tensors[1].repeat(1, 1, 3, 4)
    assert image[0, 0].numel() > edges._SAMPLED
    is_right = torch.arange(image.shape[-1]) > torch.arange(image.shape[-2])[:, None]
    coc = torch.where(is_right, thin, exact)[None]
    expected = rendered(image, coc, "auto")
    assert float((expected - rendered(image, coc, "as given")).abs().max()) > 0.05
    got = runner.run(None, {"image": image.numpy(), "coc_px": coc.numpy()})[0]
    assert error(got, expected, image) <= TOLERANCE


def test_a_file_without_edges_to_repair_is_bit_exact_in_focus(
    exported_by_command: tuple[Path, str], runner: onnxruntime.InferenceSession, tensors: tuple[Tensor, Tensor]
) -> None:
    assert describe(exported_by_command[0])["depth_edges"] == "auto"
    image = tensors[0]
    got = runner.run(None, {"image": image.numpy(), "coc_px": np.zeros_like(tensors[1])})[0]
    assert np.array_equal(got, image.numpy())


@pytest.mark.parametrize(
    ("scene", "edit"),
    [
        *((resized_post, edit) for edit in [(-3, []), (3, []), (-4, [5, 5]), (5, [5, 5]), (0, [])]),
        *((shifted_disc, edit) for edit in [(1, 0, []), (-4, 2, []), (3, -2, [3]), (0, 3, [5, 5])]),
    ],
)
def test_a_file_resizes_foregrounds_and_shifts_maps(
    scene: Callable[..., tuple[Tensor, Tensor, Tensor]],
    edit: tuple[Any, ...],
    runner: onnxruntime.InferenceSession,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In a loop, whose number of steps depends on the frame; beside it another item that needs none."""
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    image, coc, exact = scene(0.1, *edit)
    image, coc = image[:, :1].repeat(2, 1, 1, 1), torch.cat([coc, exact]) / 6.0
    expected = rendered(image, coc, "auto")
    with without(["registration"]):
        assert (float((expected - rendered(image, coc, "auto")).abs().max()) > 0.05) == (edit != (0, []))
    got = runner.run(None, {"image": image.numpy(), "coc_px": coc.numpy()})[0]
    assert error(got, expected, image) <= TOLERANCE


@pytest.mark.parametrize(("factor", "halvings"), [(3, 0), (8, 1), (16, 2), (24, 2)])
def test_a_file_narrows_the_ramps_of_enlarged_maps(
    factor: int, halvings: int, runner: onnxruntime.InferenceSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a half or a quarter of the size; beside it another item that needs none, and an invalid value."""
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    image, _, exact = resized_post(0.1, 0, [])
    exact = torch.where(exact < 0.0, -2.0, 2.0)
    small = functional.avg_pool2d(exact, factor, ceil_mode=True)
    coc = functional.interpolate(small, scale_factor=float(factor), mode="bilinear")[..., : exact.shape[-2], :160]
    coc[..., 20, 30] = torch.nan
    image, coc = image[:, :1].repeat(2, 1, 1, 1), torch.cat([coc, exact])
    expected = rendered(image, coc, "auto")
    for fewer in range(halvings):
        repair = functools.partial(edges.repair, halvings=fewer)
        with monkeypatch.context() as patch:
            patch.setattr(edges, "repair", repair)
            assert float((expected - rendered(image, coc, "auto")).nan_to_num().abs().max()) > 0.05
    got = runner.run(None, {"image": image.numpy(), "coc_px": coc.numpy()})[0]
    assert torch.from_numpy(np.array(got)).isnan().equal(expected.isnan())
    assert error(np.nan_to_num(got), expected.nan_to_num(), image) <= TOLERANCE


@pytest.mark.parametrize(("scene", "rule"), [(furry_post, "missed_parts"), (wavy_post, "in_doubt")])
def test_a_file_blurs_what_the_map_misses_and_edges_in_doubt(
    scene: Callable[[], tuple[Tensor, Tensor, Tensor]],
    rule: str,
    runner: onnxruntime.InferenceSession,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    image, coc, _ = scene()
    image = image[:, :1].contiguous()
    expected = rendered(image, coc, "auto")
    with without([rule]):
        assert float((expected - rendered(image, coc, "auto")).abs().max()) > 0.1
    got = runner.run(None, {"image": image.numpy(), "coc_px": coc.numpy()})[0]
    assert error(got, expected, image) <= TOLERANCE
