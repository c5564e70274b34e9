from typing import Any

import pytest
import torch
from torch import Tensor

import torchdof
from torchdof.reference.scenes import posts, waves
from torchdof.render.attention import box_around, weight_map
from torchdof.validation import NAMED_TOLERANCES


def scene(height: int = 192, width: int = 320) -> tuple[Tensor, Tensor]:
    """Light and signed coc of a slope behind posts."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in (height, width)), indexing="ij")
    near = posts(80.0, 12.0)(x, y)
    light = torch.where(near, waves(2)(x, y), waves(1)(x, y)).float()[None]
    return light, torch.where(near, -5.0, 8.0 * y / height - 1.0).float()[None, None]


def test_the_tolerance_applies_where_the_viewer_looks_and_draft_elsewhere() -> None:
    image, coc = scene()
    final, draft = (torchdof.blur_by_coc(image, coc, tolerance=t) for t in ("final", "draft"))
    attended = torchdof.blur_by_coc(image, coc, tolerance="final", attention=(60.0, 96.0, 24.0))
    weight = weight_map((60.0, 96.0, 24.0), image)[0, 0]
    inside, outside = (attended - final).abs().amax((0, 1)), (attended - draft).abs().amax((0, 1))
    assert torch.equal(attended, torchdof.blur_by_coc(image, coc, attention=weight[None, None])), "it may be a map"
    assert float((final - draft).abs()[..., weight == 1].max()) > 1e-3, "a draft is no different here"
    assert float(inside[weight == 1].max()) < 2e-5
    assert float(outside[weight == 0].max()) == 0.0


def test_attention_everywhere_or_nowhere_equals_one_tolerance() -> None:
    image, coc = scene(96, 160)
    everywhere = torch.ones(1, 1, 96, 160)
    assert torch.equal(torchdof.blur_by_coc(image, coc, attention=everywhere), torchdof.blur_by_coc(image, coc))
    assert torch.equal(
        torchdof.blur_by_coc(image, coc, attention=0 * everywhere), torchdof.blur_by_coc(image, coc, tolerance="draft")
    )
    loose = torchdof.blur_by_coc(image, coc, tolerance=0.05, attention=(80, 40, 10))
    assert torch.equal(loose, torchdof.blur_by_coc(image, coc, tolerance=0.05))


def test_the_circle_fades_out_over_a_quarter_of_its_radius() -> None:
    weight = weight_map((20.5, 10.5, 8.0), torch.zeros(1, 3, 21, 41))[0, 0, 10]
    assert weight[20] == 1 and weight[28] == 1 and weight[29] == pytest.approx(0.5) and weight[30] == 0


def test_the_box_contains_all_pixels_whose_blur_reaches_the_attended_area() -> None:
    weight = torch.zeros(1, 1, 400, 600)
    weight[..., 200:210, 300:301] = 0.1
    box = box_around(weight, 50.0)
    assert box is not None
    rows, columns = box
    assert rows.start <= 150 and rows.stop >= 260 and columns.start <= 250 and columns.stop >= 351
    assert rows.start % 64 == 0 and columns.start % 64 == 0 and rows.stop <= 400
    assert box_around(0 * weight, 50.0) is None


def test_attention_supports_batches_backgrounds_and_gradients() -> None:
    image, coc = scene(96, 160)
    both, cocs = torch.cat([image, image.flip(3)]), torch.cat([coc, coc.flip(3)]).requires_grad_()
    behind = torch.full_like(both, 0.3), torch.full_like(cocs, 9.0)
    out = torchdof.blur_by_coc(both, cocs, background=behind[0], background_coc_px=behind[1], attention=(40, 40, 10))
    assert out.shape == both.shape
    out.square().sum().backward()
    assert cocs.grad is not None and bool(torch.isfinite(cocs.grad).all()) and float(cocs.grad.abs().max()) > 0


MESSAGE = r"attention must be .*radius.*, got "
BAD = [(1, 2), (1, 2, 0), (1, 2, "x"), "centre", torch.ones(2, 3), (1, 2, True)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"attention": value}, MESSAGE) for value in BAD),
        ({"attention": torch.full((1, 1, 32, 40), 1.5)}, "from 0 to 1"),
        ({"attention": (3, 3, 3), "plan": torchdof.render.plan.Plan((0.0, 1.0), 1 / 255)}, "leave plan out"),
    ],
)
def test_invalid_attention_is_refused(options: dict[str, Any], message: str) -> None:
    image, coc = scene(32, 40)
    with pytest.raises(ValueError, match=message):
        torchdof.blur_by_coc(image, coc, **options)


def test_named_tolerances_equal_their_numbers() -> None:
    image, coc = scene(96, 160)
    for name, value in NAMED_TOLERANCES.items():
        named = torchdof.blur_by_coc(image, coc, tolerance=name)  # type: ignore[arg-type]
        assert torch.equal(named, torchdof.blur_by_coc(image, coc, tolerance=value))
        assert torchdof.DepthOfField(torchdof.Camera(), tolerance=name).tolerance == value  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="or one of 'draft', 'preview', 'final', got 'fine'"):
        torchdof.blur_by_coc(image, coc, tolerance="fine")  # type: ignore[arg-type]
