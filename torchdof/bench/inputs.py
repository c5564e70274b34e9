"""What speed is measured on: an image and its circle of confusion; the scene that is built in."""

import dataclasses

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.blur_table import BlurTable
from ..optics.camera import Camera
from ..reference.scenes import posts, waves

__all__ = ["LEAST_PX", "BenchScene", "shipped"]

LEAST_PX = 16
"""Smallest side of a scene."""


@dataclasses.dataclass(frozen=True)
class BenchScene:
    """What is rendered.

    Args:
        name: For the report.
        image: ``[1, C, H, W]``, linear light, without alpha.
        coc_px: ``[1, 1, H, W]``, signed radius in pixels.
        remark: Camera and focus, in words.
        table: Of the lens; the disc unless given.
    """

    name: str
    image: Tensor
    coc_px: Tensor
    remark: str = ""
    table: BlurTable = dataclasses.field(default_factory=BlurTable.disc)

    def __post_init__(self) -> None:
        height, width = self.image.shape[-2:]
        if self.coc_px.shape[-2:] != (height, width):
            h, w = self.coc_px.shape[-2:]
            raise ValueError(f"{self.name}: depth is {w} x {h} pixels but the image is {width} x {height}")
        if min(height, width) < LEAST_PX:
            raise ValueError(f"{self.name}: is {width} x {height}; speed is measured from {LEAST_PX} pixels a side on")

    @property
    def radius_px(self) -> float:
        """Largest radius of the circle of confusion."""
        return float(self.coc_px.abs().max())

    def blurred(self, radius_px: float) -> "BenchScene":
        """As blurred as this, relative to the largest radius, which is ``radius_px``."""
        return dataclasses.replace(self, coc_px=self.coc_px * (radius_px / self.radius_px))

    def resized(self, height: int, width: int) -> "BenchScene":
        """The same picture in a frame of another size, as blurred for its width."""
        how = "area" if height < self.image.shape[-2] else "bilinear"
        image = functional.interpolate(self.image, (height, width), mode=how)
        coc = functional.interpolate(self.coc_px, (height, width), mode="nearest")  # no radius that no surface has
        return dataclasses.replace(self, image=image, coc_px=coc * (width / self.image.shape[-1]))

    def crop(self, side: int, widest: bool = False) -> "BenchScene":
        """A square at most ``side`` pixels wide: in the middle, or where the blur is widest."""
        height, width = self.image.shape[-2:]
        row, column = divmod(int(self.coc_px.abs().argmax()), width) if widest else (height // 2, width // 2)
        top = min(max(0, row - side // 2), max(0, height - side))
        left = min(max(0, column - side // 2), max(0, width - side))
        part = (..., slice(top, top + side), slice(left, left + side))
        return dataclasses.replace(self, image=self.image[part], coc_px=self.coc_px[part])


def shipped(height: int = 540, width: int = 960) -> BenchScene:
    """A slope from 1 m to 10 m behind posts at 0.9 m to 1 m, with a blur radius of up to a 60th of the width.

    Example:
        >>> shipped(54, 96).image.shape
        torch.Size([1, 3, 54, 96])
    """
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in (height, width)), indexing="ij")
    near = posts(width / 6, width / 40)(x, y)
    light = torch.where(near, waves(2, (0.6, 0.3, 0.2))(x, y), waves(1)(x, y)).float()[None]
    depth = torch.where(near, 1.0 / (1.0 + 0.1 * x / width), 1.0 / (0.1 + 0.9 * y / height)).float()[None, None]
    camera = Camera(50.0, 1.0, focus_m=1.0 / 0.6)  # the blur is as large far away as at the posts
    camera = camera.replace(f_number=float(camera.coc_px(depth, width).abs().max()) / (width / 60))
    return BenchScene("slope with posts", light, camera.coc_px(depth, width), f"{camera!r}")
