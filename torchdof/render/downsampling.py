"""Blur layers at a coarser resolution: average blocks of pixels, convolve with a smaller kernel, interpolate.

A layer at every ``s``-th pixel is averaged over blocks of ``s x s`` pixels, convolved, and interpolated linearly. This
adds ``v = 1/4 - 1/(12 s^2)`` to the variance of its kernel, in squares of its pixels. So a kernel of variance ``V`` is
made smaller, by the factor

    ``sqrt(1 - k v / V)``.

For a Gaussian ``k`` is 1, because variances add. A disc would become too small with this ``k``: its visible feature is
its edge. The best factor minimises the expected squared difference between this chain and the exact kernel, over images
whose power falls with the square of the frequency, as in photographs. For all radii and resolutions in use, a constant
``k`` (1/2 for a disc) gives it to within 0.2 % of the radius; :func:`_correction` finds ``k`` once for a lens.

Reference:
    Field, "Relations between the statistics of natural images and the response properties of cortical cells", Journal
    of the Optical Society of America A 4(12), 1987 (the spectrum).
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.kernel_bank import KernelBank

_LEAST = 0.5  # lower limit of the factor, for kernels hardly wider than the averaging itself

# The comparison in which _correction finds k
_CANDIDATES = 9  # number of factors compared
_SCALE = 4  # downsampling factor
_RADIUS_PX = 5.0  # coarse pixels: coc of the kernel, smaller if the kernel would not fit into the period
_PERIOD = 32  # coarse pixels: side of the periodic area in which kernels are compared


def downsampled(values: Tensor, scale: int) -> Tensor:
    """Mean of each ``scale x scale`` values: ``[B, C, H, W] -> [B, C, H / scale, W / scale]``."""
    return values if scale == 1 else functional.avg_pool2d(values, scale)


def upsampled(values: Tensor, scale: int) -> Tensor:
    """Linear interpolation to ``scale`` times the resolution: ``[B, C, H, W] -> [B, C, scale * H, scale * W]``."""
    return functional.interpolate(values, scale_factor=float(scale), mode="bilinear", align_corners=False)


def shrink(bank: KernelBank, coc_px: float, width: float, scale: int) -> float:
    """Factor, 1/2 to 1, for the coc of a kernel that is used at every ``scale``-th pixel, to undo the averaging's blur.

    ``coc_px`` is the signed coc, and ``width`` the width of the image, in pixels of the image.
    """
    if bank.is_even or scale == 1:  # of a lens with a field, the masks are shrunk instead
        return 1.0
    added = bank.kept(math.copysign(1.0, coc_px), _correction) * (1 / 4 - 1 / (12 * scale**2))
    return math.sqrt(max(1.0 - added / bank.variance_px(coc_px, width, scale), _LEAST**2))


@torch.inference_mode()
def _correction(bank: KernelBank, one_px: float, width: float) -> float:
    """The constant ``k`` of a lens, from the factor of least error; ``one_px`` is a coc of 1 or -1 px."""
    reach = max(bank.spots([one_px], width).reach[0]) * bank.widest
    radius = min(_RADIUS_PX, (_PERIOD / 2 - 2) / reach)
    coc, width = one_px * radius, width * radius
    frequency = 2 * math.pi * torch.fft.fftfreq(_PERIOD * _SCALE, dtype=torch.float64, device="cpu")
    centres = (torch.arange(_SCALE, dtype=torch.float64, device="cpu") - (_SCALE - 1) / 2)[:, None]
    block = torch.cos(centres * frequency).mean(0)
    offsets = (torch.arange(2 * _SCALE, dtype=torch.float64, device="cpu") - _SCALE + 0.5)[:, None]
    linear = ((1 - offsets.abs() / _SCALE) * torch.cos(offsets * frequency)).sum(0) / _SCALE
    block, linear = (part[:, None] * part for part in (block, linear))
    finest = 2 * math.pi / (8 * _PERIOD * _SCALE)
    power = 1.0 / (frequency[:, None] ** 2 + frequency**2 + finest**2)
    exact = _spectra(bank, [coc * _SCALE], width * _SCALE, _PERIOD * _SCALE)[0]
    # the chain is linear, but it mixes frequencies that are aliases of each other at the coarse resolution
    meant = _aliases(linear * exact * block * power)
    chain = _aliases(linear**2) * _aliases(block**2 * power)
    added = (1 / 4 - 1 / (12 * _SCALE**2)) / bank.variance_px(coc, width, 1.0)
    least = math.sqrt(max(_LEAST**2, 1 - added))
    factors = torch.linspace(least, 1.0, _CANDIDATES, dtype=torch.float64, device="cpu")
    coarse = _spectra(bank, [coc * factor for factor in factors.tolist()], width, _PERIOD)
    errors = (coarse.abs() ** 2 * chain - 2 * (coarse.conj() * meant).real).sum((-2, -1))
    # the error of a disc ripples with the position of its edge between pixels: fit a parabola, and take its minimum
    powers = torch.stack([factors**2, factors, torch.ones_like(factors)], 1)
    bend, slope, _ = torch.linalg.lstsq(powers, errors[:, None]).solution[:, 0].tolist()
    best = min(max(-slope / (2 * bend), least), 1.0) if bend > 0 else least
    return min((1.0 - best**2) / added, 1.0)


def _spectra(bank: KernelBank, coc_px: Sequence[float], width: float, length: int) -> Tensor:
    """Spectra ``[n, length, length]`` of kernels, averaged over colours, with a period of ``length`` pixels."""
    kernels = bank.kernels(coc_px, width).mean(1)
    side = kernels.shape[-1]
    periods = functional.pad(kernels, (0, length - side, 0, length - side))
    return torch.fft.fft2(periods.roll((-(side // 2), -(side // 2)), (1, 2)))


def _aliases(values: Tensor) -> Tensor:
    """Sum over the frequencies that are aliases of each other at the coarse resolution."""
    return values.unflatten(0, (_SCALE, _PERIOD)).unflatten(2, (_SCALE, _PERIOD)).sum((0, 2))
