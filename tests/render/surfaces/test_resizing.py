"""Maps whose foregrounds are too thin or too wide: these are resized until colours no longer contradict one side."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.scenes import TURNS, resized_post, wavy_post
from torchdof import native
from torchdof.render.rules import without
from torchdof.render.surfaces import edge_search, edges, resizing
from torchdof.render.surfaces.resizing import from_resized, resizing_of

COMPILED = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built here")


def wrong_share(coc_px: Tensor, exact: Tensor) -> float:
    """Share of the pixels that have the depth of the wrong surface."""
    return float(((coc_px < -6.0) != (exact < -6.0)).float().mean())


@pytest.mark.parametrize(
    ("by_px", "widths"),
    [(-4, []), (-3, []), (3, []), (4, []), (-4, [3]), (-3, [3]), (-4, [5, 5]), (5, [5, 5]), (6, [5, 5])],
)
def test_a_post_beyond_the_window_of_the_repair_gets_its_width(engine: str, by_px: int, widths: list[int]) -> None:
    image, given, exact = resized_post(0.1, by_px, widths)
    assert wrong_share(given, exact) > 0.035
    assert wrong_share(edges.mended(image, given, "auto"), exact) < 0.01
    with without(["resizing"]):
        assert wrong_share(edges.mended(image, given, "auto"), exact) > (0.0 if widths == [5, 5] else 0.035)


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("by_px", [-3, 3])
def test_it_does_so_in_each_orientation(turn: str, by_px: int) -> None:
    image, given, exact = (TURNS[turn](t).contiguous() for t in resized_post(0.1, by_px, []))
    assert wrong_share(edges.mended(image, given, "auto"), exact) < 0.006


@pytest.mark.parametrize("edit", ["exact", "shifted", "wandering", "repair"])
def test_other_maps_are_not_resized(engine: str, edit: str) -> None:
    image, given, exact = wavy_post() if edit == "wandering" else resized_post(0.1, -3, [])
    if edit in ("exact", "shifted"):
        given = exact.roll(2, -1) if edit == "shifted" else exact
    auto = edit != "repair"  # which decides at each edge of the map as it is
    repaired, _ = edges.repair(image, given, edges.STEP_PX, auto, True)
    with without(["resizing"]):
        alone, _ = edges.repair(image, given, edges.STEP_PX, auto, True)
    assert repaired.equal(alone) or engine == "native"
    assert_close(wrong_share(repaired, exact), wrong_share(alone, exact), atol=2e-4, rtol=0)


def shares(far: tuple[float, float], near: tuple[float, float]) -> Tensor:
    """Priors of an item whose steps are wrong with these shares: in one direction, and in all others."""
    prior = torch.full((edge_search.PLACES, edge_search.DIRECTIONS), 0.5)
    for ring, (one, others) in ((0, far), (edge_search.RINGS, near)):
        wrong = torch.tensor([one] + [others] * (edge_search.DIRECTIONS - 1))
        prior[ring] = 1.0 - wrong if ring else wrong
    return prior.flatten()


@pytest.mark.parametrize(
    ("clear", "far", "near", "hard", "soft"),
    [
        ((0.0, 0.0), (0.9, 0.9), (0.1, 0.1), 1, 0),
        ((0.0, 0.0), (0.1, 0.1), (0.9, 0.9), -1, 0),
        ((0.0, 0.0), (0.5, 0.9), (0.1, 0.1), 0, 0),
        ((0.0, 0.0), (0.9, 0.9), (0.3, 0.1), 0, 0),
        ((0.0, 0.0), (0.9, 0.9), (0.9, 0.9), 0, 0),
        ((0.1, 0.5), (0.3, 0.3), (0.1, 0.1), 1, 1),
        ((0.1, 0.5), (0.1, 0.9), (0.1, 0.1), 0, 1),
        ((0.4, 0.5), (0.1, 0.1), (0.1, 0.1), 0, 0),
        ((0.5, 0.1), (0.1, 0.1), (0.1, 0.1), -1, -1),
        ((0.5, 0.0), (0.1, 0.1), (0.1, 0.1), 0, 0),
    ],
)
def test_one_side_of_all_edges_must_contradict_the_map(
    clear: tuple[float, float], far: tuple[float, float], near: tuple[float, float], hard: int, soft: int
) -> None:
    weights = torch.full((2, 2, 1, 1, 1), 1e4)
    agreed = weights * (1.0 - torch.tensor(clear).view(2, 1, 1, 1, 1))
    is_soft = torch.tensor([False, True]).view(2, 1, 1, 1)
    assert resizing_of(weights, agreed, shares(far, near).repeat(2), is_soft).flatten().tolist() == [hard, soft]


def test_resizing_never_goes_back_and_ends() -> None:
    """A map that asks for the other direction is repaired as it is; one that asks forever is resized a few times."""
    told: list[list[float] | None] = []

    def once(nearness: Tensor, before: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        told.append(None if before is None else before.flatten().tolist())
        asked = torch.tensor([1.0, 1.0 if len(told) == 1 else -1.0]).view(2, 1, 1, 1)
        return nearness + 0.5, torch.full((2, 1, 1, 1), float(len(told))), asked

    point = torch.zeros(2, 1, 32, 32)
    point[..., 16, 16] = 1.0
    repaired, doubt = from_resized(once, point, False)
    sides = ((repaired - 0.5).sum((1, 2, 3)).sqrt()).tolist()
    assert sides == [2 * resizing._MOST_PX + 1, 3]
    assert doubt.flatten().tolist() == [resizing._MOST_PX + 1, 2]
    assert told == [[2.0, 2.0], [1.0, 1.0], *[[1.0, 0.0]] * (resizing._MOST_PX - 2), None]


@COMPILED
@pytest.mark.parametrize("by_px", [-4, 4])
def test_the_engine_repairs_a_map_that_is_not_to_be_resized_that_way(by_px: int) -> None:
    image, given, _ = resized_post(0.1, by_px, [])
    expected = edges._repair(image, given, torch.tensor(edges.STEP_PX), True, True)
    asked = -by_px // 4
    assert float(expected[2]) == asked
    for stops in (0, asked, -asked, 2):
        repair = native.repair_edges(image[0], given[0, 0], torch.tensor(1.0), True, True, stops_to_resize=stops)
        assert repair[3] == asked
        assert_close(repair[0], (given if stops in (asked, 2) else expected[0])[0, 0], atol=1e-3, rtol=0)


@pytest.mark.parametrize("by_px", [-4, 5])
def test_invalid_values_stay_and_so_do_items_that_need_no_resizing(engine: str, by_px: int) -> None:
    image, given, _ = resized_post(0.1, by_px, [5, 5])
    given[..., 100, 60] = torch.nan
    other = torch.full_like(given, 0.5)
    other[..., :80] = -12.0
    repaired, doubt = edges.repair(torch.cat([image] * 2), torch.cat([given, other]), edges.STEP_PX, True, True)
    assert repaired[0].isnan().equal(given[0].isnan())
    for item, alone in enumerate((given, other)):
        own, its_doubt = edges.repair(image, alone, edges.STEP_PX, True, True)
        assert_close(repaired[item : item + 1], own, atol=0, rtol=0, equal_nan=True)
        assert_close(doubt[item : item + 1], its_doubt, atol=0, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_maps_of_other_types_are_resized_too(engine: str, dtype: torch.dtype) -> None:
    image, given, exact = resized_post(0.1, 5, [5, 5])
    coc = edges.mended(image, given.to(dtype), "auto")
    assert coc.dtype == dtype
    assert wrong_share(coc, exact) < 0.004


@COMPILED
@pytest.mark.parametrize("by_px", [-4, -1, 1, 4])
@pytest.mark.parametrize("widths", [[], [5, 5]])
def test_engines_agree(by_px: int, widths: list[int]) -> None:
    image, given, _ = resized_post(0.1, by_px, widths)
    repaired, doubt = edges.repair(image, given, edges.STEP_PX, True, True)
    with native.engine_off():
        expected, its_doubt = edges.repair(image, given, edges.STEP_PX, True, True)
    assert ((repaired - expected).abs() > 1e-3).float().mean() < 1e-4
    assert_close(doubt, its_doubt, atol=1e-3, rtol=0)
