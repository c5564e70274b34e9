"""A kernel as a picture, for shapes that no round family has: polygons, cat's eyes, coma, scratched or dusty lenses.

Its pixels are free but for three things: none is negative, they sum to 1, and neighbours are alike as far as the noise
leaves them undetermined. The smoothing is the one under which pixels that were kept back are foretold best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..problems import FitError
from ..result import Array, Mask
from ..validation import a_picture
from .diagnostics import noise_near, signal_pixels
from .forward import Forward
from .pair import prepared_pair
from .radial import solve_round

__all__ = ["KernelImage", "fit_kernel_image"]

_SMOOTHNESS = 10.0 ** np.arange(0.0, -6.5, -0.5)
_STEPS = 150
_KEPT_BACK = 0.2


@dataclass(frozen=True)
class KernelImage:
    """A fitted kernel image.

    Attributes:
        kernel: `[k, k]`, k odd, not negative, sums to 1; row 0 is the top of the picture. It is the blur of the picture
            it was fitted to: behind the focus as it stands, in front of it point-reflected against a table's.
        gain: exposure ratio of the pictures.
        background: level under the blurred dot.
        residual: norm of (data - model) over norm of the light.
        noise: the same norm expected of the noise.
    """

    kernel: Array
    gain: float
    background: float
    residual: float
    noise: float


def fit_kernel_image(
    sharp: ArrayLike,
    blurred: ArrayLike,
    *,
    magnification: float = 1.0,
    white: float | None = None,
    files: tuple[str | None, str | None] = (None, None),
) -> KernelImage:
    """Estimate the kernel between a sharp and a defocused picture of a dot without assuming a shape.

    Detail finer than the dot cannot be seen: use a dot of a third of the blur's size or less.

    Args:
        sharp: `[H, W]`, linear light, the dot in focus on a dark ground.
        blurred: `[H, W]`, linear light, the same dot out of focus, the whole blur inside the window.
        magnification: expected size of the dot in the blurred picture over its size in the sharp one.
        white: level at and above which a pixel is clipped; None looks for a plateau.
        files: names of the two pictures, for errors and warnings.

    Raises:
        FitError: wrong shapes, or one of its kinds, named after what is wrong with the capture.

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> sharp = torch.nn.functional.pad(psf.disc(3.0), (20, 20, 20, 20))  # a picture of a dot
        >>> blurred = torch.nn.functional.conv2d(sharp[None, None], psf.disc(6.0)[None, None], padding=6)[0, 0]
        >>> image = fit_kernel_image(sharp.numpy(), blurred.numpy())
        >>> bool(image.kernel.min() >= 0), round(float(image.kernel.sum()), 6)
        (True, 1.0)
    """
    still, data = a_picture("sharp", sharp, 15, files[0]), a_picture("blurred", blurred, 15, files[1])
    if still.shape != data.shape:
        raise FitError(f"sharp and blurred must have the same shape, got {list(still.shape)} and {list(data.shape)}")
    pair = prepared_pair(still, data, "auto", magnification, white, files)[0]
    round_one = solve_round(pair)
    near = signal_pixels(pair)
    noise = noise_near(pair, round_one, near)
    half = min(int(np.ceil(float(round_one.params["radius"]))) + 2, pair.half)
    source = pair.moved_source(round_one.moves)
    size = 2 * half + 1
    begin = pair.kernels("radial", {k: np.asarray(v)[None] for k, v in round_one.params.items()})[0]
    start = _fitted_to(begin, size)
    # a fifth of the pixels is kept back; the smoothing under which they are foretold best is taken
    kept_back = np.random.default_rng(0).random(pair.values.size) < _KEPT_BACK
    best: tuple[float, float, Array] | None = None
    kernel = start
    for smoothness in _SMOOTHNESS:
        kernel, gain, background = _descend(pair, source, kernel, smoothness, ~kept_back)
        model = gain * pair.convolve(source, kernel[None])[0] + background
        squares = float(np.sum((pair.values - model)[kept_back & near.ravel()[pair.flat]] ** 2))
        if best is None or squares < best[0]:
            best = squares, float(smoothness), kernel
    if best is None:
        raise AssertionError("there is always a first strength of smoothing")
    kernel, gain, background = _descend(pair, source, best[2], best[1], np.ones_like(kept_back))
    model = gain * pair.convolve(source, kernel[None])[0] + background
    rms = float(np.sqrt(np.mean((pair.values - model)[near.ravel()[pair.flat]] ** 2)))
    light = float(np.sqrt(np.mean((pair.data[near] - background) ** 2)))
    return KernelImage(kernel, gain, background, rms / light, noise / light)


def _descend(pair: Forward, source: Array, start: Array, smoothness: float, fitted: Mask) -> tuple[Array, float, float]:
    """Accelerated projected gradients on the kernel's pixels; the background is solved inside.

    Reference:
        Beck and Teboulle, "A fast iterative shrinkage-thresholding algorithm", SIAM J. Imaging Sciences 2(1), 2009.
    """
    size = start.shape[0]
    level = float(pair.values.mean())
    shaped = pair.convolve(source, start[None])[0]
    gain = max(float((shaped - shaped.mean()) @ (pair.values - level)) / float(np.var(shaped) * shaped.size), 1e-12)
    largest = float(np.abs(source).max()) ** 2
    penalty = smoothness * largest * 1e-2
    step = 1.0 / (largest + 8 * penalty)
    weights = ahead = gain * start
    pace = 1.0
    for _ in range(_STEPS):
        error = pair.convolve(source, ahead[None])[0] - pair.values
        error = np.where(fitted, error - error[fitted].mean(), 0.0)
        gradient = pair.correlate(source, error, size) + penalty * _laplacian(ahead)
        after = np.maximum(ahead - step * gradient, 0.0)
        faster = (1 + np.sqrt(1 + 4 * pace * pace)) / 2
        ahead = after + (pace - 1) / faster * (after - weights)
        weights, pace = after, faster
    gain = float(weights.sum())
    background = float((pair.values - pair.convolve(source, weights[None])[0])[fitted].mean())
    return weights / gain, gain, background


def _laplacian(picture: Array) -> Array:
    """Minus the second differences of a picture that is dark around."""
    wide = np.pad(picture, 1)
    return np.asarray(4 * picture - wide[2:, 1:-1] - wide[:-2, 1:-1] - wide[1:-1, 2:] - wide[1:-1, :-2])


def _fitted_to(kernel: Array, size: int) -> Array:
    """A kernel cut or padded to a size."""
    margin = (size - kernel.shape[0]) // 2
    if margin >= 0:
        return np.pad(kernel, margin)
    return np.ascontiguousarray(kernel[-margin : margin or None, -margin : margin or None])
