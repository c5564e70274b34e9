"""The dot in a picture: position, size, background, clipped pixels; and the noise, which neighbours share."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.ndimage import uniform_filter
from scipy.signal import correlate as correlated
from scipy.signal import fftconvolve

from ..problems import FitError, a_picture, warn
from ..result import Array, Mask

LAGS = 6  # largest distance in pixels of correlated noise; demosaicing reaches 2, a JPEG's blocks 7
_THRESHOLD = 0.15  # of the peak; low enough to keep an uneven ring in one piece
_MIN_SIDE_PX = 9
_MIN_LIGHT = 0.08  # share of the brightest dot's light above which another spot is a dot and not dirt
_MAX_CLIPPED = 0.6  # share of clipped pixels of the dot above which it cannot be fitted
_CUT_BLACKS = 0.1  # share of the paper on its lowest level above which blacks are cut
_NOISE_ASYMMETRY = 1.5  # noise above the mean over noise below it; 1.9 if a tenth of it is cut off
_MIN_PIXELS = 300  # pixels below which a correlation is not estimated
_MIN_SIGMAS = 4.0  # standard errors above which a correlation is significant
_MIN_FINE_SHARE = 1e-4  # smallest share of fine noise


@dataclass(frozen=True)
class Dot:
    """A bright spot on dark ground; lengths in px."""

    x: float  # of the centre; pixel (0, 0) has its centre at 0
    y: float  # the same, downwards
    radius: float  # of a uniform disc with the same second moment
    reach: float  # radius beyond which its light vanishes in the noise
    background: float  # level around it
    peak: float  # highest level of the slightly smoothed picture above the background
    noise: float  # standard deviation of a pixel on the background


def distance_from(dot: Dot, shape: tuple[int, ...]) -> Array:
    """Distance of every pixel of a picture from a dot's centre `[H, W]`, px."""
    rows, columns = np.indices(shape)
    return np.asarray(np.hypot(columns - dot.x, rows - dot.y))


def find_dot(picture: Array, *, file: str | None = None) -> Dot:
    """Finds the only dot in a picture `[H, W]` in linear light; an error of kind "several dots" if there are more."""
    dots = find_dots(picture, file=file)
    if len(dots) > 1:
        places = ", ".join(f"({d.x:.0f}, {d.y:.0f})" for d in dots[:6])
        text = f"{len(dots)} dots where one was expected, at {places}; cover the others, or state crop or dots"
        raise FitError(text, "several dots", file)
    return dots[0]


