"""Continue light beyond the frame's border from the pixels along it.

The scene outside the frame is unknown. The power of images falls with the square of the frequency, and for such images
the expected value beyond a straight border is the harmonic continuation: the border's row, smoothed along the border by
a width that grows with the distance from it. Half of the nearest pixel's light plus half of a mean along the border is
a good approximation; the mean extends to each side by four times the distance.

The mean is over the surface of the nearest pixel and the surfaces behind it. So a subject that the border cuts gives no
light to its background. Beyond the subject itself the background does contribute, because the subject may end there.
Surfaces are separated by the steps of the blur along the border: the steps are summed, slopes count as 0. The range of
the sum is divided into bins, and each pixel belongs to the two bins nearest to its own sum.

Reference:
    Field, "Relations between the statistics of natural images and the response properties of cortical cells", Journal
    of the Optical Society of America A 4(12), 1987 (the spectrum).
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...optics.kernel_cache import kept
from ..engines.traced import is_compiled
from ..rules import active

_WIDTH = 4  # half width of the mean along the border, over the distance from the border; larger smooths more
_BINS = 16  # number of bins; more of them separate more surfaces
_STEP = 0.5  # px on the blur axis: neighbours that differ by less are one surface, by twice that are two


def continued(
    lights: Sequence[Tensor],
    weight: Tensor,
    limit: Tensor,
    ends: tuple[int, int, int, int],
    farthest: int,
    x: Tensor,
    image_x: Tensor,
) -> list[Tensor]:
    """Add continued pixels to the light ``[B, C, H, W]`` of S surfaces at the left, right, top and bottom.

    In a corner, the vertical continuation of the row and the horizontal one of the column are averaged, each weighted
    by its own distance from the frame.

    Args:
        lights: Light of each surface.
        weight: Share of each pixel that each surface covers, concatenated to ``[S B, 1, H, W]``: the weight in means.
        limit: Largest light of a pixel that is not a highlight, ``[B, 1, H, W]``: highlights are not continued.
        ends: Pixels to add at each side; in traced code they may be symbols.
        farthest: Upper limit of ``ends``.
        x: Place of each surface's pixels on the blur axis, concatenated to ``[S B, 1, H, W]``.
        image_x: The same for the image that each surface belongs to.
    """
    maps = [lights, [weight], [x], [limit] * len(lights), [image_x]]
    rows, columns = (
        _beyond(farthest, *(_both(each, dim) for each in maps)).unflatten(1, (len(lights), -1)) for dim in (-2, -1)
    )  # [2, S, B, C, farthest, W]: top and bottom; [2, S, B, C, farthest, H]: left and right
    # corners: the continuations of the row (outwards) and of the column (sideways)
    outwards = torch.stack([rows[..., 0], rows[..., -1]], 1)[..., None]  # [top or bottom, left or right, ..., 1]
    sideways = torch.stack([columns[..., 0], columns[..., -1]])[..., None, :]
    across = torch.arange(1, farthest + 1, device=rows.device).to(rows.dtype)
    far = across[:, None]
    corners = (outwards * far + sideways * across) / (far + across)
    left, right, top, bottom = ends
    wide = []
    for k, light in enumerate(lights):
        before, after = columns[0, k, ..., :left, :], columns[1, k, ..., :right, :]
        lines = [torch.cat([before.flip(-2).transpose(-1, -2), light, after.transpose(-1, -2)], -1)]
        for side, added in ((0, top), (1, bottom)):
            parts = (corners[side, 0, k, ..., :left].flip(-1), rows[side, k], corners[side, 1, k, ..., :right])
            lines.append(torch.cat(parts, -1)[..., :added, :])
        wide.append(torch.cat([lines[1].flip(-2), lines[0], lines[2]], -2))
    return wide


def repeated(values: Tensor, ends: tuple[int, int, int, int]) -> Tensor:
    """Repeat the border of maps for some pixels at the left, right, top and bottom."""
    if not is_compiled():
        return functional.pad(values, ends, mode="replicate")
    # the default compiler expects another memory layout of that function's gradient than PyTorch gives it
    for dim, before, after in ((-1, *ends[:2]), (-2, *ends[2:])):
        places = torch.arange(-before, values.shape[dim] + after, device=values.device)
        values = values.index_select(dim, places.clamp(0, values.shape[dim] - 1))
    return values


def _both(maps: Sequence[Tensor], dim: int) -> Tensor:
    """First and last line of maps ``[B, c, H, W]`` along ``dim``: ``[2, maps B, c, n]``."""
    return torch.stack([torch.cat([values.select(dim, end) for values in maps]) for end in (0, -1)])


def _bins(x: Tensor, image_x: Tensor) -> Tensor:
    """Signed distance of each pixel from each bin, in bins: lines ``[..., 1, n]`` to ``[..., 1, bins, n]``."""
    surface = functional.pad(_step(image_x.diff()).cumsum(-1), (1, 0))
    low, high = surface.amin(-1, keepdim=True), surface.amax(-1, keepdim=True)
    per_bin = (_BINS - 1) / (high - low).clamp_min(1.0)
    place = ((surface + _step(x - image_x) - low) * per_bin).clamp(0.0, _BINS - 1.0)
    bins = torch.arange(_BINS, device=x.device, dtype=x.dtype)[:, None]
    return place.unsqueeze(-2) - bins


def _step(difference: Tensor) -> Tensor:
    """Keep differences on the blur axis that are steps between surfaces; set those of a slope to 0."""
    if not active().border_surfaces:
        return torch.zeros_like(difference)
    return difference * (difference.abs() / _STEP - 1.0).clamp(0.0, 1.0)


def _beyond(farthest: int, line: Tensor, weight: Tensor, x: Tensor, most: Tensor, image_x: Tensor) -> Tensor:
    """Continue lines ``[..., C, n]`` at the border by ``farthest`` pixels, nearest first: ``[..., C, farthest, n]``.

    The other arguments are lines ``[..., 1, n]`` of the maps of :func:`continued`.
    """
    brightest = line.amax(-2, keepdim=True)
    is_bright = brightest > most
    line = line * torch.where(is_bright, most / torch.where(is_bright, brightest, 1.0), 1.0)
    values = torch.cat([line * weight, weight], -2)[..., None, :]  # [..., C + 1, 1, n]
    bins = _bins(x, image_x)
    values = values * (1.0 - bins.abs()).clamp_min(0.0)
    # means for distances that are powers of two, interpolated linearly between them
    levels = farthest.bit_length() + 1
    octave, part = _octaves(farthest, levels, line.dtype, line.device)
    window = _window_sums(values, levels) * (1.0 - bins).clamp(0.0, 1.0).unsqueeze(-2)
    window = window.sum(-3)  # of the pixel's own surface and farther ones, [..., C + 1, levels, n]
    total = window[..., -1:, :, :]
    means = window[..., :-1, :, :] / torch.where(total > 0, total, 1.0)
    mean = torch.lerp(means.index_select(-2, octave), means.index_select(-2, octave + 1), part)
    return torch.lerp(line[..., None, :], mean, 0.5 if active().border else 0.0)


def _window_sums(values: Tensor, levels: int) -> Tensor:
    """Sums over the pixels within ``4 * 2**l`` of each pixel of lines ``[..., n]``, for level l: ``[..., levels, n]``.

    Beyond the line there are zeros. The sum over a window is that of two windows of half its width, which both contain
    the pixel in its middle: with radius r, ``sum_2r(i) = sum_r(i - r) + sum_r(i + r) - value(i)``. Unlike differences
    of sums from the start of the line, it is exact to single precision.
    """
    reach = _WIDTH * 2 ** (levels - 1)
    values = functional.pad(values, (reach, reach))
    sums = values[..., :-2] + values[..., 1:-1] + values[..., 2:]  # of pixels with a whole window, as below
    radius, windows = 1, []
    while radius < reach:
        radius *= 2
        sums = sums[..., :-radius] + sums[..., radius:] - values[..., radius:-radius]
        if radius >= _WIDTH:
            beside = reach - radius  # pixels beside the line
            windows.append(sums[..., beside : -beside or None])
    return torch.stack(windows, -2)


@kept
def _octaves(farthest: int, levels: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """For each distance up to ``farthest``, the level below it and the fraction of the way to the next level.

    Level l is for a distance of 2^l pixels. The results are ``[farthest]`` and ``[farthest, 1]``.
    """
    distance = torch.arange(1, farthest + 1, device=device)
    powers = torch.tensor([2**level for level in range(1, levels)], device=device)
    octave = (distance[:, None] >= powers).sum(1)
    return octave, (distance / 2**octave - 1.0).to(dtype)[:, None]
