"""Checks at the public boundary: what was expected, what came, what to do."""

import dataclasses
import math
from typing import Literal

import torch
from torch import Tensor

from .table import BlurTable

__all__ = ["Border", "Method", "Options", "image_and_coc", "image_and_depth"]

Method = Literal["layered", "fold"]
Border = Literal["normalize", "extend"]


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a rendering; their meaning is told at :class:`torchdof.DepthOfField`.

    Raises:
        ValueError: Naming the option that makes no sense.
    """

    table: BlurTable
    tolerance: float
    occlusion: bool
    normalize: bool
    method: Method
    border: Border
    max_coc_px: float
    check: bool

    def __post_init__(self) -> None:
        if not isinstance(self.table, BlurTable):
            got = type(self.table).__name__
            raise ValueError(f"table must be a torchdof.BlurTable, got {got}; read a file with BlurTable.load()")
        tolerance = self.tolerance
        if isinstance(tolerance, bool) or not isinstance(tolerance, int | float) or not 0 <= tolerance < 1:
            raise ValueError(f"tolerance must be a number in [0, 1), such as 1/255, got {tolerance!r}")
        if self.method not in ("layered", "fold"):
            raise ValueError(f"method must be 'layered' or 'fold', got {self.method!r}")
        if self.border not in ("normalize", "extend"):
            raise ValueError(f"border must be 'normalize' or 'extend', got {self.border!r}")
        if self.occlusion and not self.normalize:
            raise ValueError("normalize=False is the plain sum of occlusion=False; set occlusion=False as well")
        if not 0.5 < self.max_coc_px < math.inf:
            raise ValueError(f"max_coc_px must be a radius above 0.5 pixels, got {self.max_coc_px!r}")


def image_and_depth(image: Tensor, depth: Tensor, values: bool) -> None:
    """Refuse an image and a depth map that do not belong together.

    Raises:
        ValueError: If shapes or types are wrong, or, with ``values``, a depth is NaN or not positive.
    """
    _image(image)
    _map("depth", "in metres", depth, image)
    if values and not _traced():
        bad = int((~(depth > 0)).sum())
        if bad:
            raise ValueError(
                f"depth must be > 0 (inf allowed), got {bad} of {depth.numel()} pixels that are NaN, zero or negative; "
                "fill the holes, or pass check=False to let these pixels through sharp"
            )


def image_and_coc(image: Tensor, coc_px: Tensor, table: BlurTable, values: bool) -> None:
    """Refuse an image and a map of the circle of confusion that do not belong together.

    Raises:
        ValueError: If shapes or types are wrong, the table has other channels than the image, or, with ``values``, a
        coc
            or a pixel is not finite.
    """
    _image(image)
    _map("coc_px", "in pixels", coc_px, image)
    if table.channels not in (1, image.shape[1]):
        raise ValueError(f"the table blurs {table.channels} channels, the image has {image.shape[1]}")
    if values and not _traced():
        for name, tensor in (("coc_px", coc_px), ("image", image)):
            bad = tensor.numel() - int(torch.isfinite(tensor).sum())
            if bad:
                raise ValueError(
                    f"{name} must be finite, got {bad} of {tensor.numel()} values that are NaN or infinite; "
                    "mend them, or pass check=False"
                )


def _image(image: Tensor) -> None:
    if not isinstance(image, Tensor):
        raise ValueError(f"image must be a tensor [B, C, H, W] in linear light, got {type(image).__name__}")
    if not image.is_floating_point():
        raise ValueError(f"image must be floating point in linear light, got {image.dtype}; decode it first")
    if image.ndim != 4:
        hint = "; did you forget the batch dimension? use image[None]" if image.ndim == 3 else ""
        raise ValueError(f"image must be [B, C, H, W] in linear light, got {list(image.shape)}{hint}")
    if 0 in image.shape:
        raise ValueError(f"image must have at least one pixel, channel and item, got {list(image.shape)}")


def _map(name: str, unit: str, value: Tensor, image: Tensor) -> None:
    batch, _, height, width = image.shape
    expected = f"{name} must be [{batch}, 1, {height}, {width}] or [1, 1, {height}, {width}] {unit}"
    if not isinstance(value, Tensor) or not value.is_floating_point():
        got = f"a {value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"{expected} and floating point, got {got}")
    if value.ndim != 4:
        hint = "; did you forget the channel dimension?" if value.ndim == 3 else ""
        raise ValueError(f"{expected}, got {list(value.shape)}{hint}")
    if value.shape[1:] != (1, height, width) or value.shape[0] not in (1, batch):
        raise ValueError(f"{expected} as the image is {list(image.shape)}, got {list(value.shape)}")
    if value.device != image.device:
        raise ValueError(f"{name} must be on the image's device {image.device}, got {value.device}")


def _traced() -> bool:
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()
