"""Transfer curves: file values to linear light and back, with straight or premultiplied alpha.

Kornia's curves give the same bits, for three channels and light in [0, 1] only, and take a second to import.
"""

import numpy as np
import torch
from torch import Tensor

Transfer = str
"""Encoding of a file: "linear", "srgb", "bt709", "pq", "hlg", or "gamma G" with the exponent G, such as "gamma 1.8"."""

# SMPTE ST 2084 (PQ); 1 of light is the reference white of 203 cd/m2 of ITU-R BT.2408
_PQ_M1, _PQ_M2, _PQ_C1, _PQ_C2, _PQ_C3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
_PQ_PEAK = 10_000.0 / 203.0
_BT709_A, _BT709_B = 1.09929682680944, 0.018053968510807  # the digits of ITU-R BT.2020, whose curve is the same
_HLG_A, _HLG_B, _HLG_C = 0.17883277, 0.28466892, 0.55991073  # ITU-R BT.2100 (HLG), light of the scene from 0 to 1


def default_transfer(sample: str) -> Transfer:
    """Default encoding of samples of a type: "linear" for "half" and "float", "srgb" for "8" and "16"."""
    return "linear" if sample in ("half", "float") else "srgb"


def decode(pixels: Tensor, transfer: Transfer, has_alpha: bool, straight: bool) -> Tensor:
    """File values to linear light, premultiplied."""
    if not has_alpha:
        return _to_linear(pixels, transfer)
    colour, alpha = pixels[:, :-1], pixels[:, -1:]
    if transfer != "linear":
        colour = colour if straight else _divide(colour, alpha)
        colour, straight = _to_linear(colour, transfer), True
    return torch.cat([colour * alpha if straight else colour, alpha], dim=1)


def encode(pixels: Tensor, transfer: Transfer, has_alpha: bool, straight: bool) -> Tensor:
    """Linear light, premultiplied, to file values."""
    if not has_alpha:
        return _from_linear(pixels, transfer)
    colour, alpha = pixels[:, :-1], pixels[:, -1:]
    if straight or transfer != "linear":
        colour = _from_linear(_divide(colour, alpha), transfer)
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


def _to_linear(encoded: Tensor, transfer: Transfer) -> Tensor:
    """Light of encoded numbers; odd for negative ones."""
    if transfer in ("linear", "srgb"):
        return _srgb_to_linear(encoded) if transfer == "srgb" else encoded
    magnitude = encoded.abs()
    if transfer == "bt709":
        light = torch.where(
            magnitude < 4.5 * _BT709_B, magnitude / 4.5, ((magnitude + _BT709_A - 1) / _BT709_A) ** (1 / 0.45)
        )
    elif transfer == "pq":
        root = magnitude.clamp(max=1.0) ** (1 / _PQ_M2)
        light = _PQ_PEAK * ((root - _PQ_C1).clamp(min=0.0) / (_PQ_C2 - _PQ_C3 * root)) ** (1 / _PQ_M1)
    elif transfer == "hlg":
        light = torch.where(magnitude <= 0.5, magnitude**2 / 3.0, (((magnitude - _HLG_C) / _HLG_A).exp() + _HLG_B) / 12)
    else:
        light = magnitude ** _exponent(transfer)
    return light.copysign(encoded)


def _from_linear(light: Tensor, transfer: Transfer) -> Tensor:
    """The inverse of :func:`_to_linear`."""
    if transfer in ("linear", "srgb"):
        return _linear_to_srgb(light) if transfer == "srgb" else light
    magnitude = light.abs()
    if transfer == "bt709":
        encoded = torch.where(magnitude < _BT709_B, 4.5 * magnitude, _BT709_A * magnitude**0.45 - (_BT709_A - 1))
    elif transfer == "pq":
        power = (magnitude / _PQ_PEAK).clamp(max=1.0) ** _PQ_M1
        encoded = ((_PQ_C1 + _PQ_C2 * power) / (1.0 + _PQ_C3 * power)) ** _PQ_M2
        encoded = torch.where(magnitude > 0, encoded, 0.0)
    elif transfer == "hlg":
        logarithm = _HLG_A * (12.0 * magnitude - _HLG_B).clamp(min=1e-12).log() + _HLG_C
        encoded = torch.where(magnitude <= 1 / 12, (3.0 * magnitude).sqrt(), logarithm)
    else:
        encoded = magnitude ** (1.0 / _exponent(transfer))
    return encoded.copysign(light)


def _exponent(transfer: Transfer) -> float:
    """The exponent of "gamma G"."""
    word, _, exponent = transfer.partition(" ")
    if word != "gamma" or not 0.0 < float(exponent) < 100.0:
        raise ValueError(f"transfer must be linear, srgb, bt709, pq, hlg, or gamma and its exponent, got {transfer!r}")
    return float(exponent)


def _srgb_to_linear(encoded: Tensor) -> Tensor:
    """Inverse sRGB curve of IEC 61966-2-1, odd for negative values."""
    magnitude = encoded.abs()
    return torch.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4).copysign(encoded)


def _linear_to_srgb(linear: Tensor) -> Tensor:
    magnitude = linear.abs()
    curved = 1.055 * magnitude.clamp_min(0.0031308) ** (1 / 2.4) - 0.055  # clamped: the gradient is infinite at 0
    return torch.where(magnitude <= 0.0031308, magnitude * 12.92, curved).copysign(linear)


def strips(height: int, numbers_per_row: int) -> list[slice]:
    """Slices of rows with about a million numbers each, which keep temporary arrays small."""
    rows = 1 + 2**20 // numbers_per_row
    return [slice(top, top + rows) for top in range(0, height, rows)]
