"""Layers at a coarser resolution: the mean of blocks going down, linear interpolation coming up, and a smaller kernel.

A layer at every ``s``-th pixel is averaged over blocks of ``s x s`` pixels, convolved, and interpolated linearly. This
adds ``v = 1/4 - 1/(12 s^2)`` to the variance of its kernel, in squares of its pixels. So a kernel of variance ``V`` is
made smaller, by the factor

    ``sqrt(1 - k v / V)``.

For a Gaussian ``k`` is 1: second moments sum. A disc, whose edge is what one sees, would lose too much of its size by
that. The best factor is that of the chain that differs least from the kernel itself, by expectation over images whose
power falls with the square of the frequency, as that of photographs does. Over all radii and resolutions in use it is
the one of a constant k to within 0.2 % of the radius (1/2 for a disc), which :func:`_correction` finds once for a lens.

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

__all__ = ["downsampled", "shrink", "upsampled"]

_LEAST = 0.5  # a smaller kernel has nothing left to give
_CANDIDATES = 9
_SCALE = 4  # at which the correction is found,
_RADIUS_PX = 5.0  # for a coc of so many coarse pixels, or what reaches as far as the period allows
_PERIOD = 32  # coarse pixels over which kernels are compared


def downsampled(values: Tensor, scale: int) -> Tensor:
    """Mean of each ``scale x scale`` values: ``[B, C, H, W] -> [B, C, H / scale, W / scale]``."""
    return values if scale == 1 else functional.avg_pool2d(values, scale)


def upsampled(values: Tensor, scale: int) -> Tensor:
    """Linear interpolation to ``scale`` times the resolution: ``[B, C, H, W] -> [B, C, scale * H, scale * W]``."""
    return functional.interpolate(values, scale_factor=float(scale), mode="bilinear", align_corners=False)


def shrink(bank: KernelBank, coc_px: float, width: float, scale: int) -> float:
    """Size of a kernel that is used at every ``scale``-th pixel, as a share of the size that it stands for.

    Args:
        bank: Of the lens.
        coc_px: Signed coc, in pixels of the image.
        width: Width of the image in pixels.
        scale: A power of two.

    Returns:
        A factor for the coc: 1 where the scale is 1, else from 1/2 to 1.
    """
    if bank.is_even or scale == 1:  # spots of a field are made smaller by themselves
        return 1.0
    others = bank.kept(math.copysign(1.0, coc_px), _correction) * (1 / 4 - 1 / (12 * scale**2))
    return math.sqrt(max(1.0 - others / bank.variance_px(coc_px, width, scale), _LEAST**2))


@torch.inference_mode()
def _correction(bank: KernelBank, one_px: float, width: float) -> float:
    """The ``k`` of a lens at a coc of one pixel, signed, in an image of a width: from the factor of least error."""
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
    # the chain is linear, but mixes the frequencies that are one to a coarse pixel
    meant = _aliases(linear * exact * block * power)
    chain = _aliases(linear**2) * _aliases(block**2 * power)
    others = (1 / 4 - 1 / (12 * _SCALE**2)) / bank.variance_px(coc, width, 1.0)
    least = math.sqrt(max(_LEAST**2, 1 - others))
    factors = torch.linspace(least, 1.0, _CANDIDATES, dtype=torch.float64, device="cpu")
    coarse = _spectra(bank, [coc * factor for factor in factors.tolist()], width, _PERIOD)
    errors = (coarse.abs() ** 2 * chain - 2 * (coarse.conj() * meant).real).sum((-2, -1))
    # the error of a disc ripples with where its edge lies between pixels: a parabola through it does not
    powers = torch.stack([factors**2, factors, torch.ones_like(factors)], 1)
    bend, slope, _ = torch.linalg.lstsq(powers, errors[:, None]).solution[:, 0].tolist()
    best = min(max(-slope / (2 * bend), least), 1.0) if bend > 0 else least
    return min((1.0 - best**2) / others, 1.0)


def _spectra(bank: KernelBank, coc_px: Sequence[float], width: float, length: int) -> Tensor:
    """Spectra of kernels ``[n, length, length]``, the mean of their colours, over a period of so many pixels."""
    kernels = bank.kernels(coc_px, width).mean(1)
    side = kernels.shape[-1]
    periods = functional.pad(kernels, (0, length - side, 0, length - side))
    return torch.fft.fft2(periods.roll((-(side // 2), -(side // 2)), (1, 2)))


def _aliases(values: Tensor) -> Tensor:
    """Sum over the frequencies that are one to every coarse pixel."""
    return values.unflatten(0, (_SCALE, _PERIOD)).unflatten(2, (_SCALE, _PERIOD)).sum((0, 2))
