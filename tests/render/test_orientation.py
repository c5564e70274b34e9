"""How the frame is held does not matter: to the border, to what is hidden, to layers."""

import pytest
import torch
import torch.nn.functional as functional

from torchdof import blur_by_coc


@pytest.mark.parametrize("size", [(22, 36), (37, 53), (64, 41)])
@pytest.mark.parametrize("engine", ["native", "torch"])
def test_flips_and_turns_of_the_input_are_flips_and_turns_of_the_picture(
    engine: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    dice = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, *size, generator=dice)
    patches = 24 * torch.rand(1, 1, size[0] // 6 + 1, size[1] // 6 + 1, generator=dice) - 12
    coc = functional.interpolate(patches, size)
    out = blur_by_coc(image, coc, tolerance=0)
    for turns in range(4):
        for flip in ([], [-1]):
            held = [torch.rot90(t, turns, (-2, -1)).flip(flip) for t in (image, coc, out)]
            torch.testing.assert_close(blur_by_coc(held[0], held[1], tolerance=0), held[2], rtol=0, atol=2e-5)
