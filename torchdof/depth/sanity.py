"""Warnings if depth hardly fits the camera: a wrong unit would otherwise render without an error.

The renderer itself does not check, because the checks read values and would stall a GPU or break a compiled graph.
``torchdof render`` and ``torchdof inspect`` check each frame; other programs call :func:`check` where they read depth.
"""

import dataclasses
import math
import warnings
from typing import Any, Literal

import torch
from torch import Tensor

from ..optics.camera import Camera
from ..validation import one_channel
from .kinds import DepthKind

__all__ = ["DepthWarning", "Mistake", "check", "coc_mistakes", "depth_mistakes", "whole_numbers"]

_NUMBERS = ("focal_length_mm", "f_number", "sensor_width_mm")
_UNITS = {  # factors by which depth may be wrong: mm or cm taken for metres, or scaled twice
    0.001: "millimetres",
    0.01: "centimetres",
    1000.0: "1000 times too small for metres",
    100.0: "100 times too small for metres",
}
_RELATIVE = "--depth-kind relative --near-m METRES --far-m METRES"

# Limits at which depth or camera are suspicious
_SHARP_PX, _SHARP_WIDTHS = 1.0, 1e-3  # largest radius in focus: in px, and in image widths; the larger of both
_LARGE_WIDTHS, _LARGEST_WIDTHS = 1 / 8, 1.0  # image widths: a large radius, an impossible one (macro lenses reach 1/2)
_FAR_OFF_RATIO = 30.0  # ratio of focus to nearest or farthest depth beyond which a warning is given even without blur
_FAR_M, _NEAR_M = 500.0, 0.1  # m; all depth is farther than the first, or nearer than the second
_WIDEST_F_NUMBER = 0.5  # limit of an aplanatic lens in air
_SHORTEST_WIDTHS = 1 / 20  # shortest focal length in sensor widths: a field of view of 169 degrees


class DepthWarning(UserWarning):
    """Depth and camera hardly fit: a wrong unit, scale or kind of numbers is likely."""


@dataclasses.dataclass(frozen=True)
class Mistake:
    """A likely mistake in a depth map or its camera."""

    name: str
    message: str  # the observation, the likely mistake and its remedy


def check(depth: Tensor, camera: Camera, *, strict: bool = False) -> None:
    """Warns if a depth map hardly fits the camera: wrong units, a missing scale, relative depth taken for metres.

    It reads all values on their device and waits for the result: call it where depth is read, not in a training loop.
    Unusual but sensible input gives no warning: macro, astronomy, scenes wholly in focus.

    Args:
        depth: ``[B, 1, H, W]``, metres; ``inf`` and holes (NaN, zero, negative) are left out.
        camera: The camera; its numbers floats or ``[B]``.
        strict: Raise instead of warning.

    Raises:
        ValueError: If something looks like a mistake and ``strict``, or an argument is not as described.

    Example:
        >>> millimetres = torch.linspace(800.0, 5000.0, 96).expand(1, 1, 64, 96)
        >>> try:
        ...     check(millimetres, Camera(focus_m=2.0), strict=True)
        ... except ValueError as error:
        ...     print(str(error).partition("?")[0])
        the focus at 2 m is nearer than all depth (800 to 5000 m); is it millimetres (--depth-scale 0.001)
    """
    for mistake in depth_mistakes(depth, camera):
        if strict:
            raise ValueError(mistake.message)
        warnings.warn(mistake.message, DepthWarning, stacklevel=2)


def depth_mistakes(
    depth: Tensor, camera: Camera, kind: DepthKind | Literal["relative"] = "z", scale: float | None = None
) -> list[Mistake]:
    """Likely mistakes in a depth map and its camera, as :func:`check` takes them: at most one of each name.

    ``kind`` and ``scale`` are those of the conversion of the numbers to metres, for the advice in the message.
    """
    one_channel("depth", depth, "in metres")
    focus = camera.focus_range_m or (camera.focus_m, camera.focus_m)
    numbers = [torch.as_tensor(n, device="cpu").reshape(-1) for n in (*(getattr(camera, n) for n in _NUMBERS), *focus)]
    mistakes: dict[str, Mistake] = {}
    for item in range(max(depth.shape[0], *(x.numel() for x in numbers))):
        *lens, near, far = (float(x[min(item, x.numel() - 1)]) for x in numbers)
        # without tilt, because the checks below do not depend on the place in the frame
        of_item: dict[str, Any] = dict(zip(_NUMBERS, lens, strict=True), focus_range_m=(near, far))
        item_camera = camera.replace(**of_item, tilt_deg=0.0, swing_deg=0.0)
        for mistake in _mistakes(depth[min(item, depth.shape[0] - 1)], item_camera, kind, scale):
            mistakes.setdefault(mistake.name, mistake)
    return list(mistakes.values())


def coc_mistakes(coc_px: Tensor) -> list[Mistake]:
    """Likely mistakes in a map of the circle of confusion, ``[B, 1, H, W]`` in pixels."""
    one_channel("coc_px", coc_px, "in pixels")
    size, width = coc_px[coc_px.isfinite()].abs(), coc_px.shape[-1]
    if not size.numel() or _quantile(size, 0.99) <= _LARGEST_WIDTHS * width:
        return []
    radius = f"a blur radius of {float(size.max()):.6g} px on an image of {width} px is more than a lens makes"
    return [Mistake("blur", f"{radius}; are these depths instead of circles of confusion? (--depth-kind)")]


