"""Kernels of single families of blur."""

from typing import Any

from torch import Tensor

from torchdof.optics import psf


def kernel_of(family: str, *values: Any, size: int | None = None, **named: Any) -> Tensor:
    """The kernel of a family, whose parameters have the order of ``psf.FAMILIES`` or names; "softm" without a tilt."""
    tilt = {"b": 0.0, "m": 2.0} if family == "softm" else {}
    return psf.pixel_kernels(family, tilt | dict(zip(psf.FAMILIES[family], values, strict=False)) | named, size)
