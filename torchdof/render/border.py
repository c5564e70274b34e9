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
) -> Tensor:
    """Light ``[B, C, H, W]`` of a surface with so many pixels more at the left, right, top and bottom.

    Beyond a corner the continuations of the two rows that meet there are mixed by how far each goes.

    Args:
        light: Of the surface.
        weight: How much of each pixel it covers, ``[B, 1, H, W]``: the weight in means. None is 1.
        limit: Largest light that is no highlight's, ``[B, 1, H, W]``: a highlight is nowhere else but in its place.
            None: there are none.
        ends: Pixels to add; in traced code they may be symbols.
        farthest: Number that none of them exceeds.
        x: Place of its pixels on the blur axis, ``[B, 1, H, W]``; None: all of them are one surface.
        image_x: The same of the image, of which this is one of two surfaces; None: it is the image's only one.
    """
    weight = torch.ones_like(light[:, :1]) if weight is None else weight

    def beyond(dim: int, index: int, reach: int) -> Tensor:
        line = light.select(dim, index)
        if limit is not None:
            brightest, most = line.amax(1, keepdim=True), limit.select(dim, index)
            is_bright = brightest > most
            line = line * torch.where(is_bright, most / torch.where(is_bright, brightest, 1.0), 1.0)
        bins = None
        if x is not None:
            places = x.select(dim, index)
            bins = _bins(places, places if image_x is None else image_x.select(dim, index))
        return _beyond(line, weight.select(dim, index), bins, reach, farthest)

    left, right = (beyond(-1, index, reach) for index, reach in zip((0, -1), ends[:2], strict=True))  # [B, C, reach, H]
    top, bottom = (beyond(-2, index, reach) for index, reach in zip((0, -1), ends[2:], strict=True))  # [B, C, reach, W]
    rows = []
    for above, index in ((top.flip(-2), 0), (light, None), (bottom, -1)):
        sides = []
        for side, column in ((left, 0), (right, -1)):
            if index is None:
                sides.append(side.transpose(-1, -2))
                continue
            # the corner: the row's own continuation and the column's
            one, other = above[..., column, None], side[..., index][..., None, :]
            far = _distances(above, above.shape[-2])[:, None]
            far = far.flip(0) if index == 0 else far
            across = _distances(above, side.shape[-2])
            sides.append((one * far + other * across) / (far + across))
        rows.append(torch.cat([sides[0].flip(-1), above, sides[1]], -1))
    return torch.cat(rows, -2)


def _distances(like: Tensor, reach: int) -> Tensor:
    """Pixels from the last one of the frame, 1, 2, ... ``reach``."""
    return torch.arange(1, reach + 1, device=like.device).to(like.dtype)


def _bins(x: Tensor, image_x: Tensor) -> Tensor:
    """Place of each pixel of a line among the bins less the bin, ``[B, bins, n]``, from the blur axis ``[B, 1, n]``."""
    x, image_x = x.double(), image_x.double()
    surface = functional.pad(_step(image_x.diff()).cumsum(-1), (1, 0))
    low, high = surface.amin(-1, keepdim=True), surface.amax(-1, keepdim=True)
    per_bin = (_BINS - 1) / (high - low).clamp_min(1.0)
    place = ((surface + _step(x - image_x) - low) * per_bin).clamp(0.0, _BINS - 1.0)
    bins = torch.arange(_BINS, device=x.device, dtype=x.dtype)[:, None]
    return place - bins


def _step(difference: Tensor) -> Tensor:
    """Differences on the blur axis that are steps from one surface to another; 0 for those of a slope."""
    return difference * (difference.abs() / _STEP - 1.0).clamp(0.0, 1.0)


def _beyond(line: Tensor, weight: Tensor, bins: Tensor | None, reach: int, farthest: int) -> Tensor:
    """What follows on a line ``[B, C, n]`` at the border, nearest first: ``[B, C, reach, n]``.

    ``bins`` is what :func:`_bins` gives; None: all pixels lie in one bin.
    """
    # means for distances that are powers of two; between them linear
    at = torch.arange(line.shape[-1], device=line.device)
    values = torch.cat([line * weight, weight], 1).double()[:, :, None]  # [B, C + 1, 1, n]
    values = values if bins is None else values * (1.0 - bins.abs()).clamp_min(0.0)[:, None]
    sums = functional.pad(values.cumsum(-1), (1, 0))  # of what comes before
    levels = farthest.bit_length() + 1
    half = torch.tensor([_WIDTH * 2**level for level in range(levels)], device=line.device)[:, None]
    start, stop = (at - half).clamp_min(0), (at + (half + 1)).clamp_max(line.shape[-1])  # [levels, n]
    window = sums.index_select(-1, stop.flatten()) - sums.index_select(-1, start.flatten())
    window = window.unflatten(-1, (levels, -1))  # [B, C + 1, bins, levels, n]
    if bins is not None:  # those of its own surface, and of farther ones
        window = window * (1.0 - bins).clamp(0.0, 1.0)[:, None, :, None]
    window = window.sum(2)
    total = window[:, -1:]
    means = (window[:, :-1] / torch.where(total > 0, total, 1.0)).to(line.dtype)
    distance = torch.arange(1, reach + 1, device=line.device)
    powers = torch.tensor([2**level for level in range(1, levels)], device=line.device)
    octave = (distance[:, None] >= powers).sum(1)
    part = (distance / 2**octave - 1.0).to(line.dtype)[:, None]
    mean = torch.lerp(means.index_select(2, octave), means.index_select(2, octave + 1), part)
    return torch.lerp(line[:, :, None], mean, 0.5)
