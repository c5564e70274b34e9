"""Options for focus and lens: their meaning, their defaults, contradictions between them, and the camera they make."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from ..io.metadata import camera_settings
from ..io.sequence import focus_at_frame, parse_focus
from .command import Group, Parsed, numbers, option, refuse

if TYPE_CHECKING:
    from torch import Tensor

    from ..optics.camera import Camera
    from .frame import Frame

_DEFAULTS = {"focal_length_mm": 50.0, "f_number": 2.8, "sensor_width_mm": 36.0}
_LABELS = dict(zip(_DEFAULTS, ("focal length", "f-number", "sensor width"), strict=True))
_PHONE_MM, _PHONE_EQUIVALENT_MM = 10.0, 26.0  # a lens shorter than this is a phone's, whose main lens is like this one
_DEFAULT_BLUR, _VISIBLE_BLUR = 0.02, 0.005  # largest blur radius over the width: by default; the smallest visible one
_PER_OUTLIER, _MAX_SAMPLES = 1000, 2**20  # one pixel in 1000 is ignored as an outlier; most pixels examined


class Area(NamedTuple):
    """Place of an image (an EXR's data window) in the full frame (its display window), and that frame's size, in px."""

    x: int
    y: int
    width: int
    height: int

    def centred(self, values: "Tensor", size: Sequence[int]) -> "tuple[Tensor, Any]":
        """A map of an image of a size, padded so that the optical axis is in its middle, and the map's index in it."""
        from torch.nn.functional import pad

        (height, width), (rows, columns) = size, values.shape[-2:]
        across = round((self.width - 2 * self.x - width) * columns / width)  # > 0: the axis is right of the middle
        down = round((self.height - 2 * self.y - height) * rows / height)
        left, top = max(0, -across), max(0, -down)
        padded = pad(values, (left, max(0, across), top, max(0, down)))
        return padded, (..., slice(top, top + rows), slice(left, left + columns))

    def centred_camera(self, camera: "Camera", depth: "Tensor") -> "tuple[Camera, Tensor, Any]":
        """Camera and map with the optical axis in the middle of the map, and the index of ``depth`` in it."""
        padded, place = self.centred(depth, depth.shape[-2:])
        wide_mm = camera.sensor_width_mm * padded.shape[-1] / depth.shape[-1]
        return camera.replace(sensor_width_mm=wide_mm), padded, place

    def coc_px(self, camera: "Camera", depth: "Tensor") -> "Tensor":
        """As ``camera.coc_px``, with the axis of a tilted lens in the middle of the full frame."""
        wide, padded, place = self.centred_camera(camera, depth)
        return wide.coc_px(padded, padded.shape[-1])[place]


def _width_fraction(text: str) -> float:
    """Reads a percentage of the width, as a fraction; without the sign, numbers below 1 could be fractions already."""
    share = float(text.removesuffix("%")) / 100
    if not (0 < share <= 0.5 and (text.endswith("%") or share >= 0.01)):
        raise ValueError
    return share


def _f_number(text: str) -> float:
    """Reads an f-number, as ``1.8`` or ``f/1.8``."""
    return float(re.sub(r"^\s*[fF]/?", "", text))


def _equivalent(text: str) -> tuple[float, ...]:
    """Reads a focal length and an f-number, as ``85mm,1.4`` or ``85 f/1.4``."""
    return numbers(2)(re.sub(r"\s*(mm)?\s*[, ]\s*(f/?)?", ",", text, count=1))


class Sensor(Group):
    """Focus and lens."""

    focal_length_mm: float | None = option("Real focal length, not the 35 mm equivalent.")
    sensor_width_mm: float | None = option("36 for full frame.")
    fov_deg: float | None = option(
        "Horizontal field of view of a rendered image, instead of a lens.", type=click.FloatRange(0, 180, True, True)
    )


class Lens(Sensor):
    """Focus and lens."""

    focus_m: list[tuple[int, float]] | None = option(
        "Distance in focus (inf allowed), or keyframes frame:metres such as 1:2.0,48:5.5, linear in 1/distance.",
        type=Parsed("METRES", parse_focus, "2.0, or keyframes frame:metres such as 1:2.0,48:5.5, all positive"),
        basic=True,
    )
    focus_at: tuple[tuple[float, float], ...] = option(
        "Focus on the surface at this pixel from the top left; given several times, on all between the nearest and the "
        "farthest of them. Default: as the file states, else on the subject.",
        (),
        type=Parsed("X,Y", numbers(2), "320,200"),
        multiple=True,
        basic=True,
    )
    focus_range: tuple[float, float] | None = option(
        "Distances in metres between which all is in focus.", type=Parsed("NEAR,FAR", numbers(2), "1.5,2.2")
    )
    focus_range_at: tuple[float, float, float, float] | None = option(
        "Pixels of two surfaces between which all is in focus.", type=Parsed("X,Y,X,Y", numbers(4), "320,200,410,220")
    )
    tilt: float = option("Degrees by which the lens is tilted down: focus comes nearer towards the bottom.", 0.0)
    swing: float = option("Degrees to the right: focus comes nearer towards the right.", 0.0)
    f_number: float | None = option("Smaller is blurrier.", type=Parsed("N", _f_number, "1.8 or f/1.8"), basic=True)
    blur: float | None = option(
        "Open the lens until the largest blur radius is this share of the width, such as 2%; instead of --f-number.",
        type=Parsed("SHARE%", _width_fraction, "2%, above 0 and at most 50%"),
        basic=True,
    )
    equivalent: tuple[float, float] | None = option(
        "Full-frame lens that the picture is taken to be from, such as 85mm,1.4.",
        type=Parsed("MM,F", _equivalent, "85mm,1.4"),
        basic=True,
    )
    aperture_radius_m: float | None = option("Radius of the opening, with --fov-deg.")

    def __post_init__(self) -> None:
        super().__post_init__()
        for names, problem in (
            (("focus_m", "focus_at", "focus_range", "focus_range_at"), "both say where to focus"),
            (("fov_deg", "equivalent", "focal_length_mm"), "say the same"),
            (("fov_deg", "equivalent", "sensor_width_mm"), "say the same"),
            (("f_number", "aperture_radius_m", "equivalent", "blur"), "both say how wide the lens opens"),
        ):
            given = [f"--{name.replace('_', '-')}" for name in names if getattr(self, name) not in (None, ())]
            refuse((len(given) > 1, f"{' and '.join(given)} {problem}; give one of them"))
        has_radius = self.fov_deg is None and self.aperture_radius_m is not None
        refuse((has_radius, "--aperture-radius-m goes with --fov-deg; a real lens has --f-number instead"))

    @property
    def has_focus(self) -> bool:
        """Whether an option sets the focus."""
        return bool(self.given(Lens) & {"focus_m", "focus_at", "focus_range", "focus_range_at"})

    def refuse_keyframes(self) -> None:
        """Refuse keyframes of the focus, for a command that renders a single image."""
        has_keys = len(self.focus_m or []) > 1
        refuse((has_keys, "--focus-m has keyframes but IMAGE is a single image; give one distance in metres"))

    def view_deg(self, metadata: Mapping[str, Any], width: int, area: Area, estimated_deg: float | None) -> float:
        """Horizontal field of view in degrees of an image, as stated, or from focal length and sensor, or estimated."""
        stated = self._stated(area)
        lens = _estimated(estimated_deg, stated, area) | camera_settings(metadata, area.width, area.height) | stated
        if self.fov_deg is not None:
            half = math.tan(math.radians(self.fov_deg) / 2)
        elif {"focal_length_mm", "sensor_width_mm"} <= set(lens):
            half = lens["sensor_width_mm"] / (2 * lens["focal_length_mm"])
        else:
            raise ValueError("--depth-kind distance needs --fov-deg, --equivalent, or focal length and sensor width")
        return 2 * math.degrees(math.atan(half * width / area.width))

    def _stated(self, area: Area) -> dict[str, float]:
        """Numbers of the lens that the options state."""
        if self.equivalent is not None:
            return dict(zip(_DEFAULTS, (*self.equivalent, _full_frame_mm(area)), strict=True))
        return {name: value for name in _DEFAULTS if (value := getattr(self, name)) is not None}

    def camera(self, frame: "Frame", number: int = 0, is_still: bool = True) -> "tuple[Camera, list[str]]":
        """The camera of one frame, and remarks on the source of the numbers that no option states.

        Options come before the file, and this before the subject of a still and ``_DEFAULTS``. In a sequence nothing is
        guessed, because guesses would differ from frame to frame.
        """
        from ..depth.guess import subject_m
        from ..optics.camera import Camera

        area, depth, is_to_scale = frame.area, frame.values, frame.scene.is_to_scale
        width, stated = depth.shape[-1], self._stated(area)
        in_file = camera_settings(frame.picture.metadata, area.width, area.height)
        focus_in_file = in_file.pop("focus_m", 0.0)
        has_view = {"focal_length_mm", "sensor_width_mm"} <= in_file.keys()
        estimated = {} if has_view else _estimated(frame.fov_x_deg, stated, area)
        lens: dict[str, Any] = _DEFAULTS | in_file | estimated | stated
        if (
            in_file.get("focal_length_mm", math.inf) < _PHONE_MM
            and "sensor_width_mm" not in in_file | estimated | stated
        ):
            lens["sensor_width_mm"] = _full_frame_mm(area) * in_file["focal_length_mm"] / _PHONE_EQUIVALENT_MM
        remarks, focus_m = list[str](), math.inf
        if self.focus_m is not None:
            focus_m = focus_at_frame(self.focus_m, number)
        elif not self.has_focus and is_to_scale and 1000 * focus_in_file > lens["focal_length_mm"]:
            focus_m = focus_in_file
            remarks.append("focus from the file")
        elif not self.has_focus and is_still:
            focus_m = subject_m(depth, frame.scene.relative_kind or "disparity")
            remarks.append("focus on what is nearest the middle")
        elif not self.has_focus:
            raise ValueError("where is the focus? give --focus-m METRES or --focus-at X,Y (the file does not say)")
        has_opening = bool(self.given(Lens) & {"f_number", "aperture_radius_m", "equivalent", "blur"})
        if self.fov_deg is not None and not has_opening:
            raise ValueError("--fov-deg needs the opening of the lens: --aperture-radius-m, --f-number or --blur")
        sources = {name: "from the file" if name in in_file else "assumed" for name in _DEFAULTS if name not in stated}
        sources |= {name: "from the depth file" for name in estimated}
        if self.fov_deg is None:
            camera = Camera(**lens, focus_m=focus_m)
        else:
            radius_m = 0.01 if self.aperture_radius_m is None else self.aperture_radius_m
            camera = Camera.from_fov(self.fov_deg, radius_m, focus_m)
            camera = camera.replace(f_number=camera.f_number if self.f_number is None else self.f_number)
        camera = camera.replace(focus_range_m=self.focus_range, tilt_deg=self.tilt, swing_deg=self.swing)
        camera = camera.replace(sensor_width_mm=camera.sensor_width_mm * (width / area.width))
        places, both = self.focus_at, self.focus_range_at
        if both is not None:
            places = (both[:2], both[2:])
        if places:
            wide, padded, (_, rows, columns) = area.centred_camera(camera, depth)
            points = [(x - area.x + columns.start, y - area.y + rows.start) for x, y in places]
            focused = wide.focus_at(padded, *points[0]) if len(points) == 1 else wide.focus_range_at(padded, points)
            camera = focused.replace(sensor_width_mm=camera.sensor_width_mm)
        share, is_open = self.blur, is_still and not has_opening and not (is_to_scale and self.given(Lens))
        largest_px = self._largest_coc_px(camera, depth, area) if share is not None or is_open else 0.0
        if is_open and not (is_to_scale and "f_number" in in_file and largest_px >= _VISIBLE_BLUR * width):
            share = _DEFAULT_BLUR
        if share is not None and largest_px > 0:
            camera = camera.replace(f_number=camera.f_number * largest_px / (share * width))
            sources["f_number"] = f"for a blur of {share:.0%} of the width" if is_open else ""
        if self.fov_deg is None:
            remarks += [f"{_LABELS[name]} {source}" for name, source in sources.items() if source]
        return camera, remarks

    def _largest_coc_px(self, camera: "Camera", depth: "Tensor", area: Area) -> float:
        """Largest blur radius in pixels at all keyframes of the focus, without the largest thousandth of the pixels."""
        cameras = [camera.replace(focus_m=metres) for _, metres in self.focus_m or []] or [camera]
        radii = [area.coc_px(at_key, depth).abs().nan_to_num(0.0).flatten() for at_key in cameras]
        sampled = [radius[:: 1 + radius.numel() // _MAX_SAMPLES] for radius in radii]
        return max(float(radius.kthvalue(radius.numel() - radius.numel() // _PER_OUTLIER).values) for radius in sampled)


def _estimated(fov_x_deg: float | None, stated: Mapping[str, float], area: Area) -> dict[str, float]:
    """Focal length and sensor width of a field of view, unless they are stated: by default of a full-frame camera."""
    if fov_x_deg is None:
        return {}
    widths = 1 / (2 * math.tan(math.radians(fov_x_deg) / 2))  # focal length over sensor width
    focal_mm, sensor_mm = stated.get("focal_length_mm"), stated.get("sensor_width_mm")
    if focal_mm is None:
        focal_mm = widths * (sensor_mm or _full_frame_mm(area))
    lens = {"focal_length_mm": focal_mm, "sensor_width_mm": sensor_mm or focal_mm / widths}
    return {name: value for name, value in lens.items() if name not in stated}


def _full_frame_mm(area: Area) -> float:
    """Width in mm of a full-frame sensor, whose longer side is 36 mm, for a frame in landscape or portrait."""
    return 36.0 * area.width / max(area.width, area.height)
