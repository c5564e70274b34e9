"""Pictures of a dot, in focus and at other distances, and the camera that took them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from torchdof.optics.camera import Camera
from torchdof.validation import number, show

from ..problems import FitError, checked
from ..result import Array

RANGES = {  # wider than any camera's
    **{"focus_m": (1e-5, 1e6), "distance_m": (1e-5, 1e6), "exposure_s": (1e-9, 1e7)},
    **{"focal_length_mm": (1e-3, 1e6), "f_number": (1e-2, 1e4), "sensor_width_mm": (1e-3, 1e5)},
    **dict.fromkeys(("width_px", "full_width_px"), (1, 2**31)),
}
CAMERA = ("focal_length_mm", "f_number", "sensor_width_mm")


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
            independent directions. The effect on the fit is included in the standard errors.
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
        if not isinstance(self.pairs, Sequence) or not all(isinstance(p, Capture) for p in self.pairs):
            raise FitError(f"pairs must be a tuple of Capture(sharp, blurred, distance_m), got {show(self.pairs)}")
        if not self.pairs:
            raise FitError("captures hold no pair of pictures; photograph the dot at one more distance at least")
        check_distances([p.distance_m for p in self.pairs], self.focus_m, None)
        for name in ("width_px", *CAMERA):
            value = getattr(self, name)
            if value is not None or name == "width_px":
                checked(number, name, value, *RANGES[name])

    def __iter__(self) -> Iterator[Capture]:
        return iter(self.pairs)

    def __len__(self) -> int:
        return len(self.pairs)

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


def check_distances(distances: Sequence[float], focus: float, where: str | None) -> None:
    """Raises an error if distances are not positive and increasing, or one equals the focus."""
    checked(number, "focus_m", focus, 0, 1e100, "metres")
    for previous, distance in zip([0.0, *distances], distances, strict=False):
        checked(number, "distance_m", distance, -1e100, 1e100, "metres")
        if not previous < distance:
            text = f"distances must be positive and increasing, got {', '.join(f'{d:g}' for d in distances)} m"
            raise FitError(text, "distance", file=where, number=float(distance))
        if distance == focus:
            text = f"a shot lies at the focus ({focus:g} m) and has no blur"
            raise FitError(text, "distance", file=where, number=focus)
