"""Scatter layers by convolution; ``conv2d`` correlates, so it takes kernels turned by 180 degrees.

Light scattered beyond the frame's border is lost, and no light comes from there.
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

from ...tensors import is_traced

CHANNELS = 16
"""Channels of one depthwise convolution: on CPUs fewer take as long, in PyTorch and in onnxruntime."""

DIRECT_TAPS = 21 * 21
"""Taps up to which a kernel is applied directly, in float32: longer sums of equal terms drift by more than 1e-6."""

_FOURIER_STEP = 128  # px: lengths of a Fourier transform are multiples, as large prime factors make it slow


def convolve(light: Tensor, kernels: Tensor, halo: int = 0, turned: bool = False) -> Tensor:
    """Scatter light with one kernel per channel, by convolution.

    Small kernels are applied directly, large ones through a Fourier transform in float64: in float32, the rounding
    error of one highlight would spread over the whole frame.

    Args:
        light: ``[B, C, H, W]``.
        kernels: ``[1 or C, k, k]``, k odd; or one set for each item, ``[B, 1 or C, k, k]``.
        halo: Pixels on each side that scatter into the result ``[B, C, H - 2 halo, W - 2 halo]`` but are not in it; at
            most half of k.
        turned: Whether ``conv2d`` needs the kernels turned; those of a round lens are symmetric, which saves the step.
    """
    half, channels = kernels.shape[-1] // 2, light.shape[1]
    if half == 0:
        return light * kernels
    if (2 * half + 1) ** 2 > DIRECT_TAPS and not is_traced():
        wide = widest_float(light.device)
        # the transform's wrap-around falls into the halo, which is cut off
        area = [-(-(n + 2 * (half - halo)) // _FOURIER_STEP) * _FOURIER_STEP for n in light.shape[-2:]]
        spectrum = torch.fft.rfft2(light.to(wide), s=area) * torch.fft.rfft2(kernels.to(wide), s=area)
        rows, columns = (slice(half + halo, half + n - halo) for n in light.shape[-2:])
        return torch.fft.irfft2(spectrum, s=area)[..., rows, columns].to(light.dtype)
    kernels = kernels.flip(-2, -1) if turned else kernels
    if kernels.dim() == 4:  # one group for each channel of each item
        kernels = kernels.expand(-1, channels, -1, -1).reshape(-1, 1, *kernels.shape[-2:])
        spread = functional.conv2d(light.flatten(0, 1), kernels, padding=half - halo, groups=len(kernels))
        return spread.unflatten(0, (len(light), channels))
    spare = -channels % CHANNELS
    if spare and light.device.type == "cpu":
        light = functional.pad(light, (0, 0, 0, 0, 0, spare))
        kernels = functional.pad(kernels, (0, 0, 0, 0, 0, spare)) if kernels.shape[0] > 1 else kernels
    weights = kernels.expand(light.shape[1], -1, -1).unsqueeze(1)
    return functional.conv2d(light, weights, padding=half - halo, groups=light.shape[1])[:, :channels]


def widest_float(device: torch.device) -> torch.dtype:
    """Dtype for long sums: float64, or float32 on MPS, which has no float64."""
    return torch.float32 if device.type == "mps" else torch.float64
