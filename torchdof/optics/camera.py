"""Depth in metres to the signed circle of confusion in pixels: the thin lens.

Sign and axis conventions are stated here once; every other module links to this one.

* Depth ``z`` is measured along the optical axis (not along the ray), in metres, ``> 0``; ``+inf`` is allowed.
* The circle of confusion (coc) is a signed **radius** in pixels of the image at hand: negative in front of the focus
  plane, 0 on it, positive behind it.
* ``coc_px = (A / 2) * F * (1/s - 1/z)`` with ``A`` the aperture diameter [m], ``s`` the focus distance [m] and ``F``
  the image distance over the pixel pitch [px]. For a camera of focal length ``f``, f-number ``n`` and sensor width
  ``w``: ``A = f / n``, image distance ``s f / (s - f)``, pitch ``w / width``.
* A lens whose axis points ``swing`` to the right and ``tilt`` down, while the sensor stays, is in focus on a plane
  through the focus distance on the image's axis (Scheimpflug): ``1/s`` above becomes ``1/s + (n_x x + n_y y) / (F f)``,
  with ``(n_x, n_y) = (sin swing cos tilt, sin tilt)`` and ``(x, y)`` the pixel's place from the image's centre, to the
  right and down. The image distance is that of the lens when it is straight.
* ``focus_range_m=(near, far)`` is sharp between both distances. Nearer than ``near`` the blur is that of a lens focused
  on ``near``; farther than ``far``, that of a lens focused on ``far``.

Reference:
    Potmesil and Chakravarty, "A lens and aperture camera model for synthetic image generation", SIGGRAPH 1981.
    Merklinger, "Focusing the View Camera", 1996 (the hinge rule).
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .. import native
from ..tensors import floating, is_in_memory, is_traced
from ..validation import (
    are_finite,
    engine_reads,
    holds,
    number,
    numbers,
    one_channel,
    pixels_wide,
    real_tensor,
    show,
    whole,
)

__all__ = ["Camera"]

_MAY_BE_INFINITE = ("focus_m", "focus_range_m")
_NUMBERS = ("focal_length_mm", "f_number", "focus_m", "sensor_width_mm")

Number = float | Tensor


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A thin lens in front of a sensor. Every number may be a float or a tensor ``[B]``, one value a batch item.

    A tensor may be an ``nn.Parameter`` and then gets gradients. But a camera is not a module, so ``parameters()`` of a
    :class:`torchdof.DepthOfField` does not list it: register it in your own module.

    Args:
        focal_length_mm: Focal length in millimetres, > 0.
        f_number: Focal length over aperture diameter, > 0.
        focus_m: Distance of the focus plane in metres, longer than the focal length; ``inf`` focuses at infinity.
        sensor_width_mm: Width of the part of the sensor that the image shows, in millimetres, > 0.
        focus_breathing: True for a real lens, whose image distance ``s f / (s - f)`` grows (and whose field of view
            narrows) as it focuses nearer. False for the convention of computer graphics, which keeps the field of view.
        focus_range_m: ``(near, far)``: everything between these distances is in focus, and blur grows outside of them.
            It replaces ``focus_m``, which becomes the distance halfway in ``1 / z``. None focuses on ``focus_m``.
        tilt_deg: Degrees by which the lens points down, in (-90, 90): with a positive tilt the plane in focus comes
            nearer towards the bottom of the image, as along the ground. The sensor stays upright.
        swing_deg: Degrees by which the lens points to the right: focus comes nearer towards the right.

    Raises:
        ValueError: If a number is out of its range, or the focus is not beyond the focal length of a breathing lens.

    Example:
        >>> camera = Camera(focal_length_mm=50.0, f_number=1.8, focus_m=2.0)
        >>> depth = torch.tensor([1.0, 2.0, float("inf")]).reshape(1, 1, 1, 3)
        >>> [round(x, 2) for x in camera.coc_px(depth, width=1920).flatten().tolist()]
        [-18.99, 0.0, 18.99]
    """

    focal_length_mm: Number = 50.0
    f_number: Number = 2.8
    focus_m: Number = 2.0
    sensor_width_mm: Number = 36.0
    focus_breathing: bool = True
    focus_range_m: tuple[Number, Number] | None = None
    tilt_deg: Number = 0.0
    swing_deg: Number = 0.0

    def __post_init__(self) -> None:
        if self.focus_range_m is not None:
            given = self.focus_range_m
            if not isinstance(given, tuple | list) or len(given) != 2:
                raise ValueError(f"focus_range_m must be (near, far) in metres, got {show(given)}")
            for end in given:
                _check_number("focus_range_m", end)
            near, far = given
            if not is_traced() and not bool(torch.as_tensor(near <= far, device="cpu").all()):
                raise ValueError(f"focus_range_m must go from near to far, got ({_show(near)}, {_show(far)})")
            dioptres = 1.0 / near + 1.0 / far
            halfway = 2.0 / dioptres if isinstance(dioptres, Tensor) or dioptres > 0 else math.inf
            object.__setattr__(self, "focus_range_m", (near, far))
            object.__setattr__(self, "focus_m", halfway)
        for name in ("tilt_deg", "swing_deg"):
            _check_number(name, getattr(self, name), -90.0, 90.0)
        for name in _NUMBERS:
            _check_number(name, getattr(self, name))
        if not isinstance(self.focus_breathing, bool):
            raise ValueError(f"focus_breathing must be True or False, got {show(self.focus_breathing)}")
        if self.focus_breathing and not is_traced():
            ratio = self.focal_length_mm / 1000.0 / self.focus_m
            if (float(ratio.detach().max()) if isinstance(ratio, Tensor) else ratio) >= 1.0:
                focal = f"the focal length ({_show(self.focal_length_mm)} mm)"
                raise ValueError(f"focus_m must be longer than {focal}, got {_show(self.focus_m)} m")

    @classmethod
    def from_fov(cls, fov_x_deg: Number, aperture_radius_m: Number, focus_m: Number) -> "Camera":
        """Camera of a rendered image: ``F = (width / 2) / tan(fov_x / 2)`` whatever the focus.

        The focal length is the equivalent one on a sensor 36 mm wide, so that the f-number is defined.

        Args:
            fov_x_deg: Horizontal field of view in degrees, in (0, 180).
            aperture_radius_m: Radius of the aperture in metres, > 0.
            focus_m: Distance of the focus plane in metres, > 0; ``inf`` allowed.

        Raises:
            ValueError: If a number is outside its range.

        Example:
            >>> round(Camera.from_fov(fov_x_deg=40.0, aperture_radius_m=0.012, focus_m=2.0).focal_px(768), 6)
            1055.031329
        """
        _check_number("fov_x_deg", fov_x_deg, low=1e-9, high=180.0)
        _check_number("aperture_radius_m", aperture_radius_m)
        angle = fov_x_deg * (math.pi / 180.0) / 2
        half = torch.tan(angle) if isinstance(angle, Tensor) else math.tan(angle)
        focal_length_mm = 18.0 / half
        f_number = focal_length_mm / (2000.0 * aperture_radius_m)
        return cls(focal_length_mm, f_number, focus_m, 36.0, focus_breathing=False)

    @property
    def aperture_radius_m(self) -> Number:
        """Radius of the aperture, ``f / (2 n)``, in metres."""
        return self.focal_length_mm / (2000.0 * self.f_number)

    def focal_px(self, width: int) -> Number:
        """Image distance over pixel pitch, in pixels of an image ``width`` pixels wide (``F`` of the convention)."""
        pixels_wide(width)
        focal_px = self.focal_length_mm * (width / self.sensor_width_mm)
        if self.focus_breathing:
            focal_px = focal_px / (1.0 - self.focal_length_mm / 1000.0 / self.focus_m)
        return focal_px

    def coc_px(self, depth: Tensor, width: int) -> Tensor:
        """Signed radius of the circle of confusion.

        The result is exactly 0 at ``z = s`` and exactly ``(A / 2) F / s`` at infinity.

        Args:
            depth: ``[B, 1, H, W]`` (or ``[1, 1, H, W]``, broadcast over the camera's batch), metres, > 0, ``inf``
                allowed. Half precision is computed in float32. Other values are not refused here.
            width: Width in pixels of the image the coc is meant for.

        Returns:
            ``[B, 1, H, W]`` in pixels; negative in front of the focus plane, positive behind it, NaN where the depth is
            not > 0. Differentiable with respect to depth and to every tensor of the camera; NaN pixels have gradient 0.

        Raises:
            ValueError: If the depth is not a floating-point tensor, or its batch does not fit the camera's.
        """
        real_tensor("depth", depth, "in metres")
        compiled = self._compiled_coc_px(depth, width)
        if compiled is not None:
            return compiled
        z = depth if depth.dtype in (torch.float32, torch.float64) else depth.float()
        is_valid = z > 0
        z = torch.where(is_valid, z, 1.0)
        scale = _as_map(self.aperture_radius_m * self.focal_px(width), z)
        shift = self._tilted_dioptres(z, width)
        if self.focus_range_m is None:
            dioptres = _dioptres_behind(z, _as_map(self.focus_m, z)) + shift
        else:
            near, far = (_dioptres_behind(z, _as_map(end, z)) + shift for end in self.focus_range_m)
            dioptres = near.clamp(max=0.0) + far.clamp_min(0.0)
        return torch.where(is_valid, scale * dioptres, torch.nan)

    def refuse_overflow(self, coc_px: Tensor, depth: Tensor) -> None:
        """Refuse a circle of confusion of a depth if it overflowed; the message has the numbers of the lens."""
        if not holds(coc_px, are_finite):
            stated = ", ".join(f"{name} {_show(getattr(self, name))}" for name in _NUMBERS)
            checked = f"this lens ({stated}) and the depth, which starts at {float(depth.detach().min()):.3g} m"
            raise ValueError(f"depth and lens must give a finite blur radius, got an infinite one: check {checked}")

    def refuse_other_batch(self, count: int) -> None:
        """Refuse numbers ``[B]`` for another number of images than ``count``; the message names them."""
        for name, value in vars(self).items():
            if name == "focus_m" and self.focus_range_m is not None:
                continue  # is computed from the range
            for given in value if isinstance(value, tuple) else (value,):
                if isinstance(given, Tensor) and given.numel() not in (1, count):
                    images = f"[{count}], for {count} images" if count > 1 else "[1], for one image"
                    raise ValueError(f"{name} must be a number or {images}, got {list(given.shape)}")

    def _compiled_coc_px(self, depth: Tensor, width: int) -> Tensor | None:
        """:meth:`coc_px` by the compiled engine; None if it does not support the call (traced, batched, tilted)."""
        if not engine_reads(depth):
            return None
        distances = self.focus_range_m or (self.focus_m, self.focus_m)
        numbers = [self.aperture_radius_m * self.focal_px(width), *distances, self.tilt_deg, self.swing_deg]
        if any(isinstance(n, Tensor) and (n.numel() > 1 or not is_in_memory(n)) for n in numbers):
            return None
        scale, nearest, farthest, tilt, swing = (float(n) for n in numbers)
        return native.coc_px(depth, scale, nearest, farthest) if tilt == swing == 0.0 else None

    def _tilted_dioptres(self, depth: Tensor, width: int) -> Tensor | float:
        """Term that a tilted lens adds to ``1/s`` at each pixel, ``[B, 1, H, W]`` in 1/m; 0 for a straight lens."""
        tilt, swing = self.tilt_deg, self.swing_deg
        if not isinstance(tilt, Tensor) and not isinstance(swing, Tensor) and tilt == swing == 0.0:
            return 0.0
        tilt, swing = (torch.deg2rad(_as_map(angle, depth)) for angle in (tilt, swing))
        rows, columns = (
            torch.arange(n, dtype=depth.dtype, device=depth.device) + 0.5 - n / 2 for n in depth.shape[-2:]
        )
        pitch = width / depth.shape[-1] / _as_map(self.focal_px(width), depth)  # size of a pixel at a distance of 1
        along = torch.sin(swing) * torch.cos(tilt) * columns + torch.sin(tilt) * rows[:, None]
        return along * pitch / _as_map(self.focal_length_mm / 1000.0, depth)

    def replace(self, **changes: Any) -> "Camera":
        """The same camera with some numbers changed; names are those of the constructor.

        Raises:
            ValueError: If a new number is outside its range, or a focus distance is given where a range is in focus.
            TypeError: If a name is unknown.
        """
        if "focus_m" in changes and changes.get("focus_range_m", self.focus_range_m) is not None:
            raise ValueError("focus_m is given by the camera's focus_range_m, got both; remove it: focus_range_m=None")
        return dataclasses.replace(self, **changes)

    def focus_at(self, depth: Tensor, x: float, y: float, patch: int = 5) -> "Camera":
        """This camera focused on the surface at a pixel.

        Args:
            depth: ``[B, 1, H, W]``, metres. Zero, negative and NaN depths are left out; infinite ones count.
            x: Column, in pixels from the left edge (pixel centres lie at half-integers), in [0, W).
            y: Row, in pixels from the top edge, in [0, H).
            patch: Side of the square patch around the pixel, whose median counts.

        Returns:
            A camera whose ``focus_m`` is the median of each item's patch: a float for one item, else ``[B]``.

        Raises:
            ValueError: If the pixel lies outside the frame or the patch holds no valid depth.
        """
        one_channel("depth", depth, "in metres")
        whole("patch", patch, 1, 2**31)
        x, y = (number(f"{axis} of the focus point", value, unit="pixels") for axis, value in (("x", x), ("y", y)))
        height, width = depth.shape[-2:]
        if not (0 <= x < width and 0 <= y < height):
            raise ValueError(f"focus point ({x}, {y}) must lie in the frame of {width} x {height} pixels (x, y)")
        distance = depth
        at_infinity = dataclasses.replace(self, focus_m=math.inf, focus_range_m=None)
        shift = at_infinity._tilted_dioptres(depth, int(width))
        if isinstance(shift, Tensor):  # tilted: solve 1/s + shift (1 - f/s) = 1/z for s; the factor only if it breathes
            breathing = 1.0 - _as_map(self.focal_length_mm / 1000.0, depth) * shift if self.focus_breathing else 1.0
            distance = breathing / (1.0 / depth - shift)
        reach, medians = patch // 2, []
        rows, columns = (slice(max(0, int(middle) - reach), int(middle) + reach + 1) for middle in (y, x))
        for distances, is_valid in zip(distance[..., rows, columns], depth[..., rows, columns] > 0, strict=True):
            if not bool(is_valid.any()):
                area = f"within {reach} pixels of ({x}, {y}); choose another focus point"
                raise ValueError(f"depth must be > 0 where the focus lies, got no valid depth {area}")
            medians.append(distances[is_valid].median())
        if not all(float(median) > 0 for median in medians):
            raise ValueError(f"no focus brings the depth at ({x}, {y}) onto the tilted plane; tilt less")
        return self.replace(focus_m=float(medians[0]) if len(medians) == 1 else torch.stack(medians))

    def focus_range_at(self, depth: Tensor, points: Sequence[tuple[float, float]], patch: int = 5) -> "Camera":
        """This camera with all in focus between the nearest and the farthest of the surfaces at some pixels.

        Args:
            depth: As in :meth:`focus_at`.
            points: Pixels ``(x, y)``, at least one, each as in :meth:`focus_at`.
            patch: As in :meth:`focus_at`.

        Returns:
            A camera whose ``focus_range_m`` spans the focus distances of the points: floats for one item, else ``[B]``.

        Raises:
            ValueError: If there is no point, a pixel lies outside the frame, or its patch holds no valid depth.

        Example:
            >>> depth = torch.tensor([2.0, 5.0, 3.0]).expand(1, 1, 2, 3)
            >>> Camera().focus_range_at(depth, [(2, 1), (0, 1)], patch=1)
            Camera(50 mm, f/2.8, focus 2 to 3 m, sensor 36 mm)
        """
        pairs = numbers("points", points)
        if pairs.ndim != 2 or pairs.shape[0] < 1 or pairs.shape[1] != 2:
            raise ValueError(f"points must be pixels (x, y), at least one, got {show(points)}")
        at_point = self.replace(focus_range_m=None)
        found = [at_point.focus_at(depth, x, y, patch).focus_m for x, y in pairs.tolist()]
        if isinstance(found[0], Tensor):
            distances = torch.stack([torch.as_tensor(distance) for distance in found])
            return self.replace(focus_range_m=(distances.amin(0), distances.amax(0)))
        return self.replace(focus_range_m=(min(found), max(found)))

    def __repr__(self) -> str:
        focus = " to ".join(map(_show, self.focus_range_m or (self.focus_m,)))
        numbers = [f"{_show(self.focal_length_mm)} mm", f"f/{_show(self.f_number)}", f"focus {focus} m"]
        numbers.append(f"sensor {_show(self.sensor_width_mm)} mm")
        if not self.focus_breathing:
            numbers.append("fixed field of view")
        for name, angle in (("tilt", self.tilt_deg), ("swing", self.swing_deg)):
            if isinstance(angle, Tensor) or angle != 0.0:
                numbers.append(f"{name} {_show(angle)} degrees")
        return f"Camera({', '.join(numbers)})"


