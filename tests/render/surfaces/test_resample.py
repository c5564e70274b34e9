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


def stretched_to(depth: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """A map as an estimator gives it that squeezes every image into its own size."""
    return functional.interpolate(depth, (height, width), mode="nearest")


@pytest.mark.parametrize(("height", "width"), [(64, 64), (32, 32), (132, 194), (128, 64), (37, 90)])
def test_a_map_of_another_shape_is_stretched_with_a_warning(height: int, width: int) -> None:
    """Estimators work on squares, or at multiples of several pixels: 194 x 132 instead of 194 x 129 for 96 x 64."""
    image, depth = scene()
    share = max(width * 64 / (height * 96), height * 96 / (width * 64)) - 1
    with pytest.warns(
        UserWarning, match=f"depth of {width} x {height} px stretched by {share:.1%} to the shape of the im"
    ):
        sized = at_size_of(image, stretched_to(depth, height, width))
    assert float(((sized / depth - 1).abs() > 0.01).float().mean()) < 0.02


def test_a_map_that_is_larger_along_one_side_only_is_averaged_there_and_enlarged_smoothly_along_the_other() -> None:
    ramp = torch.linspace(1.0, 1.1, 24).expand(1, 1, 40, 24)
    with pytest.warns(UserWarning, match="stretched"):
        sized = at_size_of(torch.full((1, 3, 20, 48), 0.5), 1.0 / ramp)
    assert float((1.0 / sized).diff(dim=-1).max()) < 1.2 * 0.1 / 47


@pytest.mark.parametrize(("height", "width"), [(96, 64), (48, 32), (49, 32)])
def test_a_turned_map_is_refused(height: int, width: int) -> None:
    with pytest.raises(
        ValueError, match=f"depth is {width} x {height} pixels and the image 96 x 64: turned by 90 degr"
    ):
        at_size_of(scene()[0], torch.ones(1, 1, height, width))


def test_the_module_resamples_a_smaller_map_and_stretches_one_of_another_shape() -> None:
    image, depth = scene()
    dof, small = DepthOfField(Camera.from_fov(40.0, 0.05, 5.0)), depth[..., 1::2, 1::2]
    assert torch.equal(dof(image, small), dof(image, at_size_of(image, small)))
    square = stretched_to(depth, 64, 64)
    with pytest.warns(UserWarning, match=r"depth of 64 x 64 px stretched by 50\.0% to the shape of the image"):
        out = dof(image, square)
    with pytest.warns(UserWarning, match="stretched"):
        assert torch.equal(out, dof(image, at_size_of(image, square)))
    with pytest.raises(ValueError, match="turned by 90 degrees it fits; it needs the orientation of the image"):
        dof(image, small.mT)