def find_dots(picture: Array, *, file: str | None = None, smallest: float = _MIN_LIGHT) -> list[Dot]:
    """Finds dots in a picture `[H, W]` in linear light, brightest first, down to a share `smallest` of its light."""
    height, width = a_picture("a picture of a dot", picture, _MIN_SIDE_PX, file).shape
    noise, levels = noise_of(picture), picture[_near_border(picture.shape, max(1, min(height, width) // 20))]
    # a mean without outliers: the median is biased if blacks are cut off at 0, which removes half of the noise
    background = float(np.median(levels))
    if noise > 0 and (is_usual := np.abs(levels - background) <= 5 * noise).any():
        background = float(levels[is_usual].mean())
    smooth = ndimage.gaussian_filter(picture - background, 1.0, mode="nearest")
    peak = float(smooth.max())
    # smoothing by sigma = 1 px leaves 0.28 of white noise; the maximum over many pixels is about 4.5 times that
    smoothed_noise = 0.28 * noise
    if not peak > max(8 * smoothed_noise, 1e-9 * max(float(np.abs(picture).max()), 1e-300)):
        ratio = peak / smoothed_noise if smoothed_noise > 0 else 0.0
        text = f"no dot found: the brightest spot is {ratio:.1f} times the noise, 8 are needed; a white dot on black?"
        raise FitError(text, "no dot", file)
    labels, count = ndimage.label(smooth > max(_THRESHOLD * peak, 5 * smoothed_noise), structure=np.ones((3, 3)))
    light = np.asarray(ndimage.sum_labels(smooth, labels, np.arange(1, count + 1)))
    boxes = ndimage.find_objects(labels)
    dots: list[Dot] = []
    for i in map(int, np.argsort(light)[::-1]):
        if light[i] < smallest * light.max():
            break
        rows, columns = boxes[i]
        if rows.start == 0 or columns.start == 0 or rows.stop == height or columns.stop == width:
            if light[i] == light.max():
                raise FitError("the dot touches the picture's edge; leave dark paper around the blur", "window", file)
            continue
        y, x = ndimage.center_of_mass(smooth, labels, i + 1)
        # measure in a crop, which is much faster in a large frame
        margin = 20 + 2 * max(rows.stop - rows.start, columns.stop - columns.start)
        top, left = max(rows.start - margin, 0), max(columns.start - margin, 0)
        crop = picture[top : rows.stop + margin, left : columns.stop + margin] - background
        x, y, radius, reach = _measured(crop, float(x) - left, float(y) - top, noise, peak)
        dots.append(Dot(x + left, y + top, radius, reach, background, peak, noise))
    return dots


def _measured(levels: Array, x: float, y: float, noise: float, peak: float) -> tuple[float, float, float, float]:
    """Centre, radius and reach of a dot near (x, y), by moments in three rounds, each within the last reach."""
    rows, columns = np.indices(levels.shape).astype(np.float64)
    for _ in range(3):
        distance = np.hypot(columns - x, rows - y)
        rings = np.floor(distance + 0.5).astype(np.int64).ravel()  # one px wide
        count = np.bincount(rings)[: max(3, min(levels.shape) // 2 + 1)]  # without rings that the crop cuts
        mean = np.bincount(rings, weights=levels.ravel())[: count.size] / np.maximum(count, 1)
        # the reach is the radius at which the mean over a ring falls below the noise
        dark = np.abs(mean) < np.maximum(2.5 * noise / np.sqrt(np.maximum(count, 1)), 5e-4 * peak)
        bright = int(np.argmax(mean))
        dark_pairs = np.flatnonzero(dark[bright:-1] & dark[bright + 1 :])
        reach = float(bright + dark_pairs[0] + 1 if dark_pairs.size else mean.size)
        inside = np.where(distance <= reach, levels, 0.0)
        total = float(inside.sum())
        x, y = float((inside * columns).sum() / total), float((inside * rows).sum() / total)
    moment = float((inside * ((columns - x) ** 2 + (rows - y) ** 2)).sum() / total)
    return x, y, float(np.sqrt(max(2 * moment, 0.0))), reach


def inner_pixels(picture: Array, dot: Dot) -> Mask | None:
    """Pixels `[H, W]` of a sharp dot that its edge does not affect; None if they are too few."""
    inside = distance_from(dot, picture.shape) < dot.radius - 4
    return inside if inside.sum() >= 25 else None


def fine_share_inside(picture: Array, dot: Dot) -> float | None:
    """Share of the noise's variance in a sharp dot that second differences measure; None if the dot is too small."""
    inside = inner_pixels(picture, dot)
    if inside is None:
        return None
    (rows, columns), levels = np.nonzero(inside), picture[inside]
    x, y = (columns - dot.x) / dot.radius, (rows - dot.y) / dot.radius
    light = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)  # uneven light
    residual = levels - light @ np.linalg.lstsq(light, levels, rcond=None)[0]
    variance = float(residual @ residual) / (levels.size - light.shape[1])
    return min(fine_variance(picture, inside) / variance, 1.0) if variance > 0 else 1.0


def used_pixels(picture: Array, dot: Dot, white: float | None, file: str | None, *, refuse: bool = True) -> Mask:
    """Pixels `[H, W]` that are not clipped, at a plateau if `white` is None; `refuse`: with a warning or an error."""
    level = white if white is not None else _plateau(picture, dot)
    clipped = picture >= (np.inf if level is None else level * (1 - 1e-6))
    count = int(clipped.sum())
    if level is None or not count:
        return ~clipped
    # within the noise of the clipping level only the lower half of the noise is left
    clipped |= uniform_filter(picture, 3, mode="nearest") > level - 3 * dot.noise
    bright = picture > dot.background + 0.15 * dot.peak
    share = float(np.sum(clipped & bright)) / max(int(bright.sum()), 1)
    if refuse and share > _MAX_CLIPPED:
        text = f"{100 * share:.0f} % of the blurred dot's pixels are clipped at {level:.4g}; at least "
        raise FitError(f"{text}{100 - 100 * _MAX_CLIPPED:.0f} % must be below: expose less", "saturated", file)
    if refuse:
        text = f"{count} pixels of the blurred picture are clipped at {level:.4g} and were left out; expose less"
        warn(text, "saturated", file)
    return ~clipped


def _plateau(picture: Array, dot: Dot) -> float | None:
    """The level at which a picture is clipped, if more pixels have it than the next one despite noise; or None."""
    levels, counts = np.unique(picture[picture > dot.background + 0.5 * dot.peak], return_counts=True)
    top, spacing = float(levels[-1]), float(np.median(np.diff(levels))) if levels.size > 1 else 0.0
    # few pixels at the top level are the tail of the noise
    is_peak = counts[-1] >= max(5, 0.02 * counts.sum()) and (levels.size == 1 or counts[-1] > counts[-2])
    return top if is_peak and dot.noise > max(0.6 * spacing, 1e-12 * abs(top)) else None


def check_blacks(picture: Array, dot: Dot, file: str | None) -> None:
    """Warns if the dark paper's noise is cut off below; noise below a level, or symmetric noise, is not."""
    paper = picture[distance_from(dot, picture.shape) > dot.reach + 1]
    levels, counts = np.unique(paper, return_counts=True)
    if levels.size < 2 or counts[0] < _CUT_BLACKS * paper.size:
        return
    exceeds_a_level = dot.noise > max(0.6 * (levels[1] - levels[0]), 1e-6 * dot.peak)
    above, below = np.quantile(paper, 0.995) - paper.mean(), paper.mean() - levels[0]
    if exceeds_a_level and above >= _NOISE_ASYMMETRY * below:
        share = f"{100 * float(counts[0] / paper.size):.0f} % of the paper lies on its lowest level, {levels[0]:.3g}"
        text = f"{share}: cut blacks make the kernel up to 1 % too small; develop so that black lies above its noise"
        warn(text, "saturated", file)


def noise_of(picture: Array) -> float:
    """Standard deviation of a pixel's noise, from second differences, which vanish in a smooth picture."""
    differences = _mixed_differences(picture)
    # near the border, away from the dot's edges
    magnitudes = np.abs(differences[_near_border(differences.shape, max(3, min(picture.shape) // 5))])
    # a mosaic's pixels differ in noise, so use the mean square, without outliers; interpolated ones may have none
    typical = 1.4826 * float(np.median(magnitudes))
    typical = typical if typical > 1e-9 * float(np.abs(picture).max()) else float(np.percentile(magnitudes, 90))
    return float(np.sqrt(np.mean(magnitudes[magnitudes <= 5 * typical] ** 2)))


def _near_border(shape: tuple[int, ...], width: int) -> Mask:
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
    return np.diff(np.diff(picture, 2, axis=1), 2, axis=0) / 6.0


def correlation_of(values: Array, is_used: Mask) -> Array:
    """Significant correlation of used pixels' noise `[2 LAGS + 1, 2 LAGS + 1]`, with a non-negative spectrum."""
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
    correlation = sums / pairs / max(float(sums[LAGS, LAGS] / pairs[LAGS, LAGS]), np.finfo(float).tiny)
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
    # the paper's own spread, because an insignificant part of the correlation would raise the fine share
    spread = 1.4826 * float(np.median(np.abs(residual[dark] - np.median(residual[dark]))))
    return correlation, min(max((noise_of(picture) / spread) ** 2, _MIN_FINE_SHARE), 1.0) if spread > 0 else 1.0
