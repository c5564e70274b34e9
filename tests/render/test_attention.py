from typing import Any

import pytest
import torch

from tests.refused import refuses
from tests.scenes import Scene
from torchdof import Camera, DepthOfField
from torchdof.reference.scenes import posts, waves
from torchdof.render.attention import box_around, weight_map
from torchdof.render.layers.plan import Plan
from torchdof.validation import NAMED_TOLERANCES


def behind_posts(height: int, width: int, items: int = 1, **options: Any) -> Scene:
    """Light and signed coc of a slope behind posts."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in (height, width)), indexing="ij")
    near = posts(80.0, 12.0)(x, y)
    light = torch.where(near, waves(2)(x, y), waves(1)(x, y))[None]
    coc_px = torch.where(near, -5.0, 8.0 * y / height - 1.0)[None, None]
    return Scene(light.repeat(items, 1, 1, 1), coc_px.repeat(items, 1, 1, 1), options)


def test_the_tolerance_applies_where_the_viewer_looks_and_draft_elsewhere() -> None:
    scene, circle = behind_posts(192, 320), (60.0, 96.0, 24.0)
    weight = weight_map(circle, scene.image)
    ways: tuple[dict[str, Any], ...] = ({}, {"tolerance": "draft"}, {"attention": circle}, {"attention": weight})
    final, draft, attended, by_map = (scene.blurred(**way) for way in ways)
    is_inside, is_outside = (weight[0, 0] == 1, weight[0, 0] == 0)
    assert torch.equal(attended, by_map)
    assert float((final - draft)[..., is_inside].abs().max()) > 1e-3, "a draft is no different here"
    assert float((attended - final)[..., is_inside].abs().max()) < 2e-5
    assert torch.equal(attended[..., is_outside], draft[..., is_outside])


def test_attention_everywhere_or_nowhere_equals_one_tolerance() -> None:
    scene, everywhere = behind_posts(96, 160), torch.ones(1, 1, 96, 160)
    assert torch.equal(scene.blurred(attention=everywhere), scene.blurred())
    assert torch.equal(scene.blurred(attention=0 * everywhere), scene.blurred(tolerance="draft"))
    assert torch.equal(scene.blurred(tolerance=0.05, attention=(80, 40, 10)), scene.blurred(tolerance=0.05))


def test_the_circle_fades_over_a_quarter_of_its_radius_and_the_box_has_all_pixels_whose_blur_reaches_it() -> None:
    row = weight_map((20.5, 10.5, 8.0), torch.zeros(1, 3, 21, 41))[0, 0, 10]
    assert row[20] == 1 and row[28] == 1 and row[29] == pytest.approx(0.5) and row[30] == 0
    weight = torch.zeros(1, 1, 400, 600)
    weight[..., 200:210, 300:301] = 0.1
    assert box_around(weight, 50.0) == (slice(128, 320), slice(192, 384))  # multiples of 64
    weight[..., 399, 0] = 0.1
    assert box_around(weight, 50.0) == (slice(128, 400), slice(0, 384))
    assert box_around(0 * weight, 50.0) is None


def test_attention_supports_batches_backgrounds_and_gradients() -> None:
    scene = behind_posts(96, 160, items=2, attention=(40, 40, 10))
    scene.options |= {"background": torch.full_like(scene.image, 0.3)}
    scene.options |= {"background_coc_px": torch.full_like(scene.coc_px, 9.0)}
    out = scene.blurred(step_px=(leaf := torch.zeros(2, 1, 96, 160, requires_grad=True)))
    (gradient,) = torch.autograd.grad(out.square().sum(), leaf)
    assert out.shape == scene.image.shape
    assert bool(torch.isfinite(gradient).all()) and bool(gradient.any())


def attending(attention: Any, **options: Any) -> Any:
    return lambda: behind_posts(32, 40).blurred(attention=attention, **options)


test_invalid_attention_is_refused = refuses(
    *((attending(value), r"attention must be .*radius.*, got ")
      for value in ((1, 2), (1, 2, 0), (1, 2, "x"), "centre", torch.ones(2, 3), (1, 2, True))),
    (attending(torch.full((1, 1, 32, 40), 1.5)), "from 0 to 1"),
    (attending((3, 3, 3), plan=Plan((0.0, 1.0), 1 / 255)), "leave plan out"),
)  # fmt: skip


def test_named_tolerances_equal_their_numbers() -> None:
    scene = behind_posts(96, 160)
    for name, value in NAMED_TOLERANCES.items():
        assert torch.equal(scene.blurred(tolerance=name), scene.blurred(tolerance=value))
        assert DepthOfField(Camera(), tolerance=name).tolerance == value  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="or one of 'draft', 'preview', 'final', got 'fine'"):
        scene.blurred(tolerance="fine")
