"""Kernels of a free shape: a profile by non-negative least squares, a polygon of blades, a deconvolved picture."""

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.fft import irfft2, rfft2
from scipy.ndimage import binary_dilation, center_of_mass, gaussian_filter, laplace, map_coordinates
from scipy.optimize import nnls

from torchdof.optics.aperture import Aperture
from torchdof.optics.psf import pixel_kernels

from ..result import Array, Mask
from .diagnostics import ASYMMETRIC, P_VALUE, asymmetry_of, bic_of, noise_near, residual_rms, size_of_blur, unexplained
from .dot import independent_share
from .forward import Forward, Solution, without_level

# Factor of the effective parameters in cross-validation; larger: smoother profiles. The usual factor 1 sometimes fits
# the noise; 3 is equally good without noise, and up to 12 dB better with it.
_CAUTION = 3.0
_TABLE_SMOOTHNESS = 10.0 ** np.arange(-8.0, 0.0)
_MAX_STEP = {"dx": 0.5, "dy": 0.5, "magnification": 0.02}  # largest step of an iteration
_BLADES = range(3, 10)
_MIN_HARMONIC_CHI = 25.0  # chi squared of a polygon's harmonic (two degrees of freedom) above which a polygon is fitted
_MIN_BIC_GAIN = 10.0  # required decrease of BIC for a polygon; accounts for the choice among seven numbers of blades
_MIN_LIKELIHOOD_GAIN = 24.0  # required increase of twice the log likelihood of withheld pixels, for a picture
_MAX_RATIO = 2.0  # residual over noise above which a picture is tried
_SAMPLES_PER_PX = 8  # samples of an opening's picture for each pixel of the kernel
_MAX_SIDE = 64
_SMOOTHNESS = 10.0 ** np.arange(0.0, -6.5, -0.5)
_MAX_STEPS, _MIN_CHANGE = 150, 1e-4  # most steps, and change relative to the peak that ends them
_WITHHELD = 0.2  # share of pixels withheld
_LIT_SHARE = 0.06  # share of the peak of a first estimate, smoothed by a pixel, below which the kernel is dark
_WORSE_IN_A_ROW = 3  # number of successively worse strengths of smoothing after which weaker ones are not tried


def solve_radial(pair: Forward, moves: dict[str, float], radius: float, knots: int | None = None) -> Solution:
    """Fits densities per square pixel at `knots` radii up to `radius` px (default: 2 a px), and refines the moves."""
    count = knots if knots is not None else int(np.clip(np.ceil(2 * radius), 8, 48))
    half = min(int(np.ceil(radius)) + 1, pair.half)
    values = torch.eye(count, dtype=torch.float64)
    hats = pixel_kernels("radial", {"values": values, "radius": radius}, 2 * half + 1).numpy()
    moves, h = dict(moves), radius / (count - 1)
    hat_light = 2 * np.pi * h * h * np.arange(count, dtype=np.float64)  # integral of each hat over the plane
    hat_light[0], hat_light[-1] = np.pi * h * h / 3, 2 * np.pi * (radius * h / 2 - h * h / 6)
    for _ in range(10):
        columns = hat_light[:, None] * pair.blurred(pair.drawn(moves), hats)[:, pair.used]  # [knots, pixels]
        weights, smoothing = _non_negative(columns, pair.values)
        gain = float(hat_light @ weights)
        kernel = np.tensordot(hat_light * weights / gain, hats, 1)
        shaped = columns.T @ weights / gain
        fitted, gain, background = pair.project(shaped)
        residual = pair.values - fitted
        # one Gauss-Newton step of the moves, for a constant kernel
        slopes = gain * pair.move_columns(moves, pair.fit_moves, kernel).T
        step = np.linalg.lstsq(without_level(slopes, shaped), residual, rcond=None)[0]
        for name, change in zip(pair.fit_moves, step, strict=True):
            moves[name] += float(np.clip(change, -_MAX_STEP[name], _MAX_STEP[name]))
        if np.all(np.abs(step) < 3e-4):
            break
    free, covariance = np.ix_(weights > 0, weights > 0), np.zeros((count, count))
    centred = (columns - columns.mean(axis=1, keepdims=True))[weights > 0].T
    free_covariance = pair.covariance(centred, residual, kernel, gain, smoothing[free]) / gain**2
    covariance[free] = np.where(np.isfinite(free_covariance), free_covariance, 0.0)
    params: dict[str, float | Array] = {"values": weights / float(hat_light @ weights), "radius": radius}
    names, slopes = tuple(f"values[{i}]" for i in range(count)), pair.move_columns(moves, ("dx", "dy"), kernel).T
    return Solution(pair, "radial", params, moves, gain, background, fitted, names, covariance, slopes)


