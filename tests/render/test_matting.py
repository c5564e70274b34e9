"""Matting: mixed pixels are split between their two surfaces."""

import pytest
import torch
from torch import Tensor

from torchdof.render.matting import matte

RED, BLUE = torch.tensor([0.7, 0.2, 0.1]), torch.tensor([0.1, 0.3, 0.8])


def edge(share: float, near_px: float = -12.0, far_px: float = 0.0) -> tuple[Tensor, Tensor]:
    """Red in front of blue; column 31 is red by a share but has the depth of red if that is at least a half."""
    red = (torch.arange(64) < 31).float()
    red[31] = share
    image = (red * RED[:, None] + (1 - red) * BLUE[:, None])[None, :, None].expand(1, 3, 48, 64)
    coc = torch.where(red >= 0.5, near_px, far_px).expand(1, 1, 48, 64)
    return image, coc


def random_scene() -> tuple[Tensor, Tensor]:
    made = torch.Generator().manual_seed(5)
    image, coc = torch.rand(1, 3, 150, 170, generator=made), torch.full((1, 1, 150, 170), 3.0)
    coc[..., 20:70, 30:90], coc[..., 90:140, 60:160] = -14.0, -6.0
    image[..., 30:40, 30:60] *= 40.0
    return image, coc


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6, 0.8])
def test_a_mixed_pixel_is_split_between_its_two_surfaces(share: float) -> None:
    image, coc = edge(share)
    own, other, other_coc, found = (t[0, ..., 24, 31] for t in matte(image, coc))
    mine, theirs = (RED, BLUE) if share >= 0.5 else (BLUE, RED)
    assert float(found) == pytest.approx(1 - max(share, 1 - share), abs=0.03)
    assert torch.allclose(own, mine, atol=0.02) and torch.allclose(other, theirs, atol=0.02)
    assert float(other_coc) == (0.0 if share >= 0.5 else -12.0)


def test_no_light_is_lost_in_a_split() -> None:
    image, coc = random_scene()
    own, other, _, share = matte(image, coc)
    assert torch.allclose((1 - share) * own + share * other, image, atol=1e-5)