def _dioptres_behind(z: Tensor, s: Tensor) -> Tensor:
    """``1/s - 1/z``, exactly 0 at ``z = s``, for finite and infinite distances."""
    both_finite = torch.isfinite(z) & torch.isfinite(s)
    z_safe, s_safe = torch.where(both_finite, z, 1.0), torch.where(both_finite, s, 1.0)
    return torch.where(both_finite, (z_safe - s_safe) / z_safe / s_safe, 1.0 / s - 1.0 / z)


def _show(value: Number) -> str:
    values = [f"{x:.6g}" for x in (value.detach().flatten().tolist() if isinstance(value, Tensor) else [value])]
    return values[0] if len(values) == 1 else f"[{', '.join(values)}]"


def _check_number(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> None:
    """Refuse a number of the camera that is neither a float nor a tensor ``[B]``, or outside of ``(low, high)``."""
    smallest = largest = value
    if floating(value):
        real_tensor(name, value, "[B]")
        is_number = value.ndim <= 1 and value.numel() > 0
        if is_number and is_traced():
            return
        smallest, largest = value.detach().aminmax() if is_number else (low, high)
    else:
        is_number = isinstance(value, float) or (type(value) is int and value < 1e300)
    # compares with inf instead of math.isfinite: torch.compile can then treat the number as a variable
    infinite = name in _MAY_BE_INFINITE
    if not (is_number and low < smallest and (largest < high or (infinite and largest == high))):
        bounds = f"in ({low:g}, {high:g}) degrees" if high < math.inf else "positive" + " and finite" * (not infinite)
        got = _show(value) if is_number and not isinstance(value, int) else show(value)
        raise ValueError(f"{name} must be {bounds}, a float or a floating-point tensor [B], got {got}")


def _as_map(value: Number, like: Tensor) -> Tensor:
    """A camera number as ``[B, 1, 1, 1]`` or a scalar, in the dtype of ``like``; its batch must fit ``like``."""
    if not isinstance(value, Tensor):
        return torch.as_tensor(value, dtype=like.dtype, device=like.device)
    value = value.to(dtype=like.dtype, device=like.device)
    if value.ndim == 0 or value.numel() == 1:
        return value.reshape(())
    if like.ndim != 4 or (like.shape[0] != value.shape[0] and like.shape[0] != 1):
        images = f"one for each of the {like.shape[0]} maps" if like.ndim == 4 else "and depth [B, 1, H, W]"
        got = f"{value.shape[0]} numbers and depth {list(like.shape)}"
        raise ValueError(f"a number of the camera must be a float or a tensor [B], {images} of depth, got {got}")
    return value.reshape(-1, 1, 1, 1)
