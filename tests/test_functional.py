"""Scatter of pixels with kernels of their own, against plain loops."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests import loops
from tests.refused import refuses
from tests.tolerances import TOLERANCES
from tests.traced import TRACED
from torchdof import BlurTable
from torchdof.functional import splat

WIDE = torch.float64
COLOURS = BlurTable("gaussian", [1.0], {"sigma": [[0.4], [0.5], [0.6]]}, name="colours")
TABLES = [BlurTable.disc(), BlurTable.gaussian(), *map(BlurTable.load, ("sato_j15", "double_gauss_50mm_f2")),
          BlurTable.polygon(5), COLOURS]  # fmt: skip


def scene(batch: int = 2, most_px: float = 4.0, height: int = 7, width: int = 9) -> tuple[Tensor, Tensor]:
    """A random image and a random map of signed radii."""
    coc = most_px * (2 * torch.rand(batch, 1, height, width, dtype=WIDE) - 1)
    return torch.rand(batch, 3, height, width, dtype=WIDE), coc


@pytest.mark.parametrize("normalize", [True, False])
@pytest.mark.parametrize("table", TABLES, ids=str)
def test_scatter_equals_a_plain_loop_with_a_kernel_for_each_pixel(table: BlurTable, normalize: bool) -> None:
    for image, coc in (scene(1), scene(1, most_px=30.0, height=3, width=6)) if table is TABLES[0] else (scene(1),):
        expected = loops.accumulate(image, coc, table, normalize)
        assert_close(splat(image, coc, table, normalize=normalize), expected, rtol=0, atol=3e-4)


def gauss_psf(image: Tensor, c_px: Tensor) -> Tensor:
    """The layer of Gur and Wolf as published: Gaussians of a diameter, sampled at pixels, divided by their sum."""
    batch, channels, height, width = image.shape
    y, x = (t.flatten().to(WIDE) for t in torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij"))
    square = (y[:, None] - y) ** 2 + (x[:, None] - x) ** 2  # [to, from]
    c = c_px.flatten(1)[:, None]
    weight = torch.exp(-2.0 * square / c**2) / c**2
    out = weight @ image.flatten(2).transpose(1, 2) / weight.sum(2, keepdim=True)
    return out.transpose(1, 2).reshape(batch, channels, height, width)


def test_sigma_is_half_of_the_diameter_that_the_layer_of_gur_and_wolf_takes() -> None:
    image = torch.rand(2, 3, 12, 14, dtype=WIDE)
    sigma = 1.0 + 1.5 * torch.rand(2, 1, 12, 14, dtype=WIDE)
    assert_close(splat(image, sigma_px=sigma), gauss_psf(image, 2.0 * sigma), rtol=0, atol=2e-3)
    assert_close(splat(image, sigma_px=sigma), splat(image, sigma, BlurTable.gaussian(1.0)), rtol=0, atol=0)


def test_without_normalizing_light_is_kept_away_from_the_border() -> None:
    image = torch.zeros(1, 2, 31, 31)
    image[..., 15, 15] = torch.tensor([3.0, 5.0])
    summed = splat(image, torch.full((1, 1, 31, 31), -6.3), BlurTable.polygon(7), normalize=False)
    assert_close(summed.sum((2, 3)), torch.tensor([[3.0, 5.0]]))
    assert float(splat(torch.ones(1, 1, 9, 9), torch.full((1, 1, 9, 9), 3.0), normalize=False)[0, 0, 0, 0]) < 0.5
    assert_close(splat(torch.ones(1, 1, 9, 9), torch.full((1, 1, 9, 9), 3.0)), torch.ones(1, 1, 9, 9))


@pytest.mark.parametrize("normalize", [True, False])
def test_an_image_in_focus_is_returned_bit_exact(normalize: bool) -> None:
    image = torch.rand(2, 3, 8, 9)
    assert torch.equal(splat(image, torch.zeros(1, 1, 8, 9), normalize=normalize), image)


def test_items_of_batches_and_clips_equal_each_alone_and_may_share_a_map() -> None:
    image, coc = scene(6)
    together = splat(image, coc)
    for item in range(6):
        assert torch.equal(together[item], splat(image[item], coc[item]))
    assert torch.equal(splat(image, coc[:1]), splat(image, coc[:1].expand(6, -1, -1, -1)))
    clips, maps = image.unflatten(0, (2, 3)), coc.unflatten(0, (2, 3))
    assert torch.equal(splat(clips, maps), together.unflatten(0, (2, 3)))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_the_result_has_the_dtype_of_the_image(dtype: torch.dtype) -> None:
    image, coc = scene(1)
    out = splat(image.to(dtype), coc.float())
    assert out.dtype == dtype
    assert_close(out, splat(image.to(dtype).to(WIDE), coc.float()).to(dtype), **TOLERANCES[dtype])


# Gradients


@pytest.mark.parametrize("normalize", [True, False])
@pytest.mark.parametrize("table", [BlurTable.polygon(5), COLOURS], ids=["polygon", "colours"])
def test_gradients_to_image_and_coc(table: BlurTable, normalize: bool) -> None:
    image, coc = (t.requires_grad_() for t in scene(2, most_px=1.6, height=3, width=4))
    assert torch.autograd.gradcheck(lambda i, c: splat(i, c, table, normalize=normalize), (image, coc), fast_mode=True)


def test_gradients_to_sigma_and_gradients_of_these() -> None:
    image = torch.rand(1, 2, 3, 4, dtype=WIDE, requires_grad=True)
    sigma = (0.2 + torch.rand(1, 1, 3, 4, dtype=WIDE)).requires_grad_()

    for check in (torch.autograd.gradcheck, torch.autograd.gradgradcheck):
        assert check(lambda i, s: splat(i, sigma_px=s), (image, sigma), fast_mode=True)


@TRACED
def test_torch_func_has_the_same_gradient() -> None:
    image, coc = scene(1)
    wanted = coc.clone().requires_grad_()
    (expected,) = torch.autograd.grad(splat(image, wanted).square().sum(), wanted)
    assert bool(expected.any())
    assert_close(torch.func.grad(lambda c: splat(image, c).square().sum())(coc), expected)


def test_a_training_step_stores_a_few_images_for_the_backward_pass() -> None:
    image = torch.rand(1, 3, 40, 50, requires_grad=True)
    coc = (torch.rand(1, 1, 40, 50) * 8).requires_grad_()
    kept: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        splat(image, coc)
    taps = 17**2 * 40 * 50 * 4
    assert 0 < sum(kept.values()) - 17**2 * 500 * 4 < 0.2 * taps  # the second: kernels of all radii


IMAGE, COC = torch.rand(2, 3, 8, 9), torch.rand(2, 1, 8, 9)
test_invalid_arguments_are_refused_by_name = refuses(
    (lambda: splat(IMAGE), "takes coc_px, with a table, or sigma_px, of Gaussians; got neither"),
    (lambda: splat(IMAGE, COC, sigma_px=COC), "got both"),
    (lambda: splat(IMAGE, None, BlurTable.disc(), sigma_px=COC), "sigma_px .* takes no table"),
    (lambda: splat(IMAGE, sigma_px=COC[:, 0]), r"sigma_px must be \[2, 1, 8, 9\]"),
    (lambda: splat(IMAGE, COC.where(COC > 0.5, torch.nan)), "coc_px must be finite"),
    (lambda: splat(IMAGE, COC, "disc"), "table must be a torchdof.BlurTable, got str"),  # type: ignore[arg-type]
    (lambda: splat(IMAGE[:, :2], COC, COLOURS), "the table blurs 3 channels, the image has 2"),
    (lambda: splat(IMAGE, COC, BlurTable.polygon(6, vignetting=0.3)), r"vignetting.*blur_by_coc"),
    (lambda: splat(IMAGE, COC, BlurTable.polygon(6, torch.ones((), requires_grad=True))), "no gradient to the apertu"),
    (lambda: torch.vmap(splat)(IMAGE[:, None], COC[:, None]), "comes from torch.vmap"),
)  # fmt: skip
