"""Metadata of an image file: tags that a copy keeps, orientation, camera settings."""

import math
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

Metadata = dict[str, tuple[Any, Any]]
"""Name -> (OpenImageIO type, value)."""

# Attributes of the storage of one file, which do not apply to a copy.
_STORAGE = "oiio:|tiff:|openexr:|png:|pnm:|jpeg:|rgbe:|thumbnail|Exif:(ExifVersion|FlashPixVersion|ColorSpace)|"
_STORAGE += "(name|planarconfig|textureformat|CompressionQuality)$"
_MM_PER_UNIT: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit
_FLIPPED: dict[Any, tuple[int, ...]] = {2: (1,), 3: (0, 1), 4: (0,), 5: (), 6: (1,), 7: (0, 1), 8: (0,)}
"""EXIF orientation (0x0112) -> flipped axes. Orientations from 5 up first transpose the image."""
_FOCAL_MM, _SENSOR_MM, _F_NUMBERS = (0.5, 3000.0), (1.0, 300.0), (0.5, 1000.0)
"""Smallest and largest number of a lens that is believed: cameras write 0, or micrometres, for unknown numbers."""
_AXES = (("Exif:PixelXDimension", "Exif:PixelYDimension"), ("Exif:FocalPlaneXResolution", "Exif:FocalPlaneYResolution"))
_SWAPPED = {**dict(_AXES), **{down: across for across, down in _AXES}}  # names of tags when an image is transposed


def upright(values: "np.ndarray", metadata: Metadata) -> "tuple[np.ndarray, Metadata]":
    """Turns an image ``[H, W, C]`` upright by its orientation tag, and sets the tag to 1."""
    kind, orientation = metadata.get("Orientation", (None, 1))
    if orientation not in _FLIPPED:
        return values, metadata
    upright_metadata = metadata | {"Orientation": (kind, 1)}
    if orientation >= 5:
        values = values.swapaxes(0, 1)
        upright_metadata = {_SWAPPED.get(name, name): value for name, value in upright_metadata.items()}
    rows, columns = (slice(None, None, -1 if axis in _FLIPPED[orientation] else 1) for axis in (0, 1))
    return values[rows, columns], upright_metadata


def turned(values: "np.ndarray", orientation: int, shape: tuple[int, ...]) -> "np.ndarray":
    """Turns a map ``[h, w]`` like a photograph that is upright and ``shape`` large, unless its sides are so already."""
    is_upright = orientation >= 5 and (values.shape[0] > values.shape[1]) == (shape[0] > shape[1])
    if is_upright:
        return values
    return upright(values[..., None], {"Orientation": (None, orientation)})[0][..., 0]


def kept_metadata(attributes: Iterable[Any]) -> Metadata:
    """Metadata for a copy of an image: OpenImageIO's ``extra_attribs``, without those of the storage."""
    return {a.name: (a.type, a.value) for a in attributes if not re.match(_STORAGE, a.name)}


def camera_settings(metadata: Mapping[str, tuple[Any, Any]], width: int, height: int) -> dict[str, float]:
    """Camera settings found in the metadata of a picture of a size in pixels, under the names of ``torchdof.Camera``.

    The sensor width comes from the resolution of the focal plane (EXIF 0xA20E). If that is missing, or differs by more
    than 25 % (for example after scaling the picture), it comes from the 35 mm equivalent focal length, with 36 mm for
    the longer side of the picture. Numbers that no lens has are ignored.

    Example:
        >>> tags = {"Exif:FocalLength": 50.0, "FNumber": 1.8, "Exif:FocalLengthIn35mmFilm": 75}
        >>> camera_settings({name: (None, value) for name, value in tags.items()}, 6000, 4000)
        {'focal_length_mm': 50.0, 'f_number': 1.8, 'sensor_width_mm': 24.0}
    """

    def number(*names: str, ends: tuple[float, float] = (0.0, math.inf)) -> float | None:
        for name in names:
            value = metadata.get(name, (None, None))[1]
            is_number = isinstance(value, float) or (isinstance(value, int) and value < 2**63)
            if is_number and 0 < value and ends[0] <= value <= ends[1]:
                return float(value)
        return None

    settings: dict[str, float] = {}
    if focal_length_mm := number("Exif:FocalLength", "effectiveFocalLength", "nominalFocalLength", ends=_FOCAL_MM):
        settings["focal_length_mm"] = focal_length_mm
    f_number = number("FNumber", "Exif:FNumber", "aperture", ends=_F_NUMBERS)
    if f_number is None and (f_stops := number("Exif:ApertureValue", ends=(0.0, 20.0))):
        f_number = 2 ** (f_stops / 2)  # APEX
    if f_number is not None:
        settings["f_number"] = round(f_number, 6)
    if focus_m := number("Exif:SubjectDistance", "focus"):
        settings["focus_m"] = math.inf if focus_m > 1e6 else focus_m  # EXIF writes infinity as 2^32 - 1
    if film_mm := number("Exif:FocalLengthIn35mmFilm", ends=_FOCAL_MM):
        focal_length_mm = settings.setdefault("focal_length_mm", film_mm)  # the equivalent lens, if no other is known
        width_mm = 36.0 * focal_length_mm / film_mm * (width / max(width, height))
        if _SENSOR_MM[0] <= width_mm <= _SENSOR_MM[1]:
            settings["sensor_width_mm"] = width_mm
    if px_per_unit := number("Exif:FocalPlaneXResolution", ends=(0.0, 1e9)):
        original_width = number("Exif:PixelXDimension") or width
        mm_per_unit = _MM_PER_UNIT.get(number("Exif:FocalPlaneResolutionUnit") or 2, 25.4)
        plane_mm = original_width / px_per_unit * mm_per_unit
        is_agreed = abs(plane_mm / settings.get("sensor_width_mm", plane_mm) - 1.0) < 0.25
        if _SENSOR_MM[0] <= plane_mm <= _SENSOR_MM[1] and is_agreed:
            settings["sensor_width_mm"] = plane_mm
    return settings
