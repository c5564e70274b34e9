"""Metadata of an image file: what a copy keeps, and what it says about the camera."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

__all__ = ["camera_facts", "kept_metadata"]

# Facts about how one file was stored, which are wrong for the next.
_STORAGE_PREFIXES = ("oiio:", "tiff:", "openexr:", "png:", "pnm:", "jpeg:", "rgbe:", "thumbnail", "Exif:ExifVersion")
_STORAGE_NAMES: tuple[str, ...] = ("name", "planarconfig", "textureformat", "CompressionQuality")
_STORAGE_NAMES += ("Exif:FlashPixVersion", "Exif:ColorSpace")
_MM_PER_UNIT: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit


def kept_metadata(attributes: Iterable[Any]) -> dict[str, tuple[Any, Any]]:
    """What a copy of an image should keep of OpenImageIO's ``extra_attribs``.

    Returns:
        Name -> (type, value), without what describes how the file was stored.
    """
    return {
        a.name: (a.type, a.value)
        for a in attributes
        if not a.name.startswith(_STORAGE_PREFIXES) and a.name not in _STORAGE_NAMES
    }


def camera_facts(metadata: Mapping[str, tuple[Any, Any]], width: int) -> dict[str, float]:
    """What the metadata says about the camera, under the names of ``torchdof.Camera``; only what it says.

    The width of the sensor follows from the resolution of the focal plane (EXIF 0xA20E), or from the focal length's
    equivalent on 35 mm film where that is missing or contradicts it, as in a picture scaled down after it was taken.

    Args:
        metadata: As in ``Picture.metadata``.
        width: Width of the image in pixels.

    Returns:
        Any of ``focal_length_mm``, ``f_number``, ``focus_m``, ``sensor_width_mm``.

    Example:
        >>> tags = {"Exif:FocalLength": 50.0, "FNumber": 1.8, "Exif:FocalLengthIn35mmFilm": 75}
        >>> camera_facts({name: (None, value) for name, value in tags.items()}, width=6000)
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
        width_mm = 36.0 * focal_length_mm / by_film
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