def _non_negative(columns: Array, data: Array) -> tuple[Array, Array]:
    """Weights `[knots]` by generalised cross-validation, and the penalty on second differences that it chose."""
    centred = columns - columns.mean(axis=1, keepdims=True)
    level = data - data.mean()
    normal, right, total = centred @ centred.T, centred @ level, float(level @ level)
    differences = np.diff(np.eye(columns.shape[0]), 2, axis=0)
    penalty = differences.T @ differences * float(np.trace(normal)) / columns.shape[0]
    candidates = []
    for strength in _TABLE_SMOOTHNESS:
        smooth = strength * penalty
        # the Cholesky factor of the normal equations has the same minimum as the tall matrix
        factor = np.linalg.cholesky(normal + smooth + 1e-12 * np.trace(normal) * np.eye(len(normal)))
        weights, _ = nnls(factor.T, np.linalg.solve(factor, right))
        free = np.ix_(weights > 0, weights > 0)
        effective = np.trace(np.linalg.solve((normal + smooth)[free], normal[free]))
        squares = max(total - 2 * float(right @ weights) + float(weights @ normal @ weights), 1e-14 * total)
        score = squares / (data.size - min(_CAUTION * float(effective), 0.9 * data.size)) ** 2
        candidates.append((score, weights, smooth))
    return min(candidates, key=lambda t: t[0])[1:]


def solve_opening(round_fit: Solution) -> tuple[Solution, str] | None:
    """The opening ("polygon" or "image") that explains a free round profile's residual, and why; None if none does."""
    best, excluded, why = round_fit, "round", ""
    blades, harmonic_chi, _ = _harmonic(round_fit)
    if harmonic_chi > _MIN_HARMONIC_CHI:
        polygon = solve_polygon(round_fit)
        gain = bic_of(round_fit) - bic_of(polygon)
        if gain > _MIN_BIC_GAIN:
            best, excluded = polygon, f"round, nor a polygon of {blades} blades"
            why = f"a polygon of {blades} blades, its BIC lower by {gain:.0f} than that of any round profile"
    asymmetry, probability = asymmetry_of(best)
    if (asymmetry > ASYMMETRIC and probability < P_VALUE) or residual_rms(best) > _MAX_RATIO * noise_near(best):
        kernel, gain = _deconvolved(best)
        if gain > _MIN_LIKELIHOOD_GAIN:
            best = solve_image(best, kernel)
            why = f"not {excluded}: a picture predicts withheld pixels better (log likelihood +{gain / 2:.0f})"
    return (best, why) if why else None


def solve_polygon(round_fit: Solution) -> Solution:
    """Fits the regular polygon whose harmonic is the most significant one in a round profile's residual."""
    blades, _, corner = _harmonic(round_fit)
    radius = size_of_blur(round_fit)[0] * math.sqrt(6 / (2 + math.cos(2 * math.pi / blades)))
    start = {"radius": radius, "rotation_deg": (-90.0 - corner) % (360.0 / blades), "curvature": 0.1}
    return replace(round_fit.pair, opening=Aperture(blades)).solve("polygon", start)


def solve_image(previous: Solution, kernel: Array | None = None) -> Solution:
    """Fits the opening as a picture, from a kernel if given; the moves start from those of `previous`."""
    kernel = _deconvolved(previous)[0] if kernel is None else kernel
    y, x = center_of_mass(kernel)
    rows, columns = np.nonzero(kernel > 0.01 * kernel.max())
    half_px = float(np.ceil(np.hypot(rows - y, columns - x).max())) + 1.0  # half the side of the opening's square, px
    side = int(min(_MAX_SIDE, round(2 * half_px * _SAMPLES_PER_PX)))
    positions = ((np.arange(side) + 0.5) / side * 2 - 1) * half_px
    mask = map_coordinates(kernel, np.meshgrid(positions + y, positions + x, indexing="ij"), order=3, mode="constant")
    mask = np.round(np.maximum(mask / mask.max(), 0.0), 4)  # few digits keep the table's file small
    return replace(previous.pair, opening=Aperture(mask=torch.from_numpy(mask))).solve("image", {"radius": half_px})


