"""Which family a blur needs: the cheapest whose picture a viewer could not tell from the exact one."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ..problems import FitError
from ..result import Array
from ..validation import a_picture

COST = ("gaussian", "disc", "ring", "softm", "radial")
"""Families by growing number of parameters."""

_CONTRAST = 0.22  # standard deviation of a photograph's levels over its peak
_WIDTH = 256
_EVIDENCE = 2.0  # difference of BIC below which one speaks of none
_LOOK_BELOW = 20.0  # dB by which a highlight may differ more than a photograph
_DARK, _DISPLAY = 0.02, 1 / 2.2


def natural_psnr(kernel: ArrayLike, other: ArrayLike) -> float:
    """PSNR between a natural image blurred with one kernel and with another, in dB.

    Natural images have an amplitude spectrum of 1/f; with it, the mean squared difference is a sum over the kernels'
    spectra and needs no image: a standard deviation of 0.22 of the peak, 256 px wide, is taken for all. The kernels are
    `[k, k]`, k odd, and sum to 1; 200 dB is the most.

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
    first, second = _square("kernel", kernel), _square("other", other)
    width = max(_WIDTH, first.shape[-1], second.shape[-1])
    frequency = np.hypot(np.fft.fftfreq(width)[:, None], np.fft.fftfreq(width))
    frequency[0, 0] = np.inf
    power = frequency**-2 / np.sum(frequency**-2)
    difference = np.zeros((width, width))
    for sign, k in ((1, first), (-1, second)):
        around = np.arange(k.shape[0]) - k.shape[0] // 2
        difference[np.ix_(around, around)] += sign * k
    return _decibels(_CONTRAST**2 * float((power * np.abs(np.fft.fft2(difference)) ** 2).sum()))


def highlight_psnr(kernel: ArrayLike, other: ArrayLike) -> float:
    """PSNR between what a highlight looks like through one kernel and through another, in dB.

    A highlight shows the kernel itself, which a natural image hardly does. It is shown as a display shows it, encoded,
    the other's peak at white, and compared where either is brighter than 2 % of that. Kernels are as for
    :func:`natural_psnr`; the other one is that to be like.

    Raises:
        FitError: a kernel is not `[k, k]` with an odd k, or not of finite numbers.

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> round(highlight_psnr(psf.disc(6.0), psf.ring(2.0, 5.0)))  # nobody would mistake one for the other
        7
    """
    first, second = _square("kernel", kernel), _square("other", other)
    half = max(first.shape[0], second.shape[0]) // 2
    shown = [np.pad(k, half - k.shape[0] // 2) / float(second.max()) for k in (first, second)]
    seen = np.maximum(*shown) > _DARK
    encoded = [np.clip(k[seen], 0, 1) ** _DISPLAY for k in shown]
    return _decibels(float(np.mean((encoded[0] - encoded[1]) ** 2)))


def _decibels(error: float) -> float:
    return 200.0 if error <= 1e-20 else float(-10 * np.log10(error))


def _square(name: str, kernel: ArrayLike) -> Array:
    array = a_picture(name, kernel, 1)
    if array.shape[0] != array.shape[1] or array.shape[0] % 2 == 0:
        raise FitError(f"{name} must be [k, k] with an odd k, got {list(array.shape)}")
    return array


def looks_alike(kernel: Array, other: Array, accuracy_db: float) -> bool:
    """Whether a photograph through a kernel is within `accuracy_db` of that through another, a highlight 20 dB less."""
    look = highlight_psnr(kernel, other)
    return natural_psnr(kernel, other) >= accuracy_db and look >= accuracy_db - _LOOK_BELOW


def choose(
    kernels: Mapping[str, Array], bic: Mapping[str, float], accuracy_db: float
) -> tuple[str, str, dict[str, float]]:
    """The cheapest family that a viewer could not tell from the likeliest one.

    The simplest family within 2 of the lowest BIC stands for the truth. Another one will do if a photograph through it
    is `accuracy_db` from the truth's, and a highlight, where shapes show, at most 20 dB less.

    Returns:
        The family, one sentence saying why and what came second, and the PSNR of each family on a natural image
        against the free profile "radial".
    """
    by_likelihood = sorted(kernels, key=lambda f: (bic[f], COST.index(f)))
    lowest = bic[by_likelihood[0]]
    likeliest = min((f for f in kernels if bic[f] <= lowest + _EVIDENCE), key=COST.index)
    second = next(f for f in by_likelihood if f != likeliest)
    natural = {f: natural_psnr(kernels[f], kernels[likeliest]) for f in kernels}
    look = {f: highlight_psnr(kernels[f], kernels[likeliest]) for f in kernels}
    wanted = f"{accuracy_db:g} dB on a natural image and {accuracy_db - _LOOK_BELOW:g} dB on a highlight"
    enough = [f for f in kernels if natural[f] >= accuracy_db and look[f] >= accuracy_db - _LOOK_BELOW]
    family = min([*enough, likeliest], key=COST.index)
    others = ", ".join(
        f"{f} {natural[f]:.1f} and {look[f]:.1f} dB, BIC {bic[f] - bic[likeliest]:+.0f}"
        for f in by_likelihood
        if f not in (family, likeliest)
    )
    if family == likeliest:
        head = "the lowest BIC" if bic[family] == lowest else f"the simplest within {_EVIDENCE:g} of the lowest BIC"
        margin = bic[second] - bic[likeliest]
        why = f"{head} ({second} second by {margin:.0f}), and no cheaper family has {wanted}"
    else:
        reached = f"{natural[family]:.1f} and {look[family]:.1f} dB"
        why = f"the cheapest with {wanted} ({reached}) against {likeliest}, the likeliest"
    return family, f"{why} ({others})", {f: natural_psnr(kernels[f], kernels["radial"]) for f in kernels}
