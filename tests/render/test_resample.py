"""Resampling depth maps to the size of their image."""

import pytest
import torch
import torch.nn.functional as functional

from torchdof import Camera, DepthOfField
from torchdof.depth import at_size_of


def scene(height: int = 64, width: int = 96) -> tuple[torch.Tensor, torch.Tensor]:
    """A dark square in front of a bright wall, with some noise."""
    image, depth = 0.8 + 0.05 * torch.rand(1, 3, height, width), torch.full((1, 1, height, width), 5.0)
    image[..., 17:47, 23:61] -= 0.7
    depth[..., 17:47, 23:61] = 2.0
    return image, depth


@pytest.mark.parametrize("factor", [2, 4, 6])
def test_a_smaller_map_gets_the_edges_of_the_image(factor: int) -> None:
    image, depth = (functional.interpolate(values, scale_factor=2) for values in scene(48, 96))
    small = 1 / functional.avg_pool2d(1 / depth, factor)
    soft = 1 / functional.interpolate(1 / small, scale_factor=factor, mode="bilinear")
    wrong, before = (((sized / depth - 1).abs() > 0.01).float().mean() for sized in (at_size_of(image, small), soft))
    assert float(wrong) < 0.15 * float(before)


def test_a_map_of_the_size_of_the_image_is_returned_itself_and_a_larger_one_is_averaged() -> None:
    image, depth = scene()
    assert at_size_of(image, depth) is depth
    large = depth.repeat_interleave(2, -1).repeat_interleave(2, -2)
    torch.testing.assert_close(at_size_of(image, large), depth)


def test_pixels_without_depth_do_not_affect_others() -> None:
    image, depth = scene()
    small = depth[..., 1::2, 1::2].clone()
    small[..., :4, :4] = 0.0
    sized = at_size_of(image, small)
    assert bool(sized[..., :8, :8].isnan().all())
    assert float(sized[~sized.isnan()].min()) > 1.9


@pytest.mark.parametrize(("height", "width"), [(64, 64), (32, 45), (33, 47), (32, 50)])
def test_another_aspect_ratio_is_refused(height: int, width: int) -> None:
    with pytest.raises(ValueError, match=f"depth is {width} x {height} pixels and the image 96 x 64.* crop one"):
        at_size_of(scene()[0], torch.ones(1, 1, height, width))


def test_the_module_resamples_a_smaller_map_and_stretches_one_of_nearly_the_aspect_ratio() -> None:
    """Estimators work at multiples of several pixels: here 194 x 132 instead of 194 x 129 for 96 x 64."""
    image, depth = scene()
    dof, small = DepthOfField(Camera.from_fov(40.0, 0.05, 5.0)), depth[..., 1::2, 1::2]
    assert torch.equal(dof(image, small), dof(image, at_size_of(image, small)))
    with pytest.raises(ValueError, match=r"depth must be \[1, 1, 64, 96\].* got \[1, 1, 20, 48\]"):
        dof(image, depth[..., :20, ::2])
    near = functional.interpolate(depth, (132, 194), mode="nearest")
    with pytest.warns(UserWarning, match=r"depth is stretched by 2\.1% to the shape of the image"):
        out = dof(image, near)
    assert torch.equal(out, dof(image, at_size_of(image, near)))
    assert float((at_size_of(image, near) - depth).abs().median()) < 1e-4