def _harmonic(round_fit: Solution) -> tuple[int, float, float]:
    """The polygon in a round profile's residual: blades, chi squared, and a corner's angle, degrees clockwise."""
    pair, size = round_fit.pair, np.sqrt(2) * size_of_blur(round_fit)[0]
    half = min(int(np.ceil(1.3 * size)) + 3, pair.half)
    axis = np.arange(2 * half + 1) - half
    angle, r = np.arctan2(axis[:, None], axis), np.hypot(axis[:, None], axis)
    ring = np.exp(-0.5 * ((r - size) / (0.7 + 0.05 * size)) ** 2)
    waves = [ring * wave(n * angle) for n in _BLADES for wave in (np.cos, np.sin)]
    basis = pair.blurred(pair.drawn(round_fit.moves), np.stack(waves))[:, pair.used].T
    products, noise_covariance, _ = unexplained(round_fit, basis)
    candidates = []
    for i, n in enumerate(_BLADES):
        columns = slice(2 * i, 2 * i + 2)
        cosine, sine = np.linalg.pinv(basis[:, columns].T @ basis[:, columns]) @ products[columns]
        score = float(products[columns] @ np.linalg.pinv(noise_covariance[columns, columns]) @ products[columns])
        candidates.append((n, score, math.degrees(math.atan2(sine, cosine)) / n))
    return max(candidates, key=lambda candidate: candidate[1])


def _deconvolved(shape: Solution) -> tuple[Array, float]:
    """A kernel `[k, k]` by deconvolution, and twice the increase of withheld pixels' log likelihood over a solution."""
    pair, kernel, candidates = shape.pair, shape.kernel, list[tuple[float, float, Array]]()
    source = pair.drawn(shape.moves)
    # withhold a fifth of the pixels, and take the smoothing that predicts them best
    is_withheld = np.random.default_rng(0).random(pair.values.size) < _WITHHELD
    is_judged = is_withheld & pair.lit[pair.used]
    margin = min(int(np.ceil(float(shape.params["radius"]))) + 2, pair.half - 1) - kernel.shape[0] // 2
    kernel = np.pad(kernel, margin) if margin >= 0 else np.ascontiguousarray(kernel[-margin:margin, -margin:margin])
    for smoothness in _SMOOTHNESS:
        kernel, model = _descend(pair, source, kernel, smoothness, ~is_withheld)
        candidates.append((float(np.sum((pair.values - model)[is_judged] ** 2)), float(smoothness), kernel))
        if min(t[0] for t in candidates) < min(t[0] for t in candidates[-_WORSE_IN_A_ROW:]):
            break
    squares, smoothness, kernel = min(candidates, key=lambda t: t[0])
    smoothed = gaussian_filter(kernel, 1.0)
    is_lit = binary_dilation(smoothed > _LIT_SHARE * smoothed.max())
    squares_before = float(np.sum(shape.residual[is_judged] ** 2))
    kernel, _ = _descend(pair, source, kernel * is_lit, smoothness, np.ones_like(is_withheld), is_lit)
    count = is_judged.sum() * independent_share(pair.noise_correlation)
    return kernel, float(count * np.log(squares_before / squares))


def _descend(
    pair: Forward, source: Array, start: Array, smoothness: float, is_fitted: Mask, is_lit: Mask | None = None
) -> tuple[Array, Array]:
    """The kernel and the model of the used pixels, by accelerated projected gradient descent on the lit kernel pixels.

    Reference:
        Beck and Teboulle, "A fast iterative shrinkage-thresholding algorithm", SIAM J. Imaging Sciences 2(1), 2009.
    """
    transform, half, (height, width) = rfft2(source, pair.grid), len(start) // 2, pair.data.shape

    def blurred(kernel: Array) -> Array:
        full = irfft2(transform * rfft2(kernel, pair.grid), pair.grid)
        return np.asarray(full[half : half + height, half : half + width][pair.used])

    def adjoint(values: Array) -> Array:
        spread = irfft2(np.conj(transform) * rfft2(pair.picture(values), pair.grid), pair.grid)
        return np.asarray(np.roll(spread, (half, half), (0, 1))[: len(start), : len(start)])

    largest = float(np.abs(transform).max()) ** 2
    penalty = smoothness * largest * 1e-2
    step = 1.0 / (largest + 8 * penalty)
    weights = extrapolated = max(pair.project(blurred(start))[1], 1e-12) * start
    momentum, allowed = 1.0, 1.0 if is_lit is None else is_lit
    for _ in range(_MAX_STEPS):
        error = blurred(extrapolated) - pair.values
        error = np.where(is_fitted, error - error[is_fitted].mean(), 0.0)
        gradient = adjoint(error) - penalty * laplace(extrapolated, mode="constant")
        next_weights = np.maximum(extrapolated - step * gradient, 0.0) * allowed
        next_momentum = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
        extrapolated = next_weights + (momentum - 1) / next_momentum * (next_weights - weights)
        change, weights, momentum = float(np.abs(next_weights - weights).max()), next_weights, next_momentum
        if change < _MIN_CHANGE * float(next_weights.max()):
            break
    model = blurred(weights)
    return weights / float(weights.sum()), model + float((pair.values - model)[is_fitted].mean())
