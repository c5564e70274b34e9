"""Light beyond the frame's border, continued from what is seen along it.

Nothing tells what is out there, but the spectrum of images falls with the square of the frequency, and of such an image
the expectation beyond a straight border is the harmonic continuation: the row at the border, smoothed along it the more
the farther out. Half of the nearest pixel's light and half of a mean along the border, four times as wide to each side
as the place is far, come close to it.

The mean is over the surface that the nearest pixel shows and those behind it: no light of a subject that the border
cuts goes into its background, while the subject may end beyond the border and show what is behind. Surfaces are told
apart by the steps of the blur along the border, added up; slopes do not count. The sum is divided into bins, and each
pixel belongs to the two bins beside its own sum.

Reference:
    Field, "Relations between the statistics of natural images and the response properties of cortical cells", Journal
    of the Optical Society of America A 4(12), 1987 (the spectrum).
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.kernel_cache import kept

__all__ = ["continued"]

_WIDTH = 4  # the mean reaches so many times as far to each side as the place lies beyond the border
_BINS = 16  # number of bins; a larger one separates more surfaces
_STEP = 0.5  # largest difference of neighbours on one surface, on the blur axis; twice that is a whole step


def continued(
    light: Tensor,
    weight: Tensor | None,
    limit: Tensor | None,
    ends: tuple[int, int, int, int],
    farthest: int,
    x: Tensor | None = None,
    image_x: Tensor | None = None,
    surfaces: int = 1,
) -> Tensor:
    """Adds pixels to light ``[B, C, H, W]`` at the left, right, top and bottom.

    Beyond a corner the continuations of the two rows that meet there are mixed by how far each goes.

    Args:
        light: Of one surface; or of several, one after the other along the batch, B items altogether.
        weight: Share of each pixel that the surface covers, ``[B, 1, H, W]``: the weight in means. None is 1.
        limit: Largest light of a pixel that is not a highlight, ``[B / surfaces, 1, H, W]``: highlights are not
            continued. None: there are no highlights.
        ends: Pixels to add; in traced code they may be symbols.
        farthest: Number that none of them exceeds.
        x: Place of the pixels on the blur axis, ``[B, 1, H, W]``; None: all of them are one surface.
        image_x: The same of the image, ``[B / surfaces, 1, H, W]``; None: the image has the one surface.
        surfaces: Number of surfaces.
    """
    rows, columns = (
        _beyond(
            _both(light, dim),
            None if weight is None else _both(weight, dim),
            None if x is None else _both(x, dim),
            None if limit is None else _both(limit, dim, surfaces),
            None if image_x is None else _both(image_x, dim, surfaces),
            farthest,
        )
        for dim in (-2, -1)
    )  # [2, B, C, farthest, W]: top and bottom; [2, B, C, farthest, H]: left and right
    # the corners: the row's own continuation and the column's
    outwards = torch.stack([rows[..., 0], rows[..., -1]], 1)[..., None]  # [top or bottom, left or right, ..., 1]
    sideways = torch.stack([columns[..., 0], columns[..., -1]])[..., None, :]
    far, across = _distances(rows, farthest)[:, None], _distances(rows, farthest)
    corners = (outwards * far + sideways * across) / (far + across)
    left, right, top, bottom = ends
    before, after = columns[0, ..., :left, :], columns[1, ..., :right, :]
    lines = [torch.cat([before.flip(-2).transpose(-1, -2), light, after.transpose(-1, -2)], -1)]
    for side, count in ((0, top), (1, bottom)):
        parts = (corners[side, 0, ..., :left].flip(-1), rows[side], corners[side, 1, ..., :right])
        lines.append(torch.cat(parts, -1)[..., :count, :])
    return torch.cat([lines[1].flip(-2), lines[0], lines[2]], -2)


def _both(values: Tensor, dim: int, times: int = 1) -> Tensor:
    """First and last line of maps ``[B, c, H, W]`` along an axis, several times: ``[2, times B, c, n]``."""
    lines = torch.stack([values.select(dim, 0), values.select(dim, -1)])
    return lines if times == 1 else lines.repeat(1, times, 1, 1)


def _distances(like: Tensor, reach: int) -> Tensor:
    """Pixels from the last one of the frame, 1, 2, ... ``reach``."""
    return torch.arange(1, reach + 1, device=like.device).to(like.dtype)


def _bins(x: Tensor, image_x: Tensor) -> Tensor:
    """Place of each pixel of a line among the bins less the bin, ``[..., 1, bins, n]``, from ``[..., 1, n]``."""
    x, image_x = x.double(), image_x.double()
    surface = functional.pad(_step(image_x.diff()).cumsum(-1), (1, 0))
    low, high = surface.amin(-1, keepdim=True), surface.amax(-1, keepdim=True)
    per_bin = (_BINS - 1) / (high - low).clamp_min(1.0)
    place = ((surface + _step(x - image_x) - low) * per_bin).clamp(0.0, _BINS - 1.0)
    bins = torch.arange(_BINS, device=x.device, dtype=x.dtype)[:, None]
    return place.unsqueeze(-2) - bins


def _step(difference: Tensor) -> Tensor:
    """Differences on the blur axis that are steps from one surface to another; 0 for those of a slope."""
    return difference * (difference.abs() / _STEP - 1.0).clamp(0.0, 1.0)


def _beyond(
    line: Tensor, weight: Tensor | None, x: Tensor | None, most: Tensor | None, image_x: Tensor | None, farthest: int
) -> Tensor:
    """Continues lines ``[..., C, n]`` at the border by ``farthest`` pixels, nearest first: ``[..., C, farthest, n]``.

    The other arguments are lines of the maps that :func:`continued` has, ``[..., 1, n]``.
    """
    if most is not None:
        brightest = line.amax(-2, keepdim=True)
        is_bright = brightest > most
        line = line * torch.where(is_bright, most / torch.where(is_bright, brightest, 1.0), 1.0)
    weight = torch.ones_like(line[..., :1, :]) if weight is None else weight
    values = torch.cat([line * weight, weight], -2).double()[..., None, :]  # [..., C + 1, 1, n]
    bins = None if x is None else _bins(x, x if image_x is None else image_x)
    values = values if bins is None else values * (1.0 - bins.abs()).clamp_min(0.0)
    sums = functional.pad(values.cumsum(-1), (1, 0))  # of the pixels before each
    # means for distances that are powers of two; between them linear
    levels = farthest.bit_length() + 1
    start, stop, octave, part = _windows(line.shape[-1], farthest, levels, line.dtype, line.device)
    window = (sums.index_select(-1, stop) - sums.index_select(-1, start)).unflatten(-1, (levels, -1))
    if bins is not None:  # those of its own surface, and of farther ones
        window = window * (1.0 - bins).clamp(0.0, 1.0).unsqueeze(-2)
    window = window.sum(-3)  # [..., C + 1, levels, n]
    total = window[..., -1:, :, :]
    means = (window[..., :-1, :, :] / torch.where(total > 0, total, 1.0)).to(line.dtype)
    mean = torch.lerp(means.index_select(-2, octave), means.index_select(-2, octave + 1), part)
    return torch.lerp(line[..., None, :], mean, 0.5)


@kept
def _windows(
    length: int, farthest: int, levels: int, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where the window of each pixel of a line starts and stops, ``[levels n]``; level l is that of 2^l pixels.

    And for each distance up to the farthest the level before it ``[farthest]``, and its share of the way to the next
    level ``[farthest, 1]``.
    """
    at = torch.arange(length, device=device)
    half = torch.tensor([_WIDTH * 2**level for level in range(levels)], device=device)[:, None]
    start, stop = (at - half).clamp_min(0), (at + (half + 1)).clamp_max(length)
    distance = torch.arange(1, farthest + 1, device=device)
    powers = torch.tensor([2**level for level in range(1, levels)], device=device)
    octave = (distance[:, None] >= powers).sum(1)
    return start.flatten(), stop.flatten(), octave, (distance / 2**octave - 1.0).to(dtype)[:, None]
