"""Frames in tiles: which layers light up which tiles, and patches that show what the frame shows."""

from collections.abc import Sequence

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.frame import TILE, Frame, Sample
from torchdof.layers import share_at_or_behind
from torchdof.plan import Blur, Plan

NODES = (-9.0, -4.0, 0.0, 1.0, 4.0)
SLACK = 15
"""Pixels: occupancy is known in cells of 8, and in blocks of 4 that are told by their ends."""


def _blurs(halves: Sequence[int]) -> list[Blur]:
    return [Blur(torch.ones(1, 2 * half + 1, 2 * half + 1), 1) for half in halves]


def _frame(height: int, width: int, margin: int, second: bool) -> Frame:
    """A slope from left to right with a nearer square, and hidden samples below the middle."""
    made = torch.Generator().manual_seed(0)
    x = torch.linspace(-3.0, 3.9, width).expand(1, 1, height, width).clone()
    x[..., 20:50, 200:230] = -9.0
    light = torch.rand(1, 3, height, width, generator=made)
    samples = [Sample(light, x)]
    if second:
        there = torch.zeros_like(x)
        there[..., height // 2 :, :] = 0.25
        samples = [Sample(light, x, 1.0 - there), Sample(light.flip(1), (x + 1.0).clamp(max=4.0), there)]
    return Frame(iter(samples), margin, 1, tiled=True, extend=False)


def _shares(frame: Frame, k: int) -> Tensor:
    """Whether some light of a pixel of the frame is in layer k: ``[1, 1, H, W]``, 0 or 1."""
    found = torch.zeros(1, 1, *frame.area)
    rows, columns = (slice(frame.margin, frame.margin + n) for n in frame.area)
    for s in frame.samples:
        share = share_at_or_behind(s.x, NODES, k) - share_at_or_behind(s.x, NODES, k + 1)
        there = share if s.weight is None else share * s.weight
        found = torch.maximum(found, (there[..., rows, columns] > 0).float())
    return found


def _reached(shares: Tensor, halo: int) -> Tensor:
    """Tiles with such a pixel in them or so near."""
    around = functional.max_pool2d(functional.pad(shares, (halo,) * 4), 2 * halo + 1, 1)
    return functional.max_pool2d(around, TILE)[0, 0] > 0


@pytest.mark.parametrize("second", [False, True], ids=["one surface", "two"])
@pytest.mark.parametrize("halves", [(9, 4, 0, 1, 4), (40, 20, 3, 3, 20)])
def test_a_layer_is_computed_where_its_light_can_fall(halves: tuple[int, ...], second: bool) -> None:
    blurs = _blurs(halves)
    frame = _frame(200, 700, max(halves), second)
    for k, occupied in enumerate(frame.occupancy(Plan(NODES, 1 / 255), blurs)):
        shares = _shares(frame, k)
        assert bool((occupied | ~_reached(shares, halves[k])).all()), "light is missed"
        assert bool((_reached(shares, halves[k] + SLACK) | ~occupied).all()), "work for nothing"


@pytest.mark.parametrize("second", [False, True], ids=["one surface", "two"])
def test_patches_show_each_layer_what_the_frame_shows(second: bool) -> None:
    halves = (9, 4, 0, 1, 4)
    plan, blurs = Plan(NODES, 1 / 255), _blurs(halves)
    frame = _frame(300, 700, max(halves), second)
    order = [k for (k,) in frame.groups(plan, blurs)]
    assert order == [4, 3, 2, 1, 0]
    columns, alone = frame.area[1] // TILE, 0
    computed: dict[int, list[int]] = {k: [] for k in order}
    kinds: set[type] = set()
    for patch in frame.patches(blurs, order):
        assert [k for k, _ in patch.layers] == [k for k in order if k in dict(patch.layers)]
        alone += second and len(patch.window.samples) == 1
        for k, some in patch.layers:
            kinds.add(type(some))
            tiles = patch.tiles[some].tolist()
            computed[k] += tiles
            window = patch.window.part(some, patch.halo - halves[k])
            light, share, room, *seen = window.terms(NODES, k, with_room=True)
            whole = [t[0] for t in frame.whole(halves[k]).terms(NODES, k, with_room=True)]
            for i, tile in enumerate(tiles):
                rows, across = (slice(n * TILE, (n + 1) * TILE + 2 * halves[k]) for n in divmod(tile, columns))
                for mine, wanted in zip((light, share, room), whole, strict=False):
                    torch.testing.assert_close(mine[i], wanted[:, rows, across], rtol=0, atol=1e-6)
                known = seen[0][i] if seen else share[i]
                torch.testing.assert_close(known, whole[3][:, rows, across], rtol=0, atol=1e-6)
    assert kinds == {slice, torch.Tensor}, "tiles in one piece, and others"
    assert not second or alone, "no patch shows the first surface alone"
    for k, occupied in enumerate(frame.occupancy(plan, blurs)):
        assert sorted(computed[k]) == occupied.flatten().nonzero()[:, 0].tolist()
