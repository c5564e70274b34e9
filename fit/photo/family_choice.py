"""Which family a blur needs: the cheapest whose picture a viewer could not tell from the exact one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..problems import FitError
from ..result import Array
from ..validation import a_picture

__all__ = ["COST", "choose", "natural_psnr"]

COST = ("gaussian", "disc", "ring", "softm", "radial")
"""Families by growing number of parameters."""

_CONTRAST = 0.22  # standard deviation of a photograph's levels over its peak
_WIDTH = 256


def natural_psnr(kernel: ArrayLike, other: ArrayLike) -> float:
    """PSNR between a natural image blurred with one kernel and with another, in dB.

    Natural images have an amplitude spectrum of 1/f; with it, the mean squared difference is a sum over the kernels'
    spectra and needs no image: a standard deviation of 0.22 of the peak, 256 px wide, is taken for all.

    Args:
        kernel: `[k, k]`, k odd, sums to 1.
        other: `[l, l]`, l odd, sums to 1.

    Returns:
        Decibels, at most 200.

    Raises:
        FitError: a kernel is not `[k, k]` with an odd k, or not of finite numbers.

    Reference:
        D. J. Field, "Relations between the statistics of natural images and the response properties of cortical
        cells", 1987 (the 1/f spectrum).

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> natural_psnr(psf.disc(6.0), psf.disc(6.0))
        200.0
    """
    first, second = a_picture("kernel", kernel, 1), a_picture("other", other, 1)
    for name, array in (("kernel", first), ("other", second)):
        if array.shape[0] != array.shape[1] or array.shape[0] % 2 == 0:
            raise FitError(f"{name} must be [k, k] with an odd k, got {list(array.shape)}")
    width = max(_WIDTH, first.shape[-1], second.shape[-1])
    frequency = np.hypot(np.fft.fftfreq(width)[:, None], np.fft.rfftfreq(width)[None, :])
    power = np.zeros_like(frequency)
    power[frequency > 0] = frequency[frequency > 0] ** -2
    # the half plane of a real transform stands for both halves
    twice = np.where((np.arange(power.shape[1]) == 0) | (2 * np.arange(power.shape[1]) == width), 1.0, 2.0)
    power *= twice / float((power * twice).sum())
    difference = _spectrum(first, width) - _spectrum(second, width)
    error = _CONTRAST**2 * float((power * np.abs(difference) ** 2).sum())
    return 200.0 if error <= 1e-20 else float(-10 * np.log10(error))


def choose(
    kernels: Mapping[str, Array], bic: Mapping[str, float], accuracy_db: float
) -> tuple[str, str, dict[str, float]]:
    """The cheapest family that is accurate enough.

    `radial` can follow any round blur, so it stands for the truth; where the noise hides the difference (a cheaper
    family has the lower BIC), the cheaper one is as true.

    Args:
        kernels: fitted kernel of each family `[k, k]`; "radial" among them.
        bic: their information criteria.
        accuracy_db: wanted PSNR on a natural image.

    Returns:
        The family, one sentence saying why, and the PSNR of each family.
    """
    reach = {f: natural_psnr(kernels[f], kernels["radial"]) for f in COST if f in kernels}
    reached = ", ".join(f"{f} {reach[f]:.1f} dB" for f in reach if f != "radial")
    for family in COST[:-1]:
        if family in reach and reach[family] >= accuracy_db:
            return family, f"the cheapest with {accuracy_db:g} dB on a natural image ({reached})", reach
    smooth: Sequence[str] = [f for f in COST[:-1] if f in reach]
    if smooth:
        likeliest = min(smooth, key=lambda f: bic[f])
        if bic[likeliest] <= bic["radial"]:
            return likeliest, f"the noise hides what is missing to {accuracy_db:g} dB, lowest BIC ({reached})", reach
    return "radial", f"no cheaper family reaches {accuracy_db:g} dB on a natural image ({reached})", reach


def _spectrum(kernel: Array, width: int) -> Array:
    padded = np.zeros((width, width))
    padded[: kernel.shape[-2], : kernel.shape[-1]] = kernel
    half = kernel.shape[-1] // 2
    return np.asarray(np.fft.rfft2(np.roll(padded, (-half, -half), (0, 1))))
