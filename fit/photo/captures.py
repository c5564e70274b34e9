"""Pictures of a dot, in focus and at other distances, read from the camera's files, and the camera that took them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from scipy.ndimage import convolve

from torchdof.io.images import read_image
from torchdof.io.metadata import camera_settings
from torchdof.io.transfer import Transfer
from torchdof.optics.camera import Camera
from torchdof.validation import number, show

from ..problems import FitError, checked
from ..result import Array
from .dot import Dot, find_dot, find_dots

RANGES = {  # wider than any camera's
    **{"focus_m": (1e-5, 1e6), "distance_m": (1e-5, 1e6), "exposure_s": (1e-9, 1e7)},
    **{"focal_length_mm": (1e-3, 1e6), "f_number": (1e-2, 1e4), "sensor_width_mm": (1e-3, 1e5)},
    **dict.fromkeys(("width_px", "full_width_px"), (1, 2**31)),
}
CAMERA = ("focal_length_mm", "f_number", "sensor_width_mm")
Dots = Literal["one", "centre", "each", "field"]

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")  # colours of the upper left 2 x 2 pixels of a mosaic, in rows
_MARGIN = 1.35  # window over the blur's reach
_CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
_SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4


@dataclass(frozen=True)
class Capture:
    """A pair of windows around the same dot: in focus, and at another distance.

    Attributes:
        sharp: `[H, W]`, linear light, in focus.
        blurred: `[H, W]`, linear light, the same size.
        distance_m: distance of the dot in `blurred` from the lens.
        files: names of the two pictures.
        white: level of clipping in both, or None if unknown.
        exposure: stated exposure of `blurred` over that of `sharp`, or None.
        position_px: position (x, y) of the dot in the sharp frame, relative to the frame's centre.
        colours: red, green and blue of `sharp` and of `blurred`, `[3, H, W]` each; None fits only their mean.
        uncertain: `sharp` and `blurred` for other values of a guess (a tone curve), each one standard error away, in
            independent directions; enters the standard errors.
    """

    sharp: Array
    blurred: Array
    distance_m: float
    files: tuple[str | None, str | None] = (None, None)
    white: float | None = None
    exposure: float | None = None
    position_px: tuple[float, float] = (0.0, 0.0)
    colours: tuple[Array, Array] | None = None
    uncertain: tuple[tuple[Array, Array], ...] = ()


@dataclass(frozen=True)
class Captures:
    """Pairs of one dot at increasing distances, and the camera that took them.

    Attributes:
        pairs: by increasing distance.
        focus_m: distance of the sharp picture, at which the lens stays focused.
        width_px: width of the whole frame, of width `sensor_width_mm`; the pictures may be crops of it.
        focal_length_mm: of the lens, or None.
        f_number: of the lens, or None.
        sensor_width_mm: of the camera, or None.
        name: name of the table.
        notes: further provenance.
    """

    pairs: tuple[Capture, ...]
    focus_m: float
    width_px: int
    focal_length_mm: float | None = None
    f_number: float | None = None
    sensor_width_mm: float | None = None
    name: str = ""
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises a `FitError` for an invalid field."""
        pairs = self.pairs if isinstance(self.pairs, Sequence) else ()
        if not pairs or not all(isinstance(pair, Capture) for pair in pairs):
            raise FitError(f"pairs must be one or more Capture(sharp, blurred, distance_m), got {show(self.pairs)}")
        check_distances([p.distance_m for p in self.pairs], self.focus_m)
        for name in ("width_px", *(name for name in CAMERA if getattr(self, name) is not None)):
            checked(number, name, getattr(self, name), *RANGES[name])

    @property
    def distances_m(self) -> Array:
        """Distances of the pairs `[n]`."""
        return np.array([pair.distance_m for pair in self.pairs])

    @property
    def defocus(self) -> Array:
        """1/focus - 1/distance of the pairs `[n]`, 1/m; a thin lens's circle of confusion is proportional to it."""
        return 1 / self.focus_m - 1 / self.distances_m

    @property
    def promised_px(self) -> Array | None:
        """Signed circle of confusion of the pairs from the camera's numbers `[n]`, px of the frame; None if unknown."""
        camera = {name: getattr(self, name) for name in CAMERA}
        if None in camera.values():
            return None
        depth = torch.from_numpy(self.distances_m)[None, None, None]
        return Camera(focus_m=self.focus_m, **camera).coc_px(depth, width=self.width_px).numpy().reshape(-1)


