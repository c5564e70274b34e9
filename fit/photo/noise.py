"""The noise of a picture: its size, and its correlation between neighbours, which demosaicing and JPEG cause."""

import numpy as np
from scipy.signal import correlate as correlated
from scipy.signal import fftconvolve

from ..result import Array, Mask

LAGS = 6
"""Largest distance in pixels of correlated noise; demosaicing reaches 2, a JPEG's blocks 7."""

_MIN_PIXELS = 300  # pixels below which a correlation is not estimated
_MIN_SIGMAS = 4.0  # standard errors above which a correlation is significant
_MIN_FINE_SHARE = 1e-4  # smallest share of fine noise


def noise_of(picture: Array) -> float:
    """Standard deviation of a pixel's noise, from second differences, which vanish in a smooth picture."""
    differences = _mixed_differences(picture)
    # near the border, away from the dot's edges
    magnitudes = np.abs(differences[near_border(differences.shape, max(3, min(picture.shape) // 5))])
    # pixels of a mosaic differ in noise, so use the mean square, without outliers. If most pixels are interpolated (one
    # colour of a mosaic), the others carry the noise
    typical = 1.4826 * float(np.median(magnitudes))
    typical = typical if typical > 1e-9 * float(np.abs(picture).max()) else float(np.percentile(magnitudes, 90))
    return float(np.sqrt(np.mean(magnitudes[magnitudes <= 5 * typical] ** 2)))


def near_border(shape: tuple[int, ...], width: int) -> Mask:
    """Pixels `[H, W]` of a frame of this width along a picture's border."""
    frame = np.ones(shape, dtype=bool)
    frame[width:-width, width:-width] = False
    return frame


def fine_variance(picture: Array, pixels: Mask) -> float:
    """Variance of the noise of some pixels `[H, W]`, by second differences; NaN without pixels."""
    inside = pixels[1:-1, 1:-1]
    return float(np.mean(_mixed_differences(picture)[inside] ** 2)) if inside.any() else np.nan


def _mixed_differences(picture: Array) -> Array:
    """Second differences in both directions `[H - 2, W - 2]`, scaled to the size of independent noise."""
    rows = picture[:, 2:] - 2 * picture[:, 1:-1] + picture[:, :-2]
    return (rows[2:] - 2 * rows[1:-1] + rows[:-2]) / 6.0


def correlation_of(values: Array, is_used: Mask) -> Array:
    """Correlation of the noise (mean 0) of a picture's used pixels `[2 LAGS + 1, 2 LAGS + 1]`; its centre is 1.

    It is 0 at lags without significant correlation, and its spectrum is non-negative.
    """
    size = 2 * LAGS + 1
    white = np.zeros((size, size))
    white[LAGS, LAGS] = 1.0
    power = float(np.mean(values[is_used] ** 2)) if is_used.any() else 0.0
    if is_used.sum() < _MIN_PIXELS or power <= 0:
        return white
    # clip outliers (dust, an edge that is not fitted well) at five standard deviations
    clipped = np.where(is_used, np.clip(values, -5 * np.sqrt(power), 5 * np.sqrt(power)), 0.0)
    lags = tuple(slice(n - 1 - LAGS, n + LAGS) for n in values.shape)
    sums, pairs = (correlated(p, p, method="fft")[lags] for p in (clipped, is_used.astype(np.float64)))
    pairs = np.maximum(np.round(pairs), 1.0)
    correlation = sums / pairs
    correlation = correlation / max(float(correlation[LAGS, LAGS]), np.finfo(float).tiny)
    # correlation makes the estimates at other lags less certain
    significant = np.where(np.abs(correlation) > _MIN_SIGMAS / np.sqrt(pairs), correlation, 0.0)
    threshold = _MIN_SIGMAS * np.sqrt(np.sum(significant**2) / pairs)
    padded = np.pad(np.where(np.abs(correlation) > threshold, correlation, 0.0), 2 * size)
    spectrum = np.maximum(np.fft.rfft2(np.fft.ifftshift(padded)).real, 0.0)
    correlation = np.fft.fftshift(np.fft.irfft2(spectrum, padded.shape))[2 * size : 3 * size, 2 * size : 3 * size]
    if not correlation[LAGS, LAGS] > 0:
        return white
    correlation = correlation / correlation[LAGS, LAGS]
    return np.asarray(np.where(np.abs(correlation) > 1e-9, correlation, 0.0))  # removes the transform's rounding


def correlate(pictures: Array, correlation: Array) -> Array:
    """Convolves pictures `[n, H, W]` with a correlation, that is, multiplies them by the correlation matrix."""
    if np.count_nonzero(correlation) == 1:
        return pictures
    reach = int(np.abs(np.argwhere(correlation) - LAGS).max())
    middle = slice(LAGS - reach, LAGS + reach + 1)
    return np.asarray(fftconvolve(pictures, correlation[None, middle, middle], mode="same", axes=(1, 2)))


def independent_share(correlation: Array) -> float:
    """Number of independent pixels for each pixel, at most 1."""
    return float(min(1.0, 1.0 / max(correlation.sum(), 1e-3)))


def noise_beside(picture: Array, background: float, dark: Mask) -> tuple[Array, float]:
    """Correlation of the noise of some `dark` pixels, and the share of its variance that second differences measure."""
    residual = picture - background
    correlation = correlation_of(residual, dark)
    if dark.sum() < _MIN_PIXELS:
        return correlation, 1.0
    # use the paper's own spread: an insignificant part of the correlation would raise the fine share, and a mosaic's
    # noise differs between pixels
    spread = 1.4826 * float(np.median(np.abs(residual[dark] - np.median(residual[dark]))))
    return correlation, min(max((noise_of(picture) / spread) ** 2, _MIN_FINE_SHARE), 1.0) if spread > 0 else 1.0
