"""Transfer curves: file values to linear light and back, with straight or premultiplied alpha.

Kornia's curves give the same bits, for three channels and light in [0, 1] only, and take a second to import.
"""

from typing import Literal

import torch
from torch import Tensor

__all__ = ["Transfer", "decode", "default_transfer", "encode"]

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
