"""The expected shape of a kernel, which decides what a blur of a few pixels leaves open.

A picture of a small blur determines the blur's size but not its shape: a wider `softm` with a darker rim gives the same
pixels. Without an expectation, noise or a processor's rounding would choose among such parameters. So a fit counts the
expected shape as one more measurement, with an error as large as the differences between lenses.
"""

import numpy as np

from torchdof.optics.psf import FAMILIES

from ..result import Array, BlurFit

# Mean and standard deviation of the numbers of each family's shape, see `_numbers`; larger deviations: less influence.
# softm: a uniform disc with a slightly soft edge
_EXPECTED = {"ring": [(0.3, 0.4)], "softm": [(0.2, 0.2), (0.0, 0.7), (float(np.log(2.5)), 0.5)]}
_SIMILAR = 0.5  # deviations from the shape of a similar blur, relative to these; larger: less influence


def deviations(family: str, params: Array, like: BlurFit | None) -> tuple[Array, Array]:
    """Deviations of a shape from the expected one, in standard deviations `[n]`, and their slopes `[n, parameters]`.

    Args:
        family: the kernel's family; n is 0 for a family that has only one shape, or many.
        params: the family's parameters, and any others `[parameters]`.
        like: a fit of a similar blur, whose shape is expected if its family is the same.
    """
    if family not in _EXPECTED:
        return np.zeros(0), np.zeros((0, params.size))
    mean, spread = np.array(_EXPECTED[family]).T
    if like is not None and like.family == family:
        mean, spread = _numbers(np.array([like.params[name] for name in FAMILIES[family]]))[0], _SIMILAR * spread
    numbers, slopes = _numbers(params[: len(FAMILIES[family])])
    slopes = np.pad(slopes, ((0, 0), (0, params.size - slopes.shape[1])))
    return (numbers - mean) / spread, slopes / spread[:, None]


def _numbers(params: Array) -> tuple[Array, Array]:
    """Numbers of a shape of any size `[n]`: the second length's share of both; `b` and log `m`; with their slopes."""
    (first, second), others = params[:2], params[2:]
    share_slopes = np.array([-second, first]) / (first + second) ** 2
    numbers, slopes = np.array([second / (first + second)]), np.zeros((1 + others.size, params.size))
    slopes[0, :2] = share_slopes
    if others.size:
        b, m = others
        numbers = np.append(numbers, [b, np.log(m)])
        slopes[1, 2], slopes[2, 3] = 1.0, 1.0 / m
    return numbers, slopes
