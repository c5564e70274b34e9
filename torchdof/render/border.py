"""Light beyond the frame's border, continued from what is seen along it.

Nothing tells what is out there, but the spectrum of images falls with the square of the frequency, and of such an image
the expectation beyond a straight border is the harmonic continuation: the row at the border, smoothed along it the more
the farther out. Half of the nearest pixel's light and half of a mean along the border, four times as wide to each side
as the place is far, come close to it. Images are smoother than that from one pixel to the next, and return to their
mean farther out: so light goes on as the last two lines do for a few pixels, as far as what is around allows, and part
of the mean is taken from as far inside the frame.

Reference:
    Field, "Relations between the statistics of natural images and the response properties of cortical cells", Journal
    of the Optical Society of America A 4(12), 1987 (the spectrum).
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["continued"]

_WIDTH = 4  # the mean reaches so many times as far to each side as the place lies beyond the border
# fitted to blurred pictures of images that were cut out of larger ones
_INSIDE = 0.2  # of light is that of the line as far inside the frame as the place is beyond
_GOES_ON = 1.5  # times the difference of the last two lines is added to what is beyond,
_TREND_LEVELS = 3  # for distances of 1, 2 and 4 px


def continued(
    light: Tensor, weight: Tensor | None, limit: Tensor | None, ends: tuple[int, int, int, int], farthest: int
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
    """
    weight = torch.ones_like(light[:, :1]) if weight is None else weight

    def beyond(dim: int, index: int, reach: int) -> Tensor:
        last = light.shape[dim] - 1
        lines = torch.tensor([0, *(2**level for level in range(farthest.bit_length() + 1))], device=light.device)
        lines = lines.clamp_max(last) if index == 0 else last - lines.clamp_max(last)
        seen, cover = light.index_select(dim, lines), weight.index_select(dim, lines)
        if limit is not None:
            brightest, most = seen.amax(1, keepdim=True), limit.index_select(dim, lines)
            is_bright = brightest > most
            seen = seen * torch.where(is_bright, most / torch.where(is_bright, brightest, 1.0), 1.0)
        if dim == -1:
            seen, cover = seen.transpose(-1, -2), cover.transpose(-1, -2)
        return _beyond(seen, cover, reach)

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


def _beyond(lines: Tensor, weight: Tensor, reach: int) -> Tensor:
    """What follows on a line at the border, nearest first: ``[B, C, reach, n]``.

    Lines ``[B, C, 1 + levels, n]`` are that one, and those 1, 2, 4, ... pixels inside of it.
    """
    levels, length = lines.shape[-2] - 1, lines.shape[-1]
    # means for distances that are powers of two; between them linear
    powers = [2**level for level in range(levels)]
    half = torch.tensor([_WIDTH * d for d in powers] * 2, device=lines.device)[:, None]
    line = torch.tensor([0] * levels + [*range(1, levels + 1)], device=lines.device)[:, None]
    at = torch.arange(length, device=lines.device)
    start, stop = (at - half).clamp_min(0), (at + (half + 1)).clamp_max(length)  # [2 levels, n]
    sums = functional.pad(torch.cat([lines * weight, weight], 1).double().cumsum(-1), (1, 0))  # of what comes before
    start, stop = ((line * (length + 1) + place).flatten() for place in (start, stop))
    window = sums.flatten(-2).index_select(-1, stop) - sums.flatten(-2).index_select(-1, start)
    window = window.unflatten(-1, (2, levels, -1))  # [B, C + 1, 2, levels, n]
    total = window[:, -1:]
    mean, inside = (window[:, :-1] / torch.where(total > 0, total, 1.0)).to(lines.dtype).unbind(2)
    known = (total[:, :, 1] / torch.where(total[:, :, 0] > 0, total[:, :, 0], 1.0)).clamp(max=1.0).to(lines.dtype)
    inwards = known * (inside - mean)
    own = 0.5 * lines[:, :, :1]
    beyond = own + 0.5 * mean + _INSIDE * inwards
    # where it goes on, it stays within the range of what the last two lines show around it
    shown, around = weight[:, :, :2] > 0, (2, 2 * _WIDTH + 1)
    low, high = (torch.where(shown, sign * lines[:, :, :2], -torch.inf) for sign in (-1.0, 1.0))
    low, high = (functional.max_pool2d(end, around, stride=1, padding=(0, _WIDTH)) for end in (low, high))
    on = torch.minimum(beyond - _GOES_ON * inwards[:, :, :1], torch.maximum(beyond, high))
    on = torch.maximum(on, torch.minimum(beyond, -low))
    mean = torch.cat([on[:, :, :_TREND_LEVELS], beyond[:, :, _TREND_LEVELS:]], 2)
    distance = torch.arange(1, reach + 1, device=lines.device)
    octave = (distance[:, None] >= torch.tensor(powers[1:], device=lines.device)).sum(1)
    part = (distance / 2**octave - 1.0).to(lines.dtype)[:, None]
    return torch.lerp(mean.index_select(2, octave), mean.index_select(2, octave + 1), part)
