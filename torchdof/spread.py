"""Scatter of one layer: every pixel's light, multiplied into a kernel centred on the pixel, accumulated.

``fold`` does it literally, as the paper's billboards do. ``conv`` reaches the same sums by convolution: a scatter with
one isotropic kernel is a convolution with it. Light scattered over the frame's border is lost, nothing comes in.
"""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .plan import Blur

__all__ = ["Spread", "conv", "fold", "layers_by_conv", "layers_by_fold"]

Spread = Callable[[Tensor, Sequence[tuple[Blur, int]], int], Tensor]
"""``(light [B, C, H + 2 halo, W + 2 halo], [(blur, channels), ...], halo) -> [B, C, H, W]``: layers side by side."""

_COLUMN_BYTES = 256 * 2**20
_DIRECT_TAPS = 21 * 21  # a longer sum of equal terms in float32 drifts by more than 1e-6
_PACK = 16  # channels of one vectorised depthwise convolution


def fold(light: Tensor, kernels: Tensor, shares: Tensor | None = None) -> Tensor:
    """The paper's scatter, literally: columns of pixel light times kernel, summed where they fall by ``fold``.

    Works in strips of rows, so that the columns stay within 256 MB. Sums of large kernels are taken in float64.

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
        >>> from torchdof.optics import psf
        >>> light = torch.zeros(1, 1, 3, 3)
        >>> light[..., 1, 1] = 1.0
        >>> bool(torch.allclose(fold(light, psf.disc(1.2)[None].float())[0, 0], psf.disc(1.2).float()))
        True
    """
    _check(light, kernels)
    batch, channels, height, width = light.shape
    if shares is None:
        kernels, shares = kernels.unsqueeze(0), light.new_ones(1, 1, 1, 1).expand(batch, 1, height, width)
    size = kernels.shape[-1]
    half = size // 2
    if size * size > _DIRECT_TAPS and light.dtype == torch.float32 and not _traced():
        wide = _widest(light.device)
        if wide != light.dtype:
            return fold(light.to(wide), kernels.to(wide), shares.to(wide)).to(light.dtype)
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


def conv(light: Tensor, kernels: Tensor, halo: int = 0) -> Tensor:
    """The same scatter with one kernel a channel, by convolution.

    Small kernels are applied directly, 16 channels at a time. Large ones go through a Fourier
    transform in float64: in float32 a highlight would leave rounding errors all over the frame.

    Args:
        light: ``[B, C, H, W]``.
        kernels: ``[1 or C, k, k]``, symmetric under a half turn, k odd.
        halo: Pixels on each side that scatter light into the result but are not part of it.

    Returns:
        ``[B, C, H - 2 halo, W - 2 halo]``. Differentiable in both.

    Raises:
        ValueError: If the shapes do not fit.

    Example:
        >>> from torchdof.optics import psf
        >>> light = torch.rand(1, 2, 9, 9, dtype=torch.float64)
        >>> bank = psf.disc(1.7)[None].expand(2, -1, -1)
        >>> bool(torch.allclose(conv(light, bank), fold(light, bank)))
        True
    """
    _check(light, kernels)
    half = kernels.shape[-1] // 2
    if halo > half:
        spare = halo - half
        light = light[..., spare : light.shape[-2] - spare, spare : light.shape[-1] - spare]
        halo = half
    if half == 0:
        return light * kernels[:, 0, 0, None, None]
    if (2 * half + 1) ** 2 > _DIRECT_TAPS and not _traced():
        return _fourier(light, kernels.expand(light.shape[1], -1, -1), halo)
    batch, channels = light.shape[:2]
    if batch == 1 and 2 * channels <= _PACK and halo == half and not _traced():  # strips of its rows as items
        strips = conv(_strips(light, half, _PACK // channels), kernels, half)
        return strips.transpose(0, 1).flatten(1, 2)[None, :, : light.shape[-2] - 2 * half]
    together = 1 if _traced() else batch  # items as channels of one convolution
    light = _filled(light.reshape(-1, together * channels, *light.shape[-2:]), 1, _PACK)
    if kernels.shape[0] > 1:
        kernels = _filled(kernels.repeat(together, 1, 1), 0, _PACK)
    weights = kernels.expand(light.shape[1], -1, -1).unsqueeze(1)
    out = functional.conv2d(light, weights, padding=half - halo, groups=light.shape[1])[:, : together * channels]
    return out.reshape(batch, channels, *out.shape[-2:])


def _strips(light: Tensor, halo: int, count: int) -> Tensor:
    """One item in strips of rows: ``[1, C, H + 2 halo, W] -> [count, C, ceil(H / count) + 2 halo, W]``."""
    height = light.shape[-2] - 2 * halo
    rows = -(-height // count)
    light = functional.pad(light, (0, 0, 0, rows * count - height))
    return light[0].unfold(1, rows + 2 * halo, rows).permute(1, 0, 3, 2)


def _filled(values: Tensor, dim: int, multiple: int) -> Tensor:
    """Zeros appended up to a multiple of a length."""
    spare = -values.shape[dim] % multiple
    if not spare:
        return values
    shape = list(values.shape)
    shape[dim] = spare
    return torch.cat([values, values.new_zeros(shape)], dim)


def layers_by_conv(light: Tensor, blurs: Sequence[tuple[Blur, int]], halo: int) -> Tensor:
    """Scatter layers side by side, by convolution."""
    return conv(light, _side_by_side(blurs), halo)


def layers_by_fold(light: Tensor, blurs: Sequence[tuple[Blur, int]], halo: int) -> Tensor:
    """Scatter layers side by side, literally."""
    spreaded = fold(light, _side_by_side(blurs))
    return spreaded[..., halo : spreaded.shape[-2] - halo, halo : spreaded.shape[-1] - halo]


def _side_by_side(blurs: Sequence[tuple[Blur, int]]) -> Tensor:
    """Kernels of all channels, or one for all of them."""
    if len(blurs) == 1 and blurs[0][0].kernel.shape[0] == 1:
        return blurs[0][0].kernel
    half = max(blur.half for blur, _ in blurs)
    kernels = [functional.pad(blur.kernel, (half - blur.half,) * 4) for blur, _ in blurs]
    # a kernel for each channel: the same one, or one colour after the other in each part of the layer
    return torch.cat([k.repeat(channels // k.shape[0], 1, 1) for k, (_, channels) in zip(kernels, blurs, strict=True)])


def _fourier(light: Tensor, kernels: Tensor, halo: int) -> Tensor:
    """Channel by channel, for these transforms are large. What would wrap around falls into the halo."""
    half, wide = kernels.shape[-1] // 2, _widest(light.device)
    area = [_smooth_length(n + 2 * (half - halo)) for n in light.shape[-2:]]
    rows, columns = (slice(half + halo, half + n - halo) for n in light.shape[-2:])
    spectrum, channels = kernels.new_empty(0), []
    for i, kernel in enumerate(kernels):
        if i == 0 or kernels.requires_grad or not torch.equal(kernel, kernels[i - 1]):
            spectrum = torch.fft.rfft2(kernel.to(wide), s=area)
        scattered = torch.fft.irfft2(torch.fft.rfft2(light[:, i].to(wide), s=area) * spectrum, s=area)
        channels.append(scattered[:, rows, columns].to(light.dtype))
    return torch.stack(channels, 1)


def _widest(device: torch.device) -> torch.dtype:
    """Type for long sums; not every device has float64."""
    return torch.float32 if device.type == "mps" else torch.float64


def _traced() -> bool:
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()


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