def check_distances(distances: Sequence[float], focus: float, where: str | None = None) -> None:
    """Raises an error if distances are not positive and increasing, or one equals the focus."""
    checked(number, "focus_m", focus, 0, 1e100, "metres")
    numbers = [checked(number, "distance_m", distance, -1e100, 1e100, "metres") for distance in distances]
    if not all(previous < distance for previous, distance in pairwise([0.0, *numbers])):
        raise FitError(f"distances must be positive and increasing, got {numbers} m", "distance", where)
    if focus in numbers:
        raise FitError(f"a shot lies at the focus ({focus:g} m) and has no blur", "distance", where)


@dataclass(frozen=True)
class CameraPicture:
    """A picture in linear light, and facts from its file."""

    file: Path
    light: Array  # [H, W], mean of its colours
    colours: Array  # [C, H, W]
    white: float | None  # the clipping level
    encoded: bool  # whether it had integers, decoded as sRGB
    width_px: int  # of the whole picture
    middle: tuple[float, float]  # (x, y) of the whole picture's centre in px of `light`
    facts: Mapping[str, float]  # from EXIF, about the camera


def read_picture(
    path: Path, transfer: Transfer | None, dark: Array | None = None, crop: Any = None, bayer: str | None = None
) -> CameraPicture:
    """Reads a picture; `crop` is left, top, width and height in px, `dark` is light under the lens cap `[C, H, W]`."""
    invalid = partial(FitError, kind="manifest", file=str(path))
    picture = read_image(path, transfer=transfer)
    pixels = picture.pixels[0].numpy().astype(np.float64)
    pixels = pixels[[i for i, name in enumerate(picture.channels) if name != "A"]]
    if bayer is not None:
        if len(pixels) != 1:
            raise invalid(f"bayer = {bayer!r} is for pictures with one colour a pixel, got {len(pixels)} colours")
        if picture.orientation != 1:
            raise invalid(f"bayer is for unturned pictures, got EXIF orientation {picture.orientation}; remove the tag")
        pixels = demosaiced(pixels[0], bayer)
    height, width = pixels.shape[1:]
    left, top, columns, rows = crop or (0, 0, width, height)
    if left + columns > width or top + rows > height:
        raise invalid(f"crop {[left, top, columns, rows]} extends beyond the picture of {width}x{height}")
    pixels = pixels[:, top : top + rows, left : left + columns]
    white, is_clipped = 1.0 if picture.sample in ("8", "16") else None, pixels >= 1.0 - 1e-6
    if dark is not None and dark.shape != pixels.shape:
        raise invalid(f"the dark frame is {_size(dark[0])}, the picture {_size(pixels[0])}")
    pixels = pixels - (0.0 if dark is None else dark)
    light = pixels.mean(axis=0)
    if white is not None:
        pixels[is_clipped] = white
        light[is_clipped.any(axis=0)] = white  # one clipped colour clips the mean
    encoded, middle = white is not None and picture.transfer == "srgb", ((width - 1) / 2 - left, (height - 1) / 2 - top)
    facts = camera_settings(picture.metadata, width, height)
    return CameraPicture(path, light, pixels, white, encoded, width, middle, facts)