def _mistakes(depth: Tensor, camera: Camera, kind: str, scale: float | None) -> list[Mistake]:
    """Likely mistakes of one map ``[1, H, W]`` and a camera of plain numbers.

    If nothing is in focus, or the focus is far from all depth, only that is reported.
    """
    width, focus_m, valid = depth.shape[-1], float(camera.focus_m), depth.detach()[depth > 0]
    if not valid.numel():
        return []
    blur = camera.coc_px(valid.reshape(1, 1, 1, -1), width).abs()
    smallest, largest = map(float, blur.aminmax())
    finite = valid[valid < math.inf] if bool((valid < math.inf).any()) else valid
    near, far = map(float, finite.aminmax())
    extent = f"({near:.4g} to {far:.4g} m)" if near < far else f"({near:.4g} m)"
    is_whole = far <= 65535 and whole_numbers(finite)
    sharp_px = max(_SHARP_PX, _SHARP_WIDTHS * width)
    is_wide_open = float(camera.f_number) < _WIDEST_F_NUMBER and largest > _LARGE_WIDTHS * width
    is_too_blurred = is_wide_open or _quantile(blur, 0.99) > _LARGEST_WIDTHS * width
    is_sharp, is_within = smallest <= sharp_px, near <= focus_m <= far
    factor = next((factor for factor in _UNITS if near * factor <= focus_m <= far * factor), None)
    is_far_off = factor is not None and not near / _FAR_OFF_RATIO <= focus_m <= far * _FAR_OFF_RATIO
    observed = "" if is_sharp else "nothing is in focus: "
    if is_within and not is_sharp and not is_too_blurred:
        problem = f"no pixel lies near the focus at {focus_m:.4g} m, all {extent}"
        return [Mistake("gap", f"{observed}{problem}; focus on something with --focus-at X,Y")]
    if (not is_sharp and not is_within) or is_far_off:
        side, hints = "nearer" if focus_m < near else "farther", []
        if kind in ("disparity", "inverse"):
            hints.append(
                "disparity needs its scale, the baseline in metres times the focal length in pixels (--depth-scale, "
                f"{'not given' if scale is None else f'now {scale:g}'}); if it is unknown, {_RELATIVE}"
            )
        elif kind != "relative" and is_whole and far <= 255:
            hints.append(f"its whole numbers are those of a file of 8 bits; if they are relative depth, {_RELATIVE}")
        elif kind != "relative" and 0.9 < far <= 1.0 and focus_m > far:
            hints.append(f"if these are relative depth from 0 to 1, {_RELATIVE}")
        elif kind != "relative" and factor is not None:
            hints.append(f"is it {_advice(factor, scale)}?")
            if factor > 1.0 and far >= _NEAR_M and scale is None:
                hints.append(f"or is the focus in {_UNITS[1.0 / factor]} (--focus-m {focus_m / factor:.4g})?")
        if kind in ("z", "distance") and focus_m < near:
            hints.append("if near has large values in it, it is disparity (--depth-kind disparity)")
        if far < _NEAR_M:
            hints.append("all of it lies within a hand's breadth")
        hints.append("if the depth is right, focus with --focus-m METRES or --focus-at X,Y")
        message = f"{observed}the focus at {focus_m:.4g} m is {side} than all depth {extent}; {'; '.join(hints)}"
        return [Mistake("focus", message)]
    mistakes, focal_mm, sensor_mm = [], float(camera.focal_length_mm), float(camera.sensor_width_mm)
    is_8_bit, is_unit_range = is_whole and far <= 255 and far - near >= 64, 0.9 < far <= 1.0 and near < 0.05
    if kind != "relative" and (is_8_bit or is_unit_range):
        description = f"whole numbers {extent}, as files of 8 bits hold" if is_8_bit else f"between 0 and 1 {extent}"
        mistakes.append(Mistake("bits", f"all depth is {description}; if it is relative, {_RELATIVE}"))
    elif _quantile(finite, 0.05) > _FAR_M and largest <= sharp_px and (is_whole or focus_m < math.inf):
        unit = _advice(0.001, scale)
        message = f"all depth is far {extent}, and nothing is blurred; is it {unit}? The focus too is in metres"
        mistakes.append(Mistake("far", message))
    lens = f"{focal_mm:.4g} mm on a sensor of {sensor_mm:.4g} mm"
    if is_too_blurred:
        mistakes.append(
            Mistake(
                "blur",
                f"a blur radius of {largest:.6g} px on an image of {width} px is more than a lens makes: the depth "
                f"{extent}, the focus {focus_m:.4g} m, the opening {2 * float(camera.aperture_radius_m):.4g} m across "
                f"(f/{float(camera.f_number):.2g}, {lens}); which is in another unit? --depth-scale, --focus-m and "
                "--aperture-radius-m make or take metres, --focal-length-mm and --sensor-width-mm millimetres",
            )
        )
    if focal_mm < _SHORTEST_WIDTHS * sensor_mm:
        problem = f"a focal length of {lens} is shorter than any lens's"
        mistakes.append(Mistake("lens", f"{problem}; --focal-length-mm and --sensor-width-mm take millimetres"))
    return mistakes


def _advice(factor: float, scale: float | None) -> str:
    """The unit of depth that ``factor`` converts to metres, and the option that does so."""
    total = factor * (1.0 if scale is None else scale)
    remedy = "leave --depth-scale out" if math.isclose(total, 1.0) else f"--depth-scale {total:.4g}"
    return f"{_UNITS[factor]} ({remedy})"


def _sample(values: Tensor) -> Tensor:
    """About 65,536 of the values, evenly spaced, or all if there are fewer."""
    return values.flatten()[:: max(1, values.numel() // 65536)]


def whole_numbers(values: Tensor) -> bool:
    """Whether a sample has at least 16 different values, all of them whole numbers."""
    sample = _sample(values)
    return bool((sample == sample.round()).all()) and sample.unique().numel() >= 16


def _quantile(values: Tensor, share: float) -> float:
    """Quantile of a sample of the values."""
    return float(_sample(values).float().quantile(share, interpolation="lower"))
