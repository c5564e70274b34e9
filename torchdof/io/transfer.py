"""Transfer curves: file values to linear light and back, with straight or premultiplied alpha.

``kornia.color.rgb_to_linear_rgb`` and its inverse give the same bits in [0, 1]. They are not used because they support
three channels only, do not extend the curve to negative light, and take a second to import.
"""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

__all__ = ["Transfer", "decode", "default_transfer", "encode", "encode_8_bits"]

Transfer = Literal["linear", "srgb"]


def default_transfer(sample: str) -> Transfer:
    """Default encoding of samples of a type: "linear" for "half" and "float", "srgb" for "8" and "16"."""
    return "linear" if sample in ("half", "float") else "srgb"


def decode(pixels: Tensor, transfer: Transfer, has_alpha: bool, straight: bool) -> Tensor:
    """File values to linear light, premultiplied."""
    if not has_alpha:
        return _srgb_to_linear(pixels) if transfer == "srgb" else pixels
    colour, alpha = pixels[:, :-1], pixels[:, -1:]
    if transfer == "srgb":
        colour = colour if straight else _divide(colour, alpha)
        colour, straight = _srgb_to_linear(colour), True
    return torch.cat([colour * alpha if straight else colour, alpha], dim=1)


def encode(pixels: Tensor, transfer: Transfer, has_alpha: bool, straight: bool) -> Tensor:
    """Linear light, premultiplied, to file values."""
    if not has_alpha:
        return _linear_to_srgb(pixels) if transfer == "srgb" else pixels
    colour, alpha = pixels[:, :-1], pixels[:, -1:]
    if straight or transfer == "srgb":
        colour = _divide(colour, alpha)
        colour = _linear_to_srgb(colour) if transfer == "srgb" else colour
        colour = colour if straight else colour * alpha
    return torch.cat([colour, alpha], dim=1)


def encode_8_bits(pixels: Tensor, transfer: Transfer, has_alpha: bool) -> np.ndarray:
    """The result of :func:`encode` rounded to 8 bits, looked up in a table of all half-precision numbers.

    Rounding to half precision changes a number by at most a fortieth of an 8-bit step, so that 8-bit images are
    preserved exactly. Alpha becomes straight.

    Args:
        pixels: ``[1, C, H, W]``, linear light, premultiplied.
        transfer: Encoding of colour.
        has_alpha: Whether the last channel is alpha.

    Returns:
        ``[H, W, C]``, uint8.

    Example:
        >>> encode_8_bits(torch.tensor([0.0, 0.2159, 2.0]).reshape(1, 3, 1, 1), "srgb", has_alpha=False).tolist()
        [[[0, 128, 255]]]
    """
    height, width = pixels.shape[-2:]
    if has_alpha:
        pixels = torch.cat([_divide(pixels[:, :-1], pixels[:, -1:]), pixels[:, -1:]], 1)
    halves = np.arange(65536, dtype=np.uint16).view(np.float16)
    light = torch.from_numpy(halves.astype(np.float32)).nan_to_num(0.0)
    colour, alpha = (
        (encode(light, curve, False, False).clamp(0.0, 1.0) * 255.0).round().byte().numpy()
        for curve in (transfer, "linear")
    )
    channels = pixels[0].half().numpy().view(np.uint16)
    encoded = np.empty((height, width, len(channels)), np.uint8)
    for k, channel in enumerate(channels):
        for top in range(0, height, 64):
            lookup = alpha if has_alpha and k == len(channels) - 1 else colour
            encoded[top : top + 64, :, k] = np.take(lookup, channel[top : top + 64], mode="clip")
    return encoded


def _divide(colour: Tensor, alpha: Tensor) -> Tensor:
    return torch.where(alpha > 0, colour / torch.where(alpha > 0, alpha, 1.0), 0.0)


def _srgb_to_linear(encoded: Tensor) -> Tensor:
    """Inverse sRGB curve of IEC 61966-2-1, odd for negative values."""
    magnitude = encoded.abs()
    return torch.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4).copysign(encoded)


def _linear_to_srgb(linear: Tensor) -> Tensor:
    magnitude = linear.abs()
    curved = 1.055 * magnitude.clamp_min(0.0031308) ** (1 / 2.4) - 0.055  # clamped: the gradient is infinite at 0
    return torch.where(magnitude <= 0.0031308, magnitude * 12.92, curved).copysign(linear)
