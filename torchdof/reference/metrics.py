"""Differences between a rendering and the truth: PSNR in linear light and as displayed, SSIM."""

import math

import torch
from torch import Tensor

from ..io.transfer import encode
from ..validation import real_tensor, show

__all__ = ["display", "psnr", "ssim"]


def display(linear: Tensor) -> Tensor:
    """Linear light as a display shows it: clipped to [0, 1], then the sRGB curve.

    Args:
        linear: Any shape, linear light.

    Returns:
        The same shape, in [0, 1].

    Raises:
        ValueError: If it is not a floating-point tensor.

    Reference:
        IEC 61966-2-1.

    Example:
        >>> [round(x, 3) for x in display(torch.tensor([-1.0, 0.0, 0.214, 7.0])).tolist()]
        [0.0, 0.0, 0.5, 1.0]
    """
    real_tensor("linear", linear, "of linear light")
    return encode(linear.clamp(0.0, 1.0), "srgb", has_alpha=False, straight=False)


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal to noise ratio for a peak of 1, in dB, over all items and channels.

    Args:
        image: ``[B, C, H, W]``; pass both through :func:`display` for display-encoded values.
        truth: ``[B, C, H, W]``.
        mask: ``[B or 1, 1, H, W]``, bool: pixels to compare; None compares all.

    Returns:
        dB; ``inf`` where both are equal.

    Raises:
        ValueError: If shapes or types are invalid, the mask is empty, or a compared pixel is not finite.

    Example:
        >>> round(psnr(torch.zeros(1, 3, 4, 4), torch.full((1, 3, 4, 4), 0.1)), 6)
        20.0
    """
    _check_pair(image, truth)
    squared = (image.double() - truth.double()).square().mean(1, keepdim=True)
    if mask is not None:
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape[1:] != squared.shape[1:]:
            raise ValueError(f"mask must be bool [B or 1, {', '.join(map(str, squared.shape[1:]))}], got {show(mask)}")
        squared = squared[mask.expand_as(squared)]
    error = float(squared.mean())
    if not math.isfinite(error):
        finite = int(torch.isfinite(squared).sum())
        raise ValueError(
            f"psnr needs finite pixels, at least one in the mask, got {finite} of {squared.numel()} finite"
        )
    return -10.0 * math.log10(error) if error > 0 else math.inf


def ssim(image: Tensor, truth: Tensor) -> float:
    """Structural similarity of values in [0, 1]: Gaussian window of 11 pixels, sigma 1.5.

    Args:
        image: ``[B, C, H, W]``, display-encoded, at least 6 pixels a side.
        truth: ``[B, C, H, W]``.

    Returns:
        Mean over pixels and channels, at most 1.

    Raises:
        ValueError: If shapes or types are invalid.

    Reference:
        Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment", IEEE TIP 2004; computed by kornia.
    """
    from kornia.metrics import ssim as kornia_ssim

    _check_pair(image, truth)
    if min(image.shape[-2:]) < 6:
        raise ValueError(f"SSIM needs at least 6 pixels a side, got {list(image.shape)}")
    return float(kornia_ssim(image.double(), truth.double(), window_size=11).mean())


def _check_pair(image: Tensor, truth: Tensor) -> None:
    """Refuse two images that cannot be compared."""
    for name, value in (("image", image), ("truth", truth)):
        real_tensor(name, value, "[B, C, H, W]")
    if image.ndim != 4 or not image.numel() or image.shape != truth.shape or image.device != truth.device:
        raise ValueError(
            "image and truth must be [B, C, H, W] of the same shape and device, "
            f"got {list(image.shape)} on {image.device} and {list(truth.shape)} on {truth.device}"
        )
