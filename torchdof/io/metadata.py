"""Metadata of an image file: tags that a copy keeps, orientation, and facts about the camera."""

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

__all__ = ["Metadata", "camera_facts", "kept_metadata", "upright"]

Metadata = dict[str, tuple[Any, Any]]
"""Name -> (OpenImageIO type, value)."""

# Facts about how one file was stored, which are wrong for the next.
_STORAGE_PREFIXES = ("oiio:", "tiff:", "openexr:", "png:", "pnm:", "jpeg:", "rgbe:", "thumbnail", "Exif:ExifVersion")
_STORAGE_NAMES: tuple[str, ...] = ("name", "planarconfig", "textureformat", "CompressionQuality")
_STORAGE_NAMES += ("Exif:FlashPixVersion", "Exif:ColorSpace")
_MM_PER_UNIT: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit


_FLIPPED: dict[Any, tuple[int, ...]] = {2: (1,), 3: (0, 1), 4: (0,), 5: (), 6: (1,), 7: (0, 1), 8: (0,)}
"""EXIF orientation (0x0112) -> axes that are flipped, after rows and columns have changed places from 5 on."""
_OF_AXES = (
    ("Exif:PixelXDimension", "Exif:PixelYDimension"),
    ("Exif:FocalPlaneXResolution", "Exif:FocalPlaneYResolution"),
)


def upright(values: "np.ndarray", metadata: Metadata) -> "tuple[np.ndarray, Metadata]":
    """An image ``[H, W, C]`` turned as its orientation tag says, and its metadata, in which the tag is then 1.

    Example:
        >>> import numpy as np
        >>> lying = np.arange(6).reshape(2, 3, 1)
        >>> upright(lying, {"Orientation": ("uint16", 6)})[0][..., 0].tolist()
        [[3, 0], [4, 1], [5, 2]]
    """
    kind, orientation = metadata.get("Orientation", (None, 1))
    if orientation not in _FLIPPED:
        return values, metadata
    turned = metadata | {"Orientation": (kind, 1)}
    if orientation >= 5:
        values = values.swapaxes(0, 1)
        for across, down in _OF_AXES:
            for name, other in ((across, down), (down, across)):
                turned.pop(name, None)
                if other in metadata:
                    turned[name] = metadata[other]
    rows, columns = (slice(None, None, -1 if axis in _FLIPPED[orientation] else 1) for axis in (0, 1))
    return values[rows, columns], turned


def kept_metadata(attributes: Iterable[Any]) -> Metadata:
    """What a copy of an image should keep of OpenImageIO's ``extra_attribs``.

    Returns:
        Name -> (type, value), without what describes how the file was stored.
    """
    return {
        a.name: (a.type, a.value)
        for a in attributes
        if not a.name.startswith(_STORAGE_PREFIXES) and a.name not in _STORAGE_NAMES
    }


def camera_facts(metadata: Mapping[str, tuple[Any, Any]], width: int, height: int) -> dict[str, float]:
    """What the metadata says about the camera, under the names of ``torchdof.Camera``; only what it says.

    The width of the sensor follows from the resolution of the focal plane (EXIF 0xA20E), or from the focal length's
    equivalent on 35 mm film where that is missing or contradicts it, as in a picture scaled down after it was taken.
    The 36 mm of that film are the picture's longer side.

    Args:
        metadata: As in ``Picture.metadata``.
        width: Width of the image in pixels.
        height: Its height.

    Returns:
        Any of ``focal_length_mm``, ``f_number``, ``focus_m``, ``sensor_width_mm``.

    Example:
        >>> tags = {"Exif:FocalLength": 50.0, "FNumber": 1.8, "Exif:FocalLengthIn35mmFilm": 75}
        >>> camera_facts({name: (None, value) for name, value in tags.items()}, 6000, 4000)
        {'focal_length_mm': 50.0, 'f_number': 1.8, 'sensor_width_mm': 24.0}
    """

    def number(*names: str) -> float | None:
        for name in names:
            value = metadata.get(name, (None, None))[1]
            if isinstance(value, int | float) and (0 < value < 1e300 or value == math.inf):
                return float(value)
        return None

    facts: dict[str, float] = {}
    focal_length_mm = number("Exif:FocalLength", "effectiveFocalLength", "nominalFocalLength")
    if focal_length_mm is not None and math.isfinite(focal_length_mm):
        facts["focal_length_mm"] = focal_length_mm
    f_number = number("FNumber", "Exif:FNumber", "aperture")
    if f_number is not None and math.isfinite(f_number):
        facts["f_number"] = round(f_number, 6)
    focus_m = number("Exif:SubjectDistance", "focus")
    if focus_m is not None:
        facts["focus_m"] = math.inf if focus_m > 1e6 else focus_m  # EXIF writes infinity as 2^32 - 1
    by_film = number("Exif:FocalLengthIn35mmFilm")
    if by_film is not None and focal_length_mm is not None:
        width_mm = 36.0 * focal_length_mm / by_film * (width / max(width, height))
        if 0 < width_mm < math.inf:
            facts["sensor_width_mm"] = width_mm
    per_unit = number("Exif:FocalPlaneXResolution")
    if per_unit is not None:
        original_width = number("Exif:PixelXDimension") or width
        unit = _MM_PER_UNIT.get(number("Exif:FocalPlaneResolutionUnit") or 2, 25.4)
        by_plane = original_width / per_unit * unit
        if 0 < by_plane < math.inf and abs(by_plane / facts.get("sensor_width_mm", by_plane) - 1.0) < 0.25:
            facts["sensor_width_mm"] = by_plane
    return facts
