"""A picture's noise: how large it is, and how it goes together in neighbours.

Demosaicing, denoising and JPEG make noise smooth. It then averages out more slowly than the number of pixels says, and
second differences, which see only what changes from pixel to pixel, take it for less than it is.
"""

import numpy as np
from scipy.ndimage import convolve
from scipy.signal import correlate as correlated

from ..result import Array, Mask

LAGS = 6
"""Pixels up to which noise may go together; demosaicing reaches 2, a JPEG's blocks 7."""

_FEWEST = 300  # pixels below which a correlation is not worth estimating
_CLEAR = 4.0  # standard errors above which a correlation is taken for one
_LEAST_FINE = 1e-4  # share of fine noise that there is at least


def noise_of(picture: Array) -> float:
    """Standard deviation of a pixel's noise, from second differences that a smooth picture does not have."""
    differences = _mixed_differences(picture)
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


def fine_variance(picture: Array, pixels: Mask) -> float:
    """Variance of the noise of some pixels `[H, W]`, as second differences see it; NaN where there are none."""
    inside = pixels[1:-1, 1:-1]
    return float(np.mean(_mixed_differences(picture)[inside] ** 2)) if inside.any() else np.nan


def _mixed_differences(picture: Array) -> Array:
    """Second differences down and across `[H - 2, W - 2]`, as large as independent noise."""
    rows = picture[:, 2:] - 2 * picture[:, 1:-1] + picture[:, :-2]
    return (rows[2:] - 2 * rows[1:-1] + rows[:-2]) / 6.0


def rounding_of(levels: Array) -> float:
    """Variance of the noise that a file's few levels make, or hide, at most: of a level halfway between two of them.

    Levels that are means of three colours lie three times as close.
    """
    steps = np.diff(np.unique(levels))
    steps = steps[steps > 1e-6 * np.abs(levels).max(initial=0.0)]  # sums of one mean differ in their last digit
    return 3 * float(steps.min()) ** 2 / 4 if steps.size else 0.0


def correlation_of(values: Array, used: Mask) -> Array:
    """Correlation of the pixels used of a picture, noise around 0, with their neighbours.

    It is `[2 LAGS + 1, 2 LAGS + 1]`, 1 in the middle; 0 at lags where chance would explain what there is. Its spectrum
    is nowhere negative.
    """
    size = 2 * LAGS + 1
    white = np.zeros((size, size))
    white[LAGS, LAGS] = 1.0
    power = float(np.mean(values[used] ** 2)) if used.any() else 0.0
    if used.sum() < _FEWEST or power <= 0:
        return white
    # outliers (dust, an edge that is not quite fitted) count as five deviations
    kept = np.where(used, np.clip(values, -5 * np.sqrt(power), 5 * np.sqrt(power)), 0.0)
    around = tuple(slice(n - 1 - LAGS, n + LAGS) for n in values.shape)
    sums, pairs = (correlated(p, p, method="fft")[around] for p in (kept, used.astype(np.float64)))
    pairs = np.maximum(np.round(pairs), 1.0)
    found = sums / pairs
    found = found / max(float(found[LAGS, LAGS]), np.finfo(float).tiny)
    # neighbours' correlation makes the estimates of the others less certain
    certain = _CLEAR * np.sqrt(np.sum(np.where(np.abs(found) > _CLEAR / np.sqrt(pairs), found, 0.0) ** 2) / pairs)
    wide = np.pad(np.where(np.abs(found) > certain, found, 0.0), 2 * size)
    spectrum = np.maximum(np.fft.rfft2(np.fft.ifftshift(wide)).real, 0.0)
    found = np.fft.fftshift(np.fft.irfft2(spectrum, wide.shape))[2 * size : 3 * size, 2 * size : 3 * size]
    if not found[LAGS, LAGS] > 0:
        return white
    found = found / found[LAGS, LAGS]
    return np.asarray(np.where(np.abs(found) > 1e-9, found, 0.0))  # without the transform's rounding


def correlate(pictures: Array, correlation: Array) -> Array:
    """Pictures `[n, H, W]` convolved with a correlation: its product with each, as a matrix over the pixels."""
    if np.count_nonzero(correlation) == 1:
        return pictures
    reach = int(np.abs(np.argwhere(correlation) - LAGS).max())
    middle = slice(LAGS - reach, LAGS + reach + 1)
    return np.stack([convolve(p, correlation[middle, middle], mode="constant") for p in pictures])


def independent_share(correlation: Array) -> float:
    """How many independent pixels a pixel is worth, at most 1."""
    return float(min(1.0, 1.0 / max(correlation.sum(), 1e-3)))


def noise_beside(picture: Array, background: float, dark: Mask) -> tuple[Array, float]:
    """How the noise of the paper beside a dot (its pixels are `dark`) goes together, and the share that is fine.

    That is what second differences see of its variance: 1 where neighbours are independent.
    """
    beside = picture - background
    correlation = correlation_of(beside, dark)
    if dark.sum() < _FEWEST:
        return correlation, 1.0
    # a correlation of which chance hides a part makes more of the noise fine than there is, and a mosaic's is not
    # even alike in all pixels: the paper's own spread is the measure
    spread = 1.4826 * float(np.median(np.abs(beside[dark] - np.median(beside[dark]))))
    return correlation, min(max((noise_of(picture) / spread) ** 2, _LEAST_FINE), 1.0) if spread > 0 else 1.0
