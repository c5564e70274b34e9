"""The frame of a tile has the layers of the frame that it is cut from."""

from unittest import mock

import pytest
import torch
from torch import Tensor

from torchdof.export import tile_frame
from torchdof.render.layers.layer_weights import ramps
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.frame import PaddedFrame, PaddedSurface

MARGIN, AREA = 6, (24, 30)


def hard_sigmoid(name: str, inputs: list[Tensor], shape: object, numbers: dict[str, float]) -> Tensor:
    assert name == "HardSigmoid"
    return (inputs[0] * numbers["alpha"] + numbers["beta"]).clamp(0.0, 1.0)


def frames(plan: Plan) -> tuple[PaddedFrame, PaddedFrame]:
    """A frame of two random surfaces, of which a third of the pixels lie at nodes, and the same as that of a tile."""
    draw, nodes = torch.Generator().manual_seed(2), plan.nodes
    size = (2, 1, AREA[0] + 2 * MARGIN, AREA[1] + 2 * MARGIN)
    surfaces = []
    for _ in range(2):
        light = torch.rand((2, 3, *size[2:]), generator=draw)
        chosen = torch.tensor(nodes)[torch.randint(len(nodes), size, generator=draw)]
        x = torch.where(
            torch.rand(size, generator=draw) < 0.3, chosen, nodes[-1] * (2 * torch.rand(size, generator=draw) - 1)
        )
        weight = torch.rand(size, generator=draw) * (torch.rand(size, generator=draw) < 0.7)
        surfaces.append(PaddedSurface(light, x, weight))
    given = (surfaces, [nodes], ramps([nodes], surfaces[0].x), None, MARGIN, AREA, AREA, True)
    return PaddedFrame(*given), tile_frame.TileFrame(*given)


@pytest.mark.parametrize("radius_px", [1.0, 6.0, 24.0, 128.0])
def test_a_tile_has_the_layers_of_its_frame(radius_px: float) -> None:
    """To 2e-5: a far surface's cover changes 17 times as fast as the share of the near one."""
    whole, tile = (frame.near_to_far() for frame in frames(Plan.static(radius_px, 1.0 / 255.0)))
    last = len(whole.nodes[0]) - 1
    with mock.patch.object(tile_frame, "operator", hard_sigmoid):
        for first, count in [(k, 3) for k in range(0, last - 2, 2)] + [(0, last + 1), (last, 1)]:
            for expected, got in zip(whole.layers(first, count, 4), tile.layers(first, count, 4), strict=True):
                torch.testing.assert_close(got, expected, rtol=0.0, atol=2e-5)


def test_a_pixel_at_a_node_has_no_weight_in_other_layers() -> None:
    """Otherwise a picture in focus would get a little blurred light."""
    _, tile = frames(Plan.static(24.0, 1.0 / 255.0))
    near, far = tile.surfaces
    nodes, whole = tile.nodes[0], torch.ones_like(near.x)
    for place, node in enumerate(nodes):
        x = torch.full_like(near.x, node)
        flat = [PaddedSurface(near.light, x, whole), PaddedSurface(far.light, x, torch.zeros_like(x))]
        given = (flat, tile.nodes, tile.ramps, None, MARGIN, AREA, AREA, True)
        with mock.patch.object(tile_frame, "operator", hard_sigmoid):
            for first in range(0, len(nodes) - 2):
                weight = tile_frame.TileFrame(*given).layers(first, 3, 0)[1]
                is_other = [k != place for k in range(first, first + 3)]
                assert float(weight[:, is_other].abs().max()) == 0.0
