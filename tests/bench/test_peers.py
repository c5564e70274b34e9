"""The adapters in ``examples/benchmarks/tools`` make each tool blur by the given circle of confusion."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from torchdof.bench.accuracy import read_peer, renderers

TOOLS = Path(__file__).parents[2] / "examples" / "benchmarks" / "tools"
SIDE = 65


def fault(blur: Any, radius_px: float) -> str:
    """First fault in the pictures of three dots, in focus, behind and in front of it; "" if all are right.

    A right dot keeps its light within 3 % and its place within 0.75 px. The disc with the dot's second moments has
    `radius_px` within 5 %, in focus 0 within 1 px.
    """
    place, radii = torch.arange(SIDE, dtype=torch.float64) - SIDE // 2, torch.tensor([0.0, radius_px, -radius_px])
    image = torch.zeros(1, 3, SIDE, 3 * SIDE)
    image[..., SIDE // 2, SIDE // 2 :: SIDE] = 8.0
    out = blur(image, radii.repeat_interleave(SIDE).repeat(1, 1, SIDE, 1))
    out = out[0] if isinstance(out, tuple) else out
    if out.shape != image.shape or not bool(out.isfinite().all()):
        return f"{list(out.shape)}, not finite numbers {list(image.shape)}"
    for radius, dot in zip(radii.tolist(), out[0].double().mean(0).split(SIDE, 1), strict=True):
        light = float(dot.sum())
        y, x = (float((dot.sum(axis) * place).sum()) / light for axis in (1, 0))
        square = float((dot * ((place[:, None] - y) ** 2 + (place - x) ** 2)).sum()) / light
        disc_px = math.sqrt(max(2.0 * (square - 1.0 / 6.0), 0.0))  # a pixel's own second moment is 1 / 6
        if abs(light / 8.0 - 1.0) > 0.03:
            return f"{radius:g} px: {light / 8.0:.3f} of its light"
        if max(abs(x), abs(y)) > 0.75:
            return f"{radius:g} px: moved by {x:.2f}, {y:.2f} px"
        if abs(disc_px - abs(radius)) > (0.05 * abs(radius) or 1.0):
            return f"{radius:g} px: as by a disc of {disc_px:.2f} px"
    return ""


@pytest.mark.parametrize("name", ["torchdof", "gegl", "ikoma", "kornia_bins"])
def test_a_renderer_blurs_by_the_circle_of_confusion_that_it_is_given(name: str) -> None:
    blur: Any = renderers(degraded=False).get(name)
    if blur is None:
        try:
            blur = read_peer(TOOLS / f"{name}.py")[1]
        except ValueError as error:
            pytest.skip(str(error))
    assert fault(blur, 6.0) == fault(blur, 11.3) == ""
