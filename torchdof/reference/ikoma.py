"""The layered formula on which torchdof builds, as published, for comparison."""

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.blur_table import BlurTable

__all__ = ["layered_fft"]


def layered_fft(image: Tensor, coc_px: Tensor, spacing_px: float = 0.75) -> Tensor:
    """The published layered formula: no hidden surfaces, no mixed pixels, exact discs, by FFT.

    The frame is padded with its border; where layers leave a hole, the light is divided by their coverage.

    Args:
        image: ``[1, C, H, W]``, linear light; the computation uses its dtype.
        coc_px: ``[1, 1, H, W]``, signed circle of confusion.
        spacing_px: Largest difference in circle of confusion between layers.

    Returns:
        ``[1, C, H, W]``, linear light.

    Reference:
        Ikoma, Nguyen, Metzler, Peng, Wetzstein, "Depth from defocus with learned optics", ICCP 2021.
    """
    low, high = float(coc_px.min()), float(coc_px.max())
    nodes = torch.linspace(low, high, 2 + int((high - low) / spacing_px), dtype=torch.float64)
    layer_index = ((coc_px.double() - low) / max(high - low, 1e-9) * (len(nodes) - 1)).to(image.dtype)
    kernels = BlurTable.disc().kernels(nodes, coc_px.shape[-1])[:, 0].to(image.dtype)
    half = kernels.shape[-1] // 2
    light, layer_index = (functional.pad(x, (half,) * 4, mode="replicate") for x in (image, layer_index))
    height, width = (n + 2 * half for n in image.shape[-2:])
    size = [-(-(n + 2 * half) // 16) * 16 for n in image.shape[-2:]]  # multiples of 16, which make the FFT fast
    out, at_or_behind, covered = torch.zeros_like(image), torch.zeros_like(layer_index), torch.zeros_like(image[:, :1])
    min_visibility = 1e-6 if image.dtype == torch.float64 else 1e-3  # smaller values are rounding noise of the FFT
    for k in reversed(range(len(nodes))):  # far to near
        weight = (1.0 - (layer_index - k).abs()).clamp_min(0.0)
        at_or_behind = at_or_behind + weight
        stack = torch.cat([light * weight, weight, at_or_behind], 1)
        spectrum = torch.fft.rfft2(stack, size) * torch.fft.rfft2(kernels[k], size)
        blurred = torch.fft.irfft2(spectrum, size)[..., 2 * half : height, 2 * half : width]
        visibility = blurred[:, -1:].clamp_min(min_visibility)
        transmitted = 1.0 - (blurred[:, -2:-1] / visibility).clamp(0.0, 1.0)
        out = blurred[:, :-2].clamp_min(0.0) / visibility + transmitted * out
        covered = 1.0 - transmitted + transmitted * covered
    return out / covered.clamp_min(1e-6)