def demosaiced(mosaic: Array, pattern: str) -> Array:
    """Red, green and blue `[3, H, W]` of a mosaic `[H, W]`, interpolated bilinearly, which adds no false colour."""
    height, width = mosaic.shape
    names = np.tile(np.array(list(pattern)).reshape(2, 2), (height // 2 + 1, width // 2 + 1))[:height, :width]
    kernels = {"R": _SQUARE, "G": _CROSS, "B": _SQUARE}
    return np.stack([convolve(np.where(names == c, mosaic, 0.0), k, mode="mirror") for c, k in kernels.items()])


def cut_pairs(
    sharp: CameraPicture, blurred: CameraPicture, magnification: float, dots: Dots, by_colour: bool, **facts: Any
) -> Iterator[Capture]:
    """Cuts the windows around the dot, or the dots of a grid, in two photographs; every capture has the `facts`."""
    pictures, blurred_file, (height, width) = (sharp, blurred), str(blurred.file), sharp.light.shape
    if sharp.light.shape != blurred.light.shape:
        text = f"is {_size(blurred.light)}, {sharp.file.name} is {_size(sharp.light)}; give pictures of one size"
        raise FitError(text, "manifest", blurred_file)
    for name in ("f_number", "focal_length_mm"):
        before, after = (picture.facts.get(name) for picture in pictures)
        if before and after and abs(math.log(before / after)) > 0.02:
            text = f"taken at {name} {after:g} by EXIF, {sharp.file.name} at {before:g}; change neither"
            raise FitError(text, "manifest", blurred_file)
    if dots == "one":
        matched = [(find_dot(sharp.light, file=str(sharp.file)), find_dot(blurred.light, file=blurred_file))]
    else:
        matched = _matched(sharp, blurred, magnification)[: 1 if dots == "centre" else None]
    for both in matched:
        centres = [(round(dot.x), round(dot.y)) for dot in both]
        border_px = [min(x, y, width - 1 - x, height - 1 - y) for x, y in centres]
        needed = max(dot.reach for dot in both) + 2
        half = min(*border_px, math.ceil(_MARGIN * needed) + 8)
        if half < needed:
            text = f"the frame cuts the blur: it reaches {needed:.0f} px from the dot, the frame ends after {half} px"
            raise FitError(text, "window", str(pictures[border_px[0] >= both[0].reach + 2].file))
        cuts = [(..., slice(y - half, y + half + 1), slice(x - half, x + half + 1)) for x, y in centres]
        windows = sharp.light[cuts[0]].copy(), blurred.light[cuts[1]].copy()
        colours = sharp.colours[cuts[0]].copy(), blurred.colours[cuts[1]].copy()
        for picture, window in zip(pictures, windows, strict=True):
            if (count := len(find_dots(window, file=str(picture.file)))) > 1:
                text = f"{count} dots in a window of {2 * half + 1} px: print the dots farther apart than their blur"
                raise FitError(text, "several dots", str(picture.file))
        yield Capture(
            *windows,
            files=(str(sharp.file), blurred_file),
            white=sharp.white,
            position_px=(round(both[0].x - sharp.middle[0], 2), round(both[0].y - sharp.middle[1], 2)),
            colours=colours if by_colour else None,
            **facts,
        )


def _size(picture: Array) -> str:
    """Width x height, for messages."""
    return f"{picture.shape[1]}x{picture.shape[0]}"


def _matched(sharp: CameraPicture, blurred: CameraPicture, magnification: float) -> list[tuple[Dot, Dot]]:
    """Pairs the dots of a grid in both pictures, from the centre outwards: each moves on its line to the centre."""
    sharp_dots, blurred_dots = (find_dots(f.light, file=str(f.file), smallest=0.3) for f in (sharp, blurred))
    (centre_x, centre_y), pairs = sharp.middle, []
    for dot in sorted(sharp_dots, key=lambda d: math.hypot(d.x - centre_x, d.y - centre_y)):
        x, y = centre_x + magnification * (dot.x - centre_x), centre_y + magnification * (dot.y - centre_y)
        away, nearest = min(((math.hypot(d.x - x, d.y - y), d) for d in blurred_dots), key=lambda one: one[0])
        spacing = min((math.hypot(d.x - dot.x, d.y - dot.y) for d in sharp_dots if d is not dot), default=math.inf)
        if away < 0.4 * magnification * spacing:
            pairs.append((dot, nearest))
    if not pairs:
        text = f"none of the {len(sharp_dots)} dots of {sharp.file.name} is found again; are the distances right?"
        raise FitError(text, "no dot", str(blurred.file))
    return pairs
