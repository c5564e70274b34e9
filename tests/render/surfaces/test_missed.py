"""What the map misses of a blurred foreground: it is found, exact maps stay, both engines agree."""

import math

import pytest
import torch

from tests.scenes import TURNS, furry_post, pixels_from_post
from torchdof import blur_by_coc, native
from torchdof.render.rules import without
from torchdof.render.surfaces import edges, missed

DAMAGED = torch.zeros(1, 1, 224, 160)  # stands for a map that the repair has changed
COMPILED = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built here")


def test_missed_hair_gets_the_coc_of_its_foreground(engine: str) -> None:
    image, given, exact = furry_post(noise=0.1)
    completed = missed.completed(image, given, DAMAGED)[0]
    hair = (exact < 0) & (given > 0)
    assert int(hair.sum()) > 1000 and bool((completed[hair] == -12.0).all())
    far = (pixels_from_post(160) > missed._GROWTH_PX).expand_as(given)
    assert completed[far].equal(given[far])


@pytest.mark.parametrize("turn", TURNS)
def test_an_exact_map_stays(engine: str, turn: str) -> None:
    image, _, exact = (TURNS[turn](t).contiguous() for t in furry_post(noise=0.1))
    assert missed.completed(image, exact, exact - 1)[0].equal(exact)


def test_a_foreground_grows_over_a_smooth_background_which_is_not_seen(engine: str) -> None:
    image, _, exact = furry_post(noise=0.0)
    completed = missed.completed(image, exact, exact - 1)[0]
    grown = completed != exact
    assert int(grown.sum()) > 2000
    assert not grown[..., pixels_from_post(160) >= 8 + missed._GROWTH_OVER_SMOOTH_PX].any()  # from hairs of 8 px
    pictures = [blur_by_coc(image, coc, depth_edges="as given") for coc in (exact.contiguous(), completed)]
    assert float((pictures[0] - pictures[1]).abs().max()) < 0.05


def test_a_map_that_needs_no_repair_stays(engine: str) -> None:
    image, given, _ = furry_post()
    assert missed.completed(image, given, given)[0].equal(given)


def test_things_of_the_background_are_left_to_it(engine: str) -> None:
    """Fur behind a post: unlike pixels are as frequent away from the edge as beside it."""
    image = furry_post()[0]
    given = torch.where(pixels_from_post(160) < 0, -12.0, 0.5).expand(1, 1, 224, -1).contiguous()
    strands = torch.rand(1, 1, 224, 1, generator=torch.Generator().manual_seed(1)) < 0.4
    light = torch.where((given < 0) | strands, 0.05, image.amax())
    assert missed.completed(light.expand(-1, 3, -1, -1).contiguous(), given, DAMAGED)[0].equal(given)


def test_a_sharper_foreground_is_left_alone(engine: str) -> None:
    image, given, _ = furry_post()
    sharper = torch.where(given < 0, 0.0, 12.0)  # the focus is on the fur
    assert missed.completed(image, sharper, DAMAGED)[0].equal(sharper)


def test_a_matte_tells_what_a_map_misses_at_its_edges(engine: str) -> None:
    """There foregrounds neither grow nor blur their surroundings; those that the matte does not cover do."""
    image, given, exact = (torch.cat([t, t], 2) for t in furry_post(noise=0.1))
    matte = (exact < 0).float()
    matte[:, :, 224:] = 0.0  # the lower post has none
    with_matte, without_matte = (edges.mended(image, given, "auto", matte=m) for m in (matte, None))
    with without(["missed_parts", "in_doubt"]):
        repaired = edges.mended(image, given, "auto")
    upper, lower = slice(0, 224), slice(224 + edges._MATTE_REACH + 1, None)
    torch.testing.assert_close(with_matte[:, :, upper], repaired[:, :, upper], atol=5e-3, rtol=0)
    assert with_matte[:, :, lower].equal(without_matte[:, :, lower])
    is_blurred = (without_matte - repaired).abs() > 1.0
    assert int(is_blurred[:, :, upper].sum()) > 1000 and int(is_blurred[:, :, lower].sum()) > 1000


def test_items_of_a_batch_are_completed_independently(engine: str) -> None:
    image, given, exact = furry_post()
    images, maps = torch.cat([image, image.flip(-2), image]), torch.cat([given, given.flip(-2), exact])
    before = torch.cat([0 * given, given, given])  # the second has not been repaired
    together = missed.completed(images, maps, before)[0]
    for k in range(3):
        assert together[k : k + 1].equal(missed.completed(images[k : k + 1], maps[k : k + 1], before[k : k + 1])[0])


def test_invalid_values_stay_and_affect_nothing(engine: str) -> None:
    image, given, _ = furry_post()
    holes = torch.rand(given.shape, generator=torch.Generator().manual_seed(2)) < 0.02
    values = (math.nan, -math.inf, 3e38)
    completed = [missed.completed(image, torch.where(holes, value, given), DAMAGED)[0] for value in values]
    assert not completed[0][~holes].equal(given[~holes])
    for result, value in zip(completed, values, strict=True):
        torch.testing.assert_close(result[holes], torch.full_like(result[holes], value), rtol=0, atol=0, equal_nan=True)
        assert result[~holes].equal(completed[0][~holes])


def test_gradients_flow_to_pixels_that_stay() -> None:
    image, given, _ = furry_post()
    coc = given.clone().requires_grad_()
    completed = missed.completed(image, coc, DAMAGED)[0]
    completed.sum().backward()
    assert coc.grad is not None and coc.grad.equal((completed.detach() == given).float())


@COMPILED
@pytest.mark.parametrize("size", [(1, 1), (3, 70), (65, 130), (129, 63), (224, 160)])
def test_engines_agree(size: tuple[int, int]) -> None:
    height, width = size
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        image, given, _ = (t[..., :height, :width].clone() for t in furry_post(0.4 + 0.1 * seed))
        image = torch.cat([image] * 3, 1)[:, : 1 + 2 * seed].contiguous()
        image *= 10.0 ** (6 * seed - 12)
        given += 0.2 * torch.randn(given.shape, generator=generator)
        bad = torch.rand(given.shape, generator=generator) < 0.01 * seed
        given[bad], image[:, :, bad[0, 0].flip(0)] = math.nan, math.inf
        plain, share = missed._completed(image, given, torch.tensor([True]), missed.EAGER)
        fast, fast_share = native.missed_parts(image[0], given[0, 0])
        torch.testing.assert_close(fast, plain[0, 0], rtol=0, atol=0, equal_nan=True)
        assert fast_share == pytest.approx(float(share), abs=1e-4)


@COMPILED
def test_any_number_of_threads_gives_the_same_bits() -> None:
    image, given, _ = furry_post()
    threads, results = torch.get_num_threads(), []
    for count in (1, 2, 5, threads):
        torch.set_num_threads(count)
        results.append(native.missed_parts(image[0], given[0, 0])[0])
    assert not results[0].equal(given[0, 0])
    assert all(result.equal(results[0]) for result in results)


def test_completion_compiles_without_graph_breaks() -> None:
    image, given, _ = furry_post()
    compiled = torch.compile(missed.completed, backend="eager", fullgraph=True)
    assert compiled(image, given, DAMAGED)[0].equal(missed.completed(image, given, DAMAGED)[0])
