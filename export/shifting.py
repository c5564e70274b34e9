"""Linear interpolation by whole maps that are enlarged and shifted: runtimes are slow at lists of single pixels."""

from collections.abc import Iterator

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["samples"]


def samples(values: Tensor, size: tuple[int, int], ratio: float) -> Iterator[tuple[Tensor, Tensor]]:
    """The samples around each pixel of a map, and their shares of the linear mean.

    Args:
        values: Samples ``[B, C, h, w]`` at every ``ratio``-th pixel of the map, with the same centre. At the map's ends
            they go on as they are there; they reach beyond it by less than one of them.
        size: Of the map.
        ratio: 1/2, 1 or more powers of two.
    """
    if ratio < 1:  # midway between four
        share = values.new_full((), 0.25)
        yield from ((values[..., row::2, column::2], share) for row in (0, 1) for column in (0, 1))
        return
    if ratio == 1:
        yield values, values.new_ones(())
        return
    step = int(ratio)
    enlarged = functional.interpolate(
        functional.pad(values, (1,) * 4, mode="replicate"), scale_factor=float(step), mode="nearest"
    )
    rows, columns = (_ends(values, dim, length, step) for dim, length in zip((-2, -1), size, strict=True))
    for row, down in rows:
        for column, right in columns:
            yield enlarged[..., row : row + size[0], column : column + size[1]], down[:, None] * right


def _ends(values: Tensor, dim: int, length: int, step: int) -> list[tuple[int, Tensor]]:
    """Along an axis: by how much to shift the samples before each pixel, and those after it, and their shares."""
    twice = step * (values.shape[dim] + 1) - length + 1  # of the first pixel's place, in pixels of the map
    place = 2 * torch.arange(length, device=values.device) + twice
    part = (place % (2 * step)).to(values.dtype) / (2 * step)
    return [(twice // 2, 1.0 - part), (twice // 2 + step, part)]
