"""Single images and clips are rendered like a batch of their items."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.refused import refuses
from torchdof import Camera, DepthOfField, blur_by_coc

DOF = DepthOfField(Camera(focus_m=1.0, sensor_width_mm=6.0))


def clips() -> tuple[Tensor, Tensor]:
    return torch.rand(2, 3, 3, 9, 12), 0.6 + 3 * torch.rand(2, 3, 1, 9, 12)


def test_a_single_image_is_rendered_like_a_batch_of_one() -> None:
    images, depths = clips()
    out = DOF(images[0, 1], depths[0, 1], focus_m=0.8)
    assert out.shape == (3, 9, 12)
    assert torch.equal(out, DOF(images[0, 1:2], depths[0, 1:2], focus_m=0.8)[0])
    coc = DOF.coc_px(images[0, 1], depths[0, 1])
    assert torch.equal(coc, DOF.coc_px(images[0, 1:2], depths[0, 1:2])[0])
    assert torch.equal(blur_by_coc(images[0, 1], coc), blur_by_coc(images[0, 1:2], coc[None])[0])
    assert DOF.plan(images[0, 1], depths[0, 1]).coc_px == DOF.plan(images[0, 1:2], depths[0, 1:2]).coc_px


@pytest.mark.parametrize(("focus_m", "each"), [
    (0.9, [0.9] * 6),
    ([0.8, 2.0], [0.8] * 3 + [2.0] * 3),
    (torch.tensor([[0.8], [2.0]], dtype=torch.float64), [0.8] * 3 + [2.0] * 3),
    (torch.tensor([[0.8, 0.9, 1.0], [2.0, 1.5, 1.0]], dtype=torch.float64), [0.8, 0.9, 1.0, 2.0, 1.5, 1.0]),
])  # fmt: skip
def test_clips_are_rendered_frame_by_frame(focus_m: Any, each: list[float]) -> None:
    images, depths = clips()
    expected = DOF(images.flatten(0, 1), depths.flatten(0, 1), focus_m=torch.tensor(each, dtype=torch.float64))
    assert torch.equal(DOF(images, depths, focus_m=focus_m), expected.unflatten(0, (2, 3)))


def test_maps_may_be_shared_by_clips_or_frames() -> None:
    images, depths = clips()
    for depth in (depths[:1, :1], depths[:, :1], depths[:1]):
        assert torch.equal(DOF(images, depth), DOF(images, depth.expand(2, 3, -1, -1, -1).contiguous()))


def test_background_and_attention_of_a_single_image_have_its_rank() -> None:
    images, depths = clips()
    hidden: dict[str, Any] = {"background": images[0, 1], "background_depth": torch.full((1, 9, 12), 9.0)}
    out = DOF(images[0, 0], depths[0, 0], **hidden)
    assert torch.equal(out, DOF(images[:1, 0], depths[:1, 0], **{name: t[None] for name, t in hidden.items()})[0])
    look = torch.rand(1, 9, 12)
    out = DOF(images[0, 0], depths[0, 0], attention=look)
    assert torch.equal(out, DOF(images[:1, 0], depths[:1, 0], attention=look[None])[0])


def shown(image: tuple[int, ...], depth: tuple[int, ...], focus_m: Any = None) -> Callable[[], Tensor]:
    return lambda: DOF(torch.rand(image), torch.ones(depth), focus_m=focus_m)


test_mismatched_shapes_are_refused = refuses(
    (shown((3, 9, 12), (1, 1, 9, 12)), r"depth must be \[1, H, W\] beside an image \[C, H, W\]"),
    (shown((2, 3, 3, 9, 12), (3, 3, 1, 9, 12)), r"depth must be \[2, 3, 1, H, W\]"),
    (shown((2, 3, 3, 9, 12), (2, 3, 1, 9, 12), [1.0, 2.0, 3.0]), r"focus_m must be a number, \[2\] or \[2, 3\]"),
    (shown((2, 3, 9, 12), (2, 1, 9, 12), ["near", 2.0]), "focus_m must be a number, a list of numbers"),
    (shown((2, 3, 3, 9, 12), (2, 3, 1, 9, 12), torch.ones(2).to_sparse()), r"focus_m must be a tensor \[B\].*dense"),
    (shown((3, 12), (1, 12)), r"image must be \[B, C, H, W\]"),
    (shown((0, 0, 0), (1, 0, 0)), "image must be .* with at least one pixel"),
    (shown((2, 0, 3, 0, 0), (2, 0, 1, 0, 0)), "image must be .* with at least one pixel"),
)


def test_vmap_is_refused_by_name() -> None:
    images, depths = clips()
    for call in (DOF, torch.func.grad(lambda image, depth: DOF(image, depth).sum())):
        with pytest.raises(ValueError, match=r"image comes from torch\.vmap"):
            torch.vmap(call)(images[:, :1], depths[:, :1])
    for shape in ((2,), (2, 1)):
        with pytest.raises(ValueError, match=r"focus_m comes from torch\.vmap"):
            torch.vmap(lambda s: DOF(images[:, 0], depths[:, 0], focus_m=s))(torch.ones(shape))
