"""Scatter of one layer: every pixel's light, multiplied into a kernel centred on the pixel, accumulated.

``fold`` does it literally, as the paper's billboards do. ``conv`` reaches the same sums by convolution: a scatter with
one isotropic kernel is a convolution with it. Light scattered over the frame's border is lost, nothing comes in.
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

__all__ = ["conv", "fold"]

_COLUMN_BYTES = 256 * 2**20
_DIRECT_TAPS = 71 * 71
_PACK = 16  # channels of one vectorised depthwise convolution


def fold(light: Tensor, kernels: Tensor, shares: Tensor | None = None) -> Tensor:
    """The paper's scatter, literally: columns of pixel light times kernel, summed where they fall by ``fold``.

    Works in strips of rows, so that the columns stay within 256 MB.

    Args:
        light: ``[B, C, H, W]``.
        kernels: ``[1 or C, k, k]``, k odd; or, with shares, a bank of them ``[n, 1 or C, k, k]``.
        shares: How much of each kernel of the bank a pixel is spread with, ``[B, n, H, W]``.

    Returns:
        ``[B, C, H, W]``. Differentiable in all three.

    Raises:
        ValueError: If the shapes do not fit.

    Reference:
        Sato, Dobashi, Yamamoto, section 3, steps (a) to (c). The adjoint is ``unfold``.

    Example:
        >>> from torchdof import kernel
        >>> light = torch.zeros(1, 1, 3, 3)
        >>> light[..., 1, 1] = 1.0
        >>> bool(torch.allclose(fold(light, kernel.disc(1.2)[None].float())[0, 0], kernel.disc(1.2).float()))
        True
    """
    _check(light, kernels)
    batch, channels, height, width = light.shape
    if shares is None:
        kernels, shares = kernels.unsqueeze(0), light.new_ones(1, 1, 1, 1).expand(batch, 1, height, width)
    size = kernels.shape[-1]
    half = size // 2
    rows = max(1, _COLUMN_BYTES // (batch * channels * size * size * width * light.element_size()))
    bands = []
    for top in range(0, height, rows):
        strip = light[:, :, top : top + rows]
        share = shares[:, :, top : top + rows]
        taps = torch.einsum("bnp,nct->bctp", share.flatten(2), kernels.flatten(2))  # every pixel's own kernel
        columns = strip.flatten(2).unsqueeze(2) * taps  # [B, C, k*k, pixels]
        area = (strip.shape[-2] + 2 * half, width + 2 * half)
        band = functional.fold(columns.flatten(1, 2), area, (size, size))
        bands.append((top, band[..., half : half + width]))
    if len(bands) == 1:
        return bands[0][1][:, :, half : half + height]
    total = light.new_zeros(batch, channels, height + 2 * half, width)
    for top, band in bands:
        total[:, :, top : top + band.shape[-2]] += band
    return total[:, :, half : half + height]


def conv(light: Tensor, kernels: Tensor) -> Tensor:
    """The same scatter with one kernel a channel, by convolution.

    Small kernels are applied directly, 16 channels at a time in ``channels_last``. Large ones go through a Fourier
    transform in float64: in float32 a highlight would leave rounding errors all over the frame.

    Args:
        light: ``[B, C, H, W]``.
        kernels: ``[C, k, k]``, symmetric under a half turn, k odd.

    Returns:
        ``[B, C, H, W]``. Differentiable in both.

    Raises:
        ValueError: If the shapes do not fit.

    Example:
        >>> from torchdof import kernel
        >>> light = torch.rand(1, 2, 9, 9, dtype=torch.float64)
        >>> bank = kernel.disc(1.7)[None].expand(2, -1, -1)
        >>> bool(torch.allclose(conv(light, bank), fold(light, bank)))
        True
    """
    _check(light, kernels)
    size = kernels.shape[-1]
    if size == 1:
        return light * kernels[:, 0, 0, None, None]
    if size * size > _DIRECT_TAPS and not (torch.compiler.is_compiling() or torch.compiler.is_exporting()):
        return _fourier(light, kernels)
    batch, channels, height, width = light.shape
    if channels % _PACK:
        spare = _PACK - channels % _PACK
        light = functional.pad(light, (0, 0, 0, 0, 0, spare))
        kernels = functional.pad(kernels, (0, 0, 0, 0, 0, spare))
    out = functional.conv2d(
        light.contiguous(memory_format=torch.channels_last),
        kernels.unsqueeze(1),
        padding=size // 2,
        groups=kernels.shape[0],
    )
    return out[:, :channels]


def _fourier(light: Tensor, kernels: Tensor) -> Tensor:
    height, width = light.shape[-2:]
    half = kernels.shape[-1] // 2
    area = [_smooth_length(height + 2 * half), _smooth_length(width + 2 * half)]
    spectrum = torch.fft.rfft2(light.to(torch.float64), s=area) * torch.fft.rfft2(kernels.to(torch.float64), s=area)
    spread = torch.fft.irfft2(spectrum, s=area)[..., half : half + height, half : half + width]
    return spread.to(light.dtype)


def _smooth_length(least: int) -> int:
    """Smallest length from ``least`` up whose only prime factors are 2, 3 and 5."""
    length = least
    while True:
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return length
        length += 1


def _check(light: Tensor, kernels: Tensor) -> None:
    if light.ndim != 4:
        raise ValueError(f"light must be [B, C, H, W], got {list(light.shape)}")
    if kernels.shape[-1] != kernels.shape[-2] or kernels.shape[-1] % 2 == 0:
        raise ValueError(f"kernels must be square with an odd width, got {list(kernels.shape)}")
    if kernels.shape[-3] not in (1, light.shape[1]):
        raise ValueError(f"kernels must have 1 or {light.shape[1]} channels as the light does, got {kernels.shape[-3]}")
