"""Writes all parts and layers of an EXR file, with one layer replaced by a rendered one."""

import dataclasses
from typing import Any

import numpy as np

from .decode import Part

LOSSLESS = ("none", "rle", "zip", "zips", "piz")
"""Compressions that a copy keeps."""

OF_LAYERS = "cryptomatte/|multiView$"
"""Metadata that describe other layers, and that a copy without them drops."""


@dataclasses.dataclass(frozen=True)
class Layers:
    """All parts of an EXR file, and the place of the image in them."""

    parts: tuple[Part, ...]
    part: int  # that of the image
    channels: tuple[int, ...]  # of the image, in that part

    def __post_init__(self) -> None:
        """Refuses whole numbers beside floating-point numbers, which OpenImageIO reads rounded."""
        for part in self.parts:
            if "uint" in part.kinds and len({*part.kinds}) > 1:
                names = ", ".join(name for name, kind in zip(part.names, part.kinds, strict=True) if kind == "uint")
                raise ValueError(f"cannot keep the layers: {names} hold whole numbers beside others in one part")

    def replaced(self, spec: Any, array: np.ndarray) -> list[tuple[Any, np.ndarray]]:
        """Specification and numbers ``[H, W, C]`` of each part, with those of a rendered image in the image's place."""
        return [self._image(part, spec, array) if n == self.part else _copy(part) for n, part in enumerate(self.parts)]

    def _image(self, part: Part, spec: Any, array: np.ndarray) -> tuple[Any, np.ndarray]:
        kinds = list(part.kinds)
        for channel in self.channels:
            kinds[channel] = str(spec.format)
        values = part.values.astype(np.float16 if {*kinds} == {"half"} else np.float32)
        values[..., self.channels] = array
        copy, _ = _copy(dataclasses.replace(part, kinds=tuple(kinds), values=values, metadata={}))
        copy.extra_attribs = spec.extra_attribs
        _name(copy, part)
        return copy, values


def _copy(part: Part) -> tuple[Any, np.ndarray]:
    """Specification and numbers of a part."""
    import OpenImageIO as oiio

    height, width = part.values.shape[:2]
    kind = part.kinds[0] if len({*part.kinds}) == 1 else "float"
    spec = oiio.ImageSpec(width, height, len(part.names), kind)
    spec.channelnames = part.names
    if len({*part.kinds}) > 1:
        spec.channelformats = tuple(oiio.TypeDesc(kind) for kind in part.kinds)
    if part.window is not None:
        spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = part.window
    for name, (type_of_value, value) in part.metadata.items():
        if name != "compression" or value in LOSSLESS:
            spec.attribute(name, *((value,) if isinstance(value, int) else (type_of_value, value)))
    _name(spec, part)
    return spec, part.values


def _name(spec: Any, part: Part) -> None:
    if part.label:
        spec.attribute("oiio:subimagename", part.label)
        spec.attribute("name", part.label)
