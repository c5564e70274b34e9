"""An image in linear light, with what its file has beside the pixels."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from .layers import Layers
from .paths import PixelType
from .transfer import Transfer
from .windows import Window

__all__ = ["Picture", "can_state_transfer", "keeps_profile"]

_PROFILE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".webp")


@dataclasses.dataclass(frozen=True)
class Picture:
    """An image in linear light, with the properties of its file that are needed to write it back.

    Args:
        pixels: ``[1, C, H, W]`` float32 in linear light. Colour is premultiplied by alpha, if there is alpha.
        channels: Names of the channels: ``("R", "G", "B")`` or grey ``("Y",)``, either with ``"A"`` at the end.
        depth: ``[1, 1, H, W]``, the numbers of the file's own depth channel, or None. Where another data window leaves
            pixels without depth, it is NaN.
        metadata: Name -> (OpenImageIO type, value).
        sample: Stored type of a sample: "8", "16", "half" or "float".
        transfer: Encoding of the file: "linear" or "srgb", or another one that it states.
        is_stated: Whether the file states its encoding, and that is not sRGB.
        window: Place of the pixels in the full frame (EXR data window): x, y, full x, full y, full width, full height.
        orientation: EXIF orientation of the file; the pixels are upright already.
        other_layers: Names of the layers of the file that are neither the pixels nor the depth.
        layer: Names of the part and layer of the pixels, joined by a dot.
        depth_problem: The reason why none of several depth channels, or a phone's own depth, was taken, or empty.
        layers: All parts and layers of an EXR file, which :func:`write_image` then writes too; None writes the pixels.
        depth_meaning: Arguments of :func:`torchdof.depth.from_relative` with which a phone's own depth becomes metres,
            and ``along_ray`` if these are distances along the ray; empty if the file does not state it.
        matte: Coverage by the subject that a phone stored, ``[1, 1, H, W]`` in [0, 1], or None.
    """

    pixels: Tensor
    channels: tuple[str, ...] = ("R", "G", "B")
    depth: Tensor | None = None
    metadata: Mapping[str, tuple[Any, Any]] = dataclasses.field(default_factory=dict)
    sample: PixelType = "float"
    transfer: Transfer = "linear"
    window: Window | None = None
    orientation: int = 1
    other_layers: tuple[str, ...] = ()
    is_stated: bool = False
    layer: str = ""
    depth_problem: str = ""
    layers: Layers | None = None
    depth_meaning: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    matte: Tensor | None = None

    @property
    def has_alpha(self) -> bool:
        """Whether the last channel is alpha."""
        return self.channels[-1] == "A"

    @property
    def light(self) -> Tensor:
        """The pixels without alpha."""
        return self.pixels[:, :-1] if self.has_alpha else self.pixels


def can_state_transfer(picture: Picture, suffix: str) -> bool:
    """Whether a file of a type can state the encoding of a picture: a PNG any, others sRGB or that of a profile."""
    return suffix == ".png" or not picture.is_stated or keeps_profile(picture, suffix)


def keeps_profile(picture: Picture, suffix: str) -> bool:
    """Whether a file of a type keeps the profile of a picture, if its encoding is not changed."""
    return suffix in _PROFILE_SUFFIXES and "ICCProfile" in picture.metadata and "CICP" not in picture.metadata
