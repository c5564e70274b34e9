"""Maps whose foregrounds are too thin, too wide or shifted: they are edited as long as colours ask for it."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.scenes import TURNS, resized_post, shifted_disc, wavy_post
from torchdof import native
from torchdof.render.rules import without
from torchdof.render.surfaces import edge_search, edges, registration
from torchdof.render.surfaces.registration import EDITS, edits_of, registered

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
    with without(["registration"]):
        assert wrong_share(edges.mended(image, given, "auto"), exact) > (0.0 if widths == [5, 5] else 0.035)


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("by_px", [-3, 3])
def test_it_does_so_in_each_orientation(turn: str, by_px: int) -> None:
    image, given, exact = (TURNS[turn](t).contiguous() for t in resized_post(0.1, by_px, []))
    assert wrong_share(edges.mended(image, given, "auto"), exact) < 0.006


@pytest.mark.parametrize("edit", [(1, 0), (0, 2), (-3, 0), (0, -4), (2, 2), (-4, 3)])
@pytest.mark.parametrize("widths", [[], [3], [5, 5]])
def test_a_shifted_map_is_shifted_back(engine: str, edit: tuple[int, int], widths: list[int]) -> None:
    image, given, exact = shifted_disc(0.1, *edit, widths)
    in_place = shifted_disc(0.1, 0, 0, widths)[1]
    repaired, expected = (edges.mended(image, map_, "auto") for map_ in (given, in_place))
    assert wrong_share(given, exact) > 0.003
    assert wrong_share(repaired, exact) <= wrong_share(expected, exact) + 2e-4
    if not widths:
        assert repaired.equal(exact)


@pytest.mark.parametrize("edit", ["exact", "wandering", "repair"])
def test_other_maps_are_not_edited(engine: str, edit: str) -> None:
    image, given, exact = wavy_post() if edit == "wandering" else resized_post(0.1, -3, [])
    if edit == "exact":
        given = exact
    auto = edit != "repair"  # which decides at each edge of the map as it is
    repaired, _ = edges.repair(image, given, edges.STEP_PX, auto, True)
    with without(["registration"]):
        alone, _ = edges.repair(image, given, edges.STEP_PX, auto, True)
    assert repaired.equal(alone) or engine == "native"
    assert_close(wrong_share(repaired, exact), wrong_share(alone, exact), atol=2e-4, rtol=0)


UP, LEFT, DIAGONAL, RIGHT, DOWN = range(edge_search.DIRECTIONS)  # towards the near surface
THIN, WIDE, TO_DOWN, TO_RIGHT, TO_LEFT, TO_UP = range(EDITS)


def priors(far_wrong: list[float], near_wrong: list[float], on_ramps: list[float]) -> Tensor:
    """Priors of an item whose steps are wrong with these shares, and whose ramps have these, in each direction."""
    prior = torch.full((edge_search.PLACES, edge_search.DIRECTIONS), 0.5)
    prior[0], prior[edge_search.RINGS] = torch.tensor(far_wrong), 1.0 - torch.tensor(near_wrong)
    prior[2 * edge_search.RINGS :] = torch.tensor(on_ramps)
    return prior.flatten()


def few_and_many(few: float, many: float, *directions: int) -> list[float]:
    return [many if k in directions else few for k in range(edge_search.DIRECTIONS)]


@pytest.mark.parametrize(
    ("clear", "far", "near", "edits"),
    [
        ((0.0, 0.0), [0.5] * 5, [0.05] * 5, [THIN]),
        ((0.0, 0.0), [0.05] * 5, [0.5] * 5, [WIDE]),
        ((0.0, 0.0), few_and_many(0.9, 0.3, LEFT), [0.05] * 5, []),
        ((0.0, 0.0), [0.9] * 5, few_and_many(0.1, 0.6, LEFT), []),
        ((0.0, 0.0), [0.9] * 5, [0.9] * 5, []),
        ((0.1, 0.5), [0.3] * 5, [0.1] * 5, [THIN]),
        ((0.1, 0.3), [0.3] * 5, [0.3] * 5, [THIN]),
        ((0.1, 0.5), few_and_many(0.9, 0.1, LEFT), [0.1] * 5, []),
        ((0.4, 0.5), [0.1] * 5, [0.1] * 5, []),
        ((0.5, 0.1), [0.1] * 5, [0.1] * 5, [WIDE]),
        ((0.4, 0.1), [0.3] * 5, [0.1] * 5, [WIDE]),
        ((0.25, 0.1), [0.3] * 5, [0.1] * 5, []),
        ((0.5, 0.1), few_and_many(0.1, 0.9, LEFT), [0.1] * 5, []),
        ((0.0, 0.0), few_and_many(0.1, 0.5, LEFT), few_and_many(0.1, 0.5, RIGHT), [TO_RIGHT]),
        ((0.0, 0.0), few_and_many(0.1, 0.5, RIGHT), few_and_many(0.1, 0.5, LEFT), [TO_LEFT]),
        ((0.0, 0.0), few_and_many(0.1, 0.5, UP, LEFT), few_and_many(0.1, 0.5, DOWN, RIGHT), [TO_DOWN, TO_RIGHT]),
        ((0.0, 0.0), few_and_many(0.1, 0.5, DOWN), few_and_many(0.1, 0.5, UP), [TO_UP]),
        ((0.0, 0.0), few_and_many(0.1, 0.5, LEFT), few_and_many(0.1, 0.5, LEFT), []),
        ((0.0, 0.0), few_and_many(0.1, 0.5, LEFT), [0.1] * 5, []),
    ],
)
def test_steps_of_a_hard_map_tell_its_edits(
    clear: tuple[float, float], far: list[float], near: list[float], edits: list[int]
) -> None:
    assert asked(clear, priors(far, near, [0.5] * 5), False) == edits
    assert set(asked(clear, priors(far, near, [0.5] * 5), True)) <= {THIN, WIDE}


@pytest.mark.parametrize(
    ("clear", "on_ramps", "edits"),
    [
        ((0.0, 0.0), [0.75] * 5, [THIN]),
        ((0.0, 0.0), few_and_many(0.75, 0.6, UP), []),
        ((0.0, 0.0), [0.2] * 5, []),
        ((0.1, 0.5), [0.5] * 5, [THIN]),
        ((0.5, 0.1), [0.5] * 5, [WIDE]),
        ((0.4, 0.5), [0.5] * 5, []),
        ((0.5, 0.1), few_and_many(0.5, 0.8, UP), []),
        ((0.0, 0.0), [0.5, 0.6, 0.5, 0.4, 0.5], [TO_RIGHT]),
        ((0.0, 0.0), [0.4, 0.4, 0.5, 0.6, 0.6], [TO_LEFT, TO_UP]),
        ((0.0, 0.0), [0.6, 0.5, 0.5, 0.5, 0.5], []),
    ],
)
def test_ramps_of_a_soft_map_tell_its_edits(
    clear: tuple[float, float], on_ramps: list[float], edits: list[int]
) -> None:
    assert asked(clear, priors([0.0] * 5, [0.0] * 5, on_ramps), True) == edits


def asked(clear: tuple[float, float], prior: Tensor, is_soft: bool) -> list[int]:
    return found(torch.tensor(clear)[:, None].expand(2, edge_search.DIRECTIONS), prior, is_soft)


def found(contradicted: Tensor, prior: Tensor, is_soft: bool) -> list[int]:
    """The edits for shares of clear pixels that contradict a map, ``[2, DIRECTIONS]``: near and far ones."""
    weights = torch.full((2, 1, edge_search.DIRECTIONS, 1, 1), 1e4)
    agreed = weights * (1.0 - contradicted[:, None, :, None, None])
    edits, _ = edits_of(weights, agreed, prior, torch.tensor([[[[is_soft]]]]))
    return edits.flatten().nonzero().flatten().tolist()


@pytest.mark.parametrize("is_soft", [False, True])
@pytest.mark.parametrize(
    ("near", "far", "edits"),
    [
        (few_and_many(0.1, 0.3, RIGHT), few_and_many(0.1, 0.3, LEFT), [TO_RIGHT]),
        (few_and_many(0.1, 0.3, LEFT, UP), few_and_many(0.1, 0.3, RIGHT, DOWN), [TO_LEFT, TO_UP]),
        (few_and_many(0.1, 0.3, DOWN), few_and_many(0.1, 0.18, UP), [TO_DOWN]),
        (few_and_many(0.1, 0.3, DOWN), few_and_many(0.1, 0.15, UP), []),
        (few_and_many(0.1, 0.3, LEFT), few_and_many(0.1, 0.3, LEFT), []),
        (few_and_many(0.1, 0.2, LEFT), few_and_many(0.1, 0.2, RIGHT), []),
    ],
)
def test_clear_pixels_tell_larger_shifts(near: list[float], far: list[float], edits: list[int], is_soft: bool) -> None:
    prior = priors([0.05] * 5, [0.05] * 5, [0.5] * 5)
    assert found(torch.tensor([near, far]), prior, is_soft) == edits


@pytest.mark.parametrize(
    ("on_ramps", "dilated"),
    [([0.5] * 5, 0.0), ([0.34] * 5, 0.2), ([0.29] * 5, 1.0), (few_and_many(0.1, 0.4, LEFT), 0.0), ([0.9] * 5, 0.0)],
)
def test_ramps_of_each_direction_tell_dilated_foregrounds(on_ramps: list[float], dilated: float) -> None:
    clear = torch.full((2, 2, edge_search.DIRECTIONS, 1, 1), 1e4)
    prior = priors([0.0] * 5, [0.0] * 5, on_ramps).repeat(2)
    _, found = edits_of(clear, clear, prior, torch.tensor([True, False]).view(2, 1, 1, 1))
    assert_close(found.flatten(), torch.tensor([dilated, 0.0]), atol=1e-5, rtol=0)


def test_an_edit_is_never_undone_and_the_last_one_ends() -> None:
    """A map that asks for the opposite is repaired as it is; one that asks forever is edited a few times."""
    told: list[list[list[int]] | None] = []

    def once(nearness: Tensor, eroded: Tensor, following: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        told.append(None if following is None else [f.flatten().nonzero().flatten().tolist() for f in following])
        edits = torch.zeros(3, EDITS, 1, 1)
        for item, edit in enumerate([THIN, THIN if len(told) == 1 else WIDE, TO_LEFT if len(told) < 3 else TO_UP]):
            edits[item, edit] = 1.0
        return nearness + 0.5, torch.full((3, 1, 1, 1), float(len(told))), edits

    point = torch.zeros(3, 1, 32, 32)
    point[..., 16, 16] = 1.0
    repaired, doubt = registered(once, point, False)
    most = registration._MOST_PX
    assert (repaired - 0.5).sum((1, 2, 3)).tolist() == [(2 * most + 1) ** 2, 9, 1]
    assert (repaired[2, 0] == 1.5).nonzero().tolist() == [[16 - (most - 2), 14]]
    assert doubt.flatten().tolist() == [most + 1, 2, most + 1]
    sides = [TO_DOWN, TO_LEFT, TO_UP]
    assert told[:3] == [[[*range(EDITS)]] * 3, [[THIN], [THIN], sides], [[THIN], [], sides]]
    assert told[3:] == [*[[[THIN], [], [TO_LEFT, TO_UP]]] * (most - 3), None]


@pytest.mark.parametrize("of_coc", [False, True])
def test_wires_are_not_eroded(of_coc: bool) -> None:
    sign = -1.0 if of_coc else 1.0
    given = torch.zeros(1, 1, 32, 32)
    given[..., 4:12, 4:12], given[..., 20:22, :], given[..., 28, 9] = 1.0, 2.0, torch.nan
    dilated, eroded = (sign * edit(sign * given) for edit in registration._edits(of_coc)[:2])
    assert bool((dilated[..., 3:13, 3:13] == 1.0).all())
    assert bool((dilated[..., 19:23, :] == 2.0).all())
    expected = given.clone()
    expected[..., 4:12, 4:12] = 0.0
    expected[..., 5:11, 5:11] = 1.0
    assert_close(eroded, expected, atol=1e-6, rtol=0, equal_nan=True)


def test_a_repair_learns_of_eroded_foregrounds() -> None:
    told: list[list[bool]] = []

    def once(nearness: Tensor, eroded: Tensor, following: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        told.append(eroded.flatten().tolist())
        edits = torch.zeros(3, EDITS, 1, 1)
        for item, edit in enumerate([THIN, WIDE, TO_LEFT]):
            edits[item, edit] = float(len(told) < 3)
        return nearness, torch.zeros(3, 1, 1, 1), edits

    registered(once, torch.zeros(3, 1, 32, 32), False)
    assert told == [[False] * 3, [False, True, False], [False, True, False]]


@pytest.mark.parametrize(
    ("edit", "place"), [(TO_DOWN, (1, 0)), (TO_RIGHT, (0, 1)), (TO_LEFT, (0, -1)), (TO_UP, (-1, 0))]
)
def test_a_map_is_shifted_in_each_direction(edit: int, place: tuple[int, int]) -> None:
    given = torch.rand(1, 1, 6, 7, generator=torch.Generator().manual_seed(0))
    given[..., 3, 3] = torch.nan
    for of_coc in (False, True):
        shifted = registration._edits(of_coc)[edit](given)
        expected = given.roll(place, (-2, -1))
        kept = (..., slice(1, 5), slice(1, 6))
        changed = expected.isfinite() & given.isfinite()
        assert torch.equal(shifted[kept][changed[kept]], expected[kept][changed[kept]])
        assert torch.equal(shifted[~changed].nan_to_num(-1.0), given[~changed].nan_to_num(-1.0))


@COMPILED
@pytest.mark.parametrize("by_px", [-4, 4])
def test_the_engine_repairs_a_map_that_is_not_to_be_edited_that_way(by_px: int) -> None:
    image, given, _ = resized_post(0.1, by_px, [])
    expected = edges._repair(image, given, torch.tensor(edges.STEP_PX), True, True)
    edit = THIN if by_px < 0 else WIDE
    assert expected[2].flatten().nonzero().flatten().tolist() == [edit]
    for stops in (0, 1 << edit, 3 - (1 << edit), (1 << EDITS) - 1):
        repair = native.repair_edges(image[0], given[0, 0], torch.tensor(1.0), True, True, stops=stops)
        assert repair[3] == 1 << edit
        assert_close(repair[0], (given if stops >> edit & 1 else expected[0])[0, 0], atol=1e-3, rtol=0)


@COMPILED
def test_engines_agree_on_a_map_whose_foregrounds_are_eroded() -> None:
    image, given, _ = resized_post(0.25, 1, [5])
    eroded, step = torch.ones(1, 1, 1, 1, dtype=torch.bool), torch.tensor(edges.STEP_PX)
    for told in (eroded, ~eroded):
        repaired, doubt, _ = edges._repair(image, given, step, True, True, eroded=told)
        own, its_doubt, *_ = native.repair_edges(image[0], given[0, 0], step, True, True, eroded=bool(told))
        assert_close(own, repaired[0, 0], atol=1e-3, rtol=0)
        assert its_doubt == pytest.approx(float(doubt))
        assert (float(doubt) == -1.0) == bool(told)


@pytest.mark.parametrize("by_px", [-4, 5])
def test_invalid_values_stay_and_so_do_items_that_need_no_edit(engine: str, by_px: int) -> None:
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
@pytest.mark.parametrize("widths", [[], [5, 5]])
@pytest.mark.parametrize(
    ("scene", "edit"),
    [
        *((resized_post, (by_px,)) for by_px in (-4, -1, 1, 4)),
        *((shifted_disc, edit) for edit in ((1, 0), (-3, 2), (0, 4))),
    ],
)
def test_engines_agree(
    scene: Callable[..., tuple[Tensor, Tensor, Tensor]], edit: tuple[int, ...], widths: list[int]
) -> None:
    image, given, _ = scene(0.1, *edit, widths)
    repaired, doubt = edges.repair(image, given, edges.STEP_PX, True, True)
    with native.engine_off():
        expected, its_doubt = edges.repair(image, given, edges.STEP_PX, True, True)
    assert ((repaired - expected).abs() > 1e-3).float().mean() < 1e-4
    assert_close(doubt, its_doubt, atol=1e-3, rtol=0)
