"""From the arguments of a command, as typed, to settings: words, numbers and files are read and checked."""

import dataclasses
import operator
from collections.abc import Callable, Mapping
from typing import Any

from ..depth.holes import Fill
from ..io.sequence import parse_focus
from ..options import tolerance_of_text
from .settings import RenderSettings, depth_edges_of, load_aperture, load_table, pick_device

__all__ = ["settings_of"]

_OPENING = ("blades", "rotation", "curvature", "squeeze", "aperture", "vignetting")


def settings_of(arguments: Mapping[str, Any]) -> RenderSettings:
    """The settings that the user stated.

    Args:
        arguments: Those of a command, by name, before anything is done with them; what is None was not stated, and what
            is no setting is left out.

    Raises:
        ValueError: If one cannot be read, or two contradict each other.
        OSError: If the table or the picture of the aperture cannot be read.
    """
    names = {field.name for field in dataclasses.fields(RenderSettings)} - {"table"}
    stated = {}
    for argument, value in arguments.items():
        name, read = _READ.get(argument, (argument, None))
        if value is not None and name in names:
            stated[name] = value if read is None else read(value)
    if "table" in arguments:
        opening = load_aperture(*(arguments[name] for name in _OPENING))
        stated["table"] = load_table(arguments["table"], opening)
    return RenderSettings(**stated)


def _focus(focus_m: str | float) -> list[tuple[int, float]]:
    """Metres, or keyframes ``frame:metres``."""
    return parse_focus(focus_m) if isinstance(focus_m, str) else [(0, focus_m)]


def _point(text: str) -> tuple[float, float]:
    """A pixel ``X,Y``."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--focus-at expects a pixel X,Y such as 320,200, got {text!r}") from None
    return x, y


def _circle(text: str) -> tuple[float, float, float]:
    """A circle ``X,Y,RADIUS``."""
    try:
        x, y, radius = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--attention expects X,Y,RADIUS in pixels such as 320,200,80, got {text!r}") from None
    return x, y, radius


def _range(option: str, example: str) -> Callable[[str], tuple[float, float]]:
    """Reads two numbers, as of an option's example."""

    def read(text: str) -> tuple[float, float]:
        try:
            low, high = (float(part) for part in text.split(","))
        except ValueError:
            raise ValueError(f"{option} expects two numbers such as {example}, got {text!r}") from None
        return low, high

    return read


def _fill(text: str) -> Fill:
    """What holes are filled with: a word or metres."""
    if text == "nearest" or text == "far":
        return "nearest" if text == "nearest" else "far"
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"--fill-depth expects nearest, far or metres, got {text!r}") from None


_READ: dict[str, tuple[str, Callable[[Any], Any] | None]] = {
    "attention": ("attention", _circle),
    "bits": ("sample", None),
    "depth_edges": ("depth_edges", depth_edges_of),
    "device": ("device", pick_device),
    "fill_depth": ("fill", _fill),
    "focus_at": ("focus_at", _point),
    "focus_m": ("focus", _focus),
    "focus_range": ("focus_range", _range("--focus-range", "1.5,2.2")),
    "fov_deg": ("fov_x_deg", None),
    "no_occlusion": ("occlusion", operator.not_),
    "swing": ("swing_deg", None),
    "tilt": ("tilt_deg", None),
    "tolerance": ("tolerance", tolerance_of_text),
    "value_range": ("value_range", _range("--value-range", "0,255")),
}
"""Arguments that are read, or that settings call otherwise: the setting's name, and how it is read."""
