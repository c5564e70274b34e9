"""A kernel of any shape: the dot's picture deconvolved from the defocused one.

The kernel's pixels are free but for four things: none is negative, they sum to 1, neighbours are alike as far as the
noise leaves them undetermined, and there is no light where a first estimate has next to none (it would be noise that
could not be negative). The smoothing is the one under which pixels that were kept back are foretold best.
"""

from __future__ import annotations

import numpy as np

from ..result import Array, Mask
from .forward import Forward, Solution
from .noise import independent_share

__all__ = ["deconvolved"]

_SMOOTHNESS = 10.0 ** np.arange(0.0, -6.5, -0.5)
_STEPS, _STILL = 150, 1e-4  # the most, and the change over the peak that ends them
_KEPT_BACK = 0.2
_LIT = 0.06  # of the peak of a first estimate, smoothed by a pixel, below which the kernel is dark
_WORSE = 3  # strengths of smoothing in a row that foretell worse, after which weaker ones are not tried


def deconvolved(pair: Forward, shape: Solution) -> tuple[Array, float]:
    """The kernel of a pair of pictures, from a solution to begin with that gives the moves and the kernel's reach.

    Returns:
        The kernel `[k, k]`, k odd, not negative, summing to 1; and twice the log likelihood of pixels that were kept
        back, over that of the solution it began from.
    """
    from scipy.ndimage import binary_dilation, gaussian_filter

    source = pair.moved_source(shape.moves)
    half = min(int(np.ceil(float(shape.params["radius"]))) + 2, pair.half - 1)
    # a fifth of the pixels is kept back; the smoothing under which they are foretold best is taken
    kept_back = np.random.default_rng(0).random(pair.values.size) < _KEPT_BACK
    judged = kept_back & pair.lit[pair.used]
    tried: list[tuple[float, float, Array]] = []
    kernel = pair.kernel(shape)
    margin = half - kernel.shape[0] // 2
    kernel = np.pad(kernel, margin) if margin >= 0 else np.ascontiguousarray(kernel[-margin:margin, -margin:margin])
    for smoothness in _SMOOTHNESS:
        kernel, model = _descend(pair, source, kernel, smoothness, ~kept_back)
        tried.append((float(np.sum((pair.values - model)[judged] ** 2)), float(smoothness), kernel))
        if min(t[0] for t in tried) < min(t[0] for t in tried[-_WORSE:]):
            break
    squares, smoothness, kernel = min(tried, key=lambda t: t[0])
    smooth = gaussian_filter(kernel, 1.0)
    lit = binary_dilation(smooth > _LIT * smooth.max())
    before = float(np.sum((pair.values - shape.model[pair.used])[judged] ** 2))
    kernel, _ = _descend(pair, source, kernel * lit, smoothness, np.ones_like(kept_back), lit)
    count = judged.sum() * independent_share(pair.noise_correlation)
    return kernel, float(count * np.log(before / squares))


def _descend(
    pair: Forward, source: Array, start: Array, smoothness: float, fitted: Mask, lit: Mask | None = None
) -> tuple[Array, Array]:
    """The kernel and the model of the pixels used, by accelerated projected gradients on those that may be lit.

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
        wide = np.pad(ahead, 1)
        rough = 4 * ahead - wide[2:, 1:-1] - wide[:-2, 1:-1] - wide[1:-1, 2:] - wide[1:-1, :-2]
        gradient = pair.correlate(source, error, size) + penalty * rough
        after = np.maximum(ahead - step * gradient, 0.0) * (1.0 if lit is None else lit)
        faster = (1 + np.sqrt(1 + 4 * pace * pace)) / 2
        ahead = after + (pace - 1) / faster * (after - weights)
        moved, weights, pace = float(np.abs(after - weights).max()), after, faster
        if moved < _STILL * float(after.max()):
            break
    model = pair.convolve(source, weights[None])[0]
    return weights / float(weights.sum()), model + float((pair.values - model)[fitted].mean())
