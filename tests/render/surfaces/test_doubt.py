"""Maps that the image contradicts: their edges are blurred, maps that are only too thin are not in doubt."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional
from torch.testing import assert_close

from tests.scenes import furry_post, resized_post, wavy_post
from torchdof import native
from torchdof.render.rules import without
from torchdof.render.surfaces import doubt as doubt_rule
from torchdof.render.surfaces import edges
from torchdof.render.surfaces.doubt import blurred_in_doubt, doubt_of

COMPILED = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built here")


def mended(image: Tensor, coc_px: Tensor) -> Tensor:
    return edges.mended(image, coc_px, "auto")


def test_nothing_beside_a_blurred_foreground_is_sharp_where_the_image_contradicts_the_map(engine: str) -> None:
    image, given, _ = wavy_post()
    coc = mended(image, given)[0, 0]
    post = coc < -11.0
    beside = torch.zeros_like(post)
    beside[:, 1:-1] = ~post[:, 1:-1] & (post[:, 2:] | post[:, :-2])
    assert int(beside.sum()) > 300
    assert float(coc[beside].abs().min()) > 2.0
    assert float(coc[:, :30].abs().max()) < 1.0  # far from it


def test_blur_only_rises_and_each_pixel_keeps_its_side_of_the_focus() -> None:
    image, given, _ = wavy_post()
    with without([]):
        coc = mended(image, given)
    with without(["in_doubt"]):
        before = mended(image, given)
    assert int((coc != before).sum()) > 1000
    assert bool((coc.abs() >= before.abs()).all())
    assert coc.sign().equal(before.sign())


@pytest.mark.parametrize(
    ("near", "far", "doubt"), [(0.0, 0.9, 0), (0.9, 0.0, 0), (0.2, 0.1, 1), (0.02, 0.3, 0), (0.04, 0.04, 0.6)]
)
def test_a_map_is_in_doubt_if_both_sides_of_its_edges_are_contradicted_alike(
    near: float, far: float, doubt: float
) -> None:
    clear = torch.tensor([[1e4], [1e4]])
    found = doubt_of(clear, clear * (1.0 - torch.tensor([[near], [far]])))
    assert_close(found, torch.tensor([doubt]).float(), atol=0.1, rtol=0)


def test_few_pixels_say_nothing_of_a_map() -> None:
    clear = torch.tensor([[3.0], [3.0]])
    assert not doubt_of(clear, 0.9 * clear).any()


@pytest.mark.parametrize("spread", [0.02, 0.25])
def test_a_dilated_foreground_is_narrowed_and_does_not_grow(engine: str, spread: float) -> None:
    """Neither before a smooth background, beside which foregrounds else grow, nor before one of unclear colours."""
    image, given, exact = resized_post(spread, 2, [3])
    is_near = exact < -6.0
    assert ((given < -6.0) != is_near).float().mean() > 0.02
    assert ((mended(image, given) < -6.0) != is_near).float().mean() < 0.004


def test_a_map_that_misses_parts_is_in_doubt(engine: str) -> None:
    """Colours do not contradict it, but its hair is longer than it can grow."""
    image, given, _ = furry_post(noise=0.1)
    assert float(edges.repair(image, given, edges.STEP_PX, True, True)[1]) == 0.0
    coc = mended(image, given)
    with without(["in_doubt"]):
        before = mended(image, given)
    assert int((coc.abs() > before.abs() + 1.0).sum()) > 1000


def test_a_map_with_ramps_of_a_pixel_is_less_in_doubt(engine: str) -> None:
    """Strong compression makes such ramps too, and leaves edges where they were."""
    y, x = torch.meshgrid(*(torch.arange(8.0 * n) / 8 for n in (96, 128)), indexing="ij")
    is_near = functional.avg_pool2d(((x + 1.7 * torch.sin(y / 9.0)) % 53 < 26).float()[None, None], 8)
    shown = torch.where(torch.rand(is_near.shape) < 0.12, 1.0 - is_near.round(), is_near)
    image = 0.1 + shown * torch.tensor([0.5, 0.3, 0.1])[:, None, None]
    wider = functional.avg_pool2d(functional.pad(is_near, [1, 1, 1, 1], mode="replicate"), 3, stride=1)
    doubts = [float(edges.repair(image, 5 - 11 * near, edges.STEP_PX, True, True)[1]) for near in (is_near, wider)]
    assert 0.0 < doubts[0] < 0.6
    assert doubts[1] == 1.0


def test_each_item_of_a_batch_has_its_own_doubt(engine: str) -> None:
    scenes = [scene[:2] for scene in (wavy_post(), furry_post())]
    images, maps = (torch.cat(t) for t in zip(*scenes, strict=True))
    together = mended(images, maps)
    for k, scene in enumerate(scenes):
        assert together[k : k + 1].equal(mended(*scene))


def test_invalid_values_stay_and_their_kind_affects_nothing(engine: str) -> None:
    image, given, _ = wavy_post()
    holes = torch.rand(given.shape, generator=torch.Generator().manual_seed(2)) < 0.01
    results = [mended(image, torch.where(holes, value, given)) for value in (math.nan, -math.inf, 3e38)]
    for result in results:
        assert result[~holes].equal(results[0][~holes])


@COMPILED
@pytest.mark.parametrize("size", [(1, 9), (40, 97), (96, 96), (97, 193), (224, 160)])
def test_engines_agree(size: tuple[int, int]) -> None:
    image, given, _ = (torch.cat([t, t], -1)[..., : size[0], : size[1]].contiguous() for t in wavy_post())
    repaired, doubt, _ = edges._repair(image, given, torch.tensor(edges.STEP_PX), True, True)
    plain = doubt_rule._blurred(given, repaired, torch.full((1, 1, 1, 1), 0.7))
    fast = native.blurred_in_doubt(given[0, 0], repaired[0, 0], 0.7)
    assert_close(fast, plain[0, 0], rtol=0, atol=1e-5)
    fast, of_fast, *_ = native.repair_edges(image[0], given[0, 0], torch.tensor(edges.STEP_PX), True, True)
    assert_close(fast, repaired[0, 0], rtol=0, atol=1e-3)
    assert of_fast == pytest.approx(float(doubt), abs=1e-3)


def test_full_doubt_blurs_beside_a_foreground_by_a_part_of_its_blur_that_falls_with_the_distance(engine: str) -> None:
    given = torch.full((1, 1, 9, 60), 0.1)
    repaired = given.clone()
    repaired[..., :20] = -10.0
    blurred = blurred_in_doubt(repaired, repaired, torch.ones(1, 1, 1, 1))[0, 0, 4]
    assert blurred[:20].equal(repaired[0, 0, 4, :20])
    columns = torch.arange(20.0, 60.0)
    expected = (0.4 * 10.0 - 0.5 * (columns - 17.0)).clamp_min(0.1)  # all is the foreground within 2 px of column 17
    assert_close(blurred[22:], expected[2:])
    assert_close(blurred[20:22], torch.tensor([2.6, 2.1]), atol=0.2, rtol=0)  # or as far as its mean reaches
    assert bool((blurred[20:].diff() <= 0).all())


def test_blur_falls_along_the_shortest_of_all_paths() -> None:
    """Against the definition: the largest blur less half the length of the shortest path of steps to neighbours."""
    dice = torch.Generator().manual_seed(3)
    blur = torch.where(torch.rand(1, 1, 17, 40, generator=dice) < 0.02, 63.0 * torch.rand(1, generator=dice), 0.0)
    blur += torch.rand(blur.shape, generator=dice)
    y, x = (t.flatten() for t in torch.meshgrid(torch.arange(17.0), torch.arange(40.0), indexing="ij"))
    dy, dx = (y[:, None] - y).abs(), (x[:, None] - x).abs()
    distance = torch.maximum(dy, dx) + (math.sqrt(2.0) - 1.0) * torch.minimum(dy, dx)
    expected = (blur.flatten() - 0.5 * distance).amax(1).reshape(blur.shape)
    assert_close(doubt_rule._falling(blur), expected, rtol=0, atol=1e-4)


def test_a_lone_pixel_blurs_little_around_it(engine: str) -> None:
    """Maps have specks; a foreground is larger."""
    repaired = torch.full((1, 1, 40, 40), 0.1)
    repaired[..., 20, 20] = -25.0
    blurred = blurred_in_doubt(repaired, repaired, torch.ones(1, 1, 1, 1))
    assert int((blurred.abs() > 0.2).sum()) <= 25
    assert float(blurred.max()) < 0.5


def test_least_blur_fades_over_what_a_foreground_covers(engine: str) -> None:
    """Nowhere is a line: from pixel to pixel the blur changes by half a pixel."""
    image, given, _ = wavy_post()
    coc = mended(image, given)
    is_far = coc > -2.0
    steps = (coc[..., 1:] - coc[..., :-1]).abs()[is_far[..., 1:] & is_far[..., :-1]]
    with without(["in_doubt"]):
        assert float((coc - mended(image, given)).abs().max()) > 1.5
    assert float(steps.max()) < 1.0
    assert float(steps.quantile(0.999)) < 0.51


@pytest.mark.parametrize("farther_px", [0.0, 0.6])
def test_a_small_change_of_a_map_in_doubt_has_a_small_effect(farther_px: float, engine: str) -> None:
    """On its blur; on its side of the focus only where a pixel in front of it just reaches the least blur."""
    dice = torch.Generator().manual_seed(0)
    given = -48.0 * torch.rand(1, 1, 192, 288, generator=dice) - 0.1
    is_sharp = torch.arange(288) % 48 >= 24  # columns of blurred and of sharp pixels
    given = torch.where(is_sharp, 0.025 * given + farther_px, given)
    moved = given - 2.0 * (torch.rand(given.shape, generator=dice) - 0.97).clamp_min(0.0) / 0.03
    nearby = moved + 1e-3 * (torch.rand(moved.shape, generator=dice) - 0.5)
    blurred, again = (blurred_in_doubt(given, repaired, torch.ones(1, 1, 1, 1)) for repaired in (moved, nearby))
    assert float((blurred != moved).float().mean()) > 0.2
    assert float((again.abs() - blurred.abs()).abs().max()) < 0.02
    is_raised = is_sharp & (blurred.abs() > 1.0 + moved.abs())
    assert float(is_raised.float().mean()) > 0.05
    assert float((again - blurred)[is_raised].abs().max()) < 0.02
    assert float(((again - blurred).abs() >= 0.02).float().mean()) < 2e-4
