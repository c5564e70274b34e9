"""Chooses the kernel family: the cheapest whose picture a viewer cannot distinguish from the most likely one's."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ..problems import FitError, a_picture
from ..result import Array

COST = ("gaussian", "disc", "ring", "softm", "radial")  # families by growing number of parameters
_CONTRAST = 0.22  # standard deviation of a photograph's levels over their peak
_WIDTH = 256  # px; smallest picture for the comparison
_BIC_TIE = 2.0  # difference of BIC that is not significant
_HIGHLIGHT_ALLOWANCE_DB = 20.0  # dB by which a highlight may differ more than a photograph
_COMPARED_LEVEL, _DISPLAY_EXPONENT = 0.02, 1 / 2.2  # level of a highlight that is compared, and exponent of the display


def natural_psnr(kernel: ArrayLike, other: ArrayLike) -> float:
    """PSNR between a natural image blurred with one kernel and with another, in dB, at most 200.

    It needs no image: natural ones have an amplitude spectrum of 1/f; a standard deviation of 0.22 of the peak and a
    width of 256 px are assumed. The kernels are `[k, k]`, k odd, and sum to 1.

    Raises:
        FitError: a kernel is not `[k, k]` with an odd k, or not of finite numbers.

    Reference:
        D. J. Field, "Relations between the statistics of natural images and the response properties of cortical
        cells", 1987 (the 1/f spectrum).

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> disc = psf.pixel_kernels("disc", {"radius": 6.0})
        >>> natural_psnr(disc, disc)
        200.0
    """
    first, second = _of_one_size(kernel, other)
    width = max(_WIDTH, len(first))
    frequency = np.hypot(np.fft.fftfreq(width)[:, None], np.fft.fftfreq(width))
    frequency[0, 0] = np.inf
    natural, difference = frequency**-2, np.abs(np.fft.fft2(first - second, (width, width))) ** 2
    return _decibels(_CONTRAST**2 * float((natural * difference).sum() / natural.sum()))


def highlight_psnr(kernel: ArrayLike, other: ArrayLike) -> float:
    """PSNR between the pictures of a highlight through two kernels, in dB.

    A highlight shows the kernel itself. It is encoded for display with the peak of `other`, the reference, at white,
    and compared where either picture is brighter than 2 % of that. Kernels and errors are as for :func:`natural_psnr`.

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> disc = psf.pixel_kernels("disc", {"radius": 6.0})
        >>> ring = psf.pixel_kernels("ring", {"sigma": 2.0, "r_c": 5.0})
        >>> round(highlight_psnr(disc, ring))  # clearly different
        7
    """
    kernels = _of_one_size(kernel, other)
    scaled = kernels / kernels[1].max()
    first, second = np.clip(scaled[:, scaled.max(axis=0) > _COMPARED_LEVEL], 0, 1) ** _DISPLAY_EXPONENT
    return _decibels(float(np.mean((first - second) ** 2)))


def _decibels(error: float) -> float:
    return float(-10 * np.log10(max(error, 1e-20)))


def _of_one_size(kernel: ArrayLike, other: ArrayLike) -> Array:
    """Two kernels `[2, k, k]`, the smaller one with a border of zeros."""
    arrays = [a_picture("kernel", kernel, 1), a_picture("other", other, 1)]
    for height, width in (array.shape for array in arrays):
        if height != width or height % 2 == 0:
            raise FitError(f"a kernel must be [k, k] with an odd k, got {[height, width]}")
    size = max(map(len, arrays))
    return np.stack([np.pad(array, (size - len(array)) // 2) for array in arrays])


def looks_alike(kernel: Array, other: Array, accuracy_db: float) -> bool:
    """Whether two kernels agree within `accuracy_db` on a photograph, and within 20 dB less on a highlight."""
    return min(natural_psnr(kernel, other), highlight_psnr(kernel, other) + _HIGHLIGHT_ALLOWANCE_DB) >= accuracy_db


def choose(kernels: Mapping[str, Array], bic: Mapping[str, float], accuracy_db: float) -> tuple[str, str]:
    """The cheapest family that looks like the simplest one within 2 of the lowest BIC, and why."""
    likeliest = min((f for f in kernels if bic[f] <= min(bic.values()) + _BIC_TIE), key=COST.index)
    best = kernels[likeliest]
    family = min((f for f in kernels if f == likeliest or looks_alike(kernels[f], best, accuracy_db)), key=COST.index)
    required = f"{accuracy_db:g} dB on a natural image and {accuracy_db - _HIGHLIGHT_ALLOWANCE_DB:g} dB on a highlight"
    compared = [
        f"{f} {natural_psnr(k, best):.1f} and {highlight_psnr(k, best):.1f} dB, BIC {bic[f] - bic[likeliest]:+.0f}"
        for f, k in kernels.items()
        if f != likeliest
    ]
    return family, f"the cheapest with {required} against {likeliest}, the likeliest ({'; '.join(compared)})"
