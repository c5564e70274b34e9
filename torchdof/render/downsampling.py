"""Layers at a coarser resolution: the mean of blocks going down, linear interpolation coming up, and a smaller kernel.

A layer at every ``s``-th pixel is averaged over blocks of ``s x s`` pixels, convolved, and interpolated linearly. For a
Gaussian all three together have the width of the kernel that is meant if their second moments sum to it. For a disc,
whose edge is what one sees, that leaves out too much. So the size is the one whose chain differs least from the kernel
itself, by expectation over images whose power falls with the square of the frequency, as that of photographs does.

Reference:
    Field, "Relations between the statistics of natural images and the response properties of cortical cells", Journal
    of the Optical Society of America A 4(12), 1987 (the spectrum).
"""

import math

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.blur_table import BlurTable
from ..optics.kernel_cache import KernelCache

__all__ = ["downsampled", "shrink", "upsampled"]

_PERIOD = 64  # coarse pixels of the period over which kernels are compared
_LARGEST_PX = 10.0  # in coarse pixels; beyond, second moments do
_STEP_PX = 0.25  # coarse pixels between radii that are fitted
_CANDIDATES = 9
_LEAST = 0.5  # a smaller kernel has nothing left to give
_MOMENT_REACH = 64.0  # px; second moments of kernels that large are those of the continuous profile
_factors = KernelCache(2**20)


def downsampled(values: Tensor, scale: int) -> Tensor:
    """Mean of each ``scale x scale`` values: ``[B, C, H, W] -> [B, C, H / scale, W / scale]``."""
    return values if scale == 1 else functional.avg_pool2d(values, scale)


def upsampled(values: Tensor, scale: int) -> Tensor:
    """Linear interpolation to ``scale`` times the resolution: ``[B, C, H, W] -> [B, C, scale * H, scale * W]``."""
    return functional.interpolate(values, scale_factor=float(scale), mode="bilinear", align_corners=False)


def shrink(table: BlurTable, coc_px: float, width: float, scale: int) -> float:
    """Size of a kernel that is used at every ``scale``-th pixel, as a share of the size that it stands for.

    It is a factor for the coc, at most 1. The coc, signed, and the width of the image are in coarse pixels; ``scale``
    is a power of two, from 2.
    """
    if abs(coc_px) > _LARGEST_PX or table.reach_px(coc_px, width) >= _PERIOD / 2 - 1:
        return _by_moments(table, coc_px, width, scale)
    step = math.copysign(round(abs(coc_px) / _STEP_PX) * _STEP_PX, coc_px)
    return _factors.get((table.fingerprint(), step, width, scale), lambda: _fitted(table, step, width, scale))


@torch.inference_mode()
def _fitted(table: BlurTable, coc_px: float, width: float, scale: int) -> float:
    """The factor whose chain differs least from the kernel: the lowest point of a parabola through candidates."""
    frequency = 2 * math.pi * torch.fft.fftfreq(_PERIOD * scale, dtype=torch.float64)
    centres = (torch.arange(scale, dtype=torch.float64) - (scale - 1) / 2)[:, None]
    block = torch.cos(centres * frequency).mean(0)
    offsets = (torch.arange(2 * scale, dtype=torch.float64) - scale + 0.5)[:, None]
    linear = ((1 - offsets.abs() / scale) * torch.cos(offsets * frequency)).sum(0) / scale
    block, linear = (part[:, None] * part for part in (block, linear))
    finest = 2 * math.pi / (8 * _PERIOD * scale)
    power = 1.0 / (frequency[:, None] ** 2 + frequency**2 + finest**2)
    exact = _spectrum(table, coc_px * scale, width * scale, _PERIOD * scale)
    # the chain is linear, but mixes the frequencies that are one to a coarse pixel
    meant = _aliases(linear * exact * block * power, scale)
    chain = _aliases(linear**2, scale) * _aliases(block**2 * power, scale)
    least = _by_moments(table, coc_px, width, scale)
    factors = torch.linspace(least, 1.0, _CANDIDATES, dtype=torch.float64)
    errors = []
    for factor in factors.tolist():
        coarse = _spectrum(table, coc_px * factor, width, _PERIOD)
        errors.append((coarse.abs() ** 2 * chain - 2 * (coarse.conj() * meant).real).sum())
    # the error of a disc ripples with where its edge lies between pixels: a parabola through it does not
    powers = torch.stack([factors**2, factors, torch.ones_like(factors)], 1)
    bend, slope, _ = torch.linalg.lstsq(powers, torch.stack(errors)[:, None]).solution[:, 0].tolist()
    return min(max(-slope / (2 * bend), least), 1.0) if bend > 0 else least


def _spectrum(table: BlurTable, coc_px: float, width: float, length: int) -> Tensor:
    """Spectrum of a kernel, the mean of its colours, over a period of so many pixels."""
    kernel = table.kernels(torch.tensor([coc_px], dtype=torch.float64), width)[0].mean(0)
    half = kernel.shape[-1] // 2
    period = kernel.new_zeros(length, length)
    period[: kernel.shape[-1], : kernel.shape[-1]] = kernel
    return torch.fft.fft2(period.roll((-half, -half), (0, 1)))


def _aliases(values: Tensor, scale: int) -> Tensor:
    """Sum over the frequencies that are one to every ``scale``-th pixel."""
    return values.unflatten(0, (scale, _PERIOD)).unflatten(2, (scale, _PERIOD)).sum((0, 2))


def _by_moments(table: BlurTable, coc_px: float, width: float, scale: int) -> float:
    """The factor that leaves out the second moments of averaging and interpolation."""
    # second moment of the kernel, mean of both axes; that of a large one from a smaller one of the same shape
    smaller = max(1.0, min(table.reach_px(coc_px, width) / _MOMENT_REACH, abs(coc_px)))
    kernel = table.kernels(torch.tensor([coc_px / smaller], dtype=torch.float64), width / smaller)[0]
    axis = torch.arange(kernel.shape[-1], dtype=torch.float64) - kernel.shape[-1] // 2
    lines = kernel.mean(0).sum(0), kernel.mean(0).sum(1)
    variances = [(line * axis**2).sum() - (line * axis).sum() ** 2 for line in lines]
    variance = smaller**2 * float(sum(variances)) / 2
    others = 1 / 4 - 1 / (12 * scale**2)
    return math.sqrt(max(_LEAST**2, 1 - others / variance))
