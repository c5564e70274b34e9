"""The dot in a picture: where it is, how large, on what background, in how much noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..problems import DotNotFoundError, SeveralDotsError, WindowError
from ..result import Array, Mask

__all__ = [
    "Dot",
    "find_dot",
    "find_dots",
    "fine_share_inside",
    "mixed_differences",
    "noise_inside",
    "noise_of",
    "radial_mean",
    "rounding_of",
]

_THRESHOLD = 0.15  # of the peak: low enough to keep an uneven ring in one piece
_SMALLEST_PX = 9
_TOGETHER = 1.9  # neighbouring second differences share pixels: their mean square is as uncertain as of so many fewer
_OTHER_DOT = 0.08  # light of a second dot, over the first's, that is not dirt


@dataclass(frozen=True)
class Dot:
    """A bright spot on a dark ground.

    Attributes:
        x: centre in px, pixel (0, 0) has its centre at 0.
        y: the same, downwards.
        radius: radius in px of a uniform disc with the same second moment.
        reach: radius in px beyond which its light is lost in the noise.
        background: level around it.
        peak: highest level of the slightly smoothed picture above the background.
        noise: standard deviation of a pixel on the background.
        light: sum of the levels above the background.
    """

    x: float
    y: float
    radius: float
    reach: float
    background: float
    peak: float
    noise: float
    light: float


def find_dot(picture: Array, *, file: str | None = None) -> Dot:
    """The one dot in a picture.

    Args:
        picture: `[H, W]`, linear light.
        file: named in errors.

    Raises:
        DotNotFoundError: nothing stands out from the noise.
        SeveralDotsError: more than one does.
        WindowError: the dot touches the edge of the picture, or that is too small.
    """
    dots = find_dots(picture, file=file)
    if len(dots) > 1:
        where = ", ".join(f"({d.x:.0f}, {d.y:.0f})" for d in dots[:6])
        raise SeveralDotsError(
            f"{len(dots)} dots where one was expected, at {where}; cover the others, say crop = [left, top, width, "
            "height] in capture.toml (cropping in an editor loses the scale), or read a grid with dots='centre'",
            file=file,
            number=float(len(dots)),
        )
    return dots[0]


def find_dots(picture: Array, *, file: str | None = None, smallest: float = _OTHER_DOT) -> list[Dot]:
    """Every dot in a picture, the brightest (by its light) first.

    Args:
        picture: `[H, W]`, linear light.
        file: named in errors.
        smallest: least light of a dot over that of the first.

    Raises:
        DotNotFoundError: nothing stands out from the noise.
        WindowError: the brightest dot touches the edge of the picture, or that is too small.
    """
    from scipy import ndimage

    if min(picture.shape) < _SMALLEST_PX:
        raise WindowError(
            f"a picture of {picture.shape[1]}x{picture.shape[0]} px is too small for a dot; {_SMALLEST_PX} px a side "
            "are the least",
            file=file,
            number=float(min(picture.shape)),
        )
    noise = noise_of(picture)
    frame = max(1, min(picture.shape) // 20)
    edge = np.ones(picture.shape, dtype=bool)
    edge[frame:-frame, frame:-frame] = False
    background = _level(picture[edge], noise)
    smooth = ndimage.gaussian_filter(picture - background, 1.0, mode="nearest")
    peak = float(smooth.max())
    # smoothing by sigma = 1 px leaves 0.28 of white noise; its largest of many pixels is about 4.5 of that
    floor = 0.28 * noise
    if not peak > max(8 * floor, 1e-9 * max(float(np.abs(picture).max()), 1e-300)):
        ratio = peak / floor if floor > 0 else 0.0
        raise DotNotFoundError(
            f"no dot found: the brightest spot is {ratio:.1f} times the noise, at least 8 are needed; is it a white "
            "dot on black paper, well exposed?",
            file=file,
            number=ratio,
        )
    labels, count = ndimage.label(smooth > max(_THRESHOLD * peak, 5 * floor), structure=np.ones((3, 3)))
    light = np.asarray(ndimage.sum_labels(smooth, labels, np.arange(1, count + 1)))
    order = [int(i) for i in np.argsort(light)[::-1] if light[i] >= smallest * light.max()]
    boxes = ndimage.find_objects(labels)
    height, width = picture.shape
    dots = []
    for rank, i in enumerate(order):
        rows, columns = boxes[i]
        if rows.start == 0 or columns.start == 0 or rows.stop == height or columns.stop == width:
            if rank == 0:
                raise WindowError(
                    f"the dot touches the picture's edge (rows {rows.start}-{rows.stop}, columns "
                    f"{columns.start}-{columns.stop} of {height}x{width}); leave dark paper around the whole blur",
                    file=file,
                    number=1.0,
                )
            continue
        y, x = ndimage.center_of_mass(smooth, labels, i + 1)
        # a crop around the spot is enough, and much faster in a large frame
        margin = 20 + 2 * max(rows.stop - rows.start, columns.stop - columns.start)
        top, left = max(rows.start - margin, 0), max(columns.start - margin, 0)
        crop = picture[top : rows.stop + margin, left : columns.stop + margin] - background
        dot = _measure(crop, float(x) - left, float(y) - top, background, noise, peak)
        dots.append(replace(dot, x=dot.x + left, y=dot.y + top))
    return dots


def _level(values: Array, noise: float) -> float:
    """Mean without outliers: where blacks are cut off at 0, half the noise is gone and the median is not the mean."""
    middle = float(np.median(values))
    kept = values[np.abs(values - middle) <= 5 * noise]
    return float(kept.mean()) if noise > 0 and kept.size else middle


def _measure(above: Array, x: float, y: float, background: float, noise: float, peak: float) -> Dot:
    """Centre, reach, radius and light of a dot around (x, y), by moments; three rounds, each within the reach found."""
    height, width = above.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    reach = 0.0
    for _ in range(3):
        distance = np.hypot(columns - x, rows - y)
        reach = _reach(above, distance, noise, peak)
        inside = np.where(distance <= reach, above, 0.0)
        total = float(inside.sum())
        x, y = float((inside * columns).sum() / total), float((inside * rows).sum() / total)
    moment = float((inside * ((columns - x) ** 2 + (rows - y) ** 2)).sum() / total)
    return Dot(x, y, float(np.sqrt(max(2 * moment, 0.0))), reach, background, peak, noise, total)


def _reach(above: Array, distance: Array, noise: float, peak: float) -> float:
    """Radius in px from which on the mean level over rings is not above the noise."""
    mean, count = radial_mean(above, distance)
    # light so faint that neither the noise nor a moment would feel it
    dark = np.abs(mean) < np.maximum(2.5 * noise / np.sqrt(np.maximum(count, 1)), 5e-4 * peak)
    quiet = dark[:-1] & dark[1:]
    bright = int(np.argmax(mean))
    first = np.flatnonzero(quiet[bright:])
    return float(bright + first[0] + 1 if first.size else mean.size)


def radial_mean(picture: Array, distance: Array) -> tuple[Array, Array]:
    """Mean of a picture over rings one px wide, and how many pixels each has: both `[largest whole ring]`."""
    bins = np.floor(distance + 0.5).astype(np.int64).ravel()
    count = np.bincount(bins)
    total = np.bincount(bins, weights=picture.ravel())
    height, width = picture.shape
    whole = max(3, min(count.size, min(height, width) // 2 + 1))
    return total[:whole] / np.maximum(count[:whole], 1), count[:whole].astype(np.float64)


def _inside(picture: Array, dot: Dot) -> Mask | None:
    """Pixels `[H, W]` that the edge of a sharp dot does not reach; None where they are too few."""
    rows, columns = np.indices(picture.shape)
    inside = np.asarray(np.hypot(columns - dot.x, rows - dot.y) < dot.radius - 4)
    return inside if inside.sum() >= 25 else None


def fine_share_inside(picture: Array, dot: Dot) -> float | None:
    """Share of the noise's variance within a sharp dot that second differences see; None where the dot is too small.

    A JPEG keeps fine noise in the light that it takes away in the dark. Uneven light, a parabola, is no noise.
    """
    inside = _inside(picture, dot)
    if inside is None:
        return None
    rows, columns = np.nonzero(inside)
    x, y = (columns - dot.x) / dot.radius, (rows - dot.y) / dot.radius
    light = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    levels = picture[inside]
    left = levels - light @ np.linalg.lstsq(light, levels, rcond=None)[0]
    variance = float(left @ left) / (levels.size - light.shape[1])
    fine = float(np.mean(mixed_differences(picture)[inside[1:-1, 1:-1]] ** 2))
    return min(fine / variance, 1.0) if variance > 0 else 1.0


def noise_inside(picture: Array, dot: Dot) -> tuple[float, int] | None:
    """Deviation of a pixel's noise within a sharp dot, and how certain it is; None where the dot is too small.

    The latter as one over the square of its relative standard error.
    """
    inside = _inside(picture, dot)
    if inside is None:
        return None
    # as `noise_of` measures it, which sees another share of noise that goes together in neighbours than one axis does
    found = float(np.sqrt(np.mean(mixed_differences(picture)[inside[1:-1, 1:-1]] ** 2)))
    return found, int(inside.sum() / _TOGETHER)


def noise_of(picture: Array) -> float:
    """Standard deviation of a pixel's noise, from second differences that a smooth picture does not have."""
    differences = mixed_differences(picture)
    # the border is where a dot's own edges are not
    frame = max(3, min(picture.shape) // 5)
    edge = np.ones(differences.shape, dtype=bool)
    edge[frame:-frame, frame:-frame] = False
    sizes = np.abs(differences[edge])
    # pixels of a mosaic have unlike noise: its mean square counts, not its median. Where most are interpolated (one
    # colour of a mosaic), those that are not carry it
    usual = 1.4826 * float(np.median(sizes))
    usual = usual if usual > 1e-9 * float(np.abs(picture).max()) else float(np.percentile(sizes, 90))
    return float(np.sqrt(np.mean(sizes[sizes <= 5 * usual] ** 2)))


def rounding_of(levels: Array) -> float:
    """Variance of the noise that a file's few levels make, or hide, at most: of a level halfway between two of them.

    Args:
        levels: of some pixels. They may be means of three colours, whose levels lie three times as far apart.
    """
    steps = np.diff(np.unique(levels))
    steps = steps[steps > 1e-6 * np.abs(levels).max(initial=0.0)]  # sums of one mean differ in their last digit
    return 3 * float(steps.min()) ** 2 / 4 if steps.size else 0.0


def mixed_differences(picture: Array) -> Array:
    """Second differences down and across `[H - 2, W - 2]`, as large as independent noise."""
    rows = picture[:, 2:] - 2 * picture[:, 1:-1] + picture[:, :-2]
    return (rows[2:] - 2 * rows[1:-1] + rows[:-2]) / 6.0
