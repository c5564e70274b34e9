"""Transfer curves: file values to linear light and back, with straight or premultiplied alpha.

Kornia's curves give the same bits, for three channels and light in [0, 1] only, and take a second to import.
"""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

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
    """The result of :func:`encode`, with straight alpha, rounded to 8 bits: ``[H, W, C]`` of ``[1, C, H, W]``.

    It is looked up in a table of all half-precision numbers, seven times as fast. Rounding to half precision changes a
    number by at most a fortieth of an 8-bit step, so that 8-bit images are preserved exactly.
    """
    if has_alpha:
        pixels = torch.cat([_divide(pixels[:, :-1], pixels[:, -1:]), pixels[:, -1:]], 1)
    halves = np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32)
    light = torch.from_numpy(halves).nan_to_num(0.0)
    colour, alpha = (
        (encode(light, curve, False, False).clamp(0.0, 1.0) * 255.0).round().byte().numpy()
        for curve in (transfer, "linear")
    )
    encoded = np.empty((*pixels.shape[-2:], pixels.shape[1]), np.uint8)
    for k, channel in enumerate(pixels[0].half().numpy().view(np.uint16)):
        is_alpha = has_alpha and k == pixels.shape[1] - 1
        encoded[..., k] = np.take(alpha if is_alpha else colour, channel, mode="clip")
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
